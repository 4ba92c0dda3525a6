# SPDX-License-Identifier: Apache-2.0
"""Means with confidence intervals per arm, and paired differences between arms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from wiw.analysis.intervals import Interval, Kind, agresti_min, clustered_bootstrap, clustered_t, student, wilson
from wiw.metrics.metric import Metric


@dataclass(frozen=True)
class Estimate:
    """A mean and its confidence interval, in the units shown (rates and their differences in percent)."""

    value: float
    low: float
    high: float
    n: int
    """Episodes."""
    scenes: int
    method: str
    bootstrap: Interval | None = None
    """A second opinion: the bootstrap over scenes, too narrow where they are few; None for one scene."""

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
    p_value: float | None
    """Exact McNemar test, for 0/1 metrics."""
    p_adjusted: float | None = None
    """The same, adjusted by Holm for all arms that are compared with this base."""


def estimate_mean(values: ArrayLike, scenes: Sequence[str], metric: Metric, *, seed: int = 0) -> Estimate:
    """Return the mean over episodes with a 95 % interval over scenes (`intervals`); `seed` is the bootstrap's."""
    data = np.asarray(values, np.float64)
    found = _estimate(data, scenes, metric, "rate" if metric.kind == "rate" else "length", seed)
    return replace(found, low=max(found.low, metric.scale * metric.least))


def estimate_difference(
    arm: ArrayLike, base: ArrayLike, scenes: Sequence[str], metric: Metric, *, seed: int = 0
) -> Estimate:
    """Return the mean paired difference, arm minus base, with a 95 % interval over scenes."""
    data = np.asarray(arm, np.float64) - np.asarray(base, np.float64)
    return _estimate(data, scenes, metric, "difference" if metric.kind == "rate" else "length", seed)


def mcnemar(arm: ArrayLike, base: ArrayLike) -> float:
    """Return the two-sided p of the exact McNemar test on paired 0/1 outcomes."""
    data = np.asarray(arm, np.float64) - np.asarray(base, np.float64)
    wins, differing = int((data > 0).sum()), int((data != 0).sum())
    return 1.0 if differing == 0 else min(1.0, 2 * float(special.bdtr(min(wins, differing - wins), differing, 0.5)))


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
    """Return the differences with Holm-adjusted p values; the arms of one metric are a family of tests."""
    found = list(differences)
    for metric in {difference.metric for difference in found}:
        family = [i for i, d in enumerate(found) if d.metric == metric and d.p_value is not None]
        p_values = np.array([found[i].p_value for i in family], np.float64)
        for i, p_value in zip(family, holm(p_values), strict=True):
            found[i] = replace(found[i], p_adjusted=float(p_value))
    return tuple(found)


def compare(
    arm: str, base: str, outcomes: Mapping[str, Mapping[int, Mapping[str, Any]]], metric: Metric, seed: int = 0
) -> Difference | None:
    """Return the paired difference of two arms, or None without common episodes that have the metric.

    Args:
        arm: name of the arm under test.
        base: name of the arm it is compared with.
        outcomes: for each arm, scored episodes by index with "scene" and "metrics".
        metric: which metric.
        seed: of the bootstrap.
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
    gains = sign * (np.asarray(ours) - np.asarray(theirs))
    binary = metric.kind == "rate" and set(ours) | set(theirs) <= {0, 1}
    return Difference(
        arm,
        base,
        metric.name,
        estimate_difference(ours, theirs, scenes, metric, seed=seed),
        int((gains > 0).sum()),
        int((gains < 0).sum()),
        mcnemar(ours, theirs) if binary else None,
    )


_OVER_EPISODES: dict[Kind, tuple[str, Callable[[NDArray[np.float64]], Interval]]] = {
    "rate": ("Wilson", lambda data: wilson(float(data.mean()), len(data))),
    "difference": ("Agresti-Min", agresti_min),
    "length": ("Student t", student),
}


def _estimate(data: NDArray[np.float64], scenes: Sequence[str], metric: Metric, kind: Kind, seed: int) -> Estimate:
    groups, scale = len(set(scenes)), metric.scale
    second = None
    if groups > 1:
        name, (low, high) = f"t over {groups} scenes", clustered_t(data, list(scenes), kind)
        bootstrap = clustered_bootstrap(data, list(scenes), seed=seed)
        second = scale * bootstrap[0], scale * bootstrap[1]
    else:
        name, interval = _OVER_EPISODES[kind]
        low, high = interval(data)
    return Estimate(scale * float(data.mean()), scale * low, scale * high, len(data), groups, name, second)
