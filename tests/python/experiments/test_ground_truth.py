# SPDX-License-Identifier: Apache-2.0
"""Stages of the loop that are given the ground truth: what a guide knows, and who is granted one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blame_parts import AHEAD, FAN, SPIN, Noise, Spinner, Writer

import wiw
from recognition_file import a_file
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.datasets import ar
from wiw.datasets.visibility import measure_sizes, visible_fraction
from wiw.errors import ArgumentError
from wiw.experiments.gating import Gated
from wiw.experiments.ground_truth import TruePlans, TrueScores
from wiw.experiments.placebos import ShuffledPlacebo
from wiw.loop.memory import Query
from wiw.loop.privileged import LiveEnvironments
from wiw.policies.base import Policy
from wiw.policies.wrapper import PolicyWrapper
from wiw.runs.compose import RunContext
from wiw.runs.recipes import AgentRecipe
from wiw.tasks.ar import AR
from wiw.tasks.imagenav import ImageNav
from wiw.types import Answer, Goal, Key, Observation


def begin_env(task: Any, index: int = 0) -> Any:
    env = task.environment(depth=False)
    env.begin(task.episode(index))
    return env


def unsure(task: Any) -> Answer:
    return Answer(task.choices, np.full(len(task.choices), 1 / len(task.choices)))


def decide(agent: wiw.Agent, env: Any) -> Any:
    """Decide with the live environment granted, as a run grants it."""
    environments = LiveEnvironments()
    environments.add(Key(0, 0), env)
    agent.grant(environments)
    return agent.decide_batch([Query(env.observation, env.goal, Key(0, 0))])[0]


def with_true_scores(policy: Policy, model: Any = None, **numbers: Any) -> wiw.Agent:
    return wiw.Agent(policy, model, reviser=TrueScores(policy), **numbers)


@pytest.mark.parametrize("index", range(4))
def test_true_plans_lead_to_the_goal_almost_as_fast_as_can_be(two_rooms: str, index: int) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"), index)
    steps = 0
    while not env.state.ended:
        segment = env.run(env.guide().suggest_plan(5)[:3])
        steps += len(segment.executed)
        assert steps <= 1.2 * env.state.episode.info["ideal_primitives"] + 3
    assert env.state.success


def test_asking_a_guide_moves_nothing(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    before, guide = env.truth(), env.guide()
    first = guide.evaluate_plan(AHEAD), guide.suggest_plan(9).tolist()
    assert (guide.evaluate_plan(AHEAD), guide.suggest_plan(9).tolist()) == first and len(first[1]) == 9
    np.testing.assert_array_equal(env.truth().position, before.position)
    assert env.truth().yaw == before.yaw and env.state.actions == 0


def test_worth_is_primitives_to_go_and_best_within_reach(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    guide, start = env.guide(), env.state.geodesic_to_goal()
    plan = guide.suggest_plan(20)
    worths = [guide.evaluate_plan(plan[:k]) for k in range(1, 11)]
    assert worths[0] < worths[4] < worths[-1] and -worths[0] >= start / 0.2 - 1
    assert guide.evaluate_plan([*plan[:5], *[TURN_LEFT] * 8]) < worths[4] - 3  # it ends with its back to the goal
    while env.guide().evaluate_plan(last := env.guide().suggest_plan(5)) < 0:
        env.run(last[:3])
    assert env.guide().evaluate_plan([*last, *[FORWARD] * 8]) == 0  # the episode ends where the goal is reached
    env.run(last)
    assert env.guide().evaluate_plan([TURN_LEFT]) == 0


def test_a_goal_that_cannot_be_walked_to_is_judged_in_a_straight_line(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    env.state.goal_position = np.array([40.0, 0.0, 0.0])
    worths = [env.guide().evaluate_plan(plan) for plan in FAN]
    assert np.isfinite(worths).all() and len(env.guide().suggest_plan(5)) == 5


def test_recognition_progresses_with_what_is_seen(two_rooms: str, tmp_path: Path) -> None:
    task = AR(episode_file=a_file(tmp_path, two_rooms, start=(-1.2, 0.0, 1.2), yaw=np.pi / 2), backend="cpu")
    env = begin_env(task)
    state, target = env.state, int(env.state.episode.info["target"])
    place = env.fork().position
    size, share = measure_sizes(state.world, place[None])[0, target], visible_fraction(state.world, place, target)
    clarity = ar.measure_clarity(state.world, place, target)
    assert clarity == pytest.approx(share * min(1, size / ar.EpisodeRules().enough)) and 0 < clarity < 1
    best = task.find_destination(state)
    assert ar.measure_clarity(state.world, best, target) > 1.5 * clarity
    while np.linalg.norm(env.truth().position - best) > 0.25:
        env.run(env.guide().suggest_plan(4)[:1], unsure(task))
        assert env.state.actions <= 9
    assert ar.measure_clarity(state.world, np.array([3.0, 0.0, 0.0]), target) == 0  # from the other room


def test_scoring_follows_the_truth_whatever_policies_say(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    worths = [env.guide().evaluate_plan(plan) for plan in FAN[:3]]
    for policy, model in ((Noise(), None), (Noise(), "copy")):
        decision = decide(with_true_scores(policy, model), env)
        np.testing.assert_array_equal(decision.scores, worths)
        assert decision.chosen == int(np.argmax(worths)) and decision.actions.tolist() == list(
            map(int, FAN[decision.chosen])
        )
    own = decide(with_true_scores(Writer(), "copy"), env)
    assert own.chosen is not None and len(own.actions) > 1
    unconsulted = decide(with_true_scores(Noise(), Gated(wiw.world_model("oracle"), 0.0)), env)
    assert unconsulted.rollouts is None and unconsulted.scores.tolist() == worths


def test_only_what_is_carried_out_is_scored(two_rooms: str) -> None:
    """A plan that dithers before it goes far would be begun again and again, and never be gone on with."""
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    true = env.guide().suggest_plan(8)

    class Dithering(Noise):
        plans = ([TURN_LEFT, TURN_RIGHT, TURN_LEFT, TURN_RIGHT, *true], true[:5])

    numbers: dict[str, Any] = {"candidates": 2, "horizon": 12, "execute": 3}
    recipe = AgentRecipe(Dithering(), "copy", ground_truth=["scoring"], **numbers)
    decision = decide(recipe.build(RunContext(env.task)), env)
    far, near = (env.guide().evaluate_plan(plan) for plan in Dithering.plans)
    assert far > near and decision.chosen == 1
    parts = [env.guide().evaluate_plan(plan[:3]) for plan in Dithering.plans]
    np.testing.assert_array_equal(decision.scores, parts)


def test_deeper_beams_are_scored_by_the_truth(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    decision = decide(with_true_scores(Noise(), "copy", depth=2), env)
    assert max(len(plan.actions) for plan in decision.proposals) == 10
    np.testing.assert_array_equal(
        decision.scores, [env.guide().evaluate_plan(plan.actions) for plan in decision.proposals]
    )


def test_a_true_plan_leads_and_the_last_one_gives_way(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    env.run(env.guide().suggest_plan(9))
    true = env.guide().suggest_plan(5)
    assert FORWARD in true
    decision = decide(wiw.Agent(TruePlans(Spinner()), "copy", candidates=3), env)
    plans = [plan.actions.tolist() for plan in decision.proposals]
    assert plans == [true.tolist(), *(list(map(int, plan)) for plan in SPIN[:2])]
    assert decision.proposals[0].prior == 0 and decision.chosen == 0

    class Knows(Spinner):
        plans = ([TURN_LEFT], true.tolist(), [FORWARD])

    known = decide(wiw.Agent(TruePlans(Knows()), candidates=3), env)
    assert [plan.actions.tolist() for plan in known.proposals] == [true.tolist(), [int(TURN_LEFT)], [int(FORWARD)]]


def test_a_pool_keeps_the_true_plan_first(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    env.run(env.guide().suggest_plan(9))
    agent = wiw.Agent(TruePlans(Spinner()), candidates=2, pool=3)
    plans = [plan.actions.tolist() for plan in decide(agent, env).proposals]
    assert plans == [env.guide().suggest_plan(5).tolist(), list(map(int, SPIN[0]))]


class Rememberer(Noise):
    """Counts how often it begins, observes and scores, and writes into the memory of the episode."""

    def __init__(self) -> None:
        self.begun = self.observed = 0
        self.memories: list[Any] = []

    def begin(self, goal: Goal, key: Key) -> Any:
        self.begun += 1
        return []

    def observe(self, situations: Any) -> None:
        self.observed += len(situations)

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        self.memories.append(situations[0].memory)
        return super().propose(situations, candidates, horizon)

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> Any:
        self.memories.append(situations[0].memory)
        return super().score(situations, proposals, rollouts)


@pytest.mark.parametrize(
    "make",
    [
        lambda policy: wiw.Agent(policy, "copy"),
        lambda policy: wiw.Agent(TruePlans(policy), "copy"),
        lambda policy: wiw.Agent(policy, "copy", reviser=TrueScores(policy)),
        lambda policy: wiw.Agent(TruePlans(policy), "copy", reviser=policy),
        lambda policy: wiw.Agent(TruePlans(policy), "copy", reviser=TrueScores(policy)),
        lambda policy: wiw.Agent(TrueScores(TruePlans(policy)), "copy"),
        lambda policy: wiw.Agent(TruePlans(TrueScores(policy)), "copy"),
    ],
)
def test_proposer_and_reviser_of_one_policy_share_its_memory(two_rooms: str, make: Any) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    policy = Rememberer()
    decision = decide(make(policy), env)
    assert (policy.begun, policy.observed, len(policy.memories)) == (1, 1, 2)
    assert policy.memories[0] is policy.memories[1] and decision.calls["rows"] > 0


def test_another_reviser_keeps_a_memory_of_its_own(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    proposer, reviser = Rememberer(), Rememberer()
    decide(wiw.Agent(TruePlans(proposer), "copy", reviser=TrueScores(reviser)), env)
    assert proposer.begun == reviser.begun == proposer.observed == reviser.observed == 1
    assert proposer.memories[0] is not reviser.memories[0]


def test_true_plans_and_true_scores_compose_with_each_other_and_with_a_changed_model(two_rooms: str) -> None:
    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    model = Gated(ShuffledPlacebo(wiw.world_model("oracle")), 1.0)
    found = [
        decide(agent, env)
        for agent in (
            wiw.Agent(TruePlans(Noise()), model, reviser=TrueScores(Noise())),
            wiw.Agent(TrueScores(TruePlans(Noise())), model),
            wiw.Agent(TruePlans(TrueScores(Noise())), model),
        )
    ]
    for decision in found:
        assert decision.proposals[0].note == "true" and decision.calls["rows"] > 0
        np.testing.assert_array_equal(
            decision.scores, [env.guide().evaluate_plan(plan.actions) for plan in decision.proposals]
        )


def test_a_wrapper_that_scores_by_itself_is_asked(two_rooms: str) -> None:
    class Reversed(PolicyWrapper):
        def score(self, situations: Any, proposals: Any, rollouts: Any) -> Any:
            return [-scores for scores in super().score(situations, proposals, rollouts)]

    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    plain, other = (decide(wiw.Agent(policy, "copy"), env) for policy in (Noise(), TruePlans(Reversed(Noise()))))
    np.testing.assert_array_equal(other.scores, -plain.scores)


def test_the_oracle_imagines_in_place_of_any_model() -> None:
    context = RunContext(ImageNav(scenes="apartments:val:1"))
    for recipe in (AgentRecipe("matcher"), AgentRecipe("matcher", "warp", placebo="shuffled")):
        agent = replace(recipe, ground_truth=["imagination"]).build(context)
        assert type(agent.model.unwrapped).__name__ == "Oracle" and agent.needs == ("depth",)
        assert "placebo" not in agent.describe() and agent.describe()["model"] == wiw.world_model("oracle").describe()


@pytest.mark.parametrize("policy", ["heuristic", Noise()], ids=["another reviser", "its own reviser"])
def test_an_agent_says_which_of_its_policies_is_given_the_truth(policy: Any) -> None:
    context = RunContext(ImageNav(scenes="apartments:val:1"))

    def describe(*stages: str) -> Any:
        return AgentRecipe(policy, "copy", ground_truth=stages).build(context).describe()

    plain, scoring, proposals = describe(), describe("scoring"), describe("proposals")
    assert scoring == {**plain, "revision": {**plain["revision"], "ground_truth": "scoring"}}
    assert proposals == {**plain, "policy": {**plain["policy"], "ground_truth": "proposals"}}


def test_nobody_is_given_the_truth_unasked(two_rooms: str) -> None:
    class Guarded:
        """An environment that nobody may look into."""

        def __getattr__(self, name: str) -> Any:
            raise AssertionError(f"somebody asks for {name}")

    env = begin_env(ImageNav(scenes=two_rooms, backend="cpu"))
    environments = LiveEnvironments()
    environments.add(Key(0, 0), Guarded())
    agent = wiw.Agent(Noise(), "copy")
    agent.grant(environments)
    assert agent.decide_batch([Query(env.observation, env.goal, Key(0, 0))])[0].calls["rows"] > 0


@pytest.mark.parametrize("stages", [["luck"], "scoring"])
def test_only_stages_of_the_loop_can_be_given_the_truth(stages: Any) -> None:
    recipe = AgentRecipe("heuristic", ground_truth=stages)
    with pytest.raises(ArgumentError, match="expected stages among imagination, scoring, proposals, got"):
        recipe.build(RunContext(ImageNav(scenes="apartments:val:1")))


@pytest.mark.parametrize(
    "make",
    [
        lambda: with_true_scores(Noise()),
        lambda: wiw.Agent(TruePlans(Noise())),
        lambda: wiw.Agent(Noise(), "oracle"),
        lambda: wiw.Agent(Noise(), Gated(ShuffledPlacebo(wiw.world_model("oracle")), 1.0)),
    ],
)
def test_a_privileged_part_without_an_environment_says_how_to_grant_one(make: Any) -> None:
    image = np.zeros((576, 1024, 3), np.uint8)
    observation = Observation(image, image[:480, :480], np.zeros(3))
    with pytest.raises(ArgumentError, match=r"parts that need the simulator .*wiw\.evaluate, or .*env\.fork\(\)"):
        make().decide(observation, Goal("x"), Key(0, 0))
