# SPDX-License-Identifier: Apache-2.0
"""The worth of a model's imagination on stored decisions: which plan it chooses, and what the choice costs.

A plan's score is how near what it leads to looks to the goal (PSNR). The oracle scores true pictures, a model the ones
that it imagines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.decisions import Decisions
from wiw.metrics import psnr, rank_agreement
from wiw.training.held_out_clips import Frames, Imagine, turn_panoramas


@dataclass(frozen=True)
class DecisionErrors:
    """A model's choices in D decisions."""

    scenes: tuple[str, ...]
    """[D]."""
    agreement: NDArray[np.float64]
    """float64 [D]: Kendall's tau-b of the plans' scores with the oracle's; NaN where all scores are equal."""
    regret: NDArray[np.float64]
    """float64 [D] metres: how much further from the goal the chosen plan ends than the best one."""
    chance: NDArray[np.float64]
    """float64 [D] metres: the same of a plan chosen at random, on average."""
    oracle: NDArray[np.float64]
    """float64 [D] metres: the same of the plan that the oracle chooses."""

    def summarise(self) -> dict[str, float]:
        """Return the means by name: "rank", "regret", "regret/chance" and "regret/oracle"."""
        known = self.agreement[np.isfinite(self.agreement)]
        return {
            **({"rank": float(known.mean())} if len(known) else {}),
            "regret": float(self.regret.mean()),
            "regret/chance": float(self.chance.mean()),
            "regret/oracle": float(self.oracle.mean()),
        }


def measure_decisions(
    imagine: Imagine,
    decisions: Decisions,
    seed: int = 0,
    batch: int = 16,
    between: Callable[[], None] = lambda: None,
) -> DecisionErrors:
    """Let a model choose in stored decisions; `between` is called before each call of it.

    Of plans with equal scores the first is chosen; their order in a decision is random.
    """
    count, plans = decisions.plans.shape[:2]
    scores = np.empty((count, plans))
    for index in range(count):
        ends = _imagine_ends(imagine, decisions, index, seed, batch, between)
        scores[index] = _score(ends, decisions.goals[index])
    true = np.stack([_score(decisions.futures[index], decisions.goals[index]) for index in range(count)])
    least = decisions.distances.min(axis=1)
    rows = np.arange(count)
    return DecisionErrors(
        decisions.scenes,
        np.array([rank_agreement(own, oracle) for own, oracle in zip(scores, true, strict=True)]),
        decisions.distances[rows, scores.argmax(axis=1)] - least,
        decisions.distances.mean(axis=1) - least,
        decisions.distances[rows, true.argmax(axis=1)] - least,
    )


def _imagine_ends(
    imagine: Imagine, decisions: Decisions, index: int, seed: int, batch: int, between: Callable[[], None]
) -> Frames:
    """Return the imagined ends of a decision's plans, uint8 [M, H, W, 3], facing where the observation does."""
    plans, lengths = decisions.plans[index], decisions.lengths[index]
    images = np.repeat(decisions.images[index][None], len(plans), axis=0)
    seeds = np.arange(len(plans), dtype=np.uint64) + np.uint64(seed + index * len(plans))
    parts = []
    for first in range(0, len(plans), batch):
        rows = slice(first, first + batch)
        between()
        parts.append(imagine(images[rows], plans[rows], seeds[rows], lengths[rows, None])[:, 0])
    headings = action.to_trajectory(plans)[:, -1, 2]
    return turn_panoramas(np.concatenate(parts), -headings)


def _score(ends: Frames, goal: Frames) -> NDArray[np.float64]:
    return np.asarray(psnr(ends, np.broadcast_to(goal, ends.shape), weights="latitude"))
