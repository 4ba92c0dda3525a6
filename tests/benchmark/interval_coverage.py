# SPDX-License-Identifier: Apache-2.0
"""How often intervals hold the truth, in simulated runs: the tables of docs/statistics.md (some minutes).

python tests/benchmark/interval_coverage.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "python"))
from coverage_grid import CORRELATIONS, DESIGNS, measure_coverage, measure_errors, truths

from wiw.analysis.intervals import clustered_bootstrap, wilson
from wiw.analysis.simulate import draw_outcome_counts
from wiw.analysis.utility import ratio

SHOWN = ("5 x 5", "5 x 10", "10 x 5", "10 x 10", "30 x 5", "87 x 5", "1, 2, ... 10", "20 + 9 x 5", "40 + 9 x 1")
FEW_SHOWN = ("5 x 5", "10 x 5", "30 x 5", "87 x 5")
RUNS, SLOW_RUNS = 20_000, 1_000
TRIPLES = np.array([92, 1, 6, 1, 20, 1, 54, 35]) / 210
"""Shares of episodes in which copy (1), warp (2) and oracle (4) succeed, by the sum of those."""


def episodes(shares: list[float], values: list[float], sizes: list[int], correlation: float) -> Iterator[np.ndarray]:
    """The episodes of each run, scene by scene."""
    rng = np.random.default_rng([1, len(sizes), round(1000 * correlation)])
    for run in draw_outcome_counts(shares, sizes, correlation, SLOW_RUNS, rng):
        yield np.concatenate([np.repeat(values, ways) for ways in run])


def compare_with_others(sizes: list[int], correlation: float) -> tuple[float, float]:
    """Shares of runs at SR 35 % that the bootstrap over scenes holds, and Wilson's interval over episodes."""
    labels, found = np.repeat(np.arange(len(sizes)), sizes), np.zeros(2)
    for data in episodes([0.35, 0.65], [1, 0], sizes, correlation):
        intervals = clustered_bootstrap(data, labels, resamples=999), wilson(float(data.mean()), len(data))
        found += [low <= 0.35 <= high for low, high in intervals]
    bootstrap, independent = 100 * found / SLOW_RUNS
    return bootstrap, independent


def utilities(sizes: list[int], correlation: float) -> tuple[float, float]:
    """Share of runs in which U of warp is defined, and of those the share whose interval holds it."""
    copy, warp, oracle = (np.arange(8) >> bit & 1 for bit in range(3))
    labels = np.repeat(np.arange(len(sizes)), sizes)
    truth = TRIPLES @ (warp - copy) / (TRIPLES @ (oracle - copy))
    held, given = 0, 0
    for ways in episodes(list(TRIPLES), list(range(8)), sizes, correlation):
        _, (low, high) = ratio((warp - copy)[ways], (oracle - copy)[ways], labels)
        held, given = held + (low <= truth <= high), given + (not np.isnan(low))
    return 100 * given / SLOW_RUNS, 100 * held / max(given, 1)


def line(name: str, cells: list[str]) -> None:
    """One row of a Markdown table."""
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    print(f"runs: {RUNS}, bootstrap and utility {SLOW_RUNS}")
    for correlation in CORRELATIONS:
        print(f"\ncorrelation within scenes {correlation:g}: coverage")
        line("", list(SHOWN))
        widths = {design: [] for design in SHOWN}
        means = {design: [] for design in SHOWN}
        for name, shares, values, kind in truths():
            cells = []
            for design in SHOWN:
                held, width = measure_coverage(shares, values, kind, DESIGNS[design], correlation, RUNS)
                cells.append(f"{held:.1f}")
                if kind != "length":
                    widths[design].append(width)
                    means[design].append(held)
            line(name, cells)
        line("mean of rates and differences", [f"{np.mean(means[design]):.1f}" for design in SHOWN])
        line("their mean width, points", [f"{np.mean(widths[design]):.1f}" for design in SHOWN])
        for share in (0.1, 0.3):
            name = f"false positives of the test, {share:.0%} won and lost"
            line(name, [f"{measure_errors(share, DESIGNS[design], correlation, 4000):.1f}" for design in SHOWN])
    for correlation in CORRELATIONS[:2]:
        print(f"\ncorrelation within scenes {correlation:g}: others")
        line("", list(FEW_SHOWN))
        both = [compare_with_others(DESIGNS[design], correlation) for design in FEW_SHOWN]
        line("SR 35 %, bootstrap over scenes", [f"{bootstrap:.1f}" for bootstrap, _ in both])
        line("SR 35 %, episodes as if independent", [f"{independent:.1f}" for _, independent in both])
        found = [utilities(DESIGNS[design], correlation) for design in FEW_SHOWN]
        line("U of warp, where defined", [f"{true:.1f}" for _, true in found])
        line("runs in which it is, %", [f"{share:.0f}" for share, _ in found])


if __name__ == "__main__":
    main()
