# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals for means over episodes that share scenes.

Episodes of one scene share its walls, its light and its furniture: what is drawn at random is scenes. The interval
reported is Student's t over scenes (`clustered_t`), steadied by a made-up episode or two. Where there is one scene
only, no interval can speak of others, and those over episodes are used (`wilson`, `agresti_min`, `student`). The
bootstrap over scenes is a second opinion: with few scenes it is too narrow. `docs/statistics.md` has measured coverage.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special  # its functions load ten times faster than scipy.stats

from wiw.errors import ArgumentError

Interval = tuple[float, float]
Kind = Literal["rate", "difference", "length"]
"""Values in [0, 1]; differences of two such; any numbers."""
COINS = {"rate": (0.5, 0.5), "difference": (0.0, 0.5)}
"""Mean and mean square of an episode in which the success of each arm is a fair coin."""

FEW = 5
"""Scenes below which equal means are taken for chance: scenes never count as more alike than their episodes are."""


def wilson(mean: float, n: int, confidence: float = 0.95) -> Interval:
    """Return the score interval of a proportion (Wilson 1927).

    Also holds, conservatively, for the mean of any values in [0, 1]: their variance is at most mean * (1 - mean).
    """
    z = special.ndtri(0.5 + confidence / 2)
    center = (mean + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
    return max(0.0, float(center - half)), min(1.0, float(center + half))


def student(values: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return Student's t interval of a mean; (nan, nan) for a single value."""
    data = np.asarray(values, np.float64)
    if len(data) < 2:
        return float("nan"), float("nan")
    half = special.stdtrit(len(data) - 1, 0.5 + confidence / 2) * data.std(ddof=1) / np.sqrt(len(data))
    return float(data.mean() - half), float(data.mean() + half)


def agresti_min(differences: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the interval of a mean paired difference in [-1, 1], with half a win, half a loss and a tie added.

    Source: Agresti and Min, Statistics in Medicine 24 (2005), where differences are -1, 0 or 1. A difference in between
    counts as that share of a win or a loss, which overstates its variance and so errs on the safe side.
    """
    data = np.asarray(differences, np.float64)
    n = len(data) + 2
    wins, losses = data.clip(0).sum() + 0.5, (-data).clip(0).sum() + 0.5
    center = (wins - losses) / n
    half = special.ndtri(0.5 + confidence / 2) * np.sqrt(wins + losses - (wins - losses) ** 2 / n) / n
    return max(-1.0, float(center - half)), min(1.0, float(center + half))


def clustered_t(values: ArrayLike, clusters: ArrayLike, kind: Kind, confidence: float = 0.95) -> Interval:
    """Return the interval of the pooled mean with clusters as the sampling unit: Student's t over clusters.

    Args:
        values: float [n], one an episode.
        clusters: [n] labels, e.g. scenes; at least two distinct ones.
        kind: what the values are; the interval stays in their range.
        confidence: e.g. 0.95.

    Raises:
        ArgumentError: fewer than two clusters.
    """
    data = np.asarray(values, np.float64)
    sums, counts = sum_by_cluster(data, np.asarray(clusters))
    if len(sums) < 2:
        raise ArgumentError(f"clustered_t: expected at least 2 clusters, got {len(sums)}")
    low, high = t_of_sums(sums, np.square(data).sum(), counts, kind, confidence)
    return float(low), float(high)


def t_of_sums(
    sums: NDArray[np.float64],
    squares: ArrayLike,
    counts: NDArray[np.float64],
    kind: Kind,
    confidence: float = 0.95,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return both ends of `clustered_t`, for many runs at once.

    The variance of the mean is that of leaving out one cluster at a time. It is blind where few episodes differ (five
    scenes without a success have no variance), so rates and differences get a few made-up episodes more, as Agresti
    and Coull (1998) and Agresti and Min (2005) have it: with D = variance by clusters / variance by episodes, the
    design effect, the interval is q +- t sqrt(D v / (n + w)), q and v being mean and variance over all n + w. Their
    weight w is 2 (z / t)^2: 2 for many clusters, less for few, where t alone is wide. So the coverage is nearest to
    95 % (`docs/statistics.md`).

    Args:
        sums: float [..., clusters] of the values in each.
        squares: float [...], sum of squared values over all episodes.
        counts: float [clusters], episodes in each.
        kind: see `clustered_t`.
        confidence: e.g. 0.95.
    """
    mean = sums.sum(-1) / counts.sum()
    center, variance = stabilise_mean(sums, squares, counts, kind)
    half = special.stdtrit(len(counts) - 1, 0.5 + confidence / 2) * np.sqrt(variance)
    low, high = np.minimum(center - half, mean), np.maximum(center + half, mean)
    least, most = {"rate": (0.0, 1.0), "difference": (-1.0, 1.0), "length": (-np.inf, np.inf)}[kind]
    return np.maximum(low, least), np.minimum(high, most)


def stabilise_mean(
    sums: NDArray[np.float64], squares: ArrayLike, counts: NDArray[np.float64], kind: Kind
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean and its variance by clusters, over the episodes and the pseudo-episodes; see `t_of_sums`."""
    n, total = counts.sum(), sums.sum(-1)
    mean, variance = total / n, jackknife_covariance(sums, sums, counts)
    if kind == "length":
        return mean, variance
    squares = np.asarray(squares, np.float64)
    plain = (squares / n - mean**2) / n
    seen = (plain > 1e-12) & (variance > 1e-12)
    effect = np.where(seen, variance / np.where(seen, plain, 1.0), 1.0)
    if len(counts) < FEW:
        effect = np.maximum(effect, 1.0)
    coin, coin_square = COINS[kind]
    weight = count_pseudo_episodes(len(counts))
    center = (total + weight * coin) / (n + weight)
    return center, effect * ((squares + weight * coin_square) / (n + weight) - center**2) / (n + weight)


def count_pseudo_episodes(clusters: int) -> float:
    """Return the number of pseudo-episodes that stabilise an interval over `clusters` clusters."""
    return float(2 * (special.ndtri(0.975) / special.stdtrit(clusters - 1, 0.975)) ** 2)


def jackknife_covariance(
    first: NDArray[np.float64], second: NDArray[np.float64], counts: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance of two pooled means, from leaving out one cluster at a time (jackknife).

    Args:
        first: float [..., clusters], sums of one quantity in each cluster.
        second: the same of another, or the same again for a variance.
        counts: float [clusters], episodes in each.
    """
    clusters = len(counts)
    without = [(sums.sum(-1, keepdims=True) - sums) / (counts.sum() - counts) for sums in (first, second)]
    apart = [means - means.mean(-1, keepdims=True) for means in without]
    found: NDArray[np.float64] = (clusters - 1) / clusters * (apart[0] * apart[1]).sum(-1)
    return found


def clustered_bootstrap(
    values: ArrayLike,
    clusters: ArrayLike,
    *,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    method: str = "bca",
) -> Interval:
    """Return the interval of the pooled mean from resampling whole clusters with replacement.

    Args:
        values: float [n], one an episode.
        clusters: [n] labels, e.g. scenes; at least two distinct ones.
        confidence: e.g. 0.95.
        resamples: bootstrap draws.
        seed: the draws are a function of it alone.
        method: "bca" (bias-corrected and accelerated) or "percentile".

    Raises:
        ArgumentError: fewer than two clusters, or an unknown method.
    """
    if method not in ("bca", "percentile"):
        raise ArgumentError(f"clustered_bootstrap: method is '{method}', expected bca or percentile")
    sums, counts = sum_by_cluster(np.asarray(values, np.float64), np.asarray(clusters))
    if len(sums) < 2:
        raise ArgumentError(f"clustered_bootstrap: expected at least 2 clusters, got {len(sums)}")
    draws = np.random.Generator(np.random.Philox(key=seed)).integers(len(sums), size=(resamples, len(sums)))
    means = sums[draws].sum(1) / counts[draws].sum(1)
    tails = np.array([0.5 - confidence / 2, 0.5 + confidence / 2])
    if method == "bca":
        tails = _bca_levels(means, sums, counts, tails)
    low, high = np.quantile(means, tails)
    return float(low), float(high)


def sum_by_cluster(
    values: NDArray[np.float64], clusters: NDArray[np.generic]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sums of the values and numbers of episodes, by cluster."""
    _, members = np.unique(clusters, return_inverse=True)
    return np.bincount(members, values).astype(np.float64), np.bincount(members).astype(np.float64)


def _bca_levels(
    means: NDArray[np.float64], sums: NDArray[np.float64], counts: NDArray[np.float64], tails: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return quantile levels corrected for median bias and, from leaving out one cluster at a time, for skewness."""
    estimate = sums.sum() / counts.sum()
    below = np.mean(means < estimate) + np.mean(means == estimate) / 2
    left_out = (sums.sum() - sums) / (counts.sum() - counts)
    influence = left_out.mean() - left_out
    spread = np.sum(influence**2)
    if not 0 < below < 1 or spread < 1e-24:
        return tails
    bias = special.ndtri(below)
    acceleration = np.sum(influence**3) / (6 * spread**1.5)
    shifted = bias + special.ndtri(tails)
    levels: NDArray[np.float64] = special.ndtr(bias + shifted / (1 - acceleration * shifted))
    return levels
