# SPDX-License-Identifier: Apache-2.0
"""Base of policies that change the answers of another one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.types import Answer, Decision, Exchange, Goal, Key, Proposal, Rollout, TextAnswer


class PolicyWrapper(Policy):
    """Passes every call on to the wrapped policy; a subclass overrides the methods that it changes."""

    def __init__(self, inner: Policy) -> None:
        self.inner = inner
        self.space = inner.space
        self.needs: tuple[str, ...] = tuple(inner.needs)
        self.frames: FrameSpec = inner.frames
        self.default_revision = inner.default_revision
        self.longest_decision = inner.longest_decision

    @property
    def unwrapped(self) -> Policy:
        """The policy behind everything that wraps it."""
        return self.inner.unwrapped

    def begin(self, goal: Goal, key: Key) -> Any:
        """See `Policy.begin`."""
        return self.inner.begin(goal, key)

    def observe(self, situations: Sequence[Situation]) -> None:
        """See `Policy.observe`."""
        self.inner.observe(situations)

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """See `Policy.propose`."""
        return self.inner.propose(situations, candidates, horizon)

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """See `Policy.extend`."""
        return self.inner.extend(situations, candidates, horizon)

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """See `Policy.score`."""
        return self.inner.score(situations, proposals, rollouts)

    def score_or_prefer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[NDArray[np.float64]]:
        """Score or prefer as the wrapped policy does, or by the `score` of a subclass that defines one."""
        if type(self).score is not PolicyWrapper.score:
            return super().score_or_prefer(situations, proposals, rollouts)
        return self.inner.score_or_prefer(situations, proposals, rollouts)

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """See `Policy.revise`."""
        return self.inner.revise(situation, proposals, scores)

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> Sequence[Answer | TextAnswer | None]:
        """See `Policy.answer`."""
        return self.inner.answer(situations, proposals, rollouts)

    def draw(self, situation: Situation, decision: Decision, north: float) -> Mapping[str, NDArray[np.uint8]]:
        """See `Policy.draw`."""
        return self.inner.draw(situation, decision, north)

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """See `Policy.exchanges`."""
        return self.inner.exchanges(key)

    @property
    def spent(self) -> Mapping[str, float]:
        """The wrapped policy's."""
        return self.inner.spent

    @property
    def can_revise(self) -> bool:
        """The wrapped policy's."""
        return self.inner.can_revise

    @property
    def can_extend(self) -> bool:
        """The wrapped policy's."""
        return self.inner.can_extend

    def describe(self) -> dict[str, Any]:
        """Describe the wrapped policy."""
        return self.inner.describe()
