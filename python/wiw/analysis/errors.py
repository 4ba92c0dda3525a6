# SPDX-License-Identifier: Apache-2.0
"""Costs of errors of known doses: success and regret of each arm against true futures, and of each family of errors.

Every number is paired by episode with the oracle, whose futures have no error. A family's cost is a slope: the loss of
its arms over how far their frames are from the true ones, fitted through the oracle, where both are zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.analysis.intervals import p_value_of_sums, sum_by_cluster
from wiw.analysis.rank_correlation import Correlation, correlate
from wiw.analysis.statistics import (
    LEVEL,
    Difference,
    Estimate,
    adjust_p_values,
    compare,
    estimate_difference,
    estimate_mean,
    holm,
)
from wiw.analysis.summary import split_outcomes
from wiw.experiments.errors.kinds import ERRORS
from wiw.metrics.metric import ANSWER_SCORE, MEAN_TRAJECTORY, PATH_LENGTH, SUCCESS, Metric

REGRET = Metric("regret", "Regret", "length", False, least=0.0)
"""Score of the best true future less that of the chosen plan's, in the reviser's scores."""
DISTANCES = ("LPIPS", "1 - SSIM")
"""Distances of frames from the true ones; the first that is known is the one that costs are given for."""
PSNR, METRES, DEGREES = "PSNR", "metres", "degrees"
MEASURES = (*DISTANCES, PSNR, METRES, DEGREES)
STEP = 0.1
"""Distance that costs are given for."""
MOST_MISSING = 0.1
"""Share of the oracle's episodes that an arm may lack to count among the costs of its family."""
LENGTHS = (MEAN_TRAJECTORY, PATH_LENGTH)
"""Lengths of a trajectory; the first that a task records is shown."""
FLOOR, CEILING = "none", "oracle"


@dataclass(frozen=True)
class ErrorLine:
    """One error of one dose."""

    arm: str
    kind: str
    family: str
    dose: float
    unit: str
    outcome: Estimate
    """Success rate, or score of answers, in percent."""
    loss: Difference
    """Arm minus oracle."""
    over_none: Difference | None
    """Arm minus none, paired: what is left of the gain of true futures. P is adjusted for all arms."""
    trajectory: Difference | None
    """The same in the mean trajectory: number of executed actions, or in question answering metres."""
    regret: Difference | None
    """The same in regret."""
    measures: Mapping[str, Estimate]
    """How far the frames were from the true ones, by name of `MEASURES`; those that are known."""


@dataclass(frozen=True)
class Cost:
    """The cost of a family of errors for each `STEP` of a measure."""

    family: str
    measure: str
    loss: Estimate
    """Points of the outcome."""
    regret: Estimate | None
    arms: int
    p_adjusted: float
    """P of no loss, Holm-adjusted for all costs of the table."""

    @property
    def is_shown(self) -> bool:
        """Whether the errors are shown to cost, or to gain, anything."""
        return self.p_adjusted <= LEVEL


@dataclass(frozen=True)
class CostGap:
    """The cost of one family less that of another one, paired by episode."""

    family: str
    base: str
    measure: str
    loss: Estimate
    regret: Estimate | None
    p_adjusted: float
    """P of no difference in the loss, Holm-adjusted for all pairs of families at this measure."""

    @property
    def is_shown(self) -> bool:
        """Whether one family is shown to cost more than the other."""
        return self.p_adjusted <= LEVEL


@dataclass(frozen=True)
class ErrorTable:
    """All numbers of one task."""

    task: str
    policy: str
    label: str
    """Name of the outcome: "SR" or "Score"."""
    episodes: int
    """Scored in none, the oracle and every arm that counts among the costs."""
    scenes: int
    references: Mapping[str, Estimate]
    """Outcome of "none" and "oracle"."""
    gain: Difference | None
    """The oracle minus none: what there is to lose."""
    lines: tuple[ErrorLine, ...]
    costs: tuple[Cost, ...]
    gaps: tuple[CostGap, ...]
    correlations: tuple[Correlation, ...]
    """How well each measure orders the arms by the outcome."""
    left_out: tuple[str, ...]
    """Kinds of errors that make no sense in this task."""

    @property
    def distance(self) -> str:
        """The distance of frames that costs are given for; the last one where none was measured."""
        known = {name for line in self.lines for name in line.measures}
        return next((name for name in DISTANCES if name in known), DISTANCES[-1])


def summarise_errors(
    task: str,
    policy: str,
    outcomes: Sequence[Mapping[str, Any]],
    decisions: Iterable[Mapping[str, Any]],
    arms: Mapping[str, tuple[str, float]],
    left_out: Sequence[str] = (),
    seed: int = 0,
    others: Sequence[str] = (),
) -> ErrorTable:
    """Return what each error costs.

    Args:
        task: its name.
        policy: its name.
        outcomes: ended episodes of all arms, as the run store has them.
        decisions: "arm", "episode" and "fidelity" of decisions; those without fidelity are passed over.
        arms: kind and dose of each arm with an error.
        left_out: kinds of errors without arms here.
        seed: of the bootstrap.
        others: arms with errors that were run but are not shown; p values are adjusted for them, too.
    """
    names = [FLOOR, CEILING, *arms, *others]
    done, _ = split_outcomes(names, [row for row in outcomes if row["arm"] in names])
    measured = _average_by_episode(decisions)
    _add_regret(done, measured)
    shown = [arm for arm in arms if done[arm].keys() & done[CEILING].keys()]
    pooled_arms = _choose_pooled(shown, done)
    scored = set.intersection(*(set(done[arm]) for arm in (FLOOR, CEILING, *pooled_arms)))
    metric = next(
        metric
        for metric in (ANSWER_SCORE, SUCCESS)
        if all(metric.name in row["metrics"] for own in done.values() for row in own.values())
    )
    hidden = [arm for arm in others if done[arm].keys() & done[CEILING].keys()]
    lines = _adjust(
        [_summarise_arm(arm, *arms[arm], done, measured, metric, seed) for arm in shown],
        [compare(arm, CEILING, done, metric, seed) for arm in hidden],
        [compare(arm, FLOOR, done, metric, seed) for arm in hidden],
    )
    pooled = _Pooled(pooled_arms, sorted(scored), done, measured, metric, seed)
    costs, gaps = _list_costs([line for line in lines if line.arm in pooled_arms], pooled)
    return ErrorTable(
        task,
        policy,
        metric.label,
        len(scored),
        len({done[CEILING][index]["scene"] for index in scored}),
        {arm: _estimate(done[arm], metric, seed) for arm in (FLOOR, CEILING)},
        compare(CEILING, FLOOR, done, metric, seed),
        lines,
        costs,
        gaps,
        pooled.correlate_measures(),
        tuple(left_out),
    )


Done = Mapping[str, Mapping[int, Mapping[str, Any]]]
Measured = Mapping[str, Mapping[int, Mapping[str, float]]]


def _choose_pooled(arms: Sequence[str], done: Done) -> list[str]:
    """Return the arms that lack at most `MOST_MISSING` of the oracle's episodes; all where none is so far yet."""
    whole = len(done[CEILING])
    return [arm for arm in arms if len(done[arm]) >= (1 - MOST_MISSING) * whole] or list(arms)


def _average_by_episode(decisions: Iterable[Mapping[str, Any]]) -> dict[str, dict[int, dict[str, float]]]:
    """Return the means over an episode's measured decisions and their plans: by arm, episode and measure."""
    found: dict[str, dict[int, dict[str, list[float]]]] = {}
    for row in decisions:
        if row["fidelity"] is None:
            continue
        own = found.setdefault(row["arm"], {}).setdefault(row["episode"], {})
        for name, values in _read_fidelity(row["fidelity"]).items():
            own.setdefault(name, []).extend(value for value in values if value is not None and math.isfinite(value))
    return {
        arm: {
            episode: {name: float(np.mean(values)) for name, values in own.items() if values}
            for episode, own in episodes.items()
        }
        for arm, episodes in found.items()
    }


def _read_fidelity(found: Mapping[str, Any]) -> dict[str, Sequence[float | None]]:
    """Return the measures of a decision's plans, as a store has them."""
    poses = found.get("pose_errors") or ()
    return {
        "LPIPS": found.get("lpips", ()),
        "1 - SSIM": [None if value is None else 1 - value for value in found["ssim"]],
        PSNR: found["psnr"],
        METRES: [metres for metres, _ in poses],
        DEGREES: [degrees for _, degrees in poses],
        REGRET.name: [found["regret"]],
    }


def _add_regret(done: dict[str, dict[int, Mapping[str, Any]]], measured: Measured) -> None:
    """Add the mean regret of each episode to its metrics, where it was measured."""
    for arm, rows in done.items():
        for index, row in rows.items():
            regret = measured.get(arm, {}).get(index, {}).get(REGRET.name)
            if regret is not None:
                rows[index] = {**row, "metrics": {**row["metrics"], REGRET.name: regret}}


def _estimate(done: Mapping[int, Mapping[str, Any]], metric: Metric, seed: int) -> Estimate:
    values = [row["metrics"][metric.name] for row in done.values()]
    return estimate_mean(values, [row["scene"] for row in done.values()], metric, seed=seed)


def _summarise_arm(
    arm: str, kind: str, dose: float, done: Done, measured: Measured, metric: Metric, seed: int
) -> ErrorLine:
    loss = compare(arm, CEILING, done, metric, seed)
    assert loss is not None
    measures = {}
    for name in MEASURES:
        known = {index: own[name] for index, own in measured.get(arm, {}).items() if name in own and index in done[arm]}
        if known:
            scenes = [done[arm][index]["scene"] for index in known]
            least = 0.0 if name != PSNR else -math.inf
            measures[name] = estimate_mean(
                list(known.values()), scenes, Metric(name, name, "length", False, least=least), seed=seed
            )
    return ErrorLine(
        arm,
        kind,
        ERRORS[kind].family,
        dose,
        ERRORS[kind].unit,
        _estimate(done[arm], metric, seed),
        loss,
        compare(arm, FLOOR, done, metric, seed),
        next(filter(None, (compare(arm, CEILING, done, length, seed) for length in LENGTHS)), None),
        compare(arm, CEILING, done, REGRET, seed),
        measures,
    )


def _adjust(
    lines: Sequence[ErrorLine], hidden: Sequence[Difference | None], hidden_over_none: Sequence[Difference | None]
) -> tuple[ErrorLine, ...]:
    """Return the lines with p values adjusted for all arms, also those that are not shown: against the oracle, and
    against none.
    """
    losses = _adjust_family([*(line.loss for line in lines), *hidden])
    over_none = _adjust_family([*(line.over_none for line in lines), *hidden_over_none])
    found = []
    for line, loss, over in zip(lines, losses, over_none, strict=False):
        assert loss is not None
        found.append(replace(line, loss=loss, over_none=over))
    return tuple(found)


def _adjust_family(differences: Sequence[Difference | None]) -> list[Difference | None]:
    """Return the differences adjusted for each other, in their places; those without common episodes are None."""
    adjusted = iter(adjust_p_values([each for each in differences if each is not None]))
    return [None if each is None else next(adjusted) for each in differences]


class _Pooled:
    """Arms on the episodes that are scored in all of them, as matrices [arms, episodes]."""

    def __init__(
        self, arms: Sequence[str], episodes: Sequence[int], done: Done, measured: Measured, metric: Metric, seed: int
    ) -> None:
        self._arms, self._seed, self._metric = list(arms), seed, metric
        self._scenes = [done[CEILING][index]["scene"] for index in episodes]
        self._outcome = self._read(arms, episodes, lambda arm, index: done[arm][index]["metrics"][metric.name])
        self._lost = (
            self._read([CEILING], episodes, lambda arm, index: done[arm][index]["metrics"][metric.name]) - self._outcome
        )
        get = lambda arm, index: done[arm][index]["metrics"].get(REGRET.name, math.nan)  # noqa: E731
        self._regret = self._read(arms, episodes, get) - self._read([CEILING], episodes, get)
        self._measures = {
            name: self._read(
                arms, episodes, lambda arm, index, name=name: measured.get(arm, {}).get(index, {}).get(name, math.nan)
            )
            for name in MEASURES
        }

    @staticmethod
    def _read(arms: Sequence[str], episodes: Sequence[int], get: Any) -> NDArray[np.float64]:
        return np.array([[get(arm, index) for index in episodes] for arm in arms], np.float64).reshape(
            len(arms), len(episodes)
        )

    def weigh(self, arms: Sequence[str], measure: str) -> NDArray[np.float64] | None:
        """Return weights [arms] that make the slope through the origin of what arms lose; None without any distance."""
        rows = [self._arms.index(arm) for arm in arms]
        values = self._measures[measure][rows]
        if not rows or not values.size or np.isnan(values).all(axis=1).any():
            return None
        x = np.nanmean(values, axis=1)
        weights = np.zeros(len(self._arms))
        total = float((x**2).sum())
        if total <= 0:
            return None
        weights[rows] = STEP * x / total
        return weights

    def estimate_loss(self, weights: NDArray[np.float64]) -> Estimate | None:
        """Return the weighted sum of what the arms lose, in points; None without episodes.

        As a share of the most that could be lost or won it is a difference of rates, whose interval is honest where few
        episodes differ.
        """
        if not self._scenes:
            return None
        most, shares = self._share(weights)
        found = estimate_difference(shares, np.zeros_like(shares), self._scenes, self._metric, seed=self._seed)
        return replace(found, value=most * found.value, low=most * found.low, high=most * found.high, bootstrap=None)

    def test_loss(self, weights: NDArray[np.float64]) -> float:
        """Return the p of no loss, for the weighted sum of what the arms lose: 1 - the confidence at which its interval
        ends at 0. In a single scene, of its episodes; 1 for a single episode.
        """
        _, shares = self._share(weights)
        if len(shares) == 1:
            return 1.0
        clusters = np.asarray(self._scenes) if len(set(self._scenes)) > 1 else np.arange(len(shares))
        sums, counts = sum_by_cluster(shares, clusters)
        return float(p_value_of_sums(sums, np.square(shares).sum(), counts, "difference"))

    def _share(self, weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the most that could be lost, and what each episode lost, as a share of it."""
        most = float(np.abs(weights).sum())
        return most, weights @ self._lost / most

    def estimate_regret(self, weights: NDArray[np.float64]) -> Estimate | None:
        """Return the weighted sum of what the arms gain in regret, over episodes in which it was measured in all."""
        used = weights != 0
        values = weights[used] @ self._regret[used]
        known = np.isfinite(values)
        if not known.any():
            return None
        scenes = [scene for scene, each in zip(self._scenes, known, strict=True) if each]
        return estimate_difference(values[known], np.zeros(int(known.sum())), scenes, REGRET, seed=self._seed)

    def correlate_measures(self) -> tuple[Correlation, ...]:
        """Return how well each measure orders the arms by the outcome."""
        known = [
            name for name in MEASURES if self._outcome.size and np.isfinite(self._measures[name]).any(axis=1).all()
        ]
        return tuple(correlate(name, self._outcome, self._measures[name], self._scenes, self._seed) for name in known)


def _list_costs(lines: Sequence[ErrorLine], pooled: _Pooled) -> tuple[tuple[Cost, ...], tuple[CostGap, ...]]:
    families = list(dict.fromkeys(line.family for line in lines))
    costs, gaps = [], []
    for measure in (*DISTANCES, METRES):
        weights = {
            family: pooled.weigh([line.arm for line in lines if line.family == family], measure) for family in families
        }
        known = {family: own for family, own in weights.items() if own is not None}
        for family, own in known.items():
            loss = pooled.estimate_loss(own)
            if loss is not None:
                arms = int((own != 0).sum())
                costs.append(Cost(family, measure, loss, pooled.estimate_regret(own), arms, pooled.test_loss(own)))
        if measure != METRES:
            gaps += _list_gaps(known, measure, pooled)
    adjusted = holm([each.p_adjusted for each in costs])
    costs = [replace(each, p_adjusted=float(p)) for each, p in zip(costs, adjusted, strict=True)]
    return tuple(costs), tuple(gaps)


def _list_gaps(weights: Mapping[str, NDArray[np.float64]], measure: str, pooled: _Pooled) -> list[CostGap]:
    """Return how much more each family costs than each before it, by one measure."""
    found = []
    for base, family in combinations(weights, 2):
        apart = weights[family] - weights[base]
        loss = pooled.estimate_loss(apart)
        if loss is not None:
            found.append(CostGap(family, base, measure, loss, pooled.estimate_regret(apart), pooled.test_loss(apart)))
    adjusted = holm([each.p_adjusted for each in found])
    return [replace(each, p_adjusted=float(p)) for each, p in zip(found, adjusted, strict=True)]
