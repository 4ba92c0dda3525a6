# SPDX-License-Identifier: Apache-2.0
"""Stages of the loop that are told the truth, one or several, to find out which of them a failure is due to.

imagination: the oracle stands in for the world model, or for the lack of one.
scoring: plans are judged by how far they truly get, and the best one is followed; policies still score and remember.
proposals: the plan of an agent that knows the scene leads the policy's own, as the one that the policy likes best; the
policy's last one gives way where there would be too many. It still has to be recognised.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import Proposal

STAGES = ("imagination", "scoring", "proposals")
GUIDED = frozenset({"scoring", "proposals"})
"""Stages that a guide tells the truth."""


def checked_swaps(swaps: Collection[str]) -> tuple[str, ...]:
    """The stages in their order.

    Raises:
        ArgumentError: an unknown one.
    """
    if isinstance(swaps, str) or not set(swaps) <= set(STAGES):
        raise ArgumentError(f"Agent: expected swaps among {', '.join(STAGES)}, got {swaps!r}")
    return tuple(stage for stage in STAGES if stage in swaps)


def true_scores(queries: Sequence[Any], proposals: Sequence[Sequence[Proposal]]) -> list[NDArray[np.float64]]:
    """How far each plan truly gets."""
    return [
        np.array([_guide(query).worth(plan.actions) for plan in plans], np.float64)
        for query, plans in zip(queries, proposals, strict=True)
    ]


def true_plans(
    queries: Sequence[Any], proposals: Sequence[Sequence[Proposal]], candidates: int, horizon: int
) -> list[list[Proposal]]:
    """The true plan before the policy's own, at most `candidates` in all."""
    return [
        _led(_guide(query).plan(horizon), plans, candidates) for query, plans in zip(queries, proposals, strict=True)
    ]


def _led(actions: NDArray[np.int8], plans: Sequence[Proposal], candidates: int) -> list[Proposal]:
    best = Proposal(actions, max(plan.prior for plan in plans), "true")
    others = [plan for plan in plans if not np.array_equal(plan.actions, actions)]
    return [best, *others][:candidates]


def _guide(query: Any) -> Any:
    if query.guide is None:
        raise ArgumentError("an agent with swaps needs a guide: pass decide_batch([Query(..., guide=env.guide())])")
    return query.guide
