# SPDX-License-Identifier: Apache-2.0
"""The worth of a model's imagination on stored decisions: which plan it chooses, and what the choice costs.

A plan's score is how near what it leads to looks to the goal (PSNR), seen with the heading that the plan ends with, in
the view that the model has. The oracle scores true pictures, a model the ones that it imagines.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.decisions import Decisions
from wiw.metrics import psnr, rank_agreement
from wiw.training.held_out_clips import Frames, Imagine, ShownView
from wiw.training.held_out_panoramas import WholePanorama
from wiw.types import Conditioning

PANORAMA = WholePanorama()


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
    view: ShownView = PANORAMA,
) -> DecisionErrors:
    """Let a model choose in stored decisions.

    Of plans with equal scores the first is chosen; their order in a decision is random.

    Args:
        imagine: the model.
        decisions: to choose in.
        seed: of what it draws.
        batch: plans in one call.
        between: called before each call.
        view: that the model sees and imagines.
    """
    count, plans = decisions.plans.shape[:2]
    scores, true = np.empty((count, plans)), np.empty((count, plans))
    for index in range(count):
        headings = action.to_trajectory(decisions.plans[index])[:, -1, 2]
        goals = view.show(np.repeat(decisions.goals[index][None], plans, axis=0), headings)
        ends = _imagine_ends(imagine, decisions, index, seed, batch, between, view)
        scores[index] = psnr(ends, goals, weights=view.weights)
        true[index] = psnr(view.show(decisions.futures[index], headings), goals, weights=view.weights)
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
    imagine: Imagine,
    decisions: Decisions,
    index: int,
    seed: int,
    batch: int,
    between: Callable[[], None],
    view: ShownView,
) -> Frames:
    """Return the imagined ends of a decision's plans, uint8 [M, H, W, 3], as the agent sees them there."""
    plans, lengths = decisions.plans[index], decisions.lengths[index]
    images = np.repeat(view.show(decisions.images[index][None], np.zeros(1)), len(plans), axis=0)
    seeds = np.arange(len(plans), dtype=np.uint64) + np.uint64(seed + index * len(plans))
    parts = []
    for first in range(0, len(plans), batch):
        rows = slice(first, first + batch)
        between()
        parts.append(imagine(Conditioning(images[rows]), plans[rows], seeds[rows], lengths[rows, None])[:, 0])
    return np.concatenate(parts)
