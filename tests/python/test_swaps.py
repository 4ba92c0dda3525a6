# SPDX-License-Identifier: Apache-2.0
"""Stages of the loop told the truth: what a guide says, and who is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blame_parts import AHEAD, FAN, SPIN, Noise, Spinner, Writer

import wiw
from recognition_file import a_file
from wiw.action import FORWARD, TURN_LEFT
from wiw.datasets import ar
from wiw.datasets.visibility import measure_sizes, visible_share
from wiw.errors import ArgumentError
from wiw.loop.agent import Query
from wiw.tasks.ar import AR
from wiw.tasks.imagenav import ImageNav
from wiw.types import Answer, Goal, Key, Observation


def started(task: Any, index: int = 0) -> Any:
    env = task.environment(depth=False)
    env.begin(task.episode(index))
    return env


def unsure(task: Any) -> Answer:
    return Answer(task.choices, np.full(len(task.choices), 1 / len(task.choices)))


def decided(agent: wiw.Agent, env: Any) -> Any:
    return agent.decide_batch([Query(env.observation, env.goal, Key(0, 0), env.fork(), guide=env.guide())])[0]


@pytest.mark.parametrize("index", range(4))
def test_true_plans_lead_to_the_goal_almost_as_fast_as_can_be(two_rooms: str, index: int) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"), index)
    steps = 0
    while not env.state.ended:
        segment = env.run(env.guide().plan(5)[:3])
        steps += len(segment.executed)
        assert steps <= 1.2 * env.state.episode.info["ideal_primitives"] + 3
    assert env.state.success


def test_asking_a_guide_moves_nothing(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    before, guide = env.truth(), env.guide()
    first = guide.worth(AHEAD), guide.plan(9).tolist()
    assert (guide.worth(AHEAD), guide.plan(9).tolist()) == first and len(first[1]) == 9
    np.testing.assert_array_equal(env.truth().position, before.position)
    assert env.truth().yaw == before.yaw and env.state.actions == 0


def test_worth_is_primitives_to_go_and_best_within_reach(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    guide, start = env.guide(), env.state.geodesic_to_goal()
    plan = guide.plan(20)
    worths = [guide.worth(plan[:k]) for k in range(1, 21)]
    assert worths == sorted(worths) and -worths[0] >= start / 0.2 - 1
    on_the_way = guide.worth(plan)
    assert guide.worth([*plan, *[TURN_LEFT] * 8]) >= on_the_way  # where it goes afterwards takes nothing away
    env.run(plan)
    while not env.state.ended:
        env.run(env.guide().plan(5)[:3])
    assert env.guide().worth([TURN_LEFT]) == 0


def test_a_goal_that_cannot_be_walked_to_is_judged_in_a_straight_line(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    env.state.goal_position = np.array([40.0, 0.0, 0.0])
    worths = [env.guide().worth(plan) for plan in FAN]
    assert np.isfinite(worths).all() and len(env.guide().plan(5)) == 5


def test_recognition_progresses_with_what_is_seen(two_rooms: str, tmp_path: Path) -> None:
    task = AR(episode_file=a_file(tmp_path, two_rooms, start=(-1.2, 0.0, 1.2), yaw=np.pi / 2), backend="cpu")
    env = started(task)
    state, target = env.state, int(env.state.episode.info["target"])
    place = env.fork().position
    size, share = measure_sizes(state.world, place[None])[0, target], visible_share(state.world, place, target)
    clarity = ar.measure_clarity(state.world, place, target)
    assert clarity == pytest.approx(share * min(1, size / ar.EpisodeRules().enough)) and 0 < clarity < 1
    best = task.find_destination(state)
    assert ar.measure_clarity(state.world, best, target) > 1.5 * clarity
    while np.linalg.norm(env.truth().position - best) > 0.25:
        env.run(env.guide().plan(4)[:1], unsure(task))
        assert env.state.actions <= 9
    assert ar.measure_clarity(state.world, np.array([3.0, 0.0, 0.0]), target) == 0  # from the other room


def test_scoring_follows_the_truth_whatever_policies_say(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    worths = [env.guide().worth(plan) for plan in FAN[:3]]
    for policy, model in ((Noise(), None), (Noise(), "copy")):
        decision = decided(wiw.Agent(policy, model, swaps=["scoring"]), env)
        np.testing.assert_array_equal(decision.scores, worths)
        assert decision.chosen == int(np.argmax(worths)) and decision.actions.tolist() == list(
            map(int, FAN[decision.chosen])
        )
    own = decided(wiw.Agent(Writer(), "copy", swaps=["scoring"]), env)
    assert own.chosen is not None and len(own.actions) > 1
    shared = decided(wiw.Agent(Noise(), "oracle", imagine_fraction=0.0, swaps=["scoring"]), env)
    assert shared.rollouts is None and shared.scores.tolist() == worths


def test_deeper_beams_are_scored_by_the_truth(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    decision = decided(wiw.Agent(Noise(), "copy", depth=2, swaps=["scoring"]), env)
    assert max(len(plan.actions) for plan in decision.proposals) == 10
    np.testing.assert_array_equal(decision.scores, [env.guide().worth(plan.actions) for plan in decision.proposals])


def test_a_true_plan_leads_and_the_last_one_gives_way(two_rooms: str) -> None:
    env = started(ImageNav(scenes=two_rooms, backend="cpu"))
    env.run(env.guide().plan(9))
    true = env.guide().plan(5)
    assert FORWARD in true
    decision = decided(wiw.Agent(Spinner(), "copy", candidates=3, swaps=["proposals"]), env)
    plans = [plan.actions.tolist() for plan in decision.proposals]
    assert plans == [true.tolist(), *(list(map(int, plan)) for plan in SPIN[:2])]
    assert decision.proposals[0].prior == 0 and decision.chosen == 0

    class Knows(Spinner):
        plans = ([TURN_LEFT], true.tolist(), [FORWARD])

    known = decided(wiw.Agent(Knows(), None, candidates=3, swaps=["proposals"]), env)
    assert [plan.actions.tolist() for plan in known.proposals] == [true.tolist(), [int(TURN_LEFT)], [int(FORWARD)]]


def test_the_oracle_imagines_in_place_of_any_model() -> None:
    for agent in (wiw.Agent("matcher"), wiw.Agent("matcher", "warp", placebo="shuffled")):
        told = agent.but(swaps=["imagination"])
        assert type(told.model).__name__ == "Oracle" and told.placebo is None and told.needs == ("depth", "simulator")
        assert told.describe()["swaps"] == ["imagination"] and "swaps" not in agent.describe()
        assert told.settled({"candidates": 2}).swaps == ("imagination",)


def test_nobody_is_told_unasked(two_rooms: str) -> None:
    assert "guide" not in wiw.Agent(Noise(), "oracle").needs
    assert "guide" in wiw.Agent(Noise(), swaps=["scoring"]).needs
    with pytest.raises(ArgumentError, match="expected swaps among imagination, scoring, proposals, got"):
        wiw.Agent(Noise(), swaps=["luck"])
    with pytest.raises(ArgumentError, match="expected swaps among"):
        wiw.Agent(Noise(), swaps="scoring")
    image = np.zeros((576, 1024, 3), np.uint8)
    with pytest.raises(ArgumentError, match="guide"):
        wiw.Agent(Noise(), swaps=["scoring"]).decide(
            Observation(image, image[:480, :480], np.zeros(3)), Goal("x"), Key(0, 0)
        )
