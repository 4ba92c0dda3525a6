# SPDX-License-Identifier: Apache-2.0
"""Means with confidence intervals per arm, and paired differences between arms."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.analysis.anytime import find_anytime_p
from wiw.analysis.flip_test import find_p_value
from wiw.analysis.intervals import (
    Interval,
    Kind,
    clustered_bootstrap,
    clustered_interval,
    count_effective,
    sum_by_cluster,
    tango,
    wilson,
)
from wiw.metrics.metric import SUCCESS, Metric

Units = Sequence[Sequence[int]]
"""Episodes of each unit that bets are made on: a complete scene, or an episode where there is only one scene."""
LEVEL = 0.05
"""Adjusted p up to which a difference counts as shown."""


class _Bootstrap:
    """The field `Estimate.bootstrap`, set to an interval or to a function that computes it when it is first read.

    It takes far longer than all else of an estimate, and few of its readers show it.
    """

    @overload
    def __get__(self, estimate: None, owner: type) -> None: ...
    @overload
    def __get__(self, estimate: Estimate, owner: type) -> Interval | None: ...
    def __get__(self, estimate: Estimate | None, owner: type) -> Interval | None:
        if estimate is None:
            return None  # the field's default
        found = estimate.__dict__["bootstrap"]
        if callable(found):
            found = estimate.__dict__["bootstrap"] = found()
        return found

    def __set__(self, estimate: Estimate, value: Interval | Callable[[], Interval] | None) -> None:
        estimate.__dict__["bootstrap"] = value


@dataclass(frozen=True)
class Estimate:
    """A mean and its confidence interval, in the units shown (rates and their differences in percent)."""

    value: float
    low: float
    high: float
    """Both ends are NaN where no interval is known: of the length of a single episode, and of lengths that are all
    equal at the end of their range, such as 0, which do not show how far apart lengths may lie."""
    n: int
    """Episodes."""
    scenes: int
    method: str
    bootstrap: _Bootstrap = _Bootstrap()
    """A second opinion: the bootstrap over scenes, too narrow where they are few; None for one scene."""
    effective_scenes: float = 1.0
    """Scenes with equally many episodes each that would say as much."""

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Difference:
    """One arm against another on the episodes scored in both."""

    arm: str
    base: str
    metric: str
    estimate: Estimate
    """Mean of arm minus base."""
    wins: int
    """Episodes where the arm is better."""
    losses: int
    p_value: float
    """Two-sided test over scenes (`wiw.analysis.flip_test`)."""
    p_adjusted: float = 1.0
    """The same, adjusted by Holm: of SR for all arms that are compared with this base, of other metrics for all of
    theirs."""

    @property
    def is_shown(self) -> bool:
        """Whether the adjusted test finds a difference; tables have it in bold."""
        return self.p_adjusted <= LEVEL


def estimate_mean(values: ArrayLike, scenes: Sequence[str], metric: Metric, *, seed: int = 0) -> Estimate:
    """Return the mean over episodes with a 95 % interval over scenes (`intervals`); `seed` is the bootstrap's."""
    data = np.array(values, np.float64)
    kind: Kind = "rate" if metric.kind == "rate" else "length"
    return _estimate(data, scenes, metric, kind, _find_reach(data, metric), seed, metric.least)


def estimate_difference(
    arm: ArrayLike, base: ArrayLike, scenes: Sequence[str], metric: Metric, *, seed: int = 0
) -> Estimate:
    """Return the mean paired difference, arm minus base, with a 95 % interval over scenes."""
    data, kind, reach = _subtract(arm, base, metric)
    return _estimate(data, scenes, metric, kind, reach, seed)


def compute_p_value(arm: ArrayLike, base: ArrayLike, scenes: Sequence[str], metric: Metric, *, seed: int = 0) -> float:
    """Return the two-sided p of no paired difference, by the test that knows scenes (`wiw.analysis.flip_test`)."""
    data, kind, reach = _subtract(arm, base, metric)
    return find_p_value(data, scenes, kind, reach, seed=seed)


def _compute_anytime_p(arm: ArrayLike, base: ArrayLike, episodes: Sequence[int], metric: Metric, units: Units) -> float:
    """Return the p that holds at any look, over the means of units in their order."""
    data, kind, _ = _subtract(arm, base, metric)
    if kind == "length":
        return 1.0
    differences = dict(zip(episodes, data, strict=True))
    groups = [[differences[index] for index in unit if index in differences] for unit in units]
    return find_anytime_p([float(np.mean(group)) for group in groups if group])


def _subtract(arm: ArrayLike, base: ArrayLike, metric: Metric) -> tuple[NDArray[np.float64], Kind, Interval]:
    """Return paired differences, their kind, and their reach: as two arms scatter, the range's width times root 2."""
    both = np.asarray(arm, np.float64), np.asarray(base, np.float64)
    kind: Kind = "difference" if metric.kind == "rate" else "length"
    low, high = _find_reach(np.concatenate(both), metric)
    half = math.sqrt(2) * (high - low) / 2
    return both[0] - both[1], kind, (-half, half)


def _find_reach(values: NDArray[np.float64], metric: Metric) -> Interval:
    """Return the range that values of a metric are known to have."""
    least = metric.least if math.isfinite(metric.least) else values.min()
    return float(least), float(values.max())


def holm(p_values: ArrayLike) -> NDArray[np.float64]:
    """Return Holm-adjusted p values (1979): the smallest times their number, the next times one less, and so on.

    Rejecting where the adjusted value is at most 0.05 keeps the chance of any false rejection at 5 %.
    """
    raw = np.asarray(p_values, np.float64)
    order = np.argsort(raw)
    adjusted = np.empty_like(raw)
    adjusted[order] = np.maximum.accumulate(raw[order] * np.arange(len(raw), 0, -1)).clip(max=1.0)
    return adjusted


def adjust_p_values(differences: Sequence[Difference]) -> tuple[Difference, ...]:
    """Return the differences of a table with Holm-adjusted p values: SR is one family of tests, the rest another."""
    found = list(differences)
    for is_leading in (True, False):
        family = [i for i, one in enumerate(found) if (one.metric == SUCCESS.name) == is_leading]
        for i, p_value in zip(family, holm([found[i].p_value for i in family]), strict=True):
            found[i] = replace(found[i], p_adjusted=float(p_value))
    return tuple(found)


def compare(
    arm: str,
    base: str,
    outcomes: Mapping[str, Mapping[int, Mapping[str, Any]]],
    metric: Metric,
    seed: int = 0,
    units: Units | None = None,
) -> Difference | None:
    """Return the paired difference of two arms, or None without common episodes that have the metric.

    Args:
        arm: name of the arm under test.
        base: name of the arm it is compared with.
        outcomes: for each arm, scored episodes by index with "scene" and "metrics".
        metric: which metric.
        seed: of the bootstrap.
        units: of a run that was looked at before it was stopped: the episodes of each unit, in order
            (`wiw.analysis.stopping.find_units`). P then holds however often one looks; of lengths it is 1, as the bets
            need bounds.
    """
    both = [
        index
        for index in sorted(set(outcomes[arm]) & set(outcomes[base]))
        if all(metric.name in outcomes[name][index]["metrics"] for name in (arm, base))
    ]
    if not both:
        return None
    ours, theirs = ([outcomes[name][i]["metrics"][metric.name] for i in both] for name in (arm, base))
    scenes = [outcomes[arm][i]["scene"] for i in both]
    sign = 1 if metric.higher_is_better else -1
    gains = sign * _subtract(ours, theirs, metric)[0]
    return Difference(
        arm,
        base,
        metric.name,
        estimate_difference(ours, theirs, scenes, metric, seed=seed),
        int((gains > 0).sum()),
        int((gains < 0).sum()),
        compute_p_value(ours, theirs, scenes, metric, seed=seed)
        if units is None
        else _compute_anytime_p(ours, theirs, both, metric, units),
    )


NO_SPREAD = "unknown: all values are equal, at the end of their range"
_OVER_SCENES = {"rate": "Wilson", "difference": "Tango", "length": "Student t"}
_OVER_EPISODES: dict[Kind, Callable[[NDArray[np.float64], Interval], Interval]] = {
    "rate": lambda data, reach: wilson(float(data.mean()), len(data)),
    "difference": lambda data, reach: tango(data),
    "length": lambda data, reach: (
        clustered_interval(data, np.arange(len(data)), "length", reach=reach) if len(data) > 1 else (math.nan, math.nan)
    ),
}


def _estimate(
    data: NDArray[np.float64],
    scenes: Sequence[str],
    metric: Metric,
    kind: Kind,
    reach: Interval,
    seed: int,
    least: float = -math.inf,
) -> Estimate:
    groups, scale = len(set(scenes)), metric.scale
    second, name = None, _OVER_SCENES[kind]
    if kind == "length" and not reach[1] > reach[0]:  # nothing says how far apart values may lie
        name, low, high = NO_SPREAD, math.nan, math.nan
    elif groups > 1:
        name = f"{name} over {groups} scenes"
        low, high = clustered_interval(data, list(scenes), kind, reach=reach)
        second = partial(_resample, data, list(scenes), scale, seed)
    else:
        low, high = _OVER_EPISODES[kind](data, reach)
    effective = count_effective(sum_by_cluster(data, np.asarray(scenes))[1])
    low = max(scale * low, scale * least)
    return Estimate(scale * float(data.mean()), low, scale * high, len(data), groups, name, second, effective)


def _resample(data: NDArray[np.float64], scenes: list[str], scale: float, seed: int) -> Interval:
    low, high = clustered_bootstrap(data, scenes, seed=seed)
    return scale * low, scale * high
