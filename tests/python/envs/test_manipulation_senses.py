# SPDX-License-Identifier: Apache-2.0
"""What a manipulator can be given to sense, and many tables at a time."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st

import wiw
from wiw._core import core
from wiw.action import PoseGrid
from wiw.envs.manipulation import check_poses
from wiw.envs.manipulation_vector import ManipulationVectorEnv
from wiw.envs.sensors import ARM
from wiw.errors import ArgumentError
from wiw.tabletop.base import make_action
from wiw.tabletop.cloud import unproject_depth
from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.types import GRIPPER_POSES, Key, Proposal

ALL: dict[str, Any] = {
    "depth": True, "size": 60, "cameras": ("wrist", "left_shoulder", "right_shoulder"), "ids": True, "cloud": True,
}  # fmt: skip
POSE = [0.2, 0.05, 1.0, np.pi, 0.0, 0.3, 1.0]


def made(**options: Any) -> Any:
    return wiw.make("Manipulation-v0", **{"tasks": "stack_cups", "depth": False, "size": 60, **options})


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
@pytest.mark.parametrize("options", [ALL, {"grid": True}], ids=["everything", "grid"])
def test_gymnasium_finds_nothing_wrong(options: dict[str, Any]) -> None:
    check_env(made(**options), skip_render_check=True)


def test_every_camera_gives_what_is_asked_for() -> None:
    env = made(**ALL)
    observation, info = env.reset(options={"episode": 1})
    assert env.observation_space.contains(observation) and info["objects"] == tuple(env.table.objects)
    for camera in CAMERAS:
        names = [camera, "depth", "ids"] if camera == "front" else [camera, f"{camera}_depth", f"{camera}_ids"]
        alone = env.table.bench.render_view(camera, (60, 60), ("color", "depth"))
        np.testing.assert_array_equal(observation[names[0]], alone["color"])
        np.testing.assert_array_equal(observation[names[1]], alone["depth"])
        assert len({observation[names[2]].tobytes(), *(observation[other].tobytes() for other in CAMERAS)}) == 5
    assert made(size=448).reset()[0]["front"].shape == (448, 448, 3)
    assert {*made().reset()[0]} == {"front", "pose", "joints", "held"}


def test_policies_that_need_the_wrist_camera_are_given_it() -> None:
    class ByWrist(wiw.Policy):
        space, needs = GRIPPER_POSES, ("depth", "wrist")
        seen: ClassVar[list[Any]] = []

        def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
            self.seen += [each.observation for each in situations]
            return [[Proposal(np.array([POSE]))] for _ in situations]

    agent = wiw.Agent(ByWrist())
    log = wiw.evaluate("manipulation", agent, 1, tasks="stack_cups", actions=2, progress=False)
    assert [row["error"] for row in log.episodes] == [""] and len(ByWrist.seen) == 2
    first, bench = ByWrist.seen[0], made(size=480).unwrapped
    bench.begin(bench.task.episode(0))
    np.testing.assert_array_equal(first.wrist.T_world_camera, bench.table.bench.get_camera_pose("wrist"))
    alone = bench.table.bench.render_view("wrist", (480, 480), ("color", "depth"))
    np.testing.assert_array_equal(first.wrist.image, alone["color"])
    np.testing.assert_array_equal(first.as_dict()["wrist_depth"], alone["depth"])
    blind = made(depth=True)
    blind.reset(options={"episode": 0})
    with pytest.raises(ArgumentError, match=r"cameras=\('wrist',\)"):
        agent.decide(blind.observation, blind.goal, Key(0, 0))


def test_ids_number_the_objects() -> None:
    """The pixels of an object lie where it stands."""
    env = made(**{**ALL, "size": 240})
    observation, info = env.reset(options={"episode": 1})
    assert {*np.unique(observation["ids"])} == {0, 1, 2, 3, ARM}
    points = observation["points"][: 240**2].reshape(240, 240, 3)
    for number, name in enumerate(info["objects"], start=1):
        middle = points[observation["ids"] == number].mean(axis=0)
        np.testing.assert_allclose(middle[:2], env.table.bench.get_pose(name)[:2, 3], atol=0.05)


def test_points_lie_where_pixels_look() -> None:
    env = made(**ALL)
    observation, _ = env.reset(options={"episode": 1})
    count = 60 * 60
    assert observation["points"].shape == (4 * count, 3) and observation["points"].dtype == np.float32
    np.testing.assert_array_equal(observation["colors"][:count].reshape(60, 60, 3), observation["front"])
    back = CAMERAS["front"].project_points(observation["points"][:count], (60, 60)).reshape(60, 60, 2)
    columns, rows = np.meshgrid(np.arange(60) + 0.5, np.arange(60) + 0.5)
    np.testing.assert_allclose(back, np.stack([columns, rows], axis=-1), atol=2e-3)
    # All cameras see the same table's top.
    for place in range(4):
        heights = observation["points"][place * count : (place + 1) * count, 2]
        assert (np.abs(heights - TABLE) < 1e-3).mean() > 0.1


@given(st.integers(0, 2**32))
def test_points_are_those_of_a_slow_reading(key: int) -> None:
    draws = core.uniform(key, 30)
    turn = np.linalg.qr(draws[:9].reshape(3, 3) - 0.5)[0]
    camera = np.eye(4)
    camera[:3, :3], camera[:3, 3] = turn * np.sign(np.linalg.det(turn)), draws[9:12]
    depth, hfov = draws[12:27].reshape(3, 5).astype(np.float32), 30 + 100 * draws[27]
    depth[0, 0] = 0
    found = unproject_depth(depth, hfov, camera)
    focal = 2.5 / np.tan(np.radians(hfov / 2))
    for row, column in np.ndindex(3, 5):
        ray = np.array([(column + 0.5 - 2.5) / focal, (1.5 - row - 0.5) / focal, -1.0, 0.0]) * depth[row, column]
        np.testing.assert_allclose(found[row, column], (camera @ np.add(ray, [0, 0, 0, 1]))[:3], atol=1e-5)
    np.testing.assert_allclose(found[0, 0], camera[:3, 3], atol=1e-6)


def test_the_body_is_felt() -> None:
    env = made(tasks="slide_block")
    first, _ = env.reset(options={"episode": 0})
    x, y = env.table.bench.get_pose("block")[:2, 3]
    for pose in (make_action(x, y, 0.15, 1.0), make_action(x, y, 0.02, 1.0)):
        env.step(pose)
    holding, *_ = env.step(make_action(x, y, 0.02, 0.0))
    lifted, *_ = env.step(make_action(x, y, 0.2, 0.0))
    assert [each["held"] for each in (first, holding, lifted)] == [0, 1, 1]
    assert np.abs(lifted["joints"] - first["joints"]).max() > 0.05
    np.testing.assert_allclose(lifted["pose"][:3], make_action(x, y, 0.2, 0.0)[:3], atol=5e-3)


def test_whole_numbers_are_the_grids_poses() -> None:
    grid, one, other = PoseGrid(), made(grid=True), made()
    numbers = grid.encode(POSE)
    for env in (one, other):
        env.reset(options={"episode": 0})
    seen, *_ = one.step(numbers)
    same, *_ = other.step(grid.decode(numbers))
    np.testing.assert_array_equal(seen["front"], same["front"])
    np.testing.assert_array_equal(seen["pose"], same["pose"])
    assert one.action_space.contains(numbers) and one.action_space.nvec.tolist() == [100] * 3 + [120] * 3 + [2]
    one.step([100, -3, 50, 120, -1, 0, 1])  # what prompts allow is clamped and wrapped
    with pytest.raises(ArgumentError, match="whole numbers"):
        one.step(POSE)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"cameras": ["ceiling"]}, "front, left_shoulder, right_shoulder, wrist, got ceiling"),
        ({"size": 0}, "at least one, got 0"),
        ({"size": (480, 480)}, r"size: expected a whole number of pixels, .* got \(480, 480\)"),
        ({"size": 48.5}, "a whole number of pixels, .* got 48.5"),
    ],
)
def test_senses_that_there_are_not(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        made(**options)


# -- bad plans ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        ([POSE, [np.nan, *POSE[1:]]], "finite poses .* as number 1"),
        ([POSE, POSE, [*POSE[:6], 1.01]], "gripper from 0 to 1.* as number 2"),
        ([POSE, [*POSE[:6], -0.5]], "as number 1"),
        ([[np.inf, *POSE[1:]]], "as number 0"),
        (POSE, r"\[K, 7\], got \[7\]"),
        ([POSE[:6]], r"got \[1, 6\]"),
        (np.empty((0, 7)), r"got \[0, 7\]"),
        ([["ahead"] * 7], r"expected poses \[K, 7\], got \[\['ahead'"),
        ([POSE, POSE[:6]], r"expected poses \[K, 7\]"),
    ],
)
def test_a_plan_that_is_none_moves_nothing(plan: Any, said: str) -> None:
    env = made()
    env.reset(options={"episode": 0})
    bench, before = env.table.bench, env.table.bench.pose
    steps, result = bench.seconds, env.result()
    with pytest.raises(ArgumentError, match=said):
        env.run(plan)
    np.testing.assert_array_equal(bench.pose, before)
    assert bench.seconds == steps and env.result() == result
    assert env.run([POSE]).executed.shape == (1, 7)


@given(st.lists(st.lists(st.floats(), min_size=7, max_size=7), min_size=1, max_size=4))
def test_plans_are_finite_or_refused(plan: list[list[float]]) -> None:
    valid = all(np.isfinite(pose).all() and 0 <= pose[6] <= 1 for pose in plan)
    if valid:
        np.testing.assert_array_equal(check_poses(plan), plan)
    else:
        with pytest.raises(ArgumentError):
            check_poses(plan)


def test_nothing_moves_after_the_end() -> None:
    env = made(actions=1)
    env.reset(options={"episode": 0})
    assert env.step(POSE)[3]
    ended, pose = env.result(), env.table.bench.pose
    with pytest.raises(ArgumentError, match=r"the episode has ended; call reset\(\)"):
        env.step(make_action(0.1, 0.1, 0.3, 0.0))
    np.testing.assert_array_equal(env.table.bench.pose, pose)
    assert env.result() == ended
    env.reset()
    assert env.step(POSE)[3]


def test_refused_ways_leave_a_valid_state() -> None:
    """Out of reach and into the table: the arm stays within its limits, things stay, and all goes on as if unasked."""
    env = made(tasks="push_buttons")
    env.reset(options={"episode": 0})
    bench = env.table.bench
    untouched = {name: bench.get_pose(name) for name in env.table.objects}
    refusals = [[3.0, 0, 1.0, np.pi, 0, 0, 1], [0.4, 0.35, TABLE - 0.2, np.pi, 0, 0, 1], [-0.35, 0, 0.8, 0, 0, 0, 1]]
    segment = env.run(refusals)
    assert len(segment.refused) == 3 and {"collision"} < {*segment.refused} and env.result()["refused"] == 3.0
    assert len(segment.executed) == 3 and np.isfinite(segment.path).all() and np.isfinite(bench.joints).all()
    assert bench.pose[2] > TABLE - 0.005 and (np.abs(bench.joints[:7]) < 3.8).all()
    for name, place in untouched.items():
        np.testing.assert_allclose(bench.get_pose(name), place, atol=1e-6)
    assert env.run([POSE]).refused == ()
    np.testing.assert_allclose(bench.pose[:3], POSE[:3], atol=5e-3)


# -- many at a time ----------------------------------------------------------------------------------------------------


def plans(count: int, steps: int) -> Any:
    """Somewhere over the table, other for each place and step."""
    draws = core.uniform(core.fold_key([7]), count * steps * 4).reshape(steps, count, 4)
    return [[make_action(0.3 * x, 0.4 * y - 0.2, 0.05 + 0.2 * h, round(g)) for x, y, h, g in row] for row in draws]


def vector(count: int, **options: Any) -> Any:
    return wiw.make_vec("Manipulation-v0", count, **{"tasks": "push_buttons", "depth": False, "size": 48, **options})


def test_tables_at_a_time_are_tables_alone() -> None:
    """Also where an episode ends on the way: the next one that nobody has begun follows, one step later."""
    many = vector(3, actions=2, depth=True, ids=True)
    alone = [made(tasks="push_buttons", size=48, actions=2, depth=True, ids=True) for _ in range(3)]
    assert isinstance(many, ManipulationVectorEnv) and many.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, infos = many.reset(options={"episode": [4, 1, 2]})
    single = [env.reset(options={"episode": index})[0] for env, index in zip(alone, (4, 1, 2), strict=True)]
    assert [key.episode for key in infos["key"]] == [4, 1, 2] and infos["instruction"][1] == alone[1].goal.text
    over, next_episode = [False] * 3, 5
    for actions in plans(3, 5):
        observations, rewards, terminated, truncated, infos = many.step(actions)
        assert many.observation_space.contains(observations)
        for place, env in enumerate(alone):
            if over[place]:
                found = (env.reset(options={"episode": next_episode})[0], 0.0, False, False)
                assert infos["key"][place].episode == next_episode
                next_episode += 1
            else:
                found = env.step(actions[place])[:4]
            single[place] = found[0]
            assert (rewards[place], terminated[place], truncated[place]) == found[1:]
            over[place] = found[2] or found[3]
            for name, value in single[place].items():
                np.testing.assert_array_equal(observations[name][place], value)
            assert over[place] == bool(infos.get("_result", [False] * 3)[place])
    assert next_episode > 6 and [goal.text for goal in many.goals] == [env.goal.text for env in alone]
    many.close()


def test_seeds_draw_the_same_tables() -> None:
    one, other = vector(2), vector(2)
    (first, infos), (same, _) = one.reset(seed=5), other.reset(seed=5)
    np.testing.assert_array_equal(first["front"], same["front"])
    assert infos["key"][1].episode == infos["key"][0].episode + 1
    after, infos = one.reset()
    assert (after["front"] != first["front"]).any()
    one.close(), other.close()


def test_bad_actions_move_no_table() -> None:
    many = vector(2, actions=1)
    many.reset(options={"episode": [0, 1]})
    poses = [env.table.bench.pose for env in many.envs]
    for actions, said in (
        ([POSE, [np.nan] * 7], "finite"),
        ([POSE], r"\[2, 7\], got \[1, 7\]"),
        ([[*POSE[:6], 2.0], POSE], "gripper"),
    ):
        with pytest.raises(ArgumentError, match=said):
            many.step(actions)
    for env, pose in zip(many.envs, poses, strict=True):
        np.testing.assert_array_equal(env.table.bench.pose, pose)
    assert many.step([POSE, POSE])[3].all()
    many.step(np.full((2, 7), np.nan))  # ignored: both begin anew
    with pytest.raises(ArgumentError, match="2 episodes, got 1"):
        many.reset(options={"episode": [0]})
    for episodes, said in ((1, "a list of 2 episodes"), ([0, "1"], "whole number of at least 0, got '1'")):
        with pytest.raises(ArgumentError, match=said):
            many.reset(options={"episode": episodes})
    with pytest.raises(ArgumentError, match="at least 1"):
        vector(0)
    many.close()
