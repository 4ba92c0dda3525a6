# SPDX-License-Identifier: Apache-2.0
"""How often intervals hold the truth, in simulated runs: the table of docs/statistics.md (a few minutes).

python tests/benchmark/interval_coverage.py
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from wiw.analysis.intervals import clustered_bootstrap, t_of_sums, wilson
from wiw.analysis.simulate import draw_outcome_counts, sum_by_scene
from wiw.analysis.utility import ratio

SCENES = (5, 10, 30, 87)
PER_SCENE = 5
CORRELATIONS = (0.0, 0.1)
RUNS, SLOW_RUNS = 20_000, 1_500
RATES = {"SR 5 %": [0.05, 0.95], "SR 20 %": [0.2, 0.8], "SR 35 %": [0.35, 0.65], "SR 50 %": [0.5, 0.5]}
PAIRS = {  # won, lost, neither; as measured over 210 episodes
    "oracle - none, 76 won 4 lost": [76 / 210, 4 / 210, 130 / 210],
    "climber - none, 39 won 3 lost": [39 / 210, 3 / 210, 168 / 210],
    "oracle - warp, 21 won 7 lost": [21 / 210, 7 / 210, 182 / 210],
    "no difference, 10 % won 10 % lost": [0.1, 0.1, 0.8],
}
ANY_RATE = [[rate, 1 - rate] for rate in np.arange(0.1, 0.91, 0.05)]
ANY_PAIR = [[won, lost, 1 - won - lost] for won in np.arange(0.05, 0.41, 0.05) for lost in (0.02, 0.05, 0.1, 0.2)]
"""Averaged over: with 25 episodes the coverage of any interval jumps by points between one true rate and the next."""
TRIPLES = np.array([92, 1, 6, 1, 20, 1, 54, 35]) / 210
"""Shares of episodes in which copy (1), warp (2) and oracle (4) succeed, by the sum of those."""


def held(shares: list[float], values: list[float], kind: str, scenes: int, correlation: float, runs: int) -> float:
    """Share of runs whose t interval holds the truth, percent."""
    rng = np.random.default_rng([scenes, round(1000 * correlation), runs])
    sums, squares = sum_by_scene(draw_outcome_counts(shares, scenes, PER_SCENE, correlation, runs, rng), values)
    low, high = t_of_sums(sums, squares, np.full(scenes, float(PER_SCENE)), kind)  # type: ignore[arg-type]
    return 100 * float(np.mean((low <= np.dot(shares, values)) & (np.dot(shares, values) <= high)))


def episodes(
    shares: list[float], values: list[float], scenes: int, correlation: float, runs: int
) -> Iterator[np.ndarray]:
    """The episodes of each run, scene by scene."""
    rng = np.random.default_rng([1, scenes, round(1000 * correlation)])
    for run in draw_outcome_counts(shares, scenes, PER_SCENE, correlation, runs, rng):
        yield np.concatenate([np.repeat(values, ways) for ways in run])


def slow(shares: list[float], values: list[float], scenes: int, correlation: float) -> tuple[float, float]:
    """The bootstrap over scenes, and an interval that takes episodes as independent: shares that hold the truth."""
    labels, truth = np.repeat(np.arange(scenes), PER_SCENE), np.dot(shares, values)
    found = np.zeros(2)
    for data in episodes(shares, values, scenes, correlation, SLOW_RUNS):
        intervals = clustered_bootstrap(data, labels, resamples=999), wilson(float(data.mean()), len(data))
        found += [low <= truth <= high for low, high in intervals]
    bootstrap, independent = 100 * found / SLOW_RUNS
    return bootstrap, independent


def utilities(scenes: int, correlation: float) -> tuple[float, float]:
    """Share of runs in which U of warp is defined, and of those the share whose interval holds it."""
    copy, warp, oracle = (np.arange(8) >> bit & 1 for bit in range(3))
    labels = np.repeat(np.arange(scenes), PER_SCENE)
    truth = TRIPLES @ (warp - copy) / (TRIPLES @ (oracle - copy))
    held, given = 0, 0
    for ways in episodes(list(TRIPLES), list(range(8)), scenes, correlation, SLOW_RUNS):
        _, (low, high) = ratio((warp - copy)[ways], (oracle - copy)[ways], labels)
        held, given = held + (low <= truth <= high), given + (not np.isnan(low))
    return 100 * given / SLOW_RUNS, 100 * held / given


def line(name: str, cells: list[str]) -> None:
    """One row of a Markdown table."""
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    print(f"runs: {RUNS}, bootstrap and utility {SLOW_RUNS}; {PER_SCENE} episodes a scene; columns: scenes")
    for correlation in CORRELATIONS:
        print(f"\ncorrelation within scenes {correlation:g}")
        line("", [str(scenes) for scenes in SCENES])
        for name, shares in RATES.items():
            line(name, [f"{held(shares, [1, 0], 'rate', scenes, correlation, RUNS):.1f}" for scenes in SCENES])
        for name, shares in PAIRS.items():
            values = [1, -1, 0]
            line(name, [f"{held(shares, values, 'difference', scenes, correlation, RUNS):.1f}" for scenes in SCENES])
        runs = RUNS // 10
        means = [np.mean([held(p, [1, 0], "rate", scenes, correlation, runs) for p in ANY_RATE]) for scenes in SCENES]
        line("SR from 10 to 90 %, mean", [f"{mean:.1f}" for mean in means])
        means = [
            np.mean([held(p, [1, -1, 0], "difference", scenes, correlation, runs) for p in ANY_PAIR])
            for scenes in SCENES
        ]
        line("5 to 40 % won, 2 to 20 % lost, mean", [f"{mean:.1f}" for mean in means])
        both = [slow(RATES["SR 35 %"], [1, 0], scenes, correlation) for scenes in SCENES]
        line("SR 35 %, bootstrap over scenes", [f"{bootstrap:.1f}" for bootstrap, _ in both])
        line("SR 35 %, episodes as if independent", [f"{independent:.1f}" for _, independent in both])
        found = [utilities(scenes, correlation) for scenes in SCENES]
        line("U of warp, where defined", [f"{true:.1f}" for _, true in found])
        line("runs in which it is, %", [f"{share:.0f}" for share, _ in found])


if __name__ == "__main__":
    main()
