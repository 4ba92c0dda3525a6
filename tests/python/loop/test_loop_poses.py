# SPDX-License-Identifier: Apache-2.0
"""The loop with plans of poses: a task without a world, in which a gripper is a dot that goes to a square."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw._core import core
from wiw.action import NULL, GripperTextTemplate, GripperVocabulary, resample, to_controls, to_text
from wiw.envs.base import Env, Guide, Segment
from wiw.errors import ArgumentError, ContractError
from wiw.experiments.ground_truth import TruePlans, TrueScores
from wiw.experiments.placebos import ShuffledPlacebo
from wiw.loop import imagine_poses
from wiw.loop.clock import Clock
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.plan_space import plan_space
from wiw.loop.privileged import LiveEnvironments
from wiw.policies.base import FrameSpec
from wiw.runs.compose import RunContext
from wiw.runs.recipes import AgentRecipe
from wiw.studies.evaluate import evaluate
from wiw.tasks.base import Task
from wiw.types import GRIPPER_POSES, ArmObservation, Episode, Goal, Key, Proposal, Truth

SIDE = 48
HOME = (0.5, 0.5, 0.5, 0, 0, 0, 1)


def picture(pose: Any, target: Any) -> Any:
    """The dot, as red as the gripper is high, on the square."""
    image = np.full((SIDE, SIDE, 3), 40, np.uint8)
    for (x, y), size, colour in ((target, 4, (0, 255, 0)), (pose[:2], 2, (55 + int(200 * pose[2]), 0, 0))):
        u, v = round(x * (SIDE - 1)), round(y * (SIDE - 1))
        image[max(0, v - size) : v + size + 1, max(0, u - size) : u + size + 1] = colour
    return image


def front_view(pose: Any, target: Any) -> Any:
    """The picture, enlarged to 480x480."""
    return picture(pose, target).repeat(10, axis=0).repeat(10, axis=1)


@dataclass
class Fork:
    pose: Any
    target: Any

    def fork(self) -> Fork:
        return Fork(self.pose, self.target)

    def render_fronts_after(self, poses: Any, size: Any, first: int = 0) -> Any:
        assert size == (480, 480)
        return np.stack([front_view(pose, self.target) for pose in poses[first:]])


class DotEnv(Env):
    def __init__(self, task: DotTask) -> None:
        self.task = task

    def begin(self, episode: Episode) -> ArmObservation:
        self.target, self.pose, self.decisions = np.array(episode.goal_position[:2]), np.array(HOME, float), 0
        return self.observation

    @property
    def goal(self) -> Goal:
        return Goal("dot", text="go to the green square")

    @property
    def observation(self) -> ArmObservation:
        return ArmObservation(front_view(self.pose, self.target), self.pose)

    def fork(self) -> Fork:
        return Fork(self.pose, self.target)

    def run(self, plan: Any, answer: Any = None) -> Segment:
        before, self.decisions = self.pose, self.decisions + 1
        self.pose = plan[-1]
        done = self._left() < 0.05
        path = np.stack([before[:3], *plan[:, :3]])
        return Segment(self.observation, plan, path, done, not done and self.decisions >= self.task.budget)

    def truth(self) -> Truth:
        return Truth(self.pose[:3], 0.0, self._left(), float("nan"))

    def result(self) -> dict[str, float]:
        return {"success": float(self._left() < 0.05), "actions": float(self.decisions)}

    def _left(self) -> float:
        return float(np.linalg.norm(self.pose[:2] - self.target))


@dataclass
class DotTask(Task):
    seed: int = 0
    budget: int = 6
    name: str = "dot"
    metrics: tuple[str, ...] = ("success", "mean_trajectory")
    space: str = GRIPPER_POSES

    @property
    def defaults(self) -> dict[str, int]:
        return {"candidates": 5, "horizon": 5, "execute": 5}

    def describe(self) -> dict[str, Any]:
        return {"task": self.name, "seed": self.seed}

    def environment(self, depth: bool = False) -> DotEnv:
        return DotEnv(self)

    def episodes(self, count: int) -> list[Episode]:
        places = 0.1 + 0.8 * core.uniform(core.fold_key([self.seed, 9]), 2 * count).reshape(-1, 2)
        return [
            Episode(f"{i:02d}", f"table/{i}", (0.5, 0.5, 0.0), 0.0, (float(x), float(y), 0.0), 0.0, float("nan"))
            for i, (x, y) in enumerate(places)
        ]


class Reacher(wiw.Policy):
    """Steps in five drawn directions; likes futures in which red is near green."""

    space = "pose7"
    frames = FrameSpec("front", (96, 96))

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        return [[self._plan(s, candidate, horizon) for candidate in range(candidates)] for s in situations]

    def _plan(self, situation: Any, candidate: int, horizon: int) -> Proposal:
        key = situation.key
        drawn = core.uniform(core.fold_key([key.seed, key.episode, key.decision, candidate]), 2)
        end = np.array([*drawn, *HOME[2:]])
        return Proposal(resample(end[None], horizon, start=situation.observation.pose), text=f"towards {drawn}")

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> Any:
        return [np.array([-self._distance(rollout.frames[-1]) for rollout in plans]) for plans in rollouts]

    def _distance(self, image: Any) -> float:
        red, green = (np.argwhere(image[:, :, channel] > 128).mean(axis=0) for channel in (0, 1))
        return float(np.linalg.norm(red - green))


class Spy(wiw.WorldModel):
    """Remembers what it is asked; frame k is as grey as k."""

    accepts = wiw.accepts(control="action", space="pose7", view="perspective", size=(32, 32), frames=14, best_batch=3)

    def __init__(self, **declared: Any) -> None:
        self._calls: list[Any] = []
        if declared:
            self.accepts = wiw.accepts(**{"view": "perspective", "size": (32, 32), **declared})

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        self._calls.append((observations, controls, seeds))
        frames = np.arange(len(controls[0].actions) + 1, dtype=np.uint8)[None, :, None, None, None]
        frames = np.broadcast_to(frames, (len(controls), frames.shape[1], 32, 32, 3)).copy()
        frames[:, 0] = observations.image
        return frames


def imagine(model: Any, proposals: Any, observations: Any, ends: bool = False, simulator: Any = None) -> Any:
    """Ask a model for each episode's plans from its first observation."""
    keys, origins = [Key(0, index) for index in range(len(proposals))], [range(len(own)) for own in proposals]
    space, inputs, frames = (
        plan_space("pose7"),
        [ModelInput(each, simulator=simulator) for each in observations],
        FrameSpec("front", (48, 48), ends),
    )
    return space.imagine(model, Request(space, keys, observations, inputs, proposals, origins, frames, Clock()))


def imagine_plans(model: Any, plans: Any, episodes: int = 1, ends: bool = False) -> Any:
    env = DotEnv(DotTask())
    observations = [env.begin(episode) for episode in DotTask().episodes(episodes)]
    proposals = [[Proposal(np.asarray(plan, float), text="to the left") for plan in plans] for _ in observations]
    return imagine(model, proposals, observations, ends, env.fork())


def plan_of(count: int, end: float = 1.0) -> Any:
    return resample(np.array([[end, *HOME[1:]]]), count, start=np.array(HOME, float))


def test_a_plan_is_imagined_at_the_models_length_and_seen_at_its_own_poses() -> None:
    model = Spy()
    found = imagine_plans(model, [plan_of(5), plan_of(50)])
    ((_, controls, _),) = model._calls
    for control in controls:
        assert control.ids.shape == (14, 7) and control.length == 13 and (control.actions == NULL).all()
        np.testing.assert_allclose(control.ids[0], HOME)
        np.testing.assert_allclose(control.ids[:, 0], np.linspace(0.5, 1.0, 14), atol=0.011)
    short, long = (rollout.frames[:, 0, 0, 0] for rollout in found.rollouts[0])
    assert short.tolist() == [3, 5, 8, 10, 13]
    assert len(long) == 50 and long[-1] == 13 and (np.diff(long[1:].astype(int)) >= 0).all()
    assert found.costs == [{"consultations": 1, "rows": 2, "frames": 26}]
    assert found.rollouts[0][0].frames.shape == (5, 48, 48, 3) and not found.rollouts[0][0].real.any()


def test_a_model_of_any_length_gets_the_plan_itself() -> None:
    model = Spy(control="action", space="pose7", best_batch=2)
    imagine_plans(model, [plan_of(5), plan_of(3), plan_of(5, 0.7), plan_of(5, 0.2)])
    assert [[len(c.ids) for c in controls] for _, controls, _ in model._calls] == [[4], [6, 6], [6]]
    np.testing.assert_array_equal(model._calls[1][1][0].ids[1:], plan_of(5))


def test_a_model_gets_poses_in_its_own_words_and_numbers() -> None:
    plan = plan_of(3)
    numbers = Spy(control="action", space="pose7", vocabulary=GripperVocabulary("matrix_6d"))
    imagine_plans(numbers, [plan])
    ids = numbers._calls[0][1][0].ids
    assert ids.shape == (4, 10)
    np.testing.assert_array_equal(ids[1:], to_controls(plan, GripperVocabulary("matrix_6d")))
    words = Spy(control="text", space="pose7", template=GripperTextTemplate("Do: {actions}", "to {x}", "; "))
    plans = [Proposal(plan), Proposal(plan_of(2), text="own words")]
    imagine(words, [plans], [DotEnv(DotTask()).begin(DotTask().episodes(1)[0])])
    texts = sorted(control.text for _, controls, _ in words._calls for control in controls)
    assert texts == [to_text(plan, words.accepts.template), "own words"] and texts[0].startswith("Do: to ")


@pytest.mark.parametrize("causal", [False, True])
def test_where_only_ends_are_read_the_last_frame_is_shown(causal: bool) -> None:
    model = Spy(control="action", space="pose7", frames=14, causal=causal)
    found = imagine_plans(model, [plan_of(5), plan_of(50)], ends=True)
    ((_, controls, _),) = model._calls
    assert [control.shared for control in controls] == [12 * causal] * 2
    assert [rollout.frames[:, 0, 0, 0].tolist() for rollout in found.rollouts[0]] == [[13], [13]]
    assert [rollout.real.tolist() for rollout in found.rollouts[0]] == [[False], [False]]
    assert found.costs == [{"consultations": 1, "rows": 2, "frames": 2 if causal else 26}]


def test_the_oracle_draws_no_view_that_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[float] = []

    def draw(pose: Any, target: Any) -> Any:
        drawn.append(round(float(pose[0]), 6))
        return picture(pose, target).repeat(10, axis=0).repeat(10, axis=1)

    oracle, plans = wiw.world_model("oracle", space="pose7"), [plan_of(5), plan_of(3, 0.8)]
    whole = imagine_plans(oracle, plans)
    monkeypatch.setitem(globals(), "front_view", draw)
    ends = imagine_plans(oracle, plans, ends=True)
    assert drawn[1:] == [0.8, 1.0]  # after the first observation
    for one, other in zip(ends.rollouts[0], whole.rollouts[0], strict=True):
        np.testing.assert_array_equal(one.frames, other.frames[-1:])


def test_equal_plans_of_an_episode_are_asked_once() -> None:
    model = Spy()
    found = imagine_plans(model, [plan_of(5), plan_of(5), plan_of(5, 0.7)], episodes=2)
    assert [call["rows"] for call in found.costs] == [2, 2]
    np.testing.assert_array_equal(found.rollouts[0][0].frames, found.rollouts[0][1].frames)
    seeds = np.concatenate([seeds for _, _, seeds in model._calls])
    assert len(set(seeds.tolist())) == 4


def test_words_are_the_policys_or_made_of_the_poses() -> None:
    model = Spy(control="text", frames=9)
    imagine_plans(model, [plan_of(5)])
    ((observations, controls, _),) = model._calls
    assert controls[0].text == "to the left" and controls[0].ids is None
    assert observations.image.shape == (1, 32, 32, 3)
    env = DotEnv(DotTask())
    imagine(model, [[Proposal(plan_of(2))]], [env.begin(DotTask().episodes(1)[0])])
    assert model._calls[-1][1][0].text == wiw.action.to_text(plan_of(2))


def test_a_model_with_a_memory_sees_the_front_views_and_gripper_poses_of_earlier_decisions() -> None:
    model = Spy(control="action", space="pose7", frames=14, best_batch=9, needs=("history",), history=3)
    reacher = Reacher()
    reacher.score = lambda situations, *_: [np.array([1.0, 0.0]) for _ in situations]
    agent = wiw.Agent(reacher, model, candidates=2, horizon=5, execute=2)
    env = DotEnv(DotTask())
    observation, seen, carried = env.begin(DotTask().episodes(1)[0]), [], []
    for decision in range(4):
        seen.append(observation)
        chosen = agent.decide(observation, env.goal, Key(0, 0, decision))
        carried.append(chosen.actions[: chosen.execute])
        observation = env.run(carried[-1]).observation
    young, old = model._calls[1][0].history, model._calls[3][0].history
    assert young.count.tolist() == [2, 2] and old.count.tolist() == [3, 3]
    np.testing.assert_array_equal(old.poses, [[each.pose for each in seen[1:]]] * 2)
    np.testing.assert_array_equal(young.poses[:, 0], young.poses[:, 1])
    np.testing.assert_array_equal(old.actions, [carried[1:3]] * 2)
    np.testing.assert_array_equal(old.images[:, -1], model._calls[3][0].image)
    np.testing.assert_array_equal(old.images[:, :2], [[model._calls[k][0].image[0] for k in (1, 2)]] * 2)
    assert (old.images[0, 0] != old.images[0, 1]).any()


def test_choosing_by_imagination_pays(tmp_path: Path) -> None:
    arms = {
        "none": AgentRecipe(Reacher()),
        "oracle": AgentRecipe(Reacher(), "oracle"),
        "swapped": AgentRecipe(Reacher(), "oracle", placebo="swapped"),
    }
    runs = {
        name: evaluate(DotTask(), agent, 6, out=tmp_path / name, live=3, progress=False, keep_images=0)
        for name, agent in arms.items()
    }
    rates = {name: np.mean([e["metrics"]["success"] for e in log.episodes]) for name, log in runs.items()}
    assert all(e["status"] == "done" for log in runs.values() for e in log.episodes)
    assert rates["oracle"] > rates["none"] + 0.15 and rates["oracle"] > rates["swapped"] + 0.15


def test_records_hold_poses_pictures_and_fidelity(tmp_path: Path) -> None:
    log = evaluate(DotTask(), wiw.Agent(Reacher(), "copy"), 1, out=tmp_path, fidelity=True, progress=False)
    decision = log.decisions[0]
    assert np.shape(decision["actions"]) == (5, 7) and decision["calls"]["rows"] == 5
    assert min(decision["fidelity"]["psnr"]) > 5
    pictures = log.store.images(log.arms[0], 0, 0)
    assert set(pictures) == {"front", *(f"{kind}/{plan}" for kind in ("imagined", "true") for plan in range(5))}


def test_results_do_not_depend_on_who_else_is_live(tmp_path: Path) -> None:
    logs = [
        evaluate(
            DotTask(),
            wiw.Agent(Reacher(), "oracle"),
            3,
            out=tmp_path / str(live),
            live=live,
            progress=False,
            keep_images=0,
        )
        for live in (1, 3)
    ]
    one, other = ([d["actions"] for d in log.decisions] for log in logs)
    assert sorted(map(str, one)) == sorted(map(str, other))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"model": "warp"}, "this agent plans in poses of a gripper"),
        ({"model": Spy(control="action", space="pose7", view="panorama")}, "imagines panoramas"),
        ({"model": Spy(control="viewpoint", space="pose7")}, "do not move the camera"),
        (
            {"model": "copy", "depth": 2},
            "proposes plans from imagined places, but poses of a gripper do not lead to other places",
        ),
        ({"model": "copy", "reviser": "heuristic"}, "plans in poses of a gripper, but the reviser"),
    ],
)
def test_what_poses_cannot_have_is_refused(options: Any, said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        wiw.Agent(Reacher(), **options)


def test_a_shuffled_placebo_of_poses_is_refused() -> None:
    """As soon as a run composes it; one that is composed by hand, at its first decision."""
    refusal = "reshuffles primitives, but these plans contain none; use 'swapped'"
    with pytest.raises(ArgumentError, match=refusal):
        AgentRecipe(Reacher(), "copy", placebo="shuffled").build(RunContext(DotTask()))
    agent = wiw.Agent(Reacher(), ShuffledPlacebo(wiw.world_model("copy", space="pose7")))
    env = DotEnv(DotTask())
    observation = env.begin(DotTask().episodes(1)[0])
    with pytest.raises(ArgumentError, match=refusal):
        agent.decide(observation, env.goal, Key(0, 0))


def test_a_task_without_a_wrist_camera_refuses_a_policy_that_needs_one() -> None:
    class ByWrist(Reacher):
        needs = ("wrist",)

    with pytest.raises(ArgumentError, match="task 'dot' does not have"):
        wiw.evaluate(DotTask(), wiw.Agent(ByWrist()), 1, progress=False)


def test_plans_of_poses_are_judged_by_the_truth() -> None:
    """`TrueScores` asks the guide of the live environment for poses as it does for primitives."""

    class Near(Guide):
        def __init__(self, target: Any) -> None:
            self.target = target

        def evaluate_plan(self, plan: Any) -> float:
            return -float(np.linalg.norm(plan[-1][:2] - self.target))

        def suggest_plan(self, length: int) -> Any:
            return resample(np.array([[*self.target, *HOME[2:]]]), length, start=np.array(HOME, float))

    class Guided(DotEnv):
        def guide(self) -> Near:
            return Near(self.target)

    env, reacher = Guided(DotTask()), Reacher()
    observation = env.begin(DotTask().episodes(1)[0])
    environments = LiveEnvironments()
    environments.add(Key(0, 0), env)
    agent = wiw.Agent(TruePlans(reacher), "copy", reviser=TrueScores(reacher), candidates=4, execute=5)
    agent.grant(environments)
    decision = agent.decide(observation, env.goal, Key(0, 0))
    assert decision.chosen == 0 and len(decision.proposals) == 4
    np.testing.assert_allclose(decision.scores[0], 0, atol=1e-9)
    np.testing.assert_array_equal(
        decision.scores, [env.guide().evaluate_plan(plan.actions) for plan in decision.proposals]
    )
    assert env.run(decision.actions).terminated


@pytest.mark.parametrize(
    ("poses", "said"),
    [
        (np.zeros(5), "float \\[K, 7\\]"),
        (np.zeros((6, 7)), "1 to 5 poses"),
        (np.full((5, 7), np.nan), "finite"),
        (np.full((5, 7), 1.5), "gripper from 0 to 1"),
    ],
)
def test_plans_that_are_none_are_refused(poses: Any, said: str) -> None:
    class Careless(Reacher):
        def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
            return [[Proposal(poses)] for _ in situations]

    env = DotEnv(DotTask())
    observation = env.begin(DotTask().episodes(1)[0])
    with pytest.raises(ContractError, match=said):
        wiw.Agent(Careless()).decide(observation, env.goal, Key(0, 0))


def test_depth_is_of_the_pixels_in_whose_middle_it_is() -> None:
    depth = np.arange(480 * 480, dtype=np.float32).reshape(480, 480)
    observation = ArmObservation(np.zeros((480, 480, 3), np.uint8), np.array(HOME), depth)
    accepts = wiw.accepts(control="action", space="pose7", size=(160, 96), view="perspective", needs=("depth",))
    shown = imagine_poses._build_conditioning(accepts, [ModelInput(observation)])
    np.testing.assert_array_equal(shown.depth[0], depth[1::3, 2::5])
