# SPDX-License-Identifier: Apache-2.0
"""Utility of a world model between the floor and the ceiling of its run: U = (SR - floor) / (ceiling - floor)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from wiw.analysis.intervals import (
    Array,
    Interval,
    clustered_interval,
    count_degrees,
    count_pseudo_episodes,
    jackknife_covariance,
    stabilise_mean,
    sum_by_cluster,
)
from wiw.analysis.statistics import estimate_difference
from wiw.metrics.metric import SUCCESS

FLOOR, CEILING = "copy", "oracle"
UNKNOWN: tuple[float, Interval] = (math.nan, (math.nan, math.nan))


@dataclass(frozen=True)
class Utility:
    """An arm's share of the gain that a perfect world model brings over a static one."""

    arm: str
    value: float
    """0: as the floor; 1: as the ceiling; nan where the interval for ceiling - floor does not lie above 0."""
    low: float
    high: float
    n: int
    """Episodes scored in arm, floor and ceiling."""
    scenes: int
    reference: bool
    """Whether the arm is a reference rather than a world model under test."""
    reason: str = ""
    """Why it is undefined; empty where it is defined."""

    @property
    def is_defined(self) -> bool:
        """Whether the paired 95 % interval for ceiling - floor lies above 0."""
        return not math.isnan(self.value)


def utility(arm: str, done: Mapping[str, Mapping[int, Mapping[str, Any]]], reference: bool = False) -> Utility | None:
    """Return an arm's utility on the episodes scored in it, the floor and the ceiling; None if there are none.

    Args:
        arm: its name.
        done: by arm, scored episodes by index with "scene" and "metrics".
        reference: see `Utility`.
    """
    names = (arm, FLOOR, CEILING)
    common = sorted(set.intersection(*(set(done[name]) for name in names)))
    if not common or any("success" not in done[name][i]["metrics"] for name in names for i in common):
        return None
    scored, floor, ceiling = (
        np.array([done[name][i]["metrics"]["success"] for i in common], np.float64) for name in names
    )
    scenes = [done[arm][i]["scene"] for i in common]
    clusters: Sequence[Any] = scenes if len(set(scenes)) > 1 else common  # one scene: over its episodes
    value, (low, high) = ratio(scored - floor, ceiling - floor, clusters)
    reason = _explain_undefined(ceiling, floor, scenes) if math.isnan(value) else ""
    return Utility(arm, value, low, high, len(common), len(set(scenes)), reference, reason)


def _explain_undefined(ceiling: Array, floor: Array, scenes: Sequence[str]) -> str:
    """Return why utility is undefined, by the interval that tables show for ceiling - floor."""
    span = estimate_difference(ceiling, floor, scenes, SUCCESS)
    if span.high < 0:
        return f"the interval for {CEILING} - {FLOOR} lies below 0"
    if span.low > 0:
        return "too little data for an interval of this ratio"
    return f"the interval for {CEILING} - {FLOOR} includes 0"


def ratio(gains: ArrayLike, spans: ArrayLike, clusters: ArrayLike, confidence: float = 0.95) -> tuple[float, Interval]:
    """Return mean(gains) / mean(spans) with Fieller's interval (1954) over clusters, all nan where it is undefined.

    It holds every u for which the mean of gains - u spans is within t standard errors of 0; a bootstrap of the quotient
    is too narrow (`docs/statistics.md`). It is defined where this holds for a bounded range of u, and where the
    interval of mean(spans) lies above 0.

    Args:
        gains: float [n] in [-1, 1], arm - floor in each episode.
        spans: float [n] in [-1, 1], ceiling - floor.
        clusters: [n] labels.
        confidence: e.g. 0.95.
    """
    labels = np.asarray(clusters)
    both = [np.asarray(values, np.float64) for values in (gains, spans)]
    (over, counts), (under, _) = (sum_by_cluster(values, labels) for values in both)
    if len(counts) < 2 or clustered_interval(both[1], labels, "difference", confidence)[0] <= 0:
        return UNKNOWN
    squares = [float(np.square(values).sum()) for values in both]
    a, var_a = map(float, stabilise_mean(over, squares[0], counts, "difference"))
    b, var_b = map(float, stabilise_mean(under, squares[1], counts, "difference"))
    apart = [
        all_squares - float(sums.sum() ** 2 / counts.sum())
        for all_squares, sums in zip(squares, (over, under), strict=True)
    ]
    degrees = min(float(count_degrees(sums, counts)) for sums in (over, under))
    weight = float(count_pseudo_episodes(special.stdtrit(degrees, 0.975)))
    covariance = _correlation(over, under, counts, apart, weight) * math.sqrt(var_a * var_b)
    t_square = float(special.stdtrit(degrees, 0.5 + confidence / 2)) ** 2
    square, half_linear, constant = b * b - t_square * var_b, a * b - t_square * covariance, a * a - t_square * var_a
    if square <= 0:
        return UNKNOWN
    root = math.sqrt(max(0.0, half_linear**2 - square * constant))
    return float(over.sum() / under.sum()), (float((half_linear - root) / square), float((half_linear + root) / square))


def _correlation(over: Array, under: Array, counts: Array, apart: list[float], weight: float) -> float:
    """Return the correlation of the two means over clusters; `apart` are sums of squared deviations over episodes.

    The made-up episodes count too: three fair coins, floor, arm and ceiling, give either difference a variance of 1/2
    and both a covariance of 1/4. So an arm that did as the ceiling in every episode is not certain to be its equal.
    """
    shared, *own = (float(jackknife_covariance(x, y, counts)) for x, y in ((over, under), (over, over), (under, under)))
    scale = math.sqrt(own[0] * own[1])
    seen = min(1.0, max(-1.0, shared / scale)) if scale > 1e-12 else 0.0
    more = [one + weight / 2 for one in apart]
    return (seen * math.sqrt(max(0.0, apart[0] * apart[1])) + weight / 4) / math.sqrt(more[0] * more[1])
