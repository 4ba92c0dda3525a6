# SPDX-License-Identifier: Apache-2.0
"""The history that world models with a memory are shown: right, said where it is padded, and the episode's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from history_models import Recalling, digest
from locations import PYTHON_TESTS

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, relative_poses, to_trajectory
from wiw.errors import ArgumentError
from wiw.experiments.placebos import SwappedPlacebo
from wiw.loop.attempts import Attempted
from wiw.loop.clock import Clock
from wiw.loop.history import EpisodeHistories, Frame, stack_histories
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.memory import Query
from wiw.loop.plan_space import plan_space
from wiw.loop.rollout_cache import Cached, RolloutCache
from wiw.loop.scheduler import run_episodes
from wiw.loop.search import move
from wiw.policies.base import FrameSpec, Situation
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.serving.background import serve_in_background
from wiw.tasks.imagenav import ImageNav
from wiw.types import ArmObservation, Goal, History, Key, Observation, Proposal

SIZE = (24, 32)
DECLARED = {
    "control": "trajectory", "view": "perspective", "size": SIZE, "needs": ("history",), "history": 3, "causal": True,
}  # fmt: skip
TURN = np.radians(22.5)
PLANS = ([FORWARD, FORWARD, TURN_LEFT, FORWARD], [TURN_LEFT, TURN_LEFT, FORWARD], [TURN_RIGHT, FORWARD, FORWARD])


class Watching(wiw.WorldModel):
    """Keeps what it is given; frame k of a row is as grey as 10 k."""

    def __init__(self, **declared):
        self.accepts = wiw.accepts(**{**DECLARED, **declared})
        self._calls = []

    accepts = wiw.accepts(**DECLARED)

    def rollout(self, observations, controls, seeds):
        self._calls.append((observations, controls))
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        frames[:, 1:] = np.arange(10, 10 * frames.shape[1], 10, dtype=np.uint8)[:, None, None, None]
        return frames


class Walking(wiw.Policy):
    """Proposes the same plans at each decision, and follows the one whose number is the decision's."""

    plans = PLANS
    frames = FrameSpec("front", SIZE)

    def propose(self, situations, candidates, horizon):
        return [[Proposal(plan) for plan in self.plans[:candidates]] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [
            np.eye(len(plans))[situation.key.decision % len(plans)]
            for situation, plans in zip(situations, proposals, strict=True)
        ]


class Brightest(Walking):
    """Follows the plan that looks brightest, so that what is decided depends on what was imagined."""

    def score(self, situations, proposals, rollouts):
        return [np.array([float(rollout.frames[-1].mean()) for rollout in plans]) for plans in rollouts]


@pytest.fixture
def task(two_rooms: str) -> ImageNav:
    return ImageNav(scenes=two_rooms, decisions=4)


def record_episode(task, agent, decisions=4, episode=0):
    """The observations of some decisions by hand, and what was carried out after each."""
    env = task.environment()
    observation, seen, carried = env.begin(task.episode(episode)), [], []
    for decision in range(decisions):
        seen.append(observation)
        chosen = agent.decide(observation, env.goal, Key(0, episode, decision))
        carried.append(chosen.actions[: chosen.execute])
        observation = env.run(carried[-1]).observation
    return seen, carried


@pytest.mark.parametrize("view", ["perspective", "panorama"])
def test_a_row_sees_the_episodes_latest_observations_with_what_lies_between(task: ImageNav, view: str) -> None:
    model = Watching(view=view)
    seen, carried = record_episode(task, wiw.Agent(Walking(), model, horizon=4, execute=2))
    assert len(model._calls) == 4
    ahead = [observations.image[0] for observations, _ in model._calls]  # the first plan has no leading turns
    for decision, (observations, _) in enumerate(model._calls):
        history, most = observations.history, min(3, decision + 1)
        assert history.images.shape == (3, 3, *SIZE, 3) and history.images.dtype == np.uint8 and len(history) == 3
        np.testing.assert_array_equal(history.images[:, -1], observations.image)
        assert history.count.tolist() == [most, min(3, decision + 2), min(3, decision + 2)]
        known = range(decision + 1 - most, decision + 1)
        np.testing.assert_array_equal(history.images[0, -most:], [ahead[k] for k in known])
        for place, k in enumerate(known):
            pose = history.poses[0, 3 - most + place]
            np.testing.assert_allclose(
                np.append(compose(seen[decision].odometry, pose), np.cos(pose[2])),
                np.append(seen[k].odometry[:2], np.cos(seen[k].odometry[2] - seen[decision].odometry[2])),
                atol=1e-9,
            )
        for gap, k in enumerate(known[:-1], start=3 - most):
            own = history.actions[0, gap, : history.lengths[0, gap]]
            np.testing.assert_array_equal(own, carried[k])
            assert not history.actions[0, gap, len(own) :].any()
    assert history.actions.dtype == np.int8 and history.poses.dtype == np.float64 and history.lengths.dtype == np.int64
    assert np.abs(history.poses[0]).max() > 0.1


def compose(odometry, pose):
    cos, sin = np.cos(odometry[2]), np.sin(odometry[2])
    return odometry[:2] + np.array([cos * pose[0] - sin * pose[1], sin * pose[0] + cos * pose[1]])


def test_after_leading_turns_the_present_observation_is_the_frame_before(task: ImageNav) -> None:
    model = Watching()
    record_episode(task, wiw.Agent(Walking(), model, horizon=4, execute=2), decisions=3)
    history = model._calls[-1][0].history
    ahead, left, right = range(3)
    for row, turns in ((left, 2), (right, -1)):
        np.testing.assert_array_equal(history.images[row, :-1], history.images[ahead, 1:])
        assert (history.images[row, -1] != history.images[ahead, -1]).any()
        np.testing.assert_allclose(history.poses[row, -2:], [[0, 0, -turns * TURN], [0, 0, 0]], atol=1e-12)
        assert history.lengths[row, -1] == abs(turns)
        turned = history.actions[row, -1, : abs(turns)]
        assert (turned == (TURN_LEFT if turns > 0 else TURN_RIGHT)).all()
        # the older frame lies where it lay, but in a frame that has turned
        cos, sin = np.cos(turns * TURN), np.sin(turns * TURN)
        x, y, _ = history.poses[ahead, 1]
        np.testing.assert_allclose(history.poses[row, 0, :2], (cos * x + sin * y, cos * y - sin * x), atol=1e-12)


def test_a_young_episode_is_padded_with_its_first_frame_and_says_so(task: ImageNav) -> None:
    model = Watching(history=5)
    record_episode(task, wiw.Agent(Walking(), model, candidates=1, horizon=4, execute=2), decisions=2)
    first, second = (observations.history for observations, _ in model._calls)
    assert first.valid.tolist() == [[False] * 4 + [True]] and second.valid.tolist() == [[False] * 3 + [True] * 2]
    assert first.count.tolist() == [1] and second.count.tolist() == [2]
    np.testing.assert_array_equal(first.images, np.repeat(first.images[:, -1:], 5, 1))
    np.testing.assert_array_equal(second.images[:, :3], np.repeat(second.images[:, 3:4], 3, 1))
    np.testing.assert_array_equal(second.poses[:, :3], np.repeat(second.poses[:, 3:4], 3, 1))
    assert not first.poses.any() and not first.actions.any() and first.actions.shape == (1, 4, 1)
    assert second.lengths.tolist() == [[0, 0, 0, 2]]


def test_a_model_can_tell_a_turning_agent_from_a_standing_one() -> None:
    def question_after(*turned):
        """The agent looks as it does now, wherever it has looked before."""
        model, agent = Watching(), None
        agent = wiw.Agent(Walking(), model, candidates=1, horizon=4, execute=1)
        for decision, azimuth in enumerate((*turned, 0.0)):
            panorama = np.full((576, 1024, 3), 100 + int(100 * azimuth), np.uint8)
            observation = Observation(panorama, panorama[:480, :480], np.array([0.0, 0.0, azimuth]))
            agent.decide(observation, Goal("x"), Key(0, 0, decision))
        return model._calls[-1][0]

    standing, turning = question_after(0.0, 0.0), question_after(-2 * TURN, -TURN)
    np.testing.assert_array_equal(standing.image, turning.image)
    np.testing.assert_allclose(turning.history.poses[0, :, 2], [-2 * TURN, -TURN, 0], atol=1e-12)
    assert not standing.history.poses.any() and standing.history.count.tolist() == [3]
    assert digest(standing.history, 0) != digest(turning.history, 0)


class Recorder:
    def __init__(self):
        self.decisions, self.results = {}, {}

    def decision(self, record):
        self.decisions[record.episode, record.index] = record

    def episode(self, result):
        self.results[result.episode] = result

    def record_restart(self, episodes):
        self.decisions = {key: record for key, record in self.decisions.items() if key[0] not in episodes}

    def record_lost(self, spent):
        pass


def run(task, agent, count=3, live=2, order=1):
    recorder = Recorder()
    run_episodes(task, agent, list(enumerate(task.episodes(count)))[::order], seed=0, live=live, sink=recorder)
    assert {result.status for result in recorder.results.values()} == {"done"}
    return {name: record.decision.scores.tolist() for name, record in recorder.decisions.items()}


@pytest.mark.parametrize("frames", [0, 3])
def test_histories_do_not_depend_on_what_else_is_live(task: ImageNav, frames: int) -> None:
    class Any(Recalling):
        accepts = replace(Recalling.accepts, frames=frames)

    def found(**how):
        return run(task, wiw.Agent(Brightest(), Any(), horizon=4), **how)

    alone = found(live=1)
    assert len({tuple(scores) for scores in alone.values()}) > len(alone) / 2
    assert alone == found(live=3) == found(live=2, order=-1)


def test_nor_on_workers_or_the_wire(two_rooms: str, tmp_path: Path) -> None:
    here = f"{PYTHON_TESTS / 'history_models.py'}:Recalling"
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 3})
    agent, quiet = AgentRecipe("heuristic", here, reviser="matcher"), {"progress": False, "keep_images": 0}
    with serve_in_background(Recalling) as server:
        arms = [here, f"remote:{server.address}"]
        one = wiw.evaluate(task, agent, 2, out=tmp_path / "1", live=2, arms=arms, cache="off", **quiet)
    two = wiw.evaluate(task, agent, 2, out=tmp_path / "2", workers=2, live=1, **quiet)

    def facts(log):
        found = {}
        for row in log.decisions:
            found.setdefault(row["arm"], []).append((row["episode"], row["decision"], row["actions"], row["scores"]))
        return found.values()

    (local, remote), (apart,) = facts(one), facts(two)
    assert local == remote == apart and len(local) > 3
    assert all(row["status"] == "done" for row in [*one.episodes, *two.episodes])


def test_an_episode_that_begins_again_remembers_nothing(task: ImageNav) -> None:
    clean = run(task, wiw.Agent(Brightest(), Recalling(), horizon=4), live=1)
    agent = wiw.Agent(Brightest(), Recalling(), horizon=4)
    env = task.environment()
    for _ in range(2):  # by hand, the same episode twice
        observation, again = env.begin(task.episode(0)), {}
        for decision in range(3):
            chosen = agent.decide(observation, env.goal, Key(0, 0, decision))
            again[0, decision] = chosen.scores.tolist()
            observation = env.run(chosen.actions[: chosen.execute]).observation
        assert again == {name: clean[name] for name in again}


def test_an_episode_that_is_run_again_after_an_error_remembers_nothing(task: ImageNav, monkeypatch) -> None:
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))

    class Small(Recalling):
        """Has no memory for two rows with a past, so that episodes are run again by themselves."""

        refused = 0

        def rollout(self, observations, controls, seeds):
            if len(controls) > 1 and observations.history.count.max() > 1:
                type(self).refused += 1
                raise MemoryError
            return super().rollout(observations, controls, seeds)

    def found(model, live):
        return run(task, wiw.Agent(Brightest(), model, candidates=1, horizon=4), live=live)

    assert found(Attempted(Small()), 3) == found(Recalling(), 1) and Small.refused == 3


def test_a_decision_that_is_asked_for_again_is_no_other_moment(task: ImageNav) -> None:
    model = Watching()
    agent = wiw.Agent(Walking(), model, candidates=1, horizon=4, execute=2)
    env = task.environment()
    observation = env.begin(task.episode(0))
    for decision in range(3):
        for _ in range(2):
            chosen = agent.decide(observation, env.goal, Key(0, 0, decision))
        observation = env.run(chosen.actions[: chosen.execute]).observation
    once, twice = (observations.history for observations, _ in model._calls[-2:])
    assert digest(once, 0) == digest(twice, 0) and once.lengths.tolist() == [[2, 2]]
    agent.forget(Key(0, 0))
    agent.decide(observation, env.goal, Key(0, 0, 3))
    assert model._calls[-1][0].history.count.tolist() == [1]


def test_the_swapped_placebo_is_shown_a_first_moment() -> None:
    class Bright:
        """Every other episode begins in a bright place."""

        def of(self, key):
            panorama = np.full((576, 1024, 3), 200, np.uint8)
            return ModelInput(Observation(panorama, panorama[:480, :480], np.zeros(3)))

    model = Watching()
    agent = wiw.Agent(Walking(), SwappedPlacebo(model, Bright()), candidates=3, horizon=4)
    for decision in range(2):
        own = np.full((576, 1024, 3), 40, np.uint8)
        seen = Observation(own, own[:480, :480], np.zeros(3))
        agent.decide_batch([Query(seen, Goal("x"), Key(0, 0, decision))])
    history = model._calls[-1][0].history
    assert history.count.tolist() == [1, 2, 2] and (history.images == 200).all()


# -- plans that are longer than the model's rollout --------------------------------------------------------------------


class Chunked(wiw.WorldModel):
    """Frames as grey as the poses they show; those that nobody reads are noise. Keeps its calls."""

    def __init__(self, **declared):
        self.accepts = wiw.accepts(**{**DECLARED, **declared})
        self._calls = []

    accepts = wiw.accepts(**DECLARED)

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        for row, control in enumerate(controls):
            for k in range(1, frames.shape[1]):
                unread = k <= control.shared or k > control.length
                frames[row, k] = 255 if unread else frames[row, 0, 0, 0, 0] + 16 * control.actions[:k].sum()
        self._calls.append((observations, controls))
        return frames


def imagined(model, plans, past=()):
    """Asks about an agent that has observed `past` (x, grey) and now stands at 0 and sees black."""
    histories, executed = EpisodeHistories(model.accepts), ()
    for decision, (x, grey) in enumerate((*past, (0.0, 0))):
        panorama = np.full((576, 1024, 3), grey, np.uint8)
        observation = Observation(panorama, panorama[:480, :480], np.array([x, 0.0, 0.0]))
        key = Key(0, 0, decision)
        (history,) = histories.add([Situation(observation, Goal("x"), key, None, executed)])
        executed = (*executed, int(FORWARD))
    proposals, space = [[Proposal(plan) for plan in plans]], plan_space("discrete")
    shown, seeds = [ModelInput(observation, history=history)], [range(len(plans))]
    frames = FrameSpec("front", SIZE)
    space.imagine(Attempted(model), Request(space, [key], [observation], shown, proposals, seeds, frames, Clock()))
    return model._calls


def shades(history, row=0):
    return history.images[row, :, 0, 0, 0].tolist()


def test_later_calls_go_on_from_imagined_frames() -> None:
    plan = [FORWARD, TURN_LEFT, FORWARD, FORWARD, TURN_LEFT]
    calls = imagined(Chunked(frames=3, history=4, causal=False), [plan], past=[(-0.4, 200), (-0.2, 100)])
    assert len(calls) == 3
    histories = [observations.history for observations, _ in calls]
    assert [shades(history) for history in histories] == [
        [200, 200, 100, 0],
        [100, 0, 16, 48],
        [16, 48, 64, 80],
    ]
    assert [history.count.tolist() for history in histories] == [[3], [4], [4]]
    assert [history.lengths.tolist() for history in histories] == [[[0, 1, 1]], [[1, 1, 1]], [[1, 1, 1]]]
    assert histories[1].actions[0, :, 0].tolist() == [FORWARD, FORWARD, TURN_LEFT]
    assert histories[2].actions[0, :, 0].tolist() == [TURN_LEFT, FORWARD, FORWARD]
    path = to_trajectory(plan, include_start=True)
    poses = np.concatenate([[[-0.2, 0, 0]], path[:3]])
    np.testing.assert_allclose(histories[1].poses[0], relative_poses(poses), atol=1e-12)
    np.testing.assert_allclose(histories[2].poses[0], relative_poses(path[1:5]), atol=1e-12)
    for observations, _ in calls:
        np.testing.assert_array_equal(observations.history.images[:, -1], observations.image)


def test_frames_that_plans_share_are_found_where_they_were_made() -> None:
    straight, curved = [FORWARD] * 6, [FORWARD, FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD]
    late = [*[FORWARD] * 5, TURN_LEFT]
    calls = imagined(Chunked(frames=5, history=4, causal=True), [straight, curved, late])
    shared = [[(control.length, control.shared) for control in controls] for _, controls in calls]
    assert shared == [[(4, 0), (4, 3)], [(2, 0), (2, 0), (2, 1)]]
    history = calls[1][0].history
    assert [shades(history, row) for row in range(3)] == [[16, 32, 48, 64], [16, 32, 48, 80], [16, 32, 48, 64]]
    np.testing.assert_array_equal(history.images[:, -1], calls[1][0].image)
    turned = relative_poses(to_trajectory(curved)[:4])
    np.testing.assert_allclose(history.poses[1], turned, atol=1e-12)


def test_only_other_needs_keep_a_model_from_long_plans() -> None:
    wiw.Agent(Walking(), Watching(frames=3), horizon=5)
    with pytest.raises(ArgumentError, match="needs depth, which an imagined frame does not have"):
        wiw.Agent(Walking(), Watching(frames=3, needs=("depth", "history")), horizon=5)


# -- the parts ---------------------------------------------------------------------------------------------------------


def test_who_declares_a_history_says_that_it_is_needed() -> None:
    assert wiw.accepts("image", needs=("history",)).history == 4
    assert wiw.accepts("image", needs=("history",), history=1).history == 1
    assert wiw.accepts("image").history == 0 == wiw.accepts("image", history=0).history
    for wrong, said in (
        ({"history": 4}, r"without needs=\('history',\)"),
        ({"history": 4, "needs": ("depth",)}, "declare both or neither"),
        ({"history": 0, "needs": ("history",)}, "at least 1, got 0"),
        ({"history": 2.5, "needs": ("history",)}, "whole number"),
        ({"history": True, "needs": ("history",)}, "whole number"),
    ):
        with pytest.raises(ArgumentError, match=said):
            wiw.accepts("image", **wrong)


def test_one_frame_is_frame_0(task: ImageNav) -> None:
    model = Watching(history=1)
    record_episode(task, wiw.Agent(Walking(), model, horizon=4), decisions=2)
    observations = model._calls[-1][0]
    np.testing.assert_array_equal(observations.history.images[:, 0], observations.image)
    assert observations.history.actions.shape == (3, 0, 1) and observations.history.count.tolist() == [1, 1, 1]


def test_poses_are_where_odometry_was() -> None:
    start, actions = np.array([1.0, -2.0, 3.0]), [FORWARD, TURN_LEFT, FORWARD, TURN_LEFT, FORWARD]
    odometry = np.array([start, *(move(start, np.array(actions[: k + 1], np.int8)) for k in range(5))])
    found = relative_poses(odometry)
    assert not found[-1].any()
    np.testing.assert_allclose(found[0, :2], -rotate(to_trajectory(actions)[-1, :2], -2 * TURN), atol=1e-9)
    np.testing.assert_allclose(found[:, 2], [-2 * TURN, -2 * TURN, -TURN, -TURN, 0, 0], atol=1e-9)


def rotate(point, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])


def grey(shade, x, *actions):
    return Frame(np.full((*SIZE, 3), shade, np.uint8), np.array([x, 0.0, 0.0]), np.array(actions, np.int8))


def test_rows_and_batches_are_the_same_history() -> None:
    short = [grey(1, 0.0), grey(2, 0.2, FORWARD)]
    long = [grey(3, 0.0), grey(4, 0.6, *[FORWARD] * 3), grey(5, 0.6, TURN_LEFT, TURN_LEFT)]
    batch = stack_histories([short, long], 3)
    assert batch.actions.shape == (2, 2, 3) and batch.lengths.tolist() == [[0, 1], [3, 2]]
    alone = batch.rows([0])
    assert alone.actions.shape == (1, 2, 1)
    for name in ("images", "poses", "actions", "lengths", "count"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(stack_histories([short], 3), name))
        again = History.concatenate([alone, batch.rows([1])])
        np.testing.assert_array_equal(getattr(again, name), getattr(batch, name))


def test_the_cache_tells_histories_apart_but_not_batches(tmp_path: Path) -> None:
    past = [grey(3, 0.0), grey(4, 0.2, FORWARD), grey(5, 0.4, FORWARD)]
    long = [grey(3, 0.0), grey(4, 0.2, *[FORWARD] * 5)]
    ((observations, controls),) = imagined(Chunked(frames=0), [[FORWARD]])
    others = {
        "images": [grey(9, 0.0), *past[1:]],
        "poses": [grey(3, 0.1), *past[1:]],
        "actions": [past[0], grey(4, 0.2, TURN_LEFT), past[2]],
        "lengths": [past[0], grey(4, 0.2, FORWARD, 0), past[2]],
        "count": [past[0], past[0], *past[1:]][1:],
    }
    given = stack_histories([past], 3)
    others = {name: stack_histories([row], 3) for name, row in others.items()}
    others["count"] = replace(given, count=np.array([2]))
    model = Chunked(frames=0)
    model.fingerprint = lambda: "chunked"

    def count_rows(history, rows=1):
        before = len(model._calls)
        seen = replace(observations, image=np.repeat(observations.image, rows, 0), history=history)
        Cached(Attempted(model), RolloutCache(tmp_path)).rollout(seen, controls * rows, np.zeros(rows, np.uint64))
        return sum(len(call[1]) for call in model._calls[before:])

    assert count_rows(given) == 1 and count_rows(given) == 0
    for name, other in others.items():
        assert count_rows(other) == 1, name
    assert count_rows(stack_histories([past, long], 3), rows=2) == 1  # one is known, whatever stands beside it


def test_gripper_poses_are_absolute_and_their_actions_poses() -> None:
    declared = {"space": "pose7", "needs": ("history",), "history": 3}
    histories = EpisodeHistories(wiw.accepts("action", "perspective", SIZE, **declared))
    poses = np.array([[0.1, 0, 1, 0, 0, 0, 1], [0.2, 0, 1, 0, 0, 0, 1], [0.3, 0, 1, 0, 0, 0, 0]])
    carried, history, executed = [poses[:1].repeat(2, 0), poses[1:2]], (), ()
    for decision, pose in enumerate(poses[:3]):
        seen = ArmObservation(np.full((480, 480, 3), decision, np.uint8), pose)
        (history,) = histories.add([Situation(seen, Goal("x"), Key(0, 0, decision), None, executed)])
        executed = (*executed, *(carried[decision].tolist() if decision < 2 else ()))
    found = stack_histories([history, history[1:]], 3)
    np.testing.assert_array_equal(found.poses, [poses, poses[[1, 1, 2]]])
    assert found.lengths.tolist() == [[2, 1], [0, 1]] and found.actions.shape == (2, 2, 2, 7)
    np.testing.assert_array_equal(found.actions[0], [carried[0], poses[[1, 1]]])  # padded with the last pose
    np.testing.assert_array_equal(found.actions[1, 0], poses[[1, 1]])  # nothing was carried out: it stays there
    assert found.count.tolist() == [3, 2] and found.images[0, :, 0, 0, 0].tolist() == [0, 1, 2]
