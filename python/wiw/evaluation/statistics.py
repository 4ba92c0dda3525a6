# SPDX-License-Identifier: Apache-2.0
"""What a run shows: means with intervals for each arm, and paired differences between arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from wiw.evaluation.intervals import Interval, agresti_min, clustered_bootstrap, student, wilson

Kind = Literal["rate", "length"]


@dataclass(frozen=True)
class Headline:
    """One column of the table, in the paper's terms."""

    metric: str
    """Name in `EpisodeResult.metrics`."""
    label: str
    kind: Kind
    """"rate": episode values in [0, 1], shown as percent. "length": any number."""
    higher_is_better: bool

    @property
    def scale(self) -> float:
        """From episode values to what is shown."""
        return 100.0 if self.kind == "rate" else 1.0

    @property
    def unit(self) -> str:
        """Sign behind the number."""
        return "%" if self.kind == "rate" else ""


HEADLINES = (
    Headline("success", "SR", "rate", True),
    Headline("spl", "SPL", "rate", True),
    Headline("actions", "Mean Traj", "length", False),
)


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

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Difference:
    """One arm against another on the episodes that both have finished."""

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


def estimate_mean(values: ArrayLike, scenes: Sequence[str], headline: Headline, *, seed: int = 0) -> Estimate:
    """Mean over episodes with the wider of two 95 % intervals: clustered by scene, and over episodes (`intervals`)."""
    data = np.asarray(values, np.float64)
    if headline.kind == "rate":
        return _estimate(data, scenes, headline, ("Wilson", wilson(float(data.mean()), len(data))), seed)
    return _estimate(data, scenes, headline, ("Student t", student(data)), seed)


def estimate_difference(
    arm: ArrayLike, base: ArrayLike, scenes: Sequence[str], headline: Headline, *, seed: int = 0
) -> Estimate:
    """Mean of paired differences, arm minus base, with the wider of two 95 % intervals (`intervals`)."""
    data = np.asarray(arm, np.float64) - np.asarray(base, np.float64)
    if headline.kind == "rate":
        return _estimate(data, scenes, headline, ("Agresti-Min", agresti_min(data)), seed)
    return _estimate(data, scenes, headline, ("Student t", student(data)), seed)


def mcnemar(arm: ArrayLike, base: ArrayLike) -> float:
    """Two-sided p of the exact McNemar test on paired 0/1 outcomes: a fair coin over the pairs that differ."""
    data = np.asarray(arm, np.float64) - np.asarray(base, np.float64)
    wins, differing = int((data > 0).sum()), int((data != 0).sum())
    return 1.0 if differing == 0 else float(stats.binomtest(wins, differing).pvalue)


def compare(
    arm: str, base: str, outcomes: Mapping[str, Mapping[int, Mapping[str, Any]]], headline: Headline, seed: int = 0
) -> Difference | None:
    """The paired difference of two arms, None without common episodes.

    Args:
        arm: name of the arm under test.
        base: name of the arm it is compared with.
        outcomes: for each arm, finished episodes by index with "scene" and "metrics".
        headline: which metric.
        seed: of the bootstrap.
    """
    both = sorted(set(outcomes[arm]) & set(outcomes[base]))
    if not both:
        return None
    ours, theirs = ([outcomes[name][i]["metrics"][headline.metric] for i in both] for name in (arm, base))
    scenes = [outcomes[arm][i]["scene"] for i in both]
    sign = 1 if headline.higher_is_better else -1
    gains = sign * (np.asarray(ours) - np.asarray(theirs))
    binary = headline.kind == "rate" and set(ours) | set(theirs) <= {0, 1}
    return Difference(
        arm,
        base,
        headline.metric,
        estimate_difference(ours, theirs, scenes, headline, seed=seed),
        int((gains > 0).sum()),
        int((gains < 0).sum()),
        mcnemar(ours, theirs) if binary else None,
    )


def _estimate(
    data: NDArray[np.float64], scenes: Sequence[str], headline: Headline, plain: tuple[str, Interval], seed: int
) -> Estimate:
    name, (low, high) = plain
    groups = len(set(scenes))
    if groups > 1:
        clustered = clustered_bootstrap(data, list(scenes), seed=seed)
        low, high = np.nanmin([low, clustered[0]]), np.nanmax([high, clustered[1]])
        name = f"wider of {name} and bootstrap over {groups} scenes"
    scale = headline.scale
    return Estimate(scale * float(data.mean()), scale * float(low), scale * float(high), len(data), groups, name)
