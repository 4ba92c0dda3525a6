# SPDX-License-Identifier: Apache-2.0
"""The unified action API against slow, readable twins and SciPy's rotations."""

import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation, Slerp

from wiw import action
from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError

plans = st.lists(st.integers(0, 4), max_size=40)
finite = st.floats(-5, 5)


def walk(actions, forward=0.2, turn=math.pi / 8):
    """The trajectory by complex numbers: position and heading as one would say them aloud."""
    position, heading, poses = 0j, 0.0, []
    for a in actions:
        if a == TURN_LEFT:
            heading += turn
        elif a == TURN_RIGHT:
            heading -= turn
        elif a == FORWARD:
            position += forward * complex(math.cos(heading), math.sin(heading))
        poses.append((position.real, position.imag, heading))
    return np.array(poses).reshape(-1, 3)


@given(plans)
def test_trajectory_equals_walking(actions):
    np.testing.assert_allclose(action.to_trajectory(actions), walk(actions), atol=1e-12)


@given(plans)
def test_viewpoints_equal_the_trajectory_in_the_camera_frame(actions):
    poses = action.to_viewpoints(actions)
    for T_start_camera, (x, y, azimuth) in zip(poses, walk(actions), strict=True):
        np.testing.assert_allclose(T_start_camera[:3, 3], [-y, 0, -x], atol=1e-12)
        expected = Rotation.from_euler("y", azimuth).as_matrix()
        np.testing.assert_allclose(T_start_camera[:3, :3], expected, atol=1e-12)


def test_batches_and_the_start():
    batch = np.array([[FORWARD, TURN_LEFT], [TURN_RIGHT, FORWARD]])
    both = action.to_trajectory(batch, include_start=True)
    assert both.shape == (2, 3, 3)
    assert both.dtype == np.float64
    np.testing.assert_array_equal(both[:, 0], 0)
    np.testing.assert_array_equal(both[1, 1:], action.to_trajectory(batch[1]))
    assert action.to_trajectory([]).shape == (0, 3)
    assert action.to_trajectory([], include_start=True).shape == (1, 3)


@pytest.mark.parametrize("shape", [(2, 0), (3, 2, 0), (0, 0), (0, 4), (2, 0, 4)])
def test_each_plan_has_one_start_however_short_and_few_the_plans(shape):
    plans = np.zeros(shape, int)
    full = (*shape[:-1], shape[-1] + 1)
    start = action.to_trajectory(plans, include_start=True)
    assert start.shape == (*full, 3) and not start.any()
    cameras = action.to_viewpoints(plans, include_start=True)
    np.testing.assert_array_equal(cameras, np.broadcast_to(np.eye(4), (*full, 4, 4)))
    assert action.to_trajectory(plans).shape == (*shape, 3)


def test_step_sizes_are_configurable():
    space = action.ActionSpace(forward_m=0.25, turn_deg=30)
    np.testing.assert_allclose(action.to_trajectory([2, 1], space), walk([2, 1], 0.25, math.radians(30)))
    assert "0.25 m" in action.to_text([1], space=space)
    assert pickle.loads(pickle.dumps(space)) == space
    with pytest.raises(ArgumentError, match="metres"):
        action.ActionSpace(forward_m=0)


@pytest.mark.parametrize(
    ("words", "others"),
    [
        (
            action.TextTemplate("[{actions}]", {FORWARD: "w"}, separator="é", merge_runs=True),
            [action.TextTemplate(), action.TextTemplate("[{actions}]", {FORWARD: "w"}, separator="é")],
        ),
        (
            action.GripperTextTemplate("[{actions}]", "{x}", "; "),
            [action.GripperTextTemplate(), action.GripperTextTemplate("[{actions}]", "{y}", "; "), None],
        ),
    ],
)
def test_text_templates_are_values(words, others):
    copy = pickle.loads(pickle.dumps(words))
    assert copy == words and copy is not words and hash(copy) == hash(words) and repr(copy) == repr(words)
    assert all(other != words and repr(other) != repr(words) for other in others)
    assert "0x" not in repr(words) and "[{actions}]" in repr(words)


def test_text_templates_can_be_replaced():
    words = action.TextTemplate("[{actions}]", {FORWARD: "w", TURN_LEFT: "a", TURN_RIGHT: "d"}, separator="")
    assert action.to_text([1, 1, 2, 3], words) == "[wwad]"
    default = action.to_text([1, 2])
    assert "0.2 m" in default
    assert "left 22.5" in default
    merged = action.TextTemplate("{actions}", {FORWARD: "{metres} m"}, merge_runs=True)
    assert action.to_text([1] * 3, merged) == "0.6 m"
    poses = np.array([[0.1, 0.2, 0.3, 0, 0, math.pi / 2, 1]])
    assert "(0.10, 0.20, 0.30)" in action.to_text(poses)
    with pytest.raises(ArgumentError, match="GripperTextTemplate"):
        action.to_text(poses, words)
    with pytest.raises(ArgumentError, match="actions"):
        action.to_text([1], action.TextTemplate("walk"))


@given(plans.filter(len))
def test_controls_look_each_action_up(actions):
    ids = {NULL: 7, FORWARD: 0, TURN_LEFT: 3, TURN_RIGHT: 4, STOP: 9}
    controls = action.to_controls(actions, ids)
    assert controls.dtype == np.int64
    assert controls.tolist() == [ids[action.Action(a)] for a in actions]
    with_null = action.to_controls(actions, ids, null_first=True)
    assert with_null.tolist() == [7, *controls.tolist()]
    vectors = {a.name.lower(): np.eye(5)[a] for a in action.Action}
    np.testing.assert_array_equal(action.to_controls([actions], vectors)[0], np.eye(5)[actions])


def test_unknown_actions_are_refused_by_name():
    with pytest.raises(ArgumentError, match=r"no entry for 'stop' \(it knows forward\)"):
        action.to_controls([STOP], {FORWARD: 1})
    with pytest.raises(ArgumentError, match="no entry for 'null'"):
        action.to_controls([FORWARD], {FORWARD: 1}, null_first=True)
    with pytest.raises(ArgumentError, match="jump"):
        action.to_controls([FORWARD], {"jump": 1})
    with pytest.raises(ArgumentError, match="one width"):
        action.to_controls([FORWARD], {FORWARD: [1], STOP: [1, 2]})
    with pytest.raises(ArgumentError, match="unknown action 5"):
        action.to_text([5])
    with pytest.raises(ArgumentError, match="integers"):
        action.to_trajectory([0.5])


@pytest.mark.parametrize("code", ["euler", "sin_cos", "matrix_6d", "quaternion_wxyz", "quaternion_xyzw"])
@given(poses=hnp.arrays(np.float64, (4, 7), elements=st.floats(-1.5, 1.5)))
@settings(max_examples=25)
def test_pose_vocabularies_equal_scipy(code, poses):
    rotation = Rotation.from_euler("xyz", poses[:, 3:6])
    xyzw = rotation.as_quat(canonical=True)
    wanted = {
        "euler": poses[:, 3:6],
        "sin_cos": np.stack([np.sin(poses[:, 3:6]), np.cos(poses[:, 3:6])], -1).reshape(4, 6),
        "matrix_6d": rotation.as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(4, 6),
        "quaternion_wxyz": xyzw[:, [3, 0, 1, 2]],
        "quaternion_xyzw": xyzw,
    }[code]
    got = action.to_controls(poses, action.GripperVocabulary(code, ([-2, -2, -2], [2, 4, 2])))
    np.testing.assert_allclose(got[:, :3], (poses[:, :3] + 2) / np.array([2, 3, 2]) - 1, atol=1e-12)
    np.testing.assert_allclose(got[:, 3:-1], wanted, atol=1e-9)
    np.testing.assert_array_equal(got[:, -1], poses[:, 6])


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 8), st.just(7)), elements=st.floats(-1.2, 1.2)), st.data())
def test_longer_plans_equal_linear_interpolation_and_scipys_slerp(poses, data):
    length = data.draw(st.integers(len(poses) + 1, 40))
    start = data.draw(st.none() | hnp.arrays(np.float64, 7, elements=st.floats(-1.2, 1.2)))
    got = action.resample(poses, length, start=start)
    knots = poses if start is None else np.vstack([start, poses])
    times = np.linspace(0, len(knots) - 1, length) if start is None else np.linspace(0, len(knots) - 1, length + 1)[1:]
    if len(knots) == 1:
        np.testing.assert_array_equal(got, np.repeat(knots, length, 0))
        return
    for axis in range(3):
        np.testing.assert_allclose(got[:, axis], np.interp(times, np.arange(len(knots)), knots[:, axis]), atol=1e-9)
    slerp = Slerp(np.arange(len(knots)), Rotation.from_euler("xyz", knots[:, 3:6]))
    error = (slerp(np.clip(times, 0, len(knots) - 1)).inv() * Rotation.from_euler("xyz", got[:, 3:6])).magnitude()
    assert error.max() < 1e-6
    held = np.floor(times + 1e-9).astype(int)
    np.testing.assert_array_equal(got[:, 6], knots[held, 6])
    np.testing.assert_array_equal(got[-1], poses[-1])


@given(st.integers(1, 30), st.data())
def test_shorter_plans_are_samples_of_the_given_poses(count, data):
    length = data.draw(st.integers(1, count))
    poses = np.arange(3.0 * count).reshape(count, 3)
    got = action.resample(poses, length)
    wanted = [round(i * (count - 1) / (length - 1)) for i in range(length)] if length > 1 else [count - 1]
    np.testing.assert_array_equal(got, poses[wanted])


@given(plans.filter(lambda p: len(p) > 1))
def test_viewpoints_and_trajectories_resample_alike(actions):
    length = 3 * len(actions)
    planar = action.resample(action.to_trajectory(actions), length, start=np.zeros(3))
    poses = action.resample(action.to_viewpoints(actions), length, start=np.eye(4)[None])
    positions = np.stack([-planar[:, 1], np.zeros(length), -planar[:, 0]], -1)
    np.testing.assert_allclose(poses[:, :3, 3], positions, atol=1e-9)
    wanted = Rotation.from_rotvec(planar[:, 2:] * [0, 1, 0]).as_matrix()
    np.testing.assert_allclose(poses[:, :3, :3], wanted, atol=1e-9)


def test_discrete_ids_are_never_interpolated():
    for ids in ([1, 2, 3], np.array([[1, 2, 3], [1, 1, 1]], np.int8)):
        with pytest.raises(ArgumentError, match="pad"):
            action.resample(ids, 14)
    with pytest.raises(ArgumentError, match="expected poses"):
        action.resample(np.zeros(5), 14)
    with pytest.raises(ArgumentError, match="length"):
        action.resample(np.zeros((5, 3)), 0)


@given(plans.filter(len), st.integers(1, 14), st.sampled_from(["forward", "repeat", "null"]))
def test_chunks_hold_the_plan_and_frames_lead_back_to_it(actions, length, padding):
    pieces = action.chunk(actions, length, padding)
    filler = {"forward": 1, "repeat": actions[-1], "null": 0}[padding]
    flat = pieces.ravel().tolist()
    assert flat[: len(actions)] == actions
    assert set(flat[len(actions) :]) <= {filler}
    for k, (piece, frame) in enumerate(action.frames_of_actions(len(actions), length + 1, "chunk")):
        assert pieces[piece, frame - 1] == actions[k]
    if len(actions) <= length:
        assert action.pad(actions, length, padding).tolist() == flat
        assert action.frames_of_actions(len(actions), length + 1)[:, 1].tolist() == list(range(1, len(actions) + 1))


@given(st.integers(1, 50), st.integers(2, 60))
def test_resampled_frames_show_the_plan_evenly(count, frames):
    found = action.frames_of_actions(count, frames, "resample")[:, 1]
    assert found[-1] == frames - 1
    moments = np.arange(1, count + 1) * (frames - 1) / count
    assert np.abs(found - moments).max() <= 0.5


# -- poses as whole numbers --------------------------------------------------------------------------------------------

GRID = action.PoseGrid()
WHOLE = st.tuples(*[st.integers(0, 99)] * 3, *[st.integers(0, 119)] * 3, st.integers(0, 1))


@given(WHOLE)
def test_numbers_stand_for_the_middle_of_their_bins(numbers) -> None:
    x, y, z, roll, pitch, yaw, gripper = GRID.decode(numbers)
    by_hand = [low + 0.01 * n + 0.005 for low, n in zip((-0.3, -0.5, 0.6), numbers[:3], strict=True)]
    assert (x, y, z, gripper) == pytest.approx((*by_hand, numbers[6]))
    assert np.degrees([roll, pitch, yaw]) == pytest.approx([3 * k - 180 for k in numbers[3:6]])
    assert GRID.encode(GRID.decode(numbers)).tolist() == list(numbers)


@given(
    st.tuples(st.floats(-0.3, 0.7), st.floats(-0.5, 0.5), st.floats(0.6, 1.6), *[st.floats(-7, 7)] * 3, st.floats(0, 1))
)
def test_poses_come_back_to_within_half_a_bin(pose) -> None:
    back = GRID.decode(GRID.encode(pose))
    assert np.abs(back[:3] - pose[:3]).max() <= 0.005 + 1e-9
    turned = np.angle(np.exp(1j * (back[3:6] - np.array(pose[3:6]))))
    assert np.degrees(np.abs(turned)).max() <= 1.5 + 1e-9
    assert back[6] == (pose[6] >= 0.5)


def test_numbers_off_the_grid_are_clamped_or_wrapped() -> None:
    np.testing.assert_allclose(GRID.decode([100, -1, 250, 120, -1, 240, 7]), GRID.decode([99, 0, 99, 0, 119, 0, 1]))
    assert GRID.encode([9, -9, 9, np.pi, -np.pi, 0, 0.4]).tolist() == [99, 0, 99, 0, 0, 60, 0]
    assert GRID.decode(np.zeros((2, 5, 7), int)).shape == (2, 5, 7)


@pytest.mark.parametrize(
    "call",
    [
        lambda: GRID.encode([np.nan] * 7),
        lambda: GRID.encode([0.0] * 6),
        lambda: GRID.decode([0.5] * 7),
        lambda: GRID.decode(3),
        lambda: action.PoseGrid(low=(0, 0, 0), high=(1, 0, 1)),
        lambda: action.PoseGrid(low=(0, 0)),
        lambda: action.PoseGrid(low=(0, 0), high=(1, 1)),
    ],
)
def test_what_the_grid_cannot_take_is_named(call) -> None:
    with pytest.raises(ArgumentError, match="PoseGrid"):
        call()
