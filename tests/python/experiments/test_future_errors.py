# SPDX-License-Identifier: Apache-2.0
"""Errors of known doses: nothing at dose 0, worse with every dose, and exactly what each says."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from fakes import agent_for

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.cli import main
from wiw.datasets.questions.facts import STRUCTURE
from wiw.errors import ArgumentError, RolloutError
from wiw.experiments.errors.content import list_barriers, list_things
from wiw.experiments.errors.control import Ignored, MotionDegradation, list_moves
from wiw.experiments.errors.drawing import paste_copies
from wiw.experiments.errors.erroneous import Erroneous
from wiw.experiments.errors.forks import Walker, WorldFork
from wiw.experiments.errors.kinds import ERRORS, make_error
from wiw.experiments.errors.looks import FrameDegradation
from wiw.experiments.fidelity import FidelityObserver
from wiw.loop.attempts import Attempted
from wiw.loop.clock import Clock
from wiw.loop.config import AgentConfig
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.imagine import seed_of
from wiw.loop.memory import Query
from wiw.loop.model_imaginer import ModelImaginer
from wiw.loop.model_wrapper import ModelWrapper
from wiw.loop.plan_space import plan_space
from wiw.loop.privileged import LiveEnvironments
from wiw.metrics import psnr, ssim
from wiw.physics import Box, place
from wiw.policies.base import FrameSpec
from wiw.runs.recipes import AgentRecipe, arm_recipes
from wiw.tabletop.workbench import TABLE, Thing, Workbench
from wiw.tasks.imagenav import ImageNav
from wiw.tasks.manipulation import Manipulation
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control, Key, Proposal
from wiw.world_models.oracle import ArmOracle, Oracle, make_oracle

SIZE = (64, 128)
AHEAD = Proposal([int(FORWARD)] * 4)
"""Four strides; the start of the fixture has room for them."""
SEED = 7


@pytest.fixture(scope="module")
def env(two_rooms: str):
    """An episode in the middle of a room, heading along it."""
    task = ImageNav(scenes=two_rooms)
    made = task.environment(depth=True)
    made.begin(replace(task.episodes(1)[0], start_position=(-3.2, 0.0, 0.5), start_yaw=-np.pi / 2))
    return made


def imagine(env, error=None, plans=(AHEAD,), model=None, decision=0, view="panorama", ends=False, shown=None):
    """The rollouts of an episode's plans, at a small size, and what goes with them."""
    model = model or Oracle(SIZE)
    error = make_error(error) if isinstance(error, str) else error
    imaginer = ModelImaginer(model) if error is None else Erroneous(model, error)
    environments, key = LiveEnvironments(), Key(SEED, 0, decision)
    environments.add(key, env)
    imaginer.grant(environments)
    request = Request(
        plan_space(model.accepts.space),
        [key],
        [env.observation],
        [shown or ModelInput(env.observation)],
        [list(plans)],
        [range(len(plans))],
        FrameSpec(view, SIZE, ends=ends),
        Clock(),
    )
    return imaginer.imagine(request)


def fork_of(env) -> WorldFork:
    return WorldFork(env.fork(), env.state.world, False)


@pytest.mark.parametrize("kind", ERRORS)
def test_a_dose_of_nothing_is_the_oracle_byte_for_byte(env, kind: str) -> None:
    plans = [AHEAD, Proposal([int(TURN_LEFT), int(FORWARD), int(TURN_LEFT), int(FORWARD)])]
    true, found = imagine(env, plans=plans), imagine(env, f"{kind}@0", plans)
    for one, other in zip(true.rollouts[0], found.rollouts[0], strict=True):
        np.testing.assert_array_equal(one.frames, other.frames)
        np.testing.assert_array_equal(one.real, other.real)
    assert found.costs == true.costs
    np.testing.assert_array_equal(found.pose_errors[0], 0)


@pytest.mark.parametrize("kind", ERRORS)
def test_futures_are_worse_with_every_dose_and_the_same_for_the_same_key(env, kind: str) -> None:
    true = imagine(env).rollouts[0][0].frames
    likeness, metres = [1.0], [0.0]
    for dose in ERRORS[kind].doses[PRIMITIVES]:
        found = imagine(env, f"{kind}@{dose:g}")
        frames = found.rollouts[0][0].frames
        np.testing.assert_array_equal(frames, imagine(env, f"{kind}@{dose:g}").rollouts[0][0].frames)
        likeness.append(float(np.mean(ssim(frames, true, weights="latitude"))))
        metres.append(float(found.pose_errors[0][0, 0]))
    moves = issubclass(ERRORS[kind], MotionDegradation)
    assert (np.diff(metres) >= 0).all() and (metres[-1] > 0.1) == moves, metres
    assert likeness[-1] < 0.99, likeness
    assert moves or (np.diff(likeness) <= 1e-3).all(), likeness  # plain walls look alike from places further off


class Recorded(Ignored):
    """Keeps the seeds that it draws from."""

    def __init__(self, dose: float) -> None:
        super().__init__(dose)
        self.drawn_from: list[int] = []

    def rollout(self, model, observations, controls, seeds):
        self.drawn_from += map(int, seeds)
        return super().rollout(model, observations, controls, seeds)


def test_every_future_has_draws_of_its_own(env) -> None:
    """Also those of the oracle, which has no seeds."""
    plans, error = [AHEAD, Proposal([int(FORWARD)] * 3), AHEAD], Recorded(0.5)
    found = [imagine(env, error, plans, decision=number) for number in range(2)]
    expected = [seed_of(Key(SEED, 0, decision), plan) for decision in range(2) for plan in range(2)]
    assert error.drawn_from == expected
    for own, seed in zip(found, expected[::2], strict=True):
        np.testing.assert_array_equal(
            own.pose_errors[0][0], error.misplace(fork_of(env), AHEAD.actions, seed).mean(axis=0)
        )
        np.testing.assert_array_equal(own.rollouts[0][0].frames, own.rollouts[0][2].frames)
    true = imagine(env, plans=plans).rollouts[0]
    colors = [
        (
            imagine(env, "tint@40", plans, decision=number).rollouts[0][plan].frames[-1].astype(float)
            - true[plan].frames[-1]
        ).mean(axis=(0, 1))
        for number in range(2)
        for plan in range(2)
    ]
    apart = [np.linalg.norm(one - other) for one, other in combinations(colors, 2)]
    assert min(apart) > 5, colors


class Still(wiw.WorldModel):
    """Repeats what it is shown, three frames at a time."""

    accepts = wiw.accepts("action", frames=4, size=SIZE, seeded=False)

    def rollout(self, observations, controls, seeds):
        return np.repeat(observations.image[:, None], 4, axis=1)


@pytest.mark.parametrize("error", ["tint@40", "flicker@20", "noise@120"])
def test_an_error_of_looks_is_the_same_in_all_parts_of_a_plan(env, error: str) -> None:
    """A model that imagines few frames continues from its own, not from those with the error."""
    plan = Proposal([int(FORWARD)] * 6)
    changes = imagine(env, error, [plan], Still()).rollouts[0][0].frames.astype(float)
    changes -= imagine(env, None, [plan], Still()).rollouts[0][0].frames
    strengths = np.abs(changes).mean(axis=(1, 2, 3))
    assert strengths.max() < 1.25 * strengths.min(), strengths
    likeness = np.corrcoef(changes.reshape(6, -1))[np.triu_indices(6, 1)]
    assert (likeness.min() > 0.9) if error == "tint@40" else (np.abs(likeness).max() < 0.3), likeness


@pytest.mark.parametrize("kind", ERRORS)
def test_front_views_may_have_errors(env, kind: str) -> None:
    model = Attempted(make_oracle(size=SIZE, view="perspective"), checks_pictures=False)
    true, found = (
        imagine(env, error, model=model, view="front").rollouts[0][0].frames
        for error in (None, f"{kind}@{ERRORS[kind].doses[PRIMITIVES][-1]:g}")
    )
    assert found.shape == true.shape and not np.array_equal(found, true)
    assert model.spent["rows"] == 2 and model.spent["frames"] == 8


@cache
def texture() -> np.ndarray:
    drawn = np.random.default_rng(0).integers(0, 256, (9, 16, 3)).astype(np.uint8)
    return cv2.resize(drawn, (128, 64), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("kind", [name for name, own in ERRORS.items() if issubclass(own, FrameDegradation)])
def test_looks_have_their_dose_in_frames_of_any_size(kind: str) -> None:
    large = cv2.resize(texture(), (1024, 512), interpolation=cv2.INTER_CUBIC)
    for dose in ERRORS[kind].doses[PRIMITIVES][:2]:  # the strongest noise is clipped
        error = make_error(f"{kind}@{dose}")
        found = cv2.resize(error.degrade(large, SEED, 1, True), (128, 64), interpolation=cv2.INTER_AREA)
        small = error.degrade(texture(), SEED, 1, True)
        assert small.dtype == np.uint8
        apart = [np.abs(np.subtract(each, texture(), dtype=float)).mean() for each in (found, small)]
        assert apart[1] == pytest.approx(apart[0], rel=0.15, abs=1.5), dose


def test_a_blur_is_the_gaussian_that_it_says_also_across_the_seam() -> None:
    frame = np.zeros((32, 1024, 3), np.uint8)
    frame[:, 0] = 255
    fine = make_error("blur@4").degrade(frame, 0, 1, True)[16, :, 0].astype(float)
    x = (np.arange(1024) + 512) % 1024 - 512
    np.testing.assert_allclose(fine, 255 * np.exp(-(x**2) / 32) / np.sqrt(32 * np.pi), atol=1.0)
    frame[:, np.abs(x) < 100] = 255  # a wide Gaussian is applied to a smaller picture
    wide = make_error("blur@24").degrade(frame, 0, 1, True)[16, :, 0].astype(float)
    exact = cv2.GaussianBlur(np.where(np.abs(np.arange(1024) - 512) < 100, 255.0, 0.0)[None], (0, 0), 24)[0]
    np.testing.assert_allclose(np.roll(wide, 512), exact, atol=5)


def test_flicker_differs_from_frame_to_frame_and_a_tint_does_not() -> None:
    grey = np.full((36, 64, 3), 128, np.uint8)
    flicker, tint = (make_error(text) for text in ("flicker@20", "tint@20"))
    pairs = [[error.degrade(grey, 3, index, True) for index in (1, 2)] for error in (flicker, tint)]
    assert [np.array_equal(*pair) for pair in pairs] == [False, True]
    assert flicker.degrade(grey, 3, 1, True).std() == pytest.approx(20, rel=0.1)
    color = tint.degrade(grey, 3, 1, True)[0, 0].astype(float) - 128
    assert np.linalg.norm(color) == pytest.approx(20, abs=1)


def test_a_walk_by_the_plan_is_the_simulators_own(env) -> None:
    fork = fork_of(env)
    plan = np.array([1, 1, 2, 1, 3, 3, 1, 4, 1, 1, 1, 1, 1, 1, 1, 1], np.int8)
    walker = Walker(fork)
    walked = np.stack([walker.move(*move) for move in list_moves(plan)])
    np.testing.assert_allclose(walked, fork.camera_poses_after(plan), atol=1e-4)
    assert np.linalg.norm(walked[-1, :3, 3] - walked[0, :3, 3]) < 0.2 * 12  # the last strides are into a wall


@pytest.mark.parametrize(
    ("error", "metres"),
    [
        ("scale@0.5", [0.1, 0.2, 0.3, 0.4]),
        ("lag@1", [0.2, 0.2, 0.2, 0.2]),
        ("lag@3", [0.2, 0.4, 0.6, 0.6]),
        ("drift@0.05", [0.05, 0.1, 0.15, 0.2]),
        ("ignored@1", [0.2, 0.4, 0.6, 0.8]),
        ("direction@60", [0.2, 0.4, 0.6, 0.8]),
    ],
)
def test_an_error_of_control_leads_where_it_says(env, error: str, metres: list[float]) -> None:
    found = make_error(error).misplace(fork_of(env), AHEAD.actions, SEED)
    np.testing.assert_allclose(found[:, 0], metres, atol=0.01)
    np.testing.assert_allclose(found[:, 1], 0, atol=1e-3)


def test_frames_that_lag_are_the_oracles_earlier_ones(env) -> None:
    true, late = (imagine(env, error).rollouts[0][0].frames for error in (None, "lag@1"))
    assert min(psnr(late[1:], true[:-1])) > 40 > max(psnr(late[1:], true[1:]))


def test_content_is_drawn_otherwise_and_the_renderer_is_left_as_it_was(env) -> None:
    fork = fork_of(env)
    things = list_things(fork.world.scene)
    assert all(each["category"] not in STRUCTURE for each in fork.world.scene.instances if each["id"] in things.ids)
    pose = fork.camera_poses_after(np.array([int(FORWARD)]))

    def look(renderer) -> np.ndarray:
        ids, color = np.empty((1, *SIZE), np.uint32), np.empty((1, *SIZE, 3), np.uint8)
        renderer.panorama(pose, SIZE, color, np.empty((1, *SIZE), np.float32), ids)
        return ids, color

    before = look(fork.renderer)
    gone = look(make_error("missing@1").draw_world(fork, SEED).renderer)[0]
    assert np.isin(before[0], things.ids).any() and not np.isin(gone, things.ids).any()
    opened = look(make_error("open@1").draw_world(fork, SEED).renderer)[0]
    assert not np.isin(opened, list_barriers(fork.world.scene).ids).any()
    invented = np.empty((1, *SIZE, 3), np.uint8)
    make_error("invented@1").draw_world(fork, SEED).renderer.panorama(pose, SIZE, invented, None, None)
    assert 0.005 < (invented != before[1]).any(-1).mean() < 0.7
    after = look(fork.renderer)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_open_space_is_walked_through(env) -> None:
    fork = fork_of(env)
    into_wall = np.array([int(FORWARD)] * 30, np.int8)
    blocked = fork.camera_poses_after(into_wall)[-1, :3, 3]
    free = make_error("open@1").draw_world(fork, SEED).camera_poses_after(into_wall)
    start = fork.core.position
    assert np.linalg.norm(free[-1, [0, 2], 3] - start[[0, 2]]) == pytest.approx(6.0, abs=0.05)
    assert np.linalg.norm(blocked[[0, 2]] - start[[0, 2]]) < 5.9


@pytest.mark.parametrize("error", ["scale@0.5", "missing@0.5"])
def test_an_error_acts_in_no_other_scene_than_the_episodes(env, two_rooms: str, tmp_path: Path, error: str) -> None:
    """A swapped placebo imagines in another episode's scene, where things have other ids and floor lies elsewhere."""
    task = ImageNav(scenes=str(shutil.copy(two_rooms, tmp_path / f"elsewhere{Path(two_rooms).suffix}")))
    elsewhere = task.environment()
    elsewhere.begin(task.episode(0))
    with pytest.raises(ArgumentError, match=f"'{error}' acts in the scene of the episode.*expected episodes of one"):
        imagine(env, error, shown=ModelInput(elsewhere.observation, elsewhere.fork()))
    imagine(env, "blur@4", shown=ModelInput(elsewhere.observation, elsewhere.fork()))
    imagine(env, error, shown=ModelInput(env.observation, env.fork()))


def test_copies_are_pasted_behind_what_is_nearer() -> None:
    picture, copies = np.zeros((1, 4, 3), np.uint8), np.full((1, 4, 3), 9, np.uint8)
    depth, there = np.array([[2.0, 2.0, 0.0, 2.0]], np.float32), np.array([[1.0, 3.0, 5.0, 1.0]], np.float32)
    paste_copies(picture, depth, copies, there, np.array([[True, True, True, False]]))
    assert picture[0, :, 0].tolist() == [9, 0, 9, 0]


@pytest.fixture(scope="module")
def table():
    task = Manipulation("stack_cups")
    env = task.environment()
    env.begin(task.episode(0))
    return env


@pytest.fixture(scope="module")
def bench(table):
    return table.fork()


def test_frames_of_a_changed_world_need_not_look_like_the_observation(env) -> None:
    """Where things are moved, red and blue may seem exchanged; that is no broken contract."""

    class Strange(Oracle):
        def rollout(self, observations, controls, seeds):
            frames = super().rollout(observations, controls, seeds)
            frames[:, 1:] = frames[:, 1:, ..., ::-1]
            return frames

    with pytest.raises(RolloutError):
        imagine(env, "moved@0", model=Attempted(Strange(SIZE)))
    unchecked = Attempted(Strange(SIZE), checks_pictures=False)
    assert len(imagine(env, "moved@1", model=unchecked).rollouts[0][0].frames) == 4
    for dose, checks in ((0, True), (1, False)):
        agent = agent_for(ImageNav(), AgentRecipe("matcher", "oracle", error=f"moved@{dose}"))
        (attempted,) = [one for one in list_wrappers(agent.model) if isinstance(one, Attempted)]
        assert attempted.__reduce__()[1][2] == checks


def list_wrappers(model) -> list:
    return [model, *list_wrappers(model.model)] if isinstance(model, ModelWrapper) else [model]


def test_things_on_a_table_are_drawn_elsewhere_while_physics_stays_true(bench) -> None:
    name = next(iter(bench.things))
    shift = np.eye(4)
    shift[1, 3] = 0.2
    moved = bench.draw_elsewhere({name: shift})
    ids = 1 + np.flatnonzero(np.array(bench.instance_names) == name)
    views = [each.render_view(size=(48, 48), outputs=("instance",))["instance"] for each in (bench, moved)]
    places = [np.argwhere(np.isin(view, ids)).mean(0) for view in views]
    assert np.abs(places[1] - places[0]).max() > 3
    np.testing.assert_array_equal(moved.get_pose(name), bench.get_pose(name))
    np.testing.assert_array_equal(bench.get_part_poses(), bench.fork().get_part_poses())


def test_errors_at_a_table(bench) -> None:
    """Poses that the arm reaches at once, so that the physics takes little."""
    here = bench.pose
    poses = np.repeat(here[None], 3, axis=0)
    poses[:, 1] += [0, 0.02, 0.04]
    expected = {"scale@1": [0.02, 0.04], "lag@1": [0.02, 0.02], "ignored@1": [0.02, 0.04], "drift@0.05": [0.05, 0.1]}
    for error, metres in expected.items():
        np.testing.assert_allclose(make_error(error).misplace(bench, poses[1:], SEED)[:, 0], metres, atol=1e-9)
    turned = make_error("direction@90").change_poses(poses, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(turned[1:, 0] - here[0]), [0.02, 0.04], atol=1e-9)
    np.testing.assert_array_equal(turned[:, 2:], poses[:, 2:])
    benches = {"": bench}
    benches |= {
        error: make_error(error).draw_table(bench, SEED)
        for error in ("missing@0", "missing@1", "moved@0.1", "invented@1")
    }
    views = {error: drawn.fork().render_fronts_after(here[None], (48, 48)) for error, drawn in benches.items()}
    np.testing.assert_array_equal(views[""], views["missing@0"])
    assert all(not np.array_equal(views[""], views[error]) for error in ("missing@1", "moved@0.1", "invented@1"))


@pytest.mark.parametrize("error", ["ignored@1", "lag@1"])
def test_a_gripper_that_is_not_moved_keeps_what_it_holds(error: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wide = Thing("block", ((Box([0.06] * 3), np.eye(4)),), (0.8, 0.1, 0.1), mass=0.05)
    bench = Workbench([(wide, place(0.1, 0.0, TABLE + 0.03))])
    for height, gripper in ((0.1, 1.0), (0.03, 1.0), (0.03, 0.0), (0.2, 0.0)):
        bench.move_to([0.1, 0, TABLE + height, np.pi, 0, 0, gripper])
    assert bench.held_object == "block" and bench.pose[6] > 0.5  # open, as far as the fingers tell
    control = Control.of_poses(1, "", np.stack([bench.pose, [0.1, 0, TABLE + 0.25, np.pi, 0, 0, 0]]))
    sent: list[Control] = []
    monkeypatch.setattr(ArmOracle, "rollout", lambda model, observations, controls, seeds: sent.extend(controls))
    observations = Conditioning(np.zeros((1, *SIZE, 3), np.uint8), simulators=[bench])
    make_error(error).rollout(ArmOracle(), observations, [control], np.array([SEED], np.uint64))
    fork = bench.fork()
    fork.move_to(sent[0].ids[1])
    assert fork.held_object == "block" and fork.get_pose("block")[2, 3] > TABLE + 0.15


@pytest.mark.parametrize("error", ["flicker@60", "direction@90", "ignored@0.5", "lag@1", "missing@0.5", "moved@0.1"])
def test_at_a_table_where_only_ends_are_read_nothing_else_is_drawn(table, error: str) -> None:
    plans = [Proposal(table.fork().pose + np.outer([1, 2, 3], [0, side, 0, 0, 0, 0, 0])) for side in (0.01, -0.02)]
    how = {"plans": plans, "model": make_oracle(GRIPPER_POSES, SIZE), "view": "front"}
    whole, ends = (imagine(table, error, ends=ends, **how) for ends in (False, True))
    for one, other in zip(ends.rollouts[0], whole.rollouts[0], strict=True):
        np.testing.assert_array_equal(one.frames, other.frames[-1:])
    assert [found.costs[0]["frames"] for found in (whole, ends)] == [6, 2]


def test_an_arm_names_error_dose_and_model() -> None:
    recipes = arm_recipes(
        AgentRecipe("matcher", "warp"), ["error-blur@16", "error-blur@16:warp", "heuristic+error-lag@2"]
    )
    assert [(name, own.error, own.model) for name, own in recipes.items()] == [
        ("error-blur@16", "blur@16", "oracle"),
        ("error-blur@16:warp", "blur@16", "warp"),
        ("heuristic+error-lag@2", "lag@2", "oracle"),
    ]
    again = AgentRecipe.from_json(recipes["error-blur@16:warp"].to_json())
    assert again == recipes["error-blur@16:warp"]


@pytest.mark.parametrize(
    ("arm", "text"),
    [
        ("error-blurr@1", "no error is called 'blurr'. Did you mean blur"),
        ("error-blur", "expected KIND@DOSE with a number"),
        ("error-ignored@2", "expected a dose from 0 to 1"),
        ("error-blur@-1", "expected a dose from 0"),
        ("error-blur@inf", "expected a dose from 0"),
        ("error-lag@0.5", "expected a whole number of actions as dose, got 0.5"),
        ("error-blur@1:none", "of a world model"),
    ],
)
def test_an_arm_that_names_no_error_is_refused(arm: str, text: str) -> None:
    with pytest.raises(ArgumentError, match=text):
        arm_recipes(AgentRecipe("matcher"), [arm])


def test_an_error_must_make_sense_for_task_and_model(two_rooms: str) -> None:
    table, room = Manipulation(), ImageNav(scenes=two_rooms)
    for arm, task, text in (
        ("error-open@1", table, "not defined for plans of space 'pose7'"),
        ("error-lag@1:warp", room, "only the oracle is given"),
    ):
        (recipe,) = arm_recipes(AgentRecipe(task.default_policy), [arm]).values()
        with pytest.raises(ArgumentError, match=text):
            recipe.require(task, 1)
    (recipe,) = arm_recipes(AgentRecipe("matcher"), ["error-noise@9:warp"]).values()
    recipe.require(room, 1)


def test_a_scene_without_labels_has_no_things_to_change() -> None:
    scene = wiw.scenes.Scene.from_arrays(
        [{"positions": np.eye(3, dtype=np.float32), "triangles": np.array([[0, 1, 2]])}], name="plain"
    )
    with pytest.raises(ArgumentError, match="plain has no things that could be changed"):
        list_things(scene)


def test_the_oracle_has_the_size_that_it_is_asked_for() -> None:
    assert make_oracle(size=[36, 64]).accepts.size == (36, 64) and make_oracle().accepts.size == (576, 1024)
    assert make_oracle(GRIPPER_POSES, [60, 60]).accepts.size == (60, 60)
    assert make_oracle().describe() == {"name": "Oracle"}
    with pytest.raises(ArgumentError, match=r"expected size \[height, width\]"):
        make_oracle(size=[36])


def test_errors_are_listed_with_their_units(capsys) -> None:
    assert main(["list", "errors"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert all(kind in shown for kind in ERRORS) and "error-KIND@DOSE" in shown


def test_a_share_of_the_decisions_is_measured_the_same_as_all(env) -> None:
    environments = LiveEnvironments()
    environments.add(Key(SEED, 0), env)
    found = []
    for share in (1.0, 0.5):
        model, observer = Erroneous(Oracle(SIZE), make_error("drift@0.1")), FidelityObserver(share=share)
        agent = wiw.Agent("matcher", model, config=AgentConfig(candidates=2, horizon=4), observers=[observer])
        agent.grant(environments)
        queries = [Query(env.observation, env.goal, Key(SEED, 0, decision)) for decision in range(4)]
        found.append([agent.decide_batch([query])[0].fidelity for query in queries])
    whole, part = found
    assert None not in whole and 0 < part.count(None) < len(part)
    for one, other in zip(whole, part, strict=True):
        if other is not None:
            np.testing.assert_array_equal(one.psnr, other.psnr)
            np.testing.assert_array_equal(one.pose_errors, other.pose_errors)
            assert (one.pose_errors[:, 0] > 0.05).all()
