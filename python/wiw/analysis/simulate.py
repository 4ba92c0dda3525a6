# SPDX-License-Identifier: Apache-2.0
"""Simulated runs with known success rates: to plan real runs, and to measure the coverage of intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray


def draw_outcome_counts(
    shares: ArrayLike, sizes: Sequence[int], correlation: float, runs: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Draw the number of episodes per scene and outcome, int64 [runs, scenes, ways].

    Each scene has its own shares, drawn from a Dirichlet distribution around the true ones, so that any number made of
    the ways (a success rate, a difference of arms) has the same correlation between episodes of a scene.

    Args:
        shares: float [ways], sum 1: how often an episode ends in each way, e.g. both arms succeed, only the first does.
        sizes: episodes in each scene.
        correlation: between two episodes of a scene, in [0, 1); 0: scenes are alike.
        runs: how many.
        rng: what is drawn from.
    """
    truth = np.asarray(shares, np.float64)
    local = np.broadcast_to(truth, (runs, len(sizes), len(truth)))
    if correlation > 0:
        weights = rng.gamma((1 - correlation) / correlation * truth, size=local.shape)
        weights[..., truth.argmax()] += 1e-300  # small shapes may give zeros alone
        local = weights / weights.sum(-1, keepdims=True)
    return np.asarray(rng.multinomial(np.asarray(sizes), local), np.int64)


def sum_by_scene(counts: NDArray[np.int64], values: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return sums by scene, [runs, scenes], and sums of squares, [runs], of each outcome's value."""
    worth = np.asarray(values, np.float64)
    return counts @ worth, (counts @ worth**2).sum(-1)
