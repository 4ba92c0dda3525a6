# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals for means over episodes that share scenes.

Episodes of one scene share its walls, its light and its furniture: what is drawn at random is scenes. The interval
reported is a score interval over as many episodes as they are worth by the scatter of scenes, with Student's quantile
for as many scenes as they are worth (`clustered_interval`). With one scene only, no interval can speak of others, and
those over episodes are used (`wilson`, `tango`). The bootstrap over scenes is a second opinion: with few
scenes it is too narrow. `docs/statistics.md` has measured coverage.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special  # its functions load ten times faster than scipy.stats

from wiw.errors import ArgumentError

Array = NDArray[np.float64]
Interval = tuple[float, float]
Kind = Literal["rate", "difference", "length"]
"""Values in [0, 1]; differences of two such; any numbers."""
COINS = {"rate": (0.5, 0.5), "difference": (0.0, 0.5)}
"""Mean and mean square of an episode in which the success of each arm is a fair coin."""

USUAL_CORRELATION, USUAL_WEIGHT = 0.2, 0.25
"""Correlation within scenes that is assumed where the outcomes hardly vary, and the sum of squared deviations that this
assumption counts for. Few successes cannot show whether they gather in few scenes."""
LENGTH_WEIGHT = 2
"""Made-up episodes that steady lengths, one at either end of their range, each worth as many real ones as the design
effect (as Agresti and Coull, 1998, steady proportions with four)."""
BLOCK = 2_000_000
"""Random numbers that are drawn at a time."""
HALVINGS = 40
"""Steps of the bisection for an end of Tango's interval: to 2e-12."""


def wilson(mean: float, n: float, confidence: float = 0.95) -> Interval:
    """Return the score interval of a proportion (Wilson 1927).

    Also holds, conservatively, for the mean of any values in [0, 1]: their variance is at most mean * (1 - mean).
    """
    low, high = score_rate(mean, n, special.ndtri(0.5 + confidence / 2))
    return float(low), float(high)


def tango(differences: ArrayLike, confidence: float = 0.95) -> Interval:
    """Return the score interval of a mean paired difference in [-1, 1].

    Source: Tango, Statistics in Medicine 17 (1998), where differences are -1, 0 or 1. With values in between, as many
    wins and losses are reckoned with as have the same mean and mean square.
    """
    data = np.asarray(differences, np.float64)
    z = special.ndtri(0.5 + confidence / 2)
    low, high = score_difference(data.mean(), np.square(data).mean(), len(data), z)
    return float(low), float(high)


def score_rate(mean: ArrayLike, n: ArrayLike, quantile: ArrayLike) -> tuple[Array, Array]:
    """Return both ends of Wilson's interval for arrays of means, episodes and quantiles."""
    p, n, z = (np.asarray(values, np.float64) for values in (mean, n, quantile))
    center = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(np.maximum(p * (1 - p) / n + z * z / (4 * n * n), 0))
    return np.maximum(center - half, 0.0), np.minimum(center + half, 1.0)


def score_difference(mean: ArrayLike, mean_square: ArrayLike, n: ArrayLike, quantile: ArrayLike) -> tuple[Array, Array]:
    """Return both ends of Tango's interval for arrays: the differences that a score test does not reject."""
    q, square, n, z = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (mean, mean_square, n, quantile)))
    won = np.maximum.reduce([(square + q) / 2, q, np.zeros_like(q)])
    lost = won - q

    def is_held(gap: Array) -> NDArray[np.bool_]:
        """Return whether the score test does not reject a true difference; its nuisance is the share lost."""
        linear = -won - lost + (2 - won + lost) * gap
        share = (np.sqrt(np.maximum(linear**2 + 8 * lost * gap * (1 - gap), 0)) - linear) / 4
        held: NDArray[np.bool_] = n * (q - gap) ** 2 <= z * z * np.maximum(2 * share + gap * (1 - gap), 0)
        return held

    inside, outside = np.stack([q, q]), np.stack([-np.ones_like(q), np.ones_like(q)])
    for _ in range(HALVINGS):
        middle = (inside + outside) / 2
        held = is_held(middle)
        inside, outside = np.where(held, middle, inside), np.where(held, outside, middle)
    return inside[0], inside[1]


def clustered_interval(
    values: ArrayLike, clusters: ArrayLike, kind: Kind, confidence: float = 0.95, reach: Interval | None = None
) -> Interval:
    """Return the interval of the pooled mean with clusters as the sampling unit; see `interval_of_sums`.

    Args:
        values: float [n], one an episode.
        clusters: [n] labels, e.g. scenes; at least two distinct ones.
        kind: what the values are; the interval stays in their range.
        confidence: e.g. 0.95.
        reach: least and greatest possible length; those of the values if not given.

    Raises:
        ArgumentError: fewer than two clusters.
    """
    data = np.asarray(values, np.float64)
    sums, counts = sum_by_cluster(data, np.asarray(clusters))
    if len(sums) < 2:
        raise ArgumentError(f"clustered_interval: expected at least 2 clusters, got {len(sums)}")
    reach = (float(data.min()), float(data.max())) if reach is None else reach
    low, high = interval_of_sums(sums, np.square(data).sum(), counts, kind, confidence, reach)
    return float(low), float(high)


def interval_of_sums(
    sums: Array,
    squares: ArrayLike,
    counts: Array,
    kind: Kind,
    confidence: float = 0.95,
    reach: Interval = (0.0, 0.0),
) -> tuple[Array, Array]:
    """Return both ends of `clustered_interval`, for many runs at once.

    For rates and differences it is the score interval (Wilson, Tango) over n / D episodes, D being the design effect,
    with Student's quantile for as many degrees of freedom as the scenes have; never narrower than the score interval
    over all n episodes as if they were independent. So Korn and Graubard (1998) do with Clopper and Pearson's interval.
    For lengths it is Student's t interval over clusters with the same D, steadied by made-up episodes at either end of
    their range; it holds the mean, and is no wider than the range to either side.

    Args:
        sums: float [..., clusters] of the values in each.
        squares: float [...], sum of squared values over all episodes.
        counts: float [clusters], episodes in each.
        kind: see `clustered_interval`.
        confidence: e.g. 0.95.
        reach: least and greatest possible length.
    """
    n = counts.sum()
    mean, mean_square = sums.sum(-1) / n, np.asarray(squares, np.float64) / n
    quantile = special.stdtrit(count_degrees(sums, counts), 0.5 + confidence / 2)
    if kind == "length":
        center, variance = steady_length(sums, squares, counts, reach)
        half, span = quantile * np.sqrt(variance), reach[1] - reach[0]
        return np.clip(center - half, mean - span, mean), np.clip(center + half, mean, mean + span)
    effect = design_effect(sums, squares, counts)
    plain = np.full_like(mean, special.ndtri(0.5 + confidence / 2))
    sizes, quantiles = np.stack([n / effect, np.full_like(mean, n)]), np.stack([quantile + 0 * plain, plain])
    if kind == "rate":
        low, high = score_rate(mean, sizes, quantiles)
    else:
        low, high = score_difference(mean, mean_square, sizes, quantiles)
    return low.min(0), high.max(0)


def p_value_of_sums(sums: Array, squares: ArrayLike, counts: Array, kind: Kind, reach: Interval = (0.0, 0.0)) -> Array:
    """Return the two-sided p of a mean of 0: 1 - the confidence at which `interval_of_sums` ends there.

    Args:
        sums: float [..., clusters], of differences.
        squares: as there.
        counts: as there.
        kind: "difference" or "length".
        reach: as there.
    """
    n, total = counts.sum(), sums.sum(-1)
    center, effect = total / n, np.ones_like(total)
    if kind == "length":
        center, variance = steady_length(sums, squares, counts, reach)
    else:  # the score test: the variance is the one of a mean of 0
        variance = np.maximum(np.asarray(squares, np.float64), np.abs(total)) / n**2
        effect = np.maximum(design_effect(sums, squares, counts), 0)
    error = np.sqrt(np.where(variance > 0, variance, np.inf))
    ratio = np.abs(center) / error
    p_value = 2 * special.stdtr(count_degrees(sums, counts), -ratio / np.sqrt(np.where(effect > 0, effect, 1e-12)))
    found: Array = p_value if kind == "length" else np.maximum(p_value, 2 * special.ndtr(-ratio))
    return found


def steady_length(sums: Array, squares: ArrayLike, counts: Array, reach: Interval) -> tuple[Array, Array]:
    """Return the mean length and its variance by clusters, with made-up episodes at either end of the range.

    They draw the interval towards the middle of the range, where the mean of lengths that mostly lie at one end is more
    likely to be than the values show.
    """
    low, high = reach
    effect = np.maximum(design_effect(sums, squares, counts, high - low), 1.0)
    weight = LENGTH_WEIGHT * effect
    n = counts.sum() + weight
    center = (sums.sum(-1) + weight * (low + high) / 2) / n
    mean_square = (np.asarray(squares, np.float64) + weight * (low**2 + high**2) / 2) / n
    return center, effect * np.maximum(mean_square - center**2, 0) / n


def count_effective(counts: Array) -> float:
    """Return the number of equal clusters that say as much as these: (sum n)^2 / sum n^2 (Kish 1965)."""
    return float(counts.sum() ** 2 / np.square(counts).sum())


def count_degrees(sums: Array, counts: Array) -> Array:
    """Return the degrees of freedom of the variance over clusters, at most one less than their effective number.

    Where few clusters make up most of the scatter, its own variance is large, by the kurtosis k of the clusters'
    residuals: 2 clusters / (k - 1) degrees, which is as many as clusters for a normal distribution.
    """
    limit = count_effective(counts) - 1
    if counts.max() == 1:  # no episodes share a scene
        return np.full(sums.shape[:-1], limit)
    mean = sums.sum(-1, keepdims=True) / counts.sum()
    apart = np.square(sums - mean * counts)
    scatter = np.square(apart.sum(-1))
    peaked = len(counts) * np.square(apart).sum(-1) - scatter
    degrees = 2 * len(counts) * scatter / np.where(peaked > 1e-12 * scatter, peaked, np.inf)
    found: Array = np.where(peaked > 1e-12 * scatter, np.clip(degrees, min(1.0, limit), limit), limit)
    return found


def design_effect(sums: Array, squares: ArrayLike, counts: Array, span: float = 1.0) -> Array:
    """Return variance of the mean by clusters / variance by episodes, steadied by `USUAL_CORRELATION`.

    It is unknown where no two values differ, and then that of the usual correlation.
    """
    n = counts.sum()
    mean = sums.sum(-1) / n
    apart = np.maximum(np.asarray(squares, np.float64) - n * mean**2, 0)
    seen = apart > 1e-9 * max(span, 1e-12) ** 2
    effect = jackknife_covariance(sums, sums, counts) * n**2 / np.where(seen, apart, 1.0)
    usual = 1 + USUAL_CORRELATION * (float(np.square(counts).sum() / n) - 1)
    weight = USUAL_WEIGHT * span**2
    steadied: Array = np.where(seen, (apart * effect + weight * usual) / np.where(seen, apart + weight, 1.0), usual)
    return steadied


def stabilise_mean(sums: Array, squares: ArrayLike, counts: Array, kind: Kind) -> tuple[Array, Array]:
    """Return the mean of rates or differences and its variance by clusters, with made-up episodes of fair coins.

    For quotients (`wiw.analysis.utility`), which have no score interval. Agresti and Coull (1998), Agresti and Min
    (2005) add as many.
    """
    n = counts.sum()
    coin, coin_square = COINS[kind]
    weight = count_pseudo_episodes(special.stdtrit(count_degrees(sums, counts), 0.975))
    center = (sums.sum(-1) + weight * coin) / (n + weight)
    spread = (np.asarray(squares, np.float64) + weight * coin_square) / (n + weight) - center**2
    return center, design_effect(sums, squares, counts) * spread / (n + weight)


def count_pseudo_episodes(quantile: ArrayLike) -> Array:
    """Return the number of pseudo-episodes that steady a 95 % interval with this quantile: 2 where it is 1.96."""
    found: Array = 2 * (special.ndtri(0.975) / np.asarray(quantile, np.float64)) ** 2
    return found


def jackknife_covariance(first: Array, second: Array, counts: Array) -> Array:
    """Return the covariance of two pooled means, from leaving out one cluster at a time (jackknife).

    Args:
        first: float [..., clusters], sums of one quantity in each cluster.
        second: the same of another, or the same again for a variance.
        counts: float [clusters], episodes in each.
    """
    clusters = len(counts)
    without = [(sums.sum(-1, keepdims=True) - sums) / (counts.sum() - counts) for sums in (first, second)]
    apart = [means - means.mean(-1, keepdims=True) for means in without]
    found: Array = (clusters - 1) / clusters * (apart[0] * apart[1]).sum(-1)
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
    blocks = draw_in_blocks(seed, len(sums), resamples, len(sums))
    means = np.concatenate([sums[draws].sum(1) / counts[draws].sum(1) for draws in blocks])
    tails = np.array([0.5 - confidence / 2, 0.5 + confidence / 2])
    if method == "bca":
        tails = _bca_levels(means, sums, counts, tails)
    low, high = np.quantile(means, tails)
    return float(low), float(high)


def draw_in_blocks(seed: int, end: int, rows: int, columns: int) -> Iterator[NDArray[np.int64]]:
    """Yield whole numbers from 0 to `end` - 1, int64 [rows, columns] in all, a block of rows at a time.

    They are those of a single draw, which may take too much memory.
    """
    rng = np.random.Generator(np.random.Philox(key=seed))
    for count in split_rows(rows, columns):
        yield rng.integers(end, size=(count, columns))


def split_rows(rows: int, columns: int) -> Iterator[int]:
    """Yield how many of so many rows to draw at a time: no more than `BLOCK` numbers, but at least a row."""
    most = max(1, BLOCK // columns)
    for begin in range(0, rows, most):
        yield min(most, rows - begin)


def sum_by_cluster(values: Array, clusters: NDArray[np.generic]) -> tuple[Array, Array]:
    """Return the sums of the values and numbers of episodes, by cluster."""
    _, members = np.unique(clusters, return_inverse=True)
    return np.bincount(members, values).astype(np.float64), np.bincount(members).astype(np.float64)


def _bca_levels(means: Array, sums: Array, counts: Array, tails: Array) -> Array:
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
    levels: Array = special.ndtr(bias + shifted / (1 - acceleration * shifted))
    return levels
