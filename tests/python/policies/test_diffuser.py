# SPDX-License-Identifier: Apache-2.0
"""The 3D diffusion policy: its geometry, its attention, its paths, what it proposes, and its training."""

from __future__ import annotations

import resource
import signal
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

import wiw
from wiw.cli.app import main
from wiw.datasets.demonstration import Demonstration, decode_colors, decode_depths
from wiw.errors import ArgumentError, FileError, WeightsError
from wiw.policies.base import Situation
from wiw.policies.diffuser import paths
from wiw.policies.diffuser.paths import MIDDLE
from wiw.policies.diffuser.workspace import CELL, NOWHERE, WORKSPACE, WRIST_SIZE, PinholeCamera
from wiw.studies.run_log import load_run
from wiw.tabletop.cloud import unproject_depth
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.training.recording import Collection, record_demonstration
from wiw.types import ArmObservation, CameraView, Goal, Key

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.policies.diffuser.attention import LONGEST_WAVE, OFFSET_UNIT, SHORTEST_WAVE, RelativeAttention  # noqa: E402
from wiw.policies.diffuser.diffusion import ALPHA_BARS, NOISE_LEVELS, add_noise, sample_ddim  # noqa: E402
from wiw.policies.diffuser.network import EncodedScene, Network, Shape  # noqa: E402
from wiw.policies.diffuser.policy import Diffuser  # noqa: E402
from wiw.policies.diffuser.weights import load, save  # noqa: E402
from wiw.training.checkpoint import Checkpoint  # noqa: E402
from wiw.training.diffuser import Augmentation, Recipe, Samples, extract_samples, train  # noqa: E402
from wiw.training.diffuser_paths import measure_paths  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

SMALL = Shape(width=24, heads=2, layers=2)
LENS = PinholeCamera.from_camera(CAMERAS["front"], (480, 480))
WRIST_INTRINSICS = PinholeCamera.from_camera(CAMERAS["wrist"], (480, 480)).intrinsics
HERE = np.array([0.0, 0.05, 1.2, np.pi, 0.0, 0.1, 1.0])


@pytest.fixture(scope="module")
def shown() -> list[Demonstration]:
    """A block slid, and a ring put on a peg."""
    return [
        record_demonstration(TABLETOP_TASKS[name], 3, Collection(frames=16, depth=True, wrist=True))[0]
        for name in ("slide_block", "insert_peg")
    ]


@pytest.fixture(scope="module")
def seen(shown: list[Demonstration]) -> Samples:
    return extract_samples(shown, LENS, WRIST_INTRINSICS)


def make_untrained(seed: int = 0, wrist: bool = False) -> Diffuser:
    torch.manual_seed(seed)
    return Diffuser.from_network(Network(replace(SMALL, wrist=wrist)), steps=4)


def view_from_wrist(each: Demonstration, frame: int = 0) -> CameraView:
    assert each.encoded_wrist_images is not None and each.encoded_wrist_depths is not None
    assert each.wrist_poses is not None
    image, depth = decode_colors(each.encoded_wrist_images)[frame], decode_depths(each.encoded_wrist_depths)[frame]
    return CameraView(image, each.wrist_poses[frame], depth)


def situation(each: Demonstration, key: Key, imagines: bool = True) -> Situation:
    assert each.depths is not None
    observation = ArmObservation(each.images[0], each.poses[0], each.depths[0], wrist=view_from_wrist(each))
    return Situation(observation, Goal("manipulation", text=each.instruction), key, None, imagines=imagines)


# -- where things are --------------------------------------------------------------------------------------------------


def test_points_are_where_the_renderer_has_them() -> None:
    """The pixels of a square that lies on the table, by its id, against where it was put; and back into the picture."""
    setup = TABLETOP_TASKS["slide_block"].create_setup(1, 0)
    bench = setup.build_workbench()
    picture = bench.render_view("front", (480, 480), ("depth", "instance"))
    points = LENS.unproject(picture["depth"])
    for name in ("green", "blue"):
        ids = [number for number, other in enumerate(bench.instance_names, 1) if other == name]
        found = points[np.isin(picture["instance"], ids)]
        assert len(found) > 100
        np.testing.assert_allclose(
            (found[:, :2].min(0) + found[:, :2].max(0)) / 2, bench.get_pose(name)[:2, 3], atol=4e-3
        )
        np.testing.assert_allclose(found[:, 2], TABLE + 0.002, atol=2e-3)
    rows, columns = np.nonzero(points[..., 2] > 0)
    back = CAMERAS["front"].project_points(points[rows, columns], (480, 480))
    np.testing.assert_allclose(back, np.stack([columns, rows], axis=1) + 0.5, atol=1e-6)


def test_the_window_shows_the_whole_workspace_and_knows_where_it_is() -> None:
    rows, columns = LENS.find_window((480, 480))
    assert all(each.start % CELL == each.stop % CELL == 0 for each in (rows, columns))
    depth = np.full((480, 480), 0.9, np.float32)
    depth[:, :240] = 0
    points = LENS.unproject(depth)
    outside = np.ones((480, 480), bool)
    outside[rows, columns] = False
    assert (points[outside] == NOWHERE).all() and (points[:, :240] == NOWHERE).all()
    assert ((points == NOWHERE) | ((points > WORKSPACE[0]) & (points < WORKSPACE[1]))).all()
    np.testing.assert_allclose(
        LENS.crop(rows, columns).unproject(depth[rows, columns]), points[rows, columns], atol=1e-9
    )
    view = LENS.view_workspace(np.zeros((480, 480, 3), np.uint8), depth)
    np.testing.assert_allclose(view.places, points[rows, columns][CELL // 2 :: CELL, CELL // 2 :: CELL], atol=1e-6)
    assert view.image.shape[:2] == view.height.shape == tuple(CELL * side for side in view.places.shape[:2])
    away = np.eye(4)
    away[2, 3] = 0.5
    with pytest.raises(ArgumentError, match="not in view"):
        PinholeCamera(LENS.intrinsics, away).find_window((480, 480))


def test_the_wrist_camera_sees_things_where_the_front_camera_does(shown: list[Demonstration]) -> None:
    """Pixels of the table's things by the hand's camera, reduced, lie among those of the front view."""
    for each in shown:
        frame = len(each) // 2
        wrist, lens = view_from_wrist(each, frame), CAMERAS["wrist"]
        camera = PinholeCamera.from_camera(lens, (480, 480), wrist.T_world_camera)
        assert wrist.depth is not None and each.depths is not None
        view = camera.view_from_wrist(wrist.image, wrist.depth)
        assert view.image.shape == (WRIST_SIZE, WRIST_SIZE, 3) and view.places.shape == (15, 15, 3)
        factor = 480 // WRIST_SIZE
        middle = factor * (CELL // 2) + factor // 2  # of the first cell: the pixel that its depth is of
        points = unproject_depth(wrist.depth, lens.hfov_deg, wrist.T_world_camera)[middle :: factor * CELL]
        inside = view.places[..., 2] > 0
        assert inside.sum() > 30
        np.testing.assert_allclose(
            view.places[inside], points[:, middle :: factor * CELL][inside], atol=0.004 * float(wrist.depth.max())
        )
        low = view.places[inside & (view.places[..., 2] < TABLE + 0.005)]
        front = LENS.unproject(each.depths[frame])
        near = np.linalg.norm(front[front[..., 2] > 0][None] - low[:20, None], axis=-1).min(axis=1)
        assert np.median(near) < 0.006
    with pytest.raises(ArgumentError, match="multiple of 120, got 100x100"):
        camera.view_from_wrist(np.zeros((100, 100, 3), np.uint8), np.ones((100, 100), np.float32))


# -- attention ---------------------------------------------------------------------------------------------------------


def slow_attention(layer: RelativeAttention, queries: Any, places: Any, context: Any, others: Any) -> Any:
    """[N, width]: one query, head and pair of channels after another, from differences of places alone."""
    heads, width = layer.heads, queries.shape[-1]
    size = width // heads
    count = size // 6
    waves = (
        SHORTEST_WAVE * (LONGEST_WAVE / SHORTEST_WAVE) ** (1 - np.arange(count) / max(1, count - 1))
        if count > 1
        else [LONGEST_WAVE]
    )
    query, key, value = (part(each).detach().numpy() for part, each in (
        (layer.query, queries), (layer.key, context), (layer.value, context)
    ))  # fmt: skip
    made = []
    for n, here in enumerate(places):
        read, off = [], []
        for head in range(heads):
            own = slice(head * size, (head + 1) * size)
            likeness = np.zeros(len(others))
            for m, there in enumerate(others):
                a, b = query[n, own], key[m, own]
                for axis in range(3):
                    for wave in range(count):
                        i = axis * count + wave
                        j = i + size // 2
                        angle = 2 * np.pi / waves[wave] * (there - here)[axis]
                        likeness[m] += np.cos(angle) * (a[i] * b[i] + a[j] * b[j])
                        likeness[m] += np.sin(angle) * (a[j] * b[i] - a[i] * b[j])
            weights = np.exp(likeness / size**0.5)
            weights /= weights.sum()
            read.append(weights @ value[:, own])
            off.append(weights @ (others - here) / OFFSET_UNIT)
        made.append(np.concatenate([np.concatenate([r, o]) for r, o in zip(read, off, strict=True)]))
    return layer.out(torch.tensor(np.array(made), dtype=torch.float32)).detach().numpy()


@pytest.mark.parametrize("width", [12, 48])
def test_attention_is_that_of_its_slow_twin(width: int) -> None:
    torch.manual_seed(1)
    layer = RelativeAttention(width, 2)
    queries, context = torch.randn(1, 3, width), torch.randn(1, 5, width)
    places, others = torch.rand(1, 3, 3), torch.rand(1, 5, 3)
    found = layer(queries, places, context, others)[0].detach().numpy()
    twin = slow_attention(layer, queries[0], places[0].numpy(), context[0], others[0].numpy())
    np.testing.assert_allclose(found, twin, atol=1e-5)
    hidden = torch.tensor([[False, False, False, True, True]])
    np.testing.assert_allclose(
        layer(queries, places, context, others, hidden).detach().numpy(),
        layer(queries, places, context[:, :3], others[:, :3]).detach().numpy(),
        atol=1e-6,
    )


@settings(max_examples=20, deadline=None)
@given(arrays(np.float32, 3, elements=st.floats(-2, 2, width=32)), st.integers(0, 99))
def test_what_is_denoised_moves_with_the_scene(shift: Any, level: int) -> None:
    """All points and the path elsewhere: the same path there, to a tenth of a millimetre."""
    torch.manual_seed(2)
    network = Network(SMALL).eval()
    tokens, places = torch.randn(2, 9, SMALL.width), torch.rand(2, 9, 3)
    hand, hidden = torch.randn(2, SMALL.width), torch.rand(2, 9) < 0.2
    path, levels = torch.randn(2, 3, SMALL.poses, 9), torch.full((2, 3), level)
    there = path.clone()
    there[..., :3] += torch.tensor(shift) / paths.SCALE
    with torch.inference_mode():
        found, gripper = network.denoise(EncodedScene(tokens, places, hidden, hand), path, levels)
        moved, gripper_there = network.denoise(
            EncodedScene(tokens, places + torch.tensor(shift), hidden, hand), there, levels
        )
    off = (moved - found)[..., :3] * paths.SCALE - torch.tensor(shift)
    assert off.abs().max() < 1e-4
    assert (moved - found)[..., 3:].abs().max() < 1e-3
    assert (gripper_there - gripper).abs().max() < 1e-3


# -- noise -------------------------------------------------------------------------------------------------------------


def test_noise_takes_all_and_can_be_taken_away() -> None:
    assert (ALPHA_BARS[1:] <= ALPHA_BARS[:-1]).all()
    assert ALPHA_BARS[0].min() > 0.98 and ALPHA_BARS[-1].max() < 0.02
    clean, noise = torch.randn(2, 5, 6, 9), torch.randn(2, 5, 6, 9)
    spread = add_noise(torch.zeros(2000, 6, 9), torch.randn(2000, 6, 9), torch.full((2000,), 50)).std(dim=0)
    np.testing.assert_allclose(spread, (1 - ALPHA_BARS[50]).sqrt().expand(6, 9), rtol=0.1)
    np.testing.assert_allclose(add_noise(clean, noise, torch.zeros(2, 5, dtype=torch.long)), clean, atol=0.7)
    asked: list[int] = []

    def denoise(now: Any, level: Any) -> Any:
        asked.append(int(level[0, 0]))
        return clean, torch.zeros(now.shape[:-1])

    found, gripper = sample_ddim(denoise, noise, 10)
    assert torch.equal(found, clean) and (gripper == 0.5).all()
    assert asked[0] == NOISE_LEVELS - 1 and asked[-1] == 0 and asked == sorted(asked, reverse=True) and len(asked) == 10


# -- paths -------------------------------------------------------------------------------------------------------------

POSES = arrays(np.float64, (5, 7), elements=st.floats(-1.5, 1.5)).map(lambda raw: np.c_[raw[:, :6], raw[:, 6:] > 0])


@settings(max_examples=50, deadline=None)
@given(POSES)
def test_vectors_are_poses(poses: Any) -> None:
    again = paths.to_poses(paths.to_vectors(poses))
    np.testing.assert_allclose(again[:, :3], poses[:, :3], atol=1e-5)
    turned = Rotation.from_euler("xyz", again[:, 3:6]) * Rotation.from_euler("xyz", poses[:, 3:6]).inv()
    assert turned.magnitude().max() < 1e-3
    np.testing.assert_array_equal(again[:, 6], poses[:, 6])
    stretched = paths.to_vectors(poses) * np.float32([1, 1, 1, 2, 2, 2, 3, 3, 3, 1])
    np.testing.assert_allclose(paths.to_poses(stretched)[:, :6], again[:, :6], atol=1e-3)


def test_a_dense_path_leads_through_its_poses_and_is_thinned_to_them() -> None:
    """For each kind's expert; the gripper changes where it gets to, no sooner."""
    for kind in TABLETOP_TASKS.values():
        setup = kind.create_setup(5, 1)
        plan = kind.plan_expert(setup.build_workbench().get_poses(setup.objects), setup.target)[:6]
        path = paths.densify_path(HERE, plan, 50)
        assert path.shape == (50, 7)
        ends = np.rint(50 * np.arange(1, len(plan) + 1) / len(plan)).astype(int) - 1
        np.testing.assert_allclose(path[ends][:, [0, 1, 2, 6]], plan[:, [0, 1, 2, 6]], atol=1e-9)
        before = np.r_[1.0, plan[:-1, 6]]
        for end, first, grip in zip(ends, np.r_[0, ends[:-1] + 1], before, strict=True):
            assert (path[first:end, 6] == grip).all()
        thin = paths.thin_path(HERE, path, 10)
        assert len(thin) == 10
        between = [np.linalg.norm(thin - pose, axis=1).min() for pose in plan[plan[:, 6] != before]]
        assert max(between, default=0) < 1e-6  # where the gripper changes
        np.testing.assert_array_equal(paths.thin_path(HERE, path, 50), path)
        assert len(paths.thin_path(HERE, path, 1)) == 1
        np.testing.assert_array_equal(paths.thin_path(HERE, path, 1)[0], path[-1])
    np.testing.assert_array_equal(
        paths.drop_repeated_poses(HERE, np.stack([HERE, plan[0], plan[0], plan[0]])), plan[:1]
    )
    np.testing.assert_array_equal(paths.drop_repeated_poses(HERE, HERE[None]), HERE[None])


@pytest.mark.parametrize("most", [5, 10])
def test_rounding_does_not_decide_which_poses_are_kept(most: int) -> None:
    """A path of straight moves has fewer poses that its shape needs than it is thinned to."""
    stops = HERE + np.array([[0.1, 0, 0, 0, 0, 0, 0], [0.1, 0.2, 0, 0, 0, 0.3, 0]])
    path = paths.densify_path(HERE, stops, 50)
    thin = paths.thin_path(HERE, path, most)
    assert len(np.unique(thin, axis=0)) == most and (np.linalg.norm(thin - stops[0], axis=1) < 1e-9).any()
    for seed in range(5):
        noise = 1e-9 * np.random.default_rng(seed).standard_normal(path.shape)
        np.testing.assert_allclose(paths.thin_path(HERE, path + noise, most), thin, atol=1e-7)


# -- the policy --------------------------------------------------------------------------------------------------------


def test_a_plan_does_not_depend_on_how_many_others_are_proposed(shown: list[Demonstration]) -> None:
    policy, one = make_untrained(), situation(shown[0], Key(3, 1))
    for horizon in (5, 50):
        alone, beside = (policy.propose([one], count, horizon)[0][0].actions for count in (1, 5))
        np.testing.assert_allclose(alone, beside, atol=1e-4)


def test_candidates_differ_and_are_functions_of_the_key(shown: list[Demonstration]) -> None:
    policy, key = make_untrained(), Key(3, 1, 2)
    first, second = (situation(each, key) for each in shown)
    plans = policy.propose([first, second], 5, 50)
    assert [len(each) for each in plans] == [5, 5]
    assert all(plan.actions.shape == (50, 7) for each in plans for plan in each)
    assert len({plan.actions.tobytes() for each in plans for plan in each}) == 10
    np.testing.assert_array_equal(policy.propose([second], 5, 50)[0][2].actions, plans[1][2].actions)
    np.testing.assert_allclose(policy.propose([second], 2, 50)[0][1].actions, plans[1][1].actions, atol=1e-4)
    later = policy.propose([situation(shown[0], key.at(3))], 1, 50)[0][0]
    assert not np.allclose(later.actions, plans[0][0].actions)
    assert len(policy.propose([situation(shown[0], key, imagines=False)], 5, 50)[0]) == 1
    assert all(1 <= len(plan.actions) <= 4 for plan in policy.propose([first], 5, 4)[0])


def test_what_the_wrist_camera_sees_counts_where_the_network_knows_it(shown: list[Demonstration]) -> None:
    policy, key = make_untrained(wrist=True), Key(3, 1, 2)
    assert policy.needs == ("depth", "wrist") and make_untrained().needs == ("depth",)
    here = situation(shown[1], key)
    dark = CameraView(
        np.zeros((480, 480, 3), np.uint8), here.observation.wrist.T_world_camera, here.observation.wrist.depth
    )
    other = replace(here, observation=replace(here.observation, wrist=dark))
    (seen,), (unseen,) = (policy.propose([each], 1, 50)[0] for each in (here, other))
    assert not np.allclose(seen.actions, unseen.actions)
    blind = make_untrained()
    (seen,), (unseen,) = (blind.propose([each], 1, 50)[0] for each in (here, other))
    np.testing.assert_array_equal(seen.actions, unseen.actions)


def test_the_included_weights_try_several_targets(shown: list[Demonstration]) -> None:
    """At tables of other seeds than those of its demonstrations."""
    policy = wiw.policy("diffuser")
    assert policy.needs == ("depth", "wrist") and policy.card["demonstrations"]["episodes"] == 120
    assert policy.card["found"]["near/10"] > 0.75 and policy.card["found"]["spread"] > 0.05
    block, _ = shown
    (plans,) = policy.propose([situation(block, Key(3, 1))], 10, 50)
    ends = np.stack([plan.actions[-1, :2] for plan in plans])
    assert pdist(ends).max() > 0.1, "one target alone"
    assert (np.abs(ends) < 0.6).all()


def test_weights_are_kept_with_their_shape(tmp_path: Path, shown: list[Demonstration]) -> None:
    policy = make_untrained()
    policy._network.half().float()
    save(tmp_path / "weights.safetensors", policy._network, {"recipe": {"epochs": 1}})
    again = wiw.policy("diffuser", weights=tmp_path / "weights.safetensors", steps=4)
    assert again.card == {"recipe": {"epochs": 1}}
    here = situation(shown[0], Key(0, 0))
    np.testing.assert_array_equal(
        policy.propose([here], 1, 50)[0][0].actions, again.propose([here], 1, 50)[0][0].actions
    )
    assert again.describe()["weights"] != policy.describe()["weights"]
    with pytest.raises(WeightsError, match="wiw train diffuser") as missing:
        wiw.policy("diffuser", weights=tmp_path / "none")
    assert missing.value.kind == "missing"
    (tmp_path / "damaged").write_bytes((tmp_path / "weights.safetensors").read_bytes()[:-100])
    with pytest.raises(WeightsError, match="expected complete weights") as damaged:
        load(tmp_path / "damaged")
    assert damaged.value.kind == "unfit"
    with pytest.raises(WeightsError, match="of something else"):
        load(Path(wiw.__file__).parent / "world_models/warpnet/weights.safetensors")
    for steps in (0, 2.5):
        with pytest.raises(ArgumentError, match=f"1 to 100 steps, got {steps}"):
            wiw.policy("diffuser", weights=tmp_path / "weights.safetensors", steps=steps)
    with pytest.raises(ArgumentError, match="width"):
        Shape(width=32)


# -- training ----------------------------------------------------------------------------------------------------------


def test_moments_are_the_beginnings_of_parts(shown: list[Demonstration], seen: Samples) -> None:
    assert len(seen) == 2 and seen.path.shape == (2, 6, 7)
    setup = TABLETOP_TASKS["slide_block"].create_setup(shown[0].seed, shown[0].variation)
    plan = TABLETOP_TASKS["slide_block"].plan_expert(shown[0].places, setup.target)
    np.testing.assert_allclose(seen.path[0][[0, 1, 2, 3, 5], :6], plan[[0, 1, 2, 3, 3], :6], atol=1e-6)
    np.testing.assert_array_equal(seen.pose[0], shown[0].poses[0])
    rows, columns = LENS.find_window((480, 480))
    np.testing.assert_array_equal(seen.views[0].image[0], shown[0].images[0][rows, columns])
    pushes, _ = record_demonstration(TABLETOP_TASKS["push_buttons"], 1, Collection(frames=16, depth=True))
    two = extract_samples([pushes], LENS)
    assert len(two) == 2 and len(two.views) == 1 and len(seen.views) == 2
    with pytest.raises(ArgumentError, match="wrist camera in all demonstrations"):
        extract_samples([pushes], LENS, WRIST_INTRINSICS)
    np.testing.assert_allclose(two.path[:, 2:, :2], two.path[:, 1:2, :2].repeat(4, axis=1), atol=1e-9)
    np.testing.assert_allclose(two.path[:, 2, 2], two.path[:, 0, 2], atol=1e-9)  # up again, after the last push too
    lit = two.views[0].image[1].astype(int) - two.views[0].image[0]
    assert np.abs(lit).max() > 60
    with pytest.raises(ArgumentError, match="--depth"):
        extract_samples([replace(shown[0], encoded_depths=None)], LENS)
    with pytest.raises(ArgumentError, match="push_buttons"):
        extract_samples([replace(shown[0], task="juggle")], LENS)
    with pytest.raises(ArgumentError, match="got none"):
        extract_samples([], LENS)


@pytest.mark.parametrize("mirror", [0.0, 1.0])
def test_an_augmented_scene_keeps_its_distances_and_moves_with_its_path(
    shown: list[Demonstration], mirror: float
) -> None:
    """Distances between what is seen, the gripper and its path stay; so do angles, seen in a mirror or not."""
    samples = extract_samples(shown, LENS, WRIST_INTRINSICS)
    recipe = Recipe(batch=3, tilt=0.4, mirror=mirror, recolor=0.0)
    change = Augmentation.draw(3, recipe, np.random.default_rng(0))
    chosen = np.array([0, 1, 0])
    poses = np.concatenate([samples.pose[chosen, None], samples.path[chosen]], axis=1)
    changed, view = change.change_poses(poses), samples.views[0]
    places = change.change_view(view, chosen).places.numpy()
    for row, original in enumerate(chosen):
        flipped = view.places[original][:, ::-1] if mirror else view.places[original]
        seen = flipped[..., 2] > NOWHERE[2]
        before = np.concatenate([flipped[seen], poses[row, :, :3]])
        after = np.concatenate([places[row][seen], changed[row, :, :3]])
        np.testing.assert_allclose(pdist(after), pdist(before), atol=1e-5)
        np.testing.assert_allclose(after[:, 2], before[:, 2], atol=1e-6)
        turns = Rotation.from_euler("xyz", changed[row, :, 3:6]).as_matrix()
        flip = np.diag([1, -1 if mirror else 1, 1])
        whole = Rotation.from_euler("z", change.angles[row]).as_matrix() @ flip
        np.testing.assert_allclose(
            turns, whole @ Rotation.from_euler("xyz", poses[row, :, 3:6]).as_matrix() @ flip, atol=1e-9
        )
        np.testing.assert_allclose(after[-1] - MIDDLE, whole @ (before[-1] - MIDDLE), atol=1e-6)
    assert not np.allclose(changed, poses) and (changed[..., 6] == poses[..., 6]).all()


def test_an_augmented_picture_has_other_colours_in_the_same_places(shown: list[Demonstration]) -> None:
    samples = extract_samples(shown, LENS)
    chosen, (view,) = np.arange(2), samples.views
    change = Augmentation(
        np.ones((2, 1, 1, 3), np.float32), np.array([[2, 0, 1], [0, 1, 2]]), np.array([True, False]), np.zeros(2)
    )
    image = change.change_view(view, chosen).image.numpy()
    np.testing.assert_array_equal(image[0], view.image[0][:, ::-1][..., [2, 0, 1]])
    np.testing.assert_array_equal(image[1], view.image[1])
    drawn = Augmentation.draw(400, Recipe(recolor=1.0), np.random.default_rng(0))
    assert len(np.unique(drawn.channels, axis=0)) == 6 and 150 < drawn.mirrored.sum() < 250


def test_it_learns_two_demonstrations_by_heart(shown: list[Demonstration], seen: Samples) -> None:
    recipe = Recipe(epochs=150, batch=2, levels=8, width=48, layers=2, tilt=0.0, mirror=0.0, rate=3e-3, average=0.97)
    network, _ = train(seen, recipe)
    policy = Diffuser.from_network(network)
    for each, path in zip(shown, seen.path, strict=True):
        stops = policy._sample_poses(situation(each, Key(0, 0)), [1, 2, 3])
        off = np.linalg.norm(stops[..., :3] - path[:, :3], axis=-1)
        assert np.median(off) < 0.03
        assert (stops[..., 6] == path[:, 6]).mean() > 0.8
    found = measure_paths(network, seen)
    assert found["off"] < 0.04 and found["spread"] < 0.1 and found["near/1"] <= found["near/5"] <= found["near/10"]
    untrained = measure_paths(make_untrained(wrist=True)._network, seen)
    assert untrained["near/10"] == 0 and untrained["spread"] > found["spread"]


def test_held_out_demonstrations_are_chosen_by_their_names(seen: Samples) -> None:
    rows = np.tile(np.arange(len(seen)), 50)
    names = tuple(f"slide_block {number}" for number in range(len(rows)))
    many = replace(seen.select(rows), demonstrations=names)
    own, held_out = many.hold_out(0.2)
    assert sorted((*own.demonstrations, *held_out.demonstrations)) == sorted(names)
    assert 0 < len(held_out) < 0.4 * len(names)
    fewer = many.select(np.arange(40))
    assert set(fewer.hold_out(0.2)[1].demonstrations) == {*held_out.demonstrations} & {*fewer.demonstrations}
    with pytest.raises(ArgumentError, match="collect more"):
        many.hold_out(1.0)


def test_training_that_was_stopped_goes_on_to_the_same_end(seen: Samples, tmp_path: Path) -> None:
    recipe = Recipe(epochs=3, batch=1, levels=2, width=24, layers=1)
    whole, _ = train(seen, recipe)
    file = tmp_path / "checkpoint"

    def stop(step: int, *_: Any) -> None:
        if step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(seen, recipe, on_step=stop, checkpoint=Checkpoint(file, {"a": 1}, seconds=0))
    steps: list[int] = []
    on, _ = train(seen, recipe, on_step=lambda step, *_: steps.append(step), checkpoint=Checkpoint(file, {"a": 1}))
    assert steps == [4, 5, 6]
    for name, value in whole.state_dict().items():
        assert torch.equal(value, on.state_dict()[name])
    with pytest.raises(ArgumentError, match="different data or options"):
        Checkpoint(file, {"a": 2}).load()
    file.write_bytes(file.read_bytes()[:50])
    with pytest.raises(FileError, match="delete it"):
        Checkpoint(file, {"a": 1}).load()
    with pytest.raises(ArgumentError, match="epochs"):
        Recipe(epochs=0)


class _Bytes:
    """What can be kept of a lesson: some numbers."""

    def state_dict(self) -> dict[str, Any]:
        return {"values": torch.arange(500.0)}

    def load_state_dict(self, state: Any) -> None:
        pass


def test_a_checkpoint_damaged_anyhow_is_told(tmp_path: Path) -> None:
    file = tmp_path / "checkpoint"
    checkpoint = Checkpoint(file, {"a": 1}, seconds=0)
    checkpoint.save_if_due(_Bytes(), 3, 2)
    assert checkpoint.load().step == 2
    whole = file.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(300):
        at, bits = int(rng.integers(len(whole))), int(rng.integers(1, 256))
        file.write_bytes(whole[:at] + bytes([whole[at] ^ bits]) + whole[at + 1 :])
        with suppress(FileError, ArgumentError):
            checkpoint.load()
    for data in (b"", b"PK", b"\x80\x02]q\x00.", b"\x80\x02X\x01\x00\x00\x00\xff.", whole[:900], rng.bytes(99)):
        file.write_bytes(data)
        with pytest.raises(FileError, match="delete it to start again"):
            checkpoint.load()


def test_a_checkpoint_that_finds_no_room_says_so(tmp_path: Path) -> None:
    kept = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, kept[1]))
    try:
        with pytest.raises(FileError, match="free space"):
            Checkpoint(tmp_path / "checkpoint", {}, seconds=0).save_if_due(_Bytes(), 3, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, kept)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_the_command_says_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "diffuser", "--out", str(tmp_path / "x")]) == 2
    assert "a folder of `wiw collect manipulation --depth` with --demonstrations" in capsys.readouterr().err


def test_the_command_wants_views_as_it_will_see_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason="needs wiw[export]")
    demos = str(tmp_path / "demos")
    few = ["--tasks", "slide_block", "--episodes", "1", "--frames", "16", "--depth", "--size", "64"]
    assert main(["collect", "manipulation", *few, "--out", demos]) == 0
    assert main(["train", "diffuser", "--demonstrations", demos, "--out", str(tmp_path / "x")]) == 2
    assert "of 64; collect with --size 480" in capsys.readouterr().err


def test_the_command_trains_on_what_was_collected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pyarrow", reason="needs wiw[export]")
    demos, out = str(tmp_path / "demos"), tmp_path / "weights.safetensors"
    few = ["--tasks", "slide_block", "--episodes", "2", "--frames", "16", "--depth", "--wrist"]
    assert main(["collect", "manipulation", *few, "--out", demos]) == 0
    assert main(["train", "diffuser", "--demonstrations", demos, "--epochs", "2", "--out", str(out)]) == 0
    assert "2 epochs" in capsys.readouterr().out
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith("weights")] == [out.name]
    assert load(out)[1]["recipe"]["epochs"] == 2
    run = ["run", "manipulation", "--policy", "diffuser", "--policy-option", f"weights={out}", "--tasks", "slide_block"]
    short = ["--episodes", "1", "--task-option", "actions=2", "--horizon", "2", "--task-option", "episodes=1"]
    assert main([*run, *short, "--no-report", "--out", str(tmp_path / "run")]) == 0
    log = load_run(tmp_path / "run")
    assert [row["status"] for row in log.episodes] == ["done"] and len(log.decisions) == 1
