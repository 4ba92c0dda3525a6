# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals for means over episodes that share scenes.

Two views of the same mean are taken and the wider end of each is reported:

* episodes as if independent: Wilson's score interval for rates, Student's t for lengths, Agresti and Min's adjusted
  Wald interval for paired differences of rates;
* episodes clustered by scene: a bootstrap that draws whole scenes (BCa, Efron 1987).

Sharing a scene can only make episodes more alike, so the second should not be narrower than the first. Where it is,
there are too few scenes, or too few distinct results, for resampling to see the spread: with 4 scenes of 5 episodes
the bootstrap alone holds the true rate in 77-86 % of simulated runs and the wider of both in 93-98 %; with 20 or more
scenes they agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from wiw.errors import ArgumentError

Interval = tuple[float, float]


def wilson(mean: float, n: int, confidence: float = 0.95) -> Interval:
    """Score interval of a proportion (Wilson 1927).

    Also holds, conservatively, for the mean of any values in [0, 1]: their variance is at most mean * (1 - mean).
    """
    z = stats.norm.ppf(0.5 + confidence / 2)
    center = (mean + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n))
    return max(0.0, float(center - half)), min(1.0, float(center + half))


def student(values: ArrayLike, confidence: float = 0.95) -> Interval:
    """Student's t interval of a mean; (nan, nan) for a single value."""
    data = np.asarray(values, np.float64)
    if len(data) < 2:
        return float("nan"), float("nan")
    half = stats.t.ppf(0.5 + confidence / 2, len(data) - 1) * data.std(ddof=1) / np.sqrt(len(data))
    return float(data.mean() - half), float(data.mean() + half)


def agresti_min(differences: ArrayLike, confidence: float = 0.95) -> Interval:
    """Interval of the mean of paired differences in [-1, 1]: half a win and half a loss more, half a tie of each kind.

    Source: Agresti and Min, Statistics in Medicine 24 (2005), where differences are -1, 0 or 1. A difference in between
    counts as that share of a win or a loss, which overstates its variance and so errs on the safe side.
    """
    data = np.asarray(differences, np.float64)
    n = len(data) + 2
    wins, losses = data.clip(0).sum() + 0.5, (-data).clip(0).sum() + 0.5
    center = (wins - losses) / n
    half = stats.norm.ppf(0.5 + confidence / 2) * np.sqrt(wins + losses - (wins - losses) ** 2 / n) / n
    return max(-1.0, float(center - half)), min(1.0, float(center + half))


def clustered_bootstrap(
    values: ArrayLike,
    clusters: ArrayLike,
    *,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    method: str = "bca",
) -> Interval:
    """Interval of the pooled mean when whole clusters are drawn with replacement.

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
    sums, counts = _per_cluster(np.asarray(values, np.float64), np.asarray(clusters))
    if len(sums) < 2:
        raise ArgumentError(f"clustered_bootstrap: expected at least 2 clusters, got {len(sums)}")
    draws = np.random.Generator(np.random.Philox(key=seed)).integers(len(sums), size=(resamples, len(sums)))
    means = sums[draws].sum(1) / counts[draws].sum(1)
    tails = np.array([0.5 - confidence / 2, 0.5 + confidence / 2])
    if method == "bca":
        tails = _bca_levels(means, sums, counts, tails)
    low, high = np.quantile(means, tails)
    return float(low), float(high)


def _per_cluster(
    values: NDArray[np.float64], clusters: NDArray[np.generic]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    _, members = np.unique(clusters, return_inverse=True)
    return np.bincount(members, values).astype(np.float64), np.bincount(members).astype(np.float64)


def _bca_levels(
    means: NDArray[np.float64], sums: NDArray[np.float64], counts: NDArray[np.float64], tails: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Quantile levels corrected for median bias and for skewness; the latter from leaving out one cluster at a time."""
    estimate = sums.sum() / counts.sum()
    below = np.mean(means < estimate) + np.mean(means == estimate) / 2
    left_out = (sums.sum() - sums) / (counts.sum() - counts)
    influence = left_out.mean() - left_out
    spread = np.sum(influence**2)
    if not 0 < below < 1 or spread < 1e-24:
        return tails
    bias = stats.norm.ppf(below)
    acceleration = np.sum(influence**3) / (6 * spread**1.5)
    shifted = bias + stats.norm.ppf(tails)
    levels: NDArray[np.float64] = stats.norm.cdf(bias + shifted / (1 - acceleration * shifted))
    return levels
