# SPDX-License-Identifier: Apache-2.0
"""Simulated runs with known truths: how often intervals hold them, and how often tests find what is not there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wiw.analysis.flip_test import FEWEST_SCENES, flip_signs
from wiw.analysis.intervals import Kind, interval_of_sums, p_value_of_sums
from wiw.analysis.simulate import draw_outcome_counts, sum_by_scene

DESIGNS = {
    "5 x 5": [5] * 5,
    "5 x 10": [10] * 5,
    "10 x 5": [5] * 10,
    "10 x 10": [10] * 10,
    "30 x 5": [5] * 30,
    "87 x 5": [5] * 87,
    "1, 2, ... 10": list(range(1, 11)),
    "20 + 9 x 5": [20] + [5] * 9,
    "40 + 40 + 20 x 2": [40, 40] + [2] * 20,
    "40 + 9 x 1": [40] + [1] * 9,
    "20 x 1": [1] * 20,
}
"""Scenes by episodes in each."""
CORRELATIONS = (0.0, 0.1, 0.3)
RATES = {f"SR {rate} %": [rate / 100, 1 - rate / 100] for rate in (5, 10, 20, 35, 50, 90)}
PAIRS = {
    f"{won} % won, {lost} % lost": [won / 100, lost / 100, 1 - (won + lost) / 100]
    for won, lost in ((5, 0), (10, 0), (36, 2), (10, 3), (10, 10), (30, 30))
}
LENGTHS = {
    "60 in 80 %, else 10 to 50": ([0.8, 0.05, 0.05, 0.05, 0.05], [60.0, 50.0, 40.0, 20.0, 10.0]),
    "5 in 80 %, else 10 to 60": ([0.8, 0.1, 0.05, 0.05], [5.0, 10.0, 40.0, 60.0]),
}
"""Actions of episodes of which most end at the budget, or at once: shares and values."""


def truths() -> list[tuple[str, list[float], list[float], Kind]]:
    """Everything that is simulated: name, shares of outcomes, their values, kind."""
    rates: list[tuple[str, list[float], list[float], Kind]] = [(n, s, [1.0, 0.0], "rate") for n, s in RATES.items()]
    pairs: list[tuple[str, list[float], list[float], Kind]] = [
        (n, s, [1.0, -1.0, 0.0], "difference") for n, s in PAIRS.items()
    ]
    lengths: list[tuple[str, list[float], list[float], Kind]] = [(n, *both, "length") for n, both in LENGTHS.items()]
    return [*rates, *pairs, *lengths]


def draw_sums(
    shares: Sequence[float], values: Sequence[float], sizes: Sequence[int], correlation: float, runs: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums by scene and sums of squares of simulated runs."""
    rng = np.random.default_rng([len(sizes), sum(sizes), round(1000 * correlation), round(1000 * shares[0]), runs])
    return sum_by_scene(draw_outcome_counts(shares, sizes, correlation, runs, rng), values)


def measure_coverage(
    shares: Sequence[float],
    values: Sequence[float],
    kind: Kind,
    sizes: Sequence[int],
    correlation: float,
    runs: int,
) -> tuple[float, float]:
    """Percent of runs whose 95 % interval holds the truth, and the interval's mean width (in percent for rates)."""
    sums, squares = draw_sums(shares, values, sizes, correlation, runs)
    reach = (0.0, max(values))  # of lengths
    low, high = interval_of_sums(sums, squares, np.asarray(sizes, np.float64), kind, 0.95, reach)
    truth = float(np.dot(shares, values))
    held = (low <= truth + 1e-9) & (truth - 1e-9 <= high)
    return 100 * float(np.mean(held)), (1.0 if kind == "length" else 100) * float(np.mean(high - low))


def measure_errors(share: float, sizes: Sequence[int], correlation: float, runs: int) -> float:
    """Percent of runs of two equal arms whose test finds a difference at 5 %; each wins `share` of the episodes."""
    sums, squares = draw_sums([share, share, 1 - 2 * share], [1, -1, 0], sizes, correlation, runs)
    if len(sizes) >= FEWEST_SCENES:
        p_values = np.array([flip_signs(one) for one in sums])
    else:
        p_values = p_value_of_sums(sums, squares, np.asarray(sizes, np.float64), "difference")
    return 100 * float(np.mean(p_values <= 0.05))
