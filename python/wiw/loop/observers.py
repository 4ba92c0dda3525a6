# SPDX-License-Identifier: Apache-2.0
"""Observers of decisions: they measure what an agent does and change none of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from wiw.loop.clock import Clock
from wiw.loop.imagination import Imagination
from wiw.loop.memory import Query
from wiw.loop.plan_space import PlanSpace
from wiw.policies.base import Policy, Situation
from wiw.types import Decision, Proposal


@dataclass(frozen=True)
class ScoringBatch:
    """Plans and their rollouts that the reviser is about to score, for all live episodes."""

    reviser: Policy
    space: PlanSpace
    queries: Sequence[Query]
    situations: Sequence[Situation]
    """As the reviser knows them; their memories must not be changed."""
    plans: Sequence[Sequence[Proposal]]
    imagined: Imagination
    clock: Clock


class Observer(ABC):
    """Sees every batch of decisions twice: before its rollouts are scored, and after the decisions."""

    @abstractmethod
    def watch(self, batch: ScoringBatch) -> None:
        """Inspect the rollouts of the last level, from which the reviser chooses."""

    @abstractmethod
    def annotate(self, decision: Decision) -> Decision:
        """Return the decision with measurements added."""
