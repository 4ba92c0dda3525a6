# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, ContractError
from wiw.loop.scheduler import run_episodes
from wiw.policies.base import FrameSpec
from wiw.tasks.imagenav import ImageNav
from wiw.types import Proposal


class Recorder:
    def __init__(self) -> None:
        self.decisions, self.results = {}, {}

    def decision(self, record) -> None:
        self.decisions[record.episode, record.index] = record

    def episode(self, result) -> None:
        self.results[result.episode] = result


class Stamp(wiw.WorldModel):
    """Writes seed and plan into its frames, so that a reader sees what it was asked."""

    accepts = wiw.accepts(control="trajectory", view="panorama", causal=True)

    def rollout(self, observations, controls, seeds):
        frames = np.zeros((len(controls), len(controls[0].actions) + 1, 576, 1024, 3), np.uint8)
        for row, (control, seed) in enumerate(zip(controls, seeds, strict=True)):
            for k in range(len(control.actions)):
                frames[row, k + 1] = 1 + int(seed) % 200 if k == control.length - 1 else 0
        return frames


class Greedy(wiw.Policy):
    """Proposes fixed plans and prefers bright futures."""

    plans = ([FORWARD, FORWARD, TURN_LEFT], [TURN_LEFT, FORWARD], [TURN_RIGHT, TURN_RIGHT], [FORWARD])

    def propose(self, situations, candidates, horizon):
        return [[Proposal(plan[:horizon]) for plan in self.plans[:candidates]] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.array([float(r.frames[-1].mean()) for r in rows]) for rows in rollouts]


def run(task, agent, count=3, live=2, seed=0):
    recorder = Recorder()
    run_episodes(task, agent, list(enumerate(task.episodes(count))), seed=seed, live=live, sink=recorder)
    return recorder


@pytest.fixture
def task(two_rooms: str) -> ImageNav:
    return ImageNav(scenes=two_rooms, decisions=4)


@pytest.mark.parametrize(
    "make",
    [
        lambda: wiw.Agent("matcher"),
        lambda: wiw.Agent("matcher", "copy"),
        lambda: wiw.Agent("matcher", "oracle"),
        lambda: wiw.Agent("matcher", "oracle", candidates=2, horizon=3, depth=2, width=1),
        lambda: wiw.Agent("climber"),
        lambda: wiw.Agent("geometric"),
        lambda: wiw.Agent("heuristic", "oracle", candidates=4),
        lambda: wiw.Agent(Greedy(), Stamp(), candidates=4),
    ],
    ids=[
        "matcher",
        "matcher+copy",
        "matcher+oracle",
        "two levels",
        "climber",
        "geometric",
        "heuristic+oracle",
        "greedy+stamp",
    ],
)
def test_results_do_not_depend_on_how_many_episodes_are_live(task: ImageNav, make) -> None:
    alone, together = run(task, make(), live=1), run(task, make(), live=3)
    assert alone.decisions.keys() == together.decisions.keys()
    for name, record in alone.decisions.items():
        other = together.decisions[name]
        np.testing.assert_array_equal(record.decision.actions, other.decision.actions)
        np.testing.assert_array_equal(record.decision.scores, other.decision.scores)
        np.testing.assert_array_equal(record.path, other.path)
    assert all(result.status == "done" for result in alone.results.values())


def test_the_oracle_imagines_what_then_happens(task: ImageNav) -> None:
    """The chosen plan's imagined panoramas equal what the environment shows when the plan is carried out."""

    class Whole(Greedy):
        frames = FrameSpec("panorama", (576, 1024))

    env = task.environment()
    observation = env.begin(task.episode(0))
    agent = wiw.Agent(Whole(), "oracle", candidates=4)
    decision = agent.decide(observation, env.goal, wiw.types.Key(0, 0), simulator=env.fork())
    for proposal, rollout in zip(decision.proposals, decision.rollouts, strict=True):
        env.begin(task.episode(0))
        for k, action in enumerate(proposal.actions):
            real = env.run([action]).observation.panorama
            # A rolled panorama and one rendered after the turn differ by rounding on edges.
            assert (np.abs(rollout.frames[k].astype(int) - real) > 2).mean() < 5e-3, (proposal, k)


def test_a_decision_keeps_its_evidence(task: ImageNav) -> None:
    recorder = run(task, wiw.Agent(Greedy(), Stamp(), candidates=4), count=1)
    record = recorder.decisions[0, 0]
    decision = record.decision
    assert len(decision.proposals) == len(decision.rollouts) == len(decision.scores) == 4
    assert decision.chosen == int(np.argmax(decision.scores))
    assert set(decision.seconds) == {"propose", "platform", "world_model", "revise"}
    assert decision.calls["rows"] >= 1
    np.testing.assert_array_equal(record.executed, decision.actions[: len(record.executed)])
    assert [len(r.frames) for r in decision.rollouts] == [3, 2, 2, 1]
    assert decision.rollouts[2].real.all() and not decision.rollouts[3].real.any()


def test_without_a_model_the_policy_takes_its_own_best(task: ImageNav) -> None:
    decision = run(task, wiw.Agent(Greedy()), count=1).decisions[0, 0].decision
    assert decision.rollouts is None and decision.chosen == 0


def test_a_failing_model_is_infrastructure_and_the_rest_goes_on(task: ImageNav) -> None:
    class Flaky(Stamp):
        calls = 0

        def rollout(self, observations, controls, seeds):
            Flaky.calls += 1
            if Flaky.calls == 1:
                raise ConnectionError("server is gone")
            return super().rollout(observations, controls, seeds)

    recorder = run(task, wiw.Agent(Greedy(), Flaky()), count=3, live=1)
    states = {i: r.status for i, r in recorder.results.items()}
    assert states == {0: "failed", 1: "done", 2: "done"}
    assert "server is gone" in recorder.results[0].error and not recorder.results[0].metrics


def test_a_broken_contract_is_raised_with_what_was_expected(task: ImageNav) -> None:
    class Wrong(Stamp):
        def rollout(self, observations, controls, seeds):
            return super().rollout(observations, controls, seeds)[:, 1:]

    with pytest.raises(ContractError, match=r"expected uint8 .* got uint8"):
        run(task, wiw.Agent(Greedy(), Wrong()), count=1)


def test_a_model_of_fixed_length_is_padded_and_chunked(task: ImageNav) -> None:
    class Short(wiw.WorldModel):
        accepts = wiw.accepts(
            control="action", view="perspective", size=(64, 64), frames=3, vocabulary={0: 9, 1: 7, 2: 5, 3: 6, 4: 0}
        )
        lengths: ClassVar[set] = set()

        def rollout(self, observations, controls, seeds):
            for control in controls:
                assert len(control.actions) == 2 and observations.image.shape[1:] == (64, 64, 3)
                Short.lengths.add((control.length, tuple(control.ids)))
            return np.repeat(observations.image[:, None], 3, 1)

    class Long(Greedy):
        plans = ([FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD], [FORWARD])

    record = run(task, wiw.Agent(Long(), Short(), candidates=2), count=1).decisions[0, 0]
    assert [len(r.frames) for r in record.decision.rollouts] == [5, 1]
    assert {(2, (7, 7)), (2, (5, 7)), (1, (7, 7))} <= Short.lengths


def test_a_perspective_model_works_with_the_matcher(task: ImageNav) -> None:
    class Still(wiw.WorldModel):
        accepts = wiw.accepts(control="text", view="perspective", frames=9)

        def rollout(self, observations, controls, seeds):
            assert all(
                "forward" in c.text.lower() or "left" in c.text.lower() or "right" in c.text.lower() for c in controls
            )
            return np.repeat(observations.image[:, None], 9, 1)

    recorder = run(task, wiw.Agent("matcher", Still()), count=1)
    assert recorder.results[0].status == "done", recorder.results[0].error
    assert recorder.decisions[0, 0].decision.rollouts[0].view == "front"


def test_asking_for_the_impossible_says_so(task: ImageNav) -> None:
    with pytest.raises(ArgumentError, match="candidates"):
        wiw.Agent("matcher", candidates=0)
    env = task.environment()
    observation = env.begin(task.episode(0))
    with pytest.raises(ArgumentError, match="depth=True"):
        wiw.Agent(Greedy(), "warp").decide(observation, env.goal, wiw.types.Key(0, 0))
    with pytest.raises(ArgumentError, match="simulator"):
        wiw.Agent(Greedy(), "oracle").decide(observation, env.goal, wiw.types.Key(0, 0))
