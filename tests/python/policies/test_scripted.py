# SPDX-License-Identifier: Apache-2.0
"""The scripted manipulator: what it proposes, how it scores, and that choosing by true futures pays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.errors import ArgumentError
from wiw.policies.base import Situation
from wiw.policies.scripted import Scripted
from wiw.studies.evaluate import evaluate
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tasks.manipulation import Manipulation
from wiw.types import Goal, Key, Proposal, Rollout


def begin_situation(name: str, episode: int = 0, seed: int = 11) -> tuple[Any, Situation]:
    env = Manipulation(name, seed=seed).environment()
    observation = env.begin(env.task.episode(episode))
    return env, Situation(observation, env.goal, Key(seed, episode), None)


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_plans_are_functions_of_the_decision(name: str) -> None:
    _, one = begin_situation(name)
    _, other = begin_situation(name, 1)
    together = Scripted().propose([one, other], 5, 5)
    alone = Scripted().propose([other], 3, 5)[0]
    for plan, again in zip(alone, together[1], strict=False):
        np.testing.assert_array_equal(plan.actions, again.actions)
    assert len(together[0]) == 5 and len({plan.actions.tobytes() for plan in together[0]}) == 5
    for plan in together[0]:
        assert 1 <= len(plan.actions) <= 5 and TABLETOP_TASKS[name].parse_target(plan.text)
        assert plan.prior == 0, "it does not know which of its plans err"
    later = Scripted().propose([Situation(one.observation, one.goal, one.key.at(1), None)], 1, 5)[0][0]
    assert not np.array_equal(later.actions, together[0][0].actions)


def test_a_single_plan_where_nothing_is_imagined() -> None:
    _, situation = begin_situation("slide_block")
    blind = Situation(situation.observation, situation.goal, situation.key, None, imagines=False)
    (only,) = Scripted().propose([blind], 5, 5)[0]
    np.testing.assert_array_equal(only.actions, Scripted().propose([situation], 5, 5)[0][0].actions)


def test_it_errs_at_its_rates() -> None:
    """Mistaken targets, and places astray by chance but never by much."""
    env, situation = begin_situation("slide_block")
    kind, setup = env.table.kind, env.table.setup
    square = situation.observation.places[setup.target][:2, 3]
    plans = [
        plan
        for decision in range(40)
        for plan in Scripted().propose(
            [Situation(situation.observation, situation.goal, situation.key.at(decision), None)], 5, 5
        )[0]
    ]
    right = [plan for plan in plans if kind.parse_target(plan.text) == setup.target]
    assert 0.33 < len(right) / len(plans) < 0.57
    exact = kind.plan_expert(situation.observation.places, setup.target)
    off = np.array([plan.actions[2, :2] - exact[2, :2] for plan in right])
    assert 0.003 < off.std() < 0.02 and np.abs(off).max() < 0.05
    assert np.linalg.norm(exact[2, :2] - square) < 0.1


def test_it_stays_where_nothing_is_left() -> None:
    env, situation = begin_situation("push_buttons")
    setup = env.table.setup
    wrong = next(name for name in setup.objects if name != setup.target[0])
    for pose in env.table.kind.plan_expert(situation.observation.places, (wrong,)):
        env.step(pose)
    lost = Situation(env.observation, env.goal, situation.key.at(1), None)
    for plan in Scripted().propose([lost], 2, 5)[0]:
        np.testing.assert_allclose(plan.actions, np.tile(env.observation.pose, (5, 1)))


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_true_futures_of_right_plans_score_best(name: str) -> None:
    env, situation = begin_situation(name, 2)
    kind, setup = env.table.kind, env.table.setup
    places = situation.observation.places
    targets = [setup.target, *kind.list_alternatives(setup.objects, setup.target)[:2]]
    plans = [Proposal(kind.plan_expert(places, target)[:5]) for target in targets]
    plans.append(Proposal(situation.observation.pose[None]))
    futures = [
        Rollout(env.fork().render_fronts_after(plan.actions, (240, 240)), np.zeros(len(plan.actions), bool))
        for plan in plans
    ]
    (scores,) = Scripted().score([situation], [plans], [futures])
    assert scores.shape == (4,) and scores[0] > scores[1:].max() + 0.1


def test_choosing_by_true_futures_pays(tmp_path: Path) -> None:
    """In a single decision; `docs/results.md` has whole episodes."""
    rates = {}
    for name in ("none", "copy", "oracle"):
        task = Manipulation("slide_block", seed=5, actions=5)
        agent = wiw.Agent("scripted", None if name == "none" else name, candidates=4)
        log = evaluate(task, agent, 2, out=tmp_path / name, progress=False, keep_images=0)
        assert all(episode["status"] == "done" for episode in log.episodes)
        rates[name] = np.mean([episode["metrics"]["success"] for episode in log.episodes])
    assert rates["copy"] == rates["none"]
    assert rates["oracle"] > rates["none"] + 0.15


def test_it_revises_other_policies_of_a_gripper(tmp_path: Path) -> None:
    class Wavering(wiw.Policy):
        """Stays, or does what is asked."""

        space = "pose7"

        def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
            kind = TABLETOP_TASKS["slide_block"]
            return [
                [
                    Proposal(s.observation.pose[None]),
                    Proposal(kind.plan_expert(s.observation.places, kind.parse_target(s.goal.text))[:horizon]),
                ]
                for s in situations
            ]

    agent = wiw.Agent(Wavering(), "oracle", reviser="scripted")
    log = evaluate(Manipulation("slide_block"), agent, 2, out=tmp_path, progress=False)
    assert [decision["chosen"] for decision in log.decisions] == [1, 1]


def test_what_it_cannot_read_is_refused() -> None:
    _, situation = begin_situation("slide_block")
    for goal in (Goal("manipulation"), Goal("imagenav", text="fetch the milk")):
        with pytest.raises(ArgumentError, match="about one of button, block, ring, cup"):
            Scripted().propose([Situation(situation.observation, goal, situation.key, None)], 5, 5)
