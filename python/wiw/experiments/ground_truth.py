# SPDX-License-Identifier: Apache-2.0
"""Give ground truth to stages of the loop, to find out which of them causes a failure.

imagination: the oracle stands in for the world model, or for the lack of one. scoring: plans are judged by how far
their executed part truly gets, and the best one is followed; policies still score and remember. proposals: the plan of
an agent that knows the scene leads the policy's own, as the one that the policy likes best; the policy's last one gives
way where there would be too many. It still has to be recognised.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.loop.config import AgentConfig
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.policies.base import Policy, Situation
from wiw.policies.wrapper import PolicyWrapper
from wiw.types import Key, Proposal, Rollout

STAGES = ("imagination", "scoring", "proposals")


def sort_stages(stages: Collection[str]) -> tuple[str, ...]:
    """Return the stages in their order.

    Raises:
        ArgumentError: an unknown one.
    """
    if isinstance(stages, str) or not set(stages) <= set(STAGES):
        raise ArgumentError(f"expected stages among {', '.join(STAGES)}, got {stages!r}")
    return tuple(stage for stage in STAGES if stage in stages)


class _Guided(PolicyWrapper, Privileged):
    """A policy with access to the environments' guides."""

    stage: ClassVar[str]
    """Which of `STAGES` is given ground truth."""

    def __init__(self, inner: Policy) -> None:
        super().__init__(inner)
        self._environments = LiveEnvironments()

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the live environments, whose guides know the true value of plans."""
        self._environments = environments
        if isinstance(self.inner, Privileged):
            self.inner.grant(environments)

    def describe(self) -> dict[str, Any]:
        """Describe the wrapped policy, and which stage is given ground truth."""
        return {**super().describe(), "ground_truth": self.stage}

    def _guide(self, key: Key) -> Any:
        return self._environments.find(key).guide()


class TruePlans(_Guided):
    """A policy whose proposals include the ground-truth plan."""

    stage = "proposals"

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Propose the true plan before the policy's own, at most `candidates` in all."""
        proposals = super().propose(situations, candidates, horizon)
        return [
            _prepend_plan(self._guide(situation.key).suggest_plan(horizon), plans, candidates)
            for situation, plans in zip(situations, proposals, strict=True)
        ]


class TrueScores(_Guided):
    """A reviser that knows the true progress of each plan and follows the best one.

    Args:
        inner: the reviser, which scores and remembers as it would without ground truth.
        config: of the agent. Plans are judged where the part that is carried out ends: an agent that is drawn by what
            lies beyond it can turn to and fro for ever. None: where the whole plan ends.
    """

    stage = "scoring"

    def __init__(self, inner: Policy, config: AgentConfig | None = None) -> None:
        super().__init__(inner)
        self._config = None if config is None else config.complete()

    def score_or_prefer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[NDArray[np.float64]]:
        """Let the wrapped reviser score and remember, but return the true value of each plan."""
        super().score_or_prefer(situations, proposals, rollouts)
        return [
            self._measure_worths(situation.key, plans) for situation, plans in zip(situations, proposals, strict=True)
        ]

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """Follow the best plan, even if the wrapped reviser would write its own."""
        super().revise(situation, proposals, scores)
        best = int(np.argmax(scores))
        return proposals[best].actions, best

    def _measure_worths(self, key: Key, plans: Sequence[Proposal]) -> NDArray[np.float64]:
        guide = self._guide(key)
        parts = [plan.actions[: self._count_executed(len(plan.actions))] for plan in plans]
        return np.array([guide.evaluate_plan(part) for part in parts], np.float64)

    def _count_executed(self, length: int) -> int:
        return length if self._config is None else self._config.count_executed(length)


def _prepend_plan(actions: NDArray[Any], plans: Sequence[Proposal], candidates: int) -> list[Proposal]:
    best = Proposal(actions, max(plan.prior for plan in plans), "true")
    others = [plan for plan in plans if not np.array_equal(plan.actions, actions)]
    return [best, *others][:candidates]
