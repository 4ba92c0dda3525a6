# SPDX-License-Identifier: Apache-2.0
"""Compute how many episodes a run needs, or what it can show, before running it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from typing import Any

import numpy as np
from scipy import stats

from wiw.analysis.flip_test import FEWEST_SCENES, approximate_flips
from wiw.analysis.intervals import p_value_of_sums
from wiw.analysis.simulate import draw_outcome_counts, sum_by_scene
from wiw.errors import ArgumentError

BASE, LOSSES, CORRELATION, PER_SCENE = 20.0, 2.0, 0.05, 5
"""Close to what was measured on 210 test episodes of Image-Goal Navigation in 42 apartments (`docs/results.md`): 19 %
succeed without a world model; the oracle wins 73 more and loses 3; paired differences correlate within apartments by
-0.06 to 0.06."""
WHOLE = ("scenes", "per_scene", "arms", "seed")
MOST_SCENES = 100_000
LEAST = 0.1
"""Step of the search for a difference, in points."""
_DRAWS = 2_000_000


@dataclass(frozen=True)
class Power:
    """The result of `wiw.power`; its string form is a sentence or two."""

    difference: float
    """Difference in success rate between two arms that the run shows, in points."""
    base: float
    """Success rate of the base arm, percent."""
    losses: float
    """Percent of episodes in which only the worse arm succeeds: the base, if the difference is positive."""
    correlation: float
    """Correlation between the differences in two episodes of a scene."""
    per_scene: int
    arms: int
    wanted: float
    """Requested chance of showing the difference."""
    scenes: int
    """Number of scenes needed."""
    by_interval: float
    """Chance, in simulated runs, that the interval of the difference at `confidence` excludes 0 on the right side."""
    by_test: float
    """The same for the test behind the p values in tables (`wiw.analysis.flip_test`), at the same level."""

    @property
    def confidence(self) -> float:
        """Confidence of the interval in percent: 95 for one arm, more for one of several, adjusted by Bonferroni."""
        return 100 * _find_confidence(self.arms)

    @property
    def interval(self) -> str:
        """The interval in words, e.g. "98.75 % interval, adjusted for 4 arms"."""
        adjusted = f", adjusted for {self.arms} arms" if self.arms > 1 else ""
        return f"{self.confidence:.4g} % interval{adjusted}"

    @property
    def episodes(self) -> int:
        """Number of episodes needed per arm."""
        return self.scenes * self.per_scene

    @property
    def won(self) -> float:
        """Percent of episodes in which only the arm under test succeeds."""
        return self.losses + max(self.difference, 0.0)

    @property
    def lost(self) -> float:
        """Percent of episodes in which only the base arm succeeds."""
        return self.losses + max(-self.difference, 0.0)

    def __str__(self) -> str:
        among = f", as one of {self.arms} arms," if self.arms > 1 else ""
        return (
            f"{self.episodes} episodes in {self.scenes} scenes ({self.per_scene} each) show a difference of "
            f"{self.difference:+g} points to {self.base:g} %{among} with a chance of {100 * self.by_interval:.0f} % by "
            f"its {self.interval}, and {100 * self.by_test:.0f} % by the test, if {self.won:g} % of episodes are won, "
            f"{self.lost:g} % are lost, and episodes of a scene correlate by {self.correlation:g}."
        )

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))


def power(
    difference: float | None = None,
    *,
    scenes: int | None = None,
    base: float = BASE,
    losses: float = LOSSES,
    correlation: float = CORRELATION,
    per_scene: int = PER_SCENE,
    chance: float = 0.8,
    arms: int = 1,
    seed: int = 0,
) -> Power:
    """Return the number of scenes needed to show a paired difference of success rates, or what a run can show.

        wiw.power(10)              # 20 % plus 10 points, in apartments
        wiw.power(10, arms=4)      # the same for one of four arms, with Holm-adjusted p values
        wiw.power(scenes=40)       # what 200 episodes in 40 scenes can show

    The smallest number of scenes for which the interval of the difference excludes 0 often enough is computed with a
    noncentral t distribution; the chance is then measured in simulated runs, and scenes are added until it is reached.
    The smallest difference is searched for in simulated runs, to a tenth of a point.

    Args:
        difference: in points; positive if the arm under test is better. None: the smallest that `scenes` can show.
        scenes: number of scenes; None: as many as `difference` needs.
        base: success rate of the base arm, percent.
        losses: percent of episodes in which the worse arm succeeds and the better one does not. The fewer, the more
            similar the arms, and the less is left to chance.
        correlation: correlation between the differences in two episodes of one scene, in [0, 1).
        per_scene: episodes in each scene.
        chance: chance of showing the difference, if there is one.
        arms: number of arms compared with the same base; the strictest step of Holm's adjustment is assumed.
        seed: seed of the simulation.

    Raises:
        ArgumentError: impossible numbers; both a difference and scenes, or neither.
    """
    numbers = {"difference": difference, "scenes": scenes, "base": base, "losses": losses, "correlation": correlation}
    numbers |= {"per_scene": per_scene, "chance": chance, "arms": arms, "seed": seed}
    for name, value in numbers.items():
        kind, noun = (Integral, "a whole number") if name in WHOLE else (Real, "a finite number")
        if value is not None and (isinstance(value, bool) or not isinstance(value, kind) or not math.isfinite(value)):
            raise ArgumentError(f"power: {name}: expected {noun}, got {value!r}")
    if seed < 0:
        raise ArgumentError(f"power: seed: expected at least 0, got {seed}")
    if (difference is None) == (scenes is None):
        raise ArgumentError(
            "power: expected either a difference (to compute the scenes it needs) or a number of scenes (to compute "
            "what they can show)"
        )
    plan = _Plan(losses, correlation, per_scene, chance, _find_confidence(arms), seed)
    if difference is not None:
        _check(difference, base, losses, correlation, per_scene, chance, arms)
        needed, shares = plan.scenes_for(abs(difference))
    else:
        assert scenes is not None
        _check(LEAST, base, losses, correlation, per_scene, chance, arms)
        if scenes < 2:
            raise ArgumentError(f"power: expected at least 2 scenes, got {scenes}")
        difference, shares = plan.difference_for(scenes, 100 - base - losses)
        needed = scenes
    return Power(difference, base, losses, correlation, per_scene, arms, chance, needed, *shares)


def _find_confidence(arms: int) -> float:
    """Return the confidence of the strictest step of Holm's adjustment for so many arms."""
    return 1 - 0.05 / arms if arms > 0 else 0.0


@dataclass(frozen=True)
class _Plan:
    """The fixed inputs of the search for the number of scenes, or for the difference."""

    losses: float
    correlation: float
    per_scene: int
    chance: float
    confidence: float
    seed: int

    def scenes_for(self, difference: float) -> tuple[int, tuple[float, float]]:
        """Return the smallest number of scenes, and its power by interval and by test."""
        rng = self._rng()
        scenes = self._find_fewest_scenes(difference)
        while (shares := self._simulate(difference, scenes, rng))[0] < self.chance:
            scenes += max(1, scenes // 25)
        return scenes, shares

    def difference_for(self, scenes: int, most: float) -> tuple[float, tuple[float, float]]:
        """Return the smallest difference up to `most`, to a tenth of a point, and its power."""

        @cache
        def simulate_difference(tenths: int) -> tuple[float, float]:
            return self._simulate(tenths / 10, scenes, self._rng())

        least, end = 1, int(10 * most + 1e-9)
        if end < least or simulate_difference(end)[0] < self.chance:
            raise ArgumentError(
                f"power: {scenes * self.per_scene} episodes in {scenes} scenes cannot show a difference of up to "
                f"{most:g} points with a chance of {100 * self.chance:g} %; take more scenes"
            )
        while least < end:
            middle = (least + end) // 2
            least, end = (least, middle) if simulate_difference(middle)[0] >= self.chance else (middle + 1, end)
        return end / 10, simulate_difference(end)

    def _rng(self) -> np.random.Generator:
        return np.random.Generator(np.random.Philox(key=self.seed))

    def _simulate(self, difference: float, scenes: int, rng: np.random.Generator) -> tuple[float, float]:
        lost, won = self.losses / 100, (self.losses + difference) / 100
        return simulate_power(won, lost, scenes, self.per_scene, self.correlation, self.confidence, rng)

    def _find_fewest_scenes(self, difference: float) -> int:
        """Return the smallest number of scenes according to the formula."""
        least, most = 2, 2
        while not self._has_enough_power(difference, most):
            if most > MOST_SCENES:
                raise ArgumentError(
                    f"power: a difference of {difference:g} points needs more than {MOST_SCENES} scenes"
                )
            least, most = most, 2 * most
        while least < most:
            middle = (least + most) // 2
            least, most = (least, middle) if self._has_enough_power(difference, middle) else (middle + 1, most)
        return most

    def _has_enough_power(self, difference: float, scenes: int) -> bool:
        """Return whether scenes show a difference often enough, by the noncentral t distribution."""
        gain, discordant = difference / 100, (2 * self.losses + difference) / 100
        spread = (discordant - gain**2) * (1 + (self.per_scene - 1) * self.correlation) / self.per_scene
        limit = stats.t.ppf(0.5 + self.confidence / 2, scenes - 1)
        shift = gain * math.sqrt(scenes / max(spread, 1e-12))
        return bool(stats.nct.sf(limit, scenes - 1, shift) >= self.chance)


def simulate_power(
    won: float,
    lost: float,
    scenes: int,
    per_scene: int,
    correlation: float,
    confidence: float,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Return the shares of simulated runs in which the interval, and the test, show which arm is better."""
    runs = max(400, min(8000, _DRAWS // scenes))
    sizes = [per_scene] * scenes
    counts = draw_outcome_counts([won, lost, 1 - won - lost], sizes, correlation, runs, rng)
    sums, squares = sum_by_scene(counts, [1, -1, 0])
    by_interval = p_value_of_sums(sums, squares, np.array(sizes, np.float64), "difference")
    by_test = approximate_flips(sums) if scenes >= FEWEST_SCENES else by_interval
    level, better = 1 - confidence + 1e-12, sums.sum(-1) > 0
    return float(np.mean((by_interval <= level) & better)), float(np.mean((by_test <= level) & better))


def _check(
    difference: float, base: float, losses: float, correlation: float, per_scene: int, chance: float, arms: int
) -> None:
    wins = losses + abs(difference)
    only_base, only_arm = (losses, wins) if difference > 0 else (wins, losses)
    expectations = (
        (difference != 0, f"a difference other than 0, got {difference:g}"),
        (0 <= base <= 100, f"base from 0 to 100 %, got {base:g}"),
        (losses >= 0, f"losses of at least 0 %, got {losses:g}"),
        (
            only_base <= base,
            f"a smaller difference or another base: {difference:+g} points mean that {only_base:g} % are lost, but the "
            f"base succeeds only in {base:g} %",
        ),
        (
            only_arm <= 100 - base,
            f"a smaller difference or another base: {difference:+g} points mean that {only_arm:g} % are won, but the "
            f"base fails only in {100 - base:g} %",
        ),
        (0 <= correlation < 1, f"correlation in [0, 1), got {correlation:g}"),
        (per_scene >= 1, f"per_scene of at least 1, got {per_scene}"),
        (0 < chance < 1, f"chance between 0 and 1, got {chance:g}"),
        (arms >= 1, f"arms of at least 1, got {arms}"),
    )
    for holds, expected in expectations:
        if not holds:
            raise ArgumentError(f"power: expected {expected}")
