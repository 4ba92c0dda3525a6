# SPDX-License-Identifier: Apache-2.0
"""Does a model get better with data, or with updates? Trends, fits and a split of the gain, over scenes and seeds.

Scenes and seeds are drawn anew together for all trainings (a bootstrap with both crossed), so that differences between
trainings are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError

RESAMPLES = 999
STEEPEST = 3.0
"""Largest exponent of a fit."""

SceneSums = Mapping[str, tuple[float, float]]
"""Sum and number of values in each scene."""


@dataclass(frozen=True)
class Value:
    """A mean with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether the interval lies on one side of zero."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Draws:
    """A quantity, as measured and in each draw of scenes and seeds."""

    value: float
    drawn: NDArray[np.float64]
    """float64 [RESAMPLES]."""

    def __sub__(self, other: Draws) -> Draws:
        return Draws(self.value - other.value, self.drawn - other.drawn)

    def interval(self) -> Value:
        """Return the value with its percentile interval; NaN draws are left out."""
        known = self.drawn[np.isfinite(self.drawn)]
        low, high = np.quantile(known, (0.025, 0.975)) if len(known) else (math.nan, math.nan)
        return Value(self.value, float(low), float(high))


@dataclass(frozen=True)
class Trend:
    """Page's test: does a measure fall, scene by scene, from each size to the next larger one?"""

    statistic: float
    p: float
    """One-sided: how often chance alone orders the sizes so well."""
    scenes: int


@dataclass(frozen=True)
class PowerLaw:
    """a + b (K / K_1)^-c, fitted to the means at the sizes K; K_1 is the smallest."""

    a: Value
    b: Value
    c: Value


@dataclass(frozen=True)
class Split:
    """How the gain from the smallest to the largest size comes about when each size is trained for one epoch.

    From few clips and few updates to few clips and many updates, and from there to many clips and as many updates.
    """

    total: Value
    updates: Value
    """What more updates on the few clips bring."""
    data: Value
    """What more clips bring at equal updates."""
    share: Value
    """Percent of the total that updates bring."""


class Resampled:
    """Means of one measure over trainings, resampled together.

    Args:
        tables: for each training, a table for each seed, in the same order of seeds.
        seed: of the draws.

    Raises:
        ArgumentError: no training, or numbers of seeds that differ.
    """

    def __init__(self, tables: Mapping[str, Sequence[SceneSums]], seed: int = 0) -> None:
        counts = {len(own) for own in tables.values()}
        if len(counts) != 1 or not min(counts):
            raise ArgumentError(f"expected the same number of seeds of each training, got {sorted(counts)}")
        self.scenes = sorted({scene for own in tables.values() for table in own for scene in table})
        self._sums = {name: self._arrange(own, 0) for name, own in tables.items()}
        self._counts = {name: self._arrange(own, 1) for name, own in tables.items()}
        rng = np.random.Generator(np.random.Philox(key=seed))
        seeds, scenes = counts.pop(), len(self.scenes)
        self._scene_weights = rng.multinomial(scenes, np.full(scenes, 1 / scenes), RESAMPLES).astype(np.float64)
        self._seed_weights = rng.multinomial(seeds, np.full(seeds, 1 / seeds), RESAMPLES).astype(np.float64)

    def mean(self, name: str) -> Draws:
        """Return the mean of a training over seeds, each of them pooled over scenes."""
        sums, counts = self._sums[name], self._counts[name]
        drawn = (self._scene_weights @ sums.T) / np.maximum(self._scene_weights @ counts.T, 1e-9)
        weights = self._seed_weights / self._seed_weights.sum(axis=1, keepdims=True)
        return Draws(float(np.mean(self.by_seed(name))), (drawn * weights).sum(axis=1))

    def by_seed(self, name: str) -> list[float]:
        """Return the mean of a training for each seed."""
        return [float(value) for value in self._sums[name].sum(axis=1) / self._counts[name].sum(axis=1)]

    def by_scene(self, name: str) -> NDArray[np.float64]:
        """Return the means of a training in each scene, over seeds; NaN without a value."""
        counts = self._counts[name]
        means = self._sums[name] / np.where(counts > 0, counts, np.nan)
        return np.asarray(means.mean(axis=0), np.float64)

    def _arrange(self, tables: Sequence[SceneSums], part: int) -> NDArray[np.float64]:
        return np.array([[table.get(scene, (0.0, 0.0))[part] for scene in self.scenes] for table in tables])


def measure_trend(means: Resampled, names: Sequence[str]) -> Trend:
    """Test whether a measure falls over trainings, from the first to the last.

    Page's L (1963) over scenes, in each of which the trainings are ranked; p from all orders where they are few, else
    from the normal approximation (scipy).
    """
    from scipy.stats import page_trend_test

    table = np.stack([means.by_scene(name) for name in names], axis=1)
    table = table[np.isfinite(table).all(axis=1)]
    if len(table) < 2 or len(names) < 3:
        return Trend(math.nan, math.nan, len(table))
    found = page_trend_test(-table)
    return Trend(float(found.statistic), float(found.pvalue), len(table))


def fit_power_law(sizes: Sequence[int], values: Sequence[Draws]) -> PowerLaw:
    """Fit a + b (K / K_1)^-c with a, b of 0 or more and c up to `STEEPEST`, by least squares, anew in each draw."""
    relative = np.array(sizes, np.float64) / sizes[0]
    fitted = _fit(relative, np.array([each.value for each in values]))
    drawn = np.array([_fit(relative, row) for row in np.stack([each.drawn for each in values], axis=1)])
    return PowerLaw(*(Draws(float(value), drawn[:, i]).interval() for i, value in enumerate(fitted)))


def _fit(relative: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a, b and c."""
    from scipy.optimize import least_squares

    scale = max(float(np.abs(values).max()), 1e-12)
    spread = max(float(values[0] - values[-1]) / scale, 1e-3)
    start = np.clip([values[-1] / scale, spread, 0.5], 1e-6, 10.0)

    def residuals(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c = numbers
        return np.asarray(a + b * relative**-c - values / scale)

    found = least_squares(residuals, start, bounds=([0, 0, 0.01], [np.inf, np.inf, STEEPEST]))
    return np.asarray(found.x * (scale, scale, 1.0))


def split_gain(means: Resampled, few: str, few_long: str, many: str) -> Split:
    """Split the gain between two trainings of one epoch by a third: few clips for as many updates as many clips."""
    first, middle, last = (means.mean(name) for name in (few, few_long, many))
    total, updates = first - last, first - middle
    drawn = 100 * updates.drawn / np.where(np.abs(total.drawn) > 1e-12, total.drawn, np.nan)
    share = Draws(100 * updates.value / total.value if total.value else math.nan, drawn)
    return Split(total.interval(), updates.interval(), (middle - last).interval(), share.interval())
