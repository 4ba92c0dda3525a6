# SPDX-License-Identifier: Apache-2.0
"""Does a model get better with data, or with updates? Trends, fits and a split of the gain, over scenes and seeds.

Scenes and seeds are drawn anew together for all trainings (a bootstrap with both crossed), so that differences between
trainings are paired.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.analysis.flip_test import flip_signs
from wiw.analysis.statistics import LEVEL, Estimate, holm
from wiw.errors import ArgumentError

ONE_EPOCH, EQUAL_UPDATES, FEWER_SCENES = "one epoch", "equal updates", "fewer scenes"
"""Arms: as in the paper, where more clips are also more updates; all trained as long as the largest; the same number of
clips from fewer scenes."""
RESAMPLES = 999
EXPONENTS = np.linspace(0.01, 3, 300)
"""Exponents that a fit chooses from."""
MOST_ORDERED = 7
"""Sizes up to which the trend test tries all their orders."""
DRAWN_ORDERS = 20_000
"""Orders that it draws at random beyond that."""

SceneSums = Mapping[str, Sequence[float]]
"""Sum and number of values in each scene."""


@dataclass(frozen=True)
class Value:
    """A mean with its 95 % interval."""

    value: float
    low: float
    high: float


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
    """Page's test over trainings: does a measure fall, seed by seed, from each size to the next larger one?"""

    statistic: float
    p: float
    """One-sided: how often chance alone orders the trainings of each seed so well."""
    least_p: float
    """The p of trainings in perfect order: so few trainings cannot show more."""
    trainings: int


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
    """Gain by more updates on the few clips."""
    data: Value
    """Gain by more clips at equal updates."""
    share: Value
    """Percent of the total that updates bring."""

    @property
    def verdict(self) -> str:
        """Main cause of the gain, as far as the intervals say."""
        if not self.total.low > 0:
            return "no gain"
        if self.share.low > 50:
            return "mostly updates"
        return "mostly data" if self.share.high < 50 else "undecided"


@dataclass(frozen=True)
class ScalingArm:
    """Trainings of one model, from few clips or scenes to many."""

    model: str
    name: str
    amounts: tuple[int, ...]
    """Clips of each training; scenes in the arm `FEWER_SCENES`."""
    clips: int
    """Clips of the last training."""
    updates: tuple[int, ...]
    trainings: tuple[str, ...]
    """Names, without their seeds."""


@dataclass(frozen=True)
class Curve:
    """A measure over the trainings of an arm."""

    arm: ScalingArm
    measure: str
    values: tuple[Value, ...]
    by_seed: tuple[tuple[float, ...], ...]
    """For each training, the value of each seed."""
    gain: Value
    """The first value less the last."""
    trend: Trend | None
    fit: PowerLaw | None
    """Both of primary measures over numbers of clips alone."""
    gain_p: float | None = None
    """Of primary measures over numbers of scenes alone: two-sided p of no gain, by flipping the signs of whole seeds,
    Holm-adjusted for all models and primary measures; None where a seed has measured nothing."""

    @property
    def is_gain_shown(self) -> bool:
        """Whether the adjusted test over trainings finds a difference between the fewest and all scenes."""
        return self.gain_p is not None and self.gain_p <= LEVEL


@dataclass(frozen=True)
class ModelSplit:
    """The split of a model's gain in a primary measure."""

    model: str
    measure: str
    split: Split


@dataclass(frozen=True)
class Success:
    """The success rate of a trained model in closed loop, in percent."""

    name: str
    success: Estimate


@dataclass(frozen=True)
class ScalingTable:
    """All numbers of a study."""

    primary: Mapping[str, str]
    """Measures that conclusions are drawn from, with descriptions."""
    seeds: int
    curves: tuple[Curve, ...]
    splits: tuple[ModelSplit, ...]
    references: Mapping[str, Mapping[str, float]]
    """Primary measures of who has learnt nothing, and of the oracle."""
    success: tuple[Success, ...]

    @property
    def models(self) -> list[str]:
        """Models, in order."""
        return list(dict.fromkeys(curve.arm.model for curve in self.curves))

    def find_curve(self, model: str, arm: str, measure: str) -> Curve:
        """Return the curve of a measure."""
        return next(
            each for each in self.curves if (each.arm.model, each.arm.name, each.measure) == (model, arm, measure)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers as dictionaries, with the verdict of each split."""
        found = asdict(self)
        for row, each in zip(found["splits"], self.splits, strict=True):
            row["verdict"] = each.split.verdict
        return found


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
        """Return the mean of a training over seeds, each pooled over scenes; NaN in draws of scenes without a value."""
        sums, counts = self._sums[name], self._counts[name]
        drawn_counts = self._scene_weights @ counts.T
        drawn = (self._scene_weights @ sums.T) / np.where(drawn_counts > 0, drawn_counts, np.nan)
        weights = self._seed_weights / self._seed_weights.sum(axis=1, keepdims=True)
        return Draws(float(np.mean(self.by_seed(name))), (drawn * weights).sum(axis=1))

    def by_seed(self, name: str) -> list[float]:
        """Return the mean of a training for each seed."""
        return [float(value) for value in self._sums[name].sum(axis=1) / self._counts[name].sum(axis=1)]

    def _arrange(self, tables: Sequence[SceneSums], part: int) -> NDArray[np.float64]:
        return np.array([[table.get(scene, (0.0, 0.0))[part] for scene in self.scenes] for table in tables])


def measure_trend(means: Resampled, names: Sequence[str]) -> Trend:
    """Test whether a measure falls over trainings, from the first to the last.

    The unit is a training. In each seed, the trainings are ranked by their means over all scenes; the statistic is
    Page's L (1963). If the sizes make no difference, the trainings of a seed are as likely to come in any other order,
    which gives p: exact up to `MOST_ORDERED` sizes, also with equal values, and from orders drawn at random beyond.
    Scenes are those measured, the same for all trainings: p is of what another training would do in them.

    Args:
        means: of all trainings.
        names: of the trainings, from few clips to many.
    """
    from scipy.stats import rankdata

    table = np.array([means.by_seed(name) for name in names], np.float64).T  # [seeds, sizes]
    if len(names) < 3 or not np.isfinite(table).all():
        return Trend(math.nan, math.nan, math.nan, table.size)
    ranks = rankdata(-table, axis=1)
    statistic = float((ranks @ np.arange(1, len(names) + 1)).sum())
    perfect = np.tile(np.arange(1.0, len(names) + 1), (len(table), 1))
    best = float((perfect**2).sum())
    return Trend(statistic, _find_trend_p(ranks, statistic), _find_trend_p(perfect, best), table.size)


def _find_trend_p(ranks: NDArray[np.float64], statistic: float) -> float:
    """Return how often L is at least `statistic` if the ranks [seeds, sizes] of each seed come in any order."""
    if ranks.shape[1] > MOST_ORDERED:
        rng = np.random.Generator(np.random.Philox(key=0))
        places = np.arange(1, ranks.shape[1] + 1)
        drawn = rng.permuted(np.tile(ranks, (DRAWN_ORDERS, 1, 1)), axis=-1) @ places
        return float((1 + (drawn.sum(axis=1) >= statistic).sum()) / (1 + DRAWN_ORDERS))
    totals = Counter({0.0: 1})  # ranks are whole or half numbers, so that their sums are exact
    for row in ranks:
        orders = Counter(
            sum(place * rank for place, rank in enumerate(order, 1)) for order in permutations(row.tolist())
        )
        wider: Counter[float] = Counter()
        for (total, count), (more, times) in ((a, b) for a in totals.items() for b in orders.items()):
            wider[total + more] += count * times
        totals = wider
    return sum(count for total, count in totals.items() if total >= statistic) / sum(totals.values())


def fit_power_law(sizes: Sequence[int], values: Sequence[Draws]) -> PowerLaw:
    """Fit a + b (K / K_1)^-c by least squares, anew in each draw; a and b are not below 0, c is one of `EXPONENTS`."""
    relative = np.array(sizes, np.float64) / sizes[0]
    fitted = _fit(relative, np.array([[each.value for each in values]]))[0]
    draws = np.stack([each.drawn for each in values], axis=1)
    drawn = np.where(np.isnan(draws).any(axis=1, keepdims=True), np.nan, _fit(relative, draws))
    return PowerLaw(*(Draws(float(value), drawn[:, i]).interval() for i, value in enumerate(fitted)))


def _fit(relative: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a, b and c [D, 3] of values [D, K]: for each exponent the best line, and then the best exponent."""
    x = relative ** -EXPONENTS[:, None]  # [C, K]
    centred = x - x.mean(axis=1, keepdims=True)
    b = values @ centred.T / (centred**2).sum(axis=1)  # [D, C]
    a = values.mean(axis=1, keepdims=True) - b * x.mean(axis=1)
    through_zero = values @ x.T / (x**2).sum(axis=1)
    level = np.broadcast_to(values.mean(axis=1, keepdims=True), b.shape)
    a, b = np.where(b < 0, level, np.maximum(a, 0)), np.where(b < 0, 0, np.where(a < 0, through_zero, b))
    errors = ((a[..., None] + b[..., None] * x - values[:, None]) ** 2).sum(axis=-1)
    rows, best = np.arange(len(values)), errors.argmin(axis=1)
    return np.stack([a[rows, best], b[rows, best], EXPONENTS[best]], axis=1)


def split_gain(means: Resampled, few: str, few_long: str, many: str) -> Split:
    """Split the gain between two trainings of one epoch by a third: few clips for as many updates as many clips."""
    first, middle, last = (means.mean(name) for name in (few, few_long, many))
    total, updates = first - last, first - middle
    drawn = 100 * updates.drawn / np.where(np.abs(total.drawn) > 1e-12, total.drawn, np.nan)
    share = Draws(100 * updates.value / total.value if total.value else math.nan, drawn)
    return Split(total.interval(), updates.interval(), (middle - last).interval(), share.interval())


def summarise_scaling(
    arms: Sequence[ScalingArm],
    measures: Mapping[str, Sequence[Mapping[str, SceneSums]]],
    primary: Mapping[str, str],
    references: Mapping[str, Mapping[str, float]],
    success: Sequence[Success] = (),
) -> ScalingTable:
    """Return the curves of all measures with intervals, and tests, fits and splits of the primary ones.

    Args:
        arms: of all models, each model with the three.
        measures: for each training the tables of its measures, a set for each seed.
        primary: description of each primary measure.
        references: primary measures of who has learnt nothing.
        success: rates in closed loop.

    Raises:
        ArgumentError: numbers of seeds that differ.
    """
    names = list(dict.fromkeys(name for seeds in measures.values() for table in seeds for name in table))
    resampled = {
        name: Resampled({training: [table[name] for table in seeds] for training, seeds in measures.items()})
        for name in names
    }
    curves = _test_scene_gains(
        [_draw_curve(arm, name, resampled[name], name in primary) for arm in arms for name in names], primary
    )
    splits = tuple(
        ModelSplit(arm.model, name, _split_arm(resampled[name], arm, arms))
        for name in primary
        for arm in arms
        if arm.name == ONE_EPOCH
    )
    return ScalingTable(dict(primary), len(next(iter(measures.values()))), curves, splits, references, tuple(success))


def _draw_curve(arm: ScalingArm, measure: str, means: Resampled, primary: bool) -> Curve:
    drawn = [means.mean(name) for name in arm.trainings]
    judged = primary and arm.name != FEWER_SCENES
    return Curve(
        arm,
        measure,
        tuple(each.interval() for each in drawn),
        tuple(tuple(means.by_seed(name)) for name in arm.trainings),
        (drawn[0] - drawn[-1]).interval(),
        measure_trend(means, arm.trainings) if judged else None,
        fit_power_law(arm.amounts, drawn) if judged else None,
    )


def _test_scene_gains(curves: Sequence[Curve], primary: Mapping[str, str]) -> tuple[Curve, ...]:
    """Return the curves with the p of what all scenes gain over the fewest, where it is primary and known."""
    gains = {
        index: np.subtract(curve.by_seed[0], curve.by_seed[-1])
        for index, curve in enumerate(curves)
        if curve.arm.name == FEWER_SCENES and curve.measure in primary
    }
    known = {index: own for index, own in gains.items() if np.isfinite(own).all()}
    adjusted = dict(zip(known, holm([flip_signs(own) for own in known.values()]).tolist(), strict=True))
    return tuple(replace(curve, gain_p=adjusted.get(index)) for index, curve in enumerate(curves))


def _split_arm(means: Resampled, short: ScalingArm, arms: Sequence[ScalingArm]) -> Split:
    """Split the gain of an arm of one epoch, by the arm of equal updates of the same model."""
    long = next(arm for arm in arms if (arm.model, arm.name) == (short.model, EQUAL_UPDATES))
    return split_gain(means, short.trainings[0], long.trainings[0], short.trainings[-1])
