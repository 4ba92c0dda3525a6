# SPDX-License-Identifier: Apache-2.0
"""Rank correlation over a handful of arms: Spearman's coefficient, its chance level, and its interval over scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.analysis.intervals import Interval, split_rows
from wiw.errors import ArgumentError

LEAST = 3
"""Arms below which there is no order to speak of."""
EXACT = 8
"""Arms up to which all orders are tried for p."""
SHUFFLES = 20_000
"""Random orders beyond."""
FEW = 5
"""Scenes below which there is no interval: a few draws in all, which look surer the fewer they are."""
RESAMPLES = 4999
DIGITS = 9
"""Decimals of a mean that count: sums of the same numbers in another order are ties."""


@dataclass(frozen=True)
class Correlation:
    """How well one number per arm orders the arms by success."""

    measure: str
    rho: float
    """Spearman's coefficient over the arms, -1 to 1; NaN below three arms, and where all are equal in one."""
    low: float
    """Lower end of the 95 % interval from resampling scenes with the arms fixed; NaN if there is none."""
    high: float
    p: float
    """Two-sided, exact to eight arms: how often a random order of the arms is as extreme."""
    arms: int
    unit: str
    """Unit of resampling: "scenes" or "episodes"."""
    units: int
    defined: float
    """Share of the draws that have a coefficient."""

    @property
    def least_p(self) -> float:
        """The smallest p that so many arms can have: that of a perfect order, up or down."""
        return min(1.0, 2 / math.factorial(self.arms))


def correlate(
    measure: str, success: NDArray[np.float64], values: NDArray[np.float64], scenes: ArrayLike, seed: int = 0
) -> Correlation:
    """Return the rank correlation of the arms' mean values with their success rates.

    Args:
        measure: name of the values.
        success: float64 [arms, episodes], no NaN.
        values: float64 [arms, episodes], NaN in the episodes in which it was not measured.
        scenes: [episodes] labels. Whole scenes are drawn with replacement; episodes if there is one scene.
        seed: the draws are a function of it alone.

    Raises:
        ArgumentError: shapes that differ, or NaN in `success`.
    """
    success, values, labels = np.asarray(success, np.float64), np.asarray(values, np.float64), np.asarray(scenes)
    if (
        success.shape != values.shape
        or success.ndim != 2
        or labels.shape != success.shape[1:]
        or np.isnan(success).any()
    ):
        raise ArgumentError(
            "correlate: expected success and values [arms, episodes] and scenes [episodes], success without NaN, got "
            f"{success.shape}, {values.shape} and {labels.shape}"
        )
    several = len(np.unique(labels)) > 1
    clusters = np.unique(labels, return_inverse=True)[1] if several else np.arange(len(labels))
    means = _sum_clusters(success, clusters), _sum_clusters(values, clusters)
    once = np.ones((1, means[0][0].shape[1]))
    rates, worth = (_weigh(own, once)[0] for own in means)
    rho = float(spearman(rates, worth))
    p = math.nan if math.isnan(rho) else permutation_p(rates, worth, seed)
    low, high, defined = _bootstrap(means, math.isnan(rho), seed)
    unit = "scenes" if several else "episodes"
    return Correlation(measure, rho, low, high, p, len(success), unit, once.shape[1], defined)


def spearman(x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
    """Return Spearman's coefficient along the last axis: Pearson's of the ranks, equal values sharing their mean rank.

    NaN below three values, where all values of one side are equal, and where any is NaN.

    Args:
        x: float [..., n].
        y: the same shape.
    """
    from scipy.stats import rankdata

    pair = [np.round(np.asarray(side, np.float64), DIGITS) for side in (x, y)]
    unknown = np.isnan(pair[0]).any(-1) | np.isnan(pair[1]).any(-1)
    first, second = (rankdata(np.nan_to_num(side), axis=-1) - (side.shape[-1] + 1) / 2 for side in pair)
    size = np.sqrt((first**2).sum(-1) * (second**2).sum(-1))
    undefined = unknown | (size == 0) | (first.shape[-1] < LEAST)
    return np.where(undefined, np.nan, (first * second).sum(-1) / np.where(size == 0, 1, size))


def permutation_p(x: ArrayLike, y: ArrayLike, seed: int = 0) -> float:
    """Return the two-sided p of Spearman's coefficient: the share of all orders of `y` that are at least as extreme.

    All orders are tried up to eight values; beyond, 20,000 random ones and the given one.
    """
    first, second = np.asarray(x, np.float64), np.asarray(y, np.float64)
    found = abs(float(spearman(first, second)))
    n = len(first)
    if n <= EXACT:
        orders = np.array(list(permutations(range(n))))
    else:
        rng = np.random.Generator(np.random.Philox(key=seed))
        orders = np.concatenate([[np.arange(n)], rng.permuted(np.tile(np.arange(n), (SHUFFLES, 1)), axis=1)])
    values = np.abs(spearman(np.broadcast_to(first, orders.shape), second[orders]))
    return float(np.mean(values >= found - 1e-12))


_Sums = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Sums and counts, float64 [arms, clusters]."""


def _sum_clusters(values: NDArray[np.float64], clusters: NDArray[np.int64]) -> _Sums:
    sums, counts = np.zeros((2, clusters.max(initial=-1) + 1, len(values)))
    np.add.at(sums, clusters, np.nan_to_num(values).T)
    np.add.at(counts, clusters, ~np.isnan(values).T)
    return sums.T, counts.T


def _weigh(sums: _Sums, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means over weighted clusters, float64 [draws, arms]; NaN without any value."""
    total, count = (weights @ part.T for part in sums)
    return np.where(count > 0, total / np.where(count > 0, count, 1), np.nan)


def _bootstrap(means: tuple[_Sums, _Sums], skip: bool, seed: int) -> tuple[float, float, float]:
    """Return both ends of the percentile interval, and the share of draws that have a coefficient."""
    clusters = means[0][0].shape[1]
    if skip or clusters < FEW:
        return math.nan, math.nan, 0.0
    blocks = _draw_weights(clusters, seed)
    drawn = np.concatenate([spearman(*(_weigh(own, weights) for own in means)) for weights in blocks])
    known = drawn[~np.isnan(drawn)]
    if len(known) < RESAMPLES / 2:
        return math.nan, math.nan, len(known) / RESAMPLES
    low, high = _find_interval(known)
    return low, high, len(known) / RESAMPLES


def _draw_weights(clusters: int, seed: int) -> Iterator[NDArray[np.float64]]:
    """Yield how often each draw has each cluster, float64 [RESAMPLES, clusters] in all, a block of draws at a time."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    for count in split_rows(RESAMPLES, clusters):
        yield rng.multinomial(clusters, np.full(clusters, 1 / clusters), count).astype(np.float64)


def _find_interval(values: NDArray[np.float64]) -> Interval:
    low, high = np.quantile(values, (0.025, 0.975))
    return float(low), float(high)
