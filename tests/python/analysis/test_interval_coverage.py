# SPDX-License-Identifier: Apache-2.0
"""Intervals hold the truth as often as they say, in simulated runs; tests/benchmark/interval_coverage.py has tables."""

import numpy as np
import pytest
from coverage_grid import CORRELATIONS, DESIGNS, PAIRS, RATES, draw_sums, measure_coverage, measure_errors, truths

from wiw.analysis.intervals import clustered_bootstrap, clustered_interval, interval_of_sums, wilson
from wiw.analysis.simulate import draw_outcome_counts, sum_by_scene

LEAST = 93.5
"""Percent that every cell of the grid must reach."""


def noise(runs):
    """Three standard errors of a share of 95 % in so many runs, in points."""
    return 300 * np.sqrt(0.95 * 0.05 / runs)


@pytest.mark.parametrize("design", ["5 x 5", "10 x 5", "30 x 5", "1, 2, ... 10", "40 + 9 x 1"])
@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_intervals_cover(design, correlation):
    """Rare successes and one-sided pairs among them: the cheap version of the grid below."""
    runs = 1000
    for name, shares, values, kind in truths():
        found, _ = measure_coverage(shares, values, kind, DESIGNS[design], correlation, runs)
        assert found > LEAST - noise(runs), name


@pytest.mark.nightly
@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_intervals_cover_everywhere(design, correlation):
    runs = 20_000
    for name, shares, values, kind in truths():
        found, _ = measure_coverage(shares, values, kind, DESIGNS[design], correlation, runs)
        assert found > LEAST - noise(runs), name


@pytest.mark.nightly
@pytest.mark.parametrize("correlation", CORRELATIONS)
@pytest.mark.parametrize("design", ["30 x 5", "87 x 5"])
def test_with_many_scenes_the_average_is_what_is_claimed(design, correlation):
    """With few scenes intervals are wider than they need be, lest any truth be missed too often."""
    cells = [(s, [1.0, 0.0], "rate") for s in RATES.values()] + [
        (s, [1.0, -1.0, 0.0], "difference") for s in PAIRS.values()
    ]
    mean = np.mean([measure_coverage(s, v, k, DESIGNS[design], correlation, 20_000)[0] for s, v, k in cells])
    assert 93.5 < mean < 97.0  # 96.5 was the aim; 30 scenes without correlation reach 96.6


@pytest.mark.parametrize(("design", "correlation"), [("5 x 10", 0.3), ("10 x 5", 0.1), ("40 + 9 x 1", 0.3)])
def test_equal_arms_are_rarely_found_different(design, correlation):
    runs = 600
    assert measure_errors(0.3, DESIGNS[design], correlation, runs) < 5 + noise(runs)


@pytest.mark.nightly
@pytest.mark.parametrize("design", DESIGNS)
@pytest.mark.parametrize("correlation", [*CORRELATIONS, 0.6])
@pytest.mark.parametrize("share", [0.02, 0.1, 0.3, 0.5])
def test_equal_arms_are_rarely_found_different_anywhere(design, correlation, share):
    runs = 4000
    assert measure_errors(share, DESIGNS[design], correlation, runs) < 5 + noise(runs)


@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_never_narrower_than_over_episodes(correlation):
    sizes = DESIGNS["10 x 5"]
    sums, squares = draw_sums([0.1, 0.9], [1, 0], sizes, correlation, 500)
    low, high = interval_of_sums(sums, squares, np.asarray(sizes, float), "rate")
    for ends, total in zip(zip(low, high, strict=True), sums.sum(-1), strict=True):
        plain = wilson(total / sum(sizes), sum(sizes))
        assert ends[0] <= plain[0] + 1e-12 and ends[1] >= plain[1] - 1e-12


def test_why_neither_the_bootstrap_nor_independent_episodes():
    """Where the interval holds the truth in 95 %, the bootstrap does in 86 % and Wilson's in 90 %."""
    sizes, labels = [5] * 5, np.repeat(np.arange(5), 5)
    counts = draw_outcome_counts([0.35, 0.65], sizes, 0.15, 300, np.random.default_rng(0))
    found = np.zeros(3)
    for run in counts:
        data = np.concatenate([np.repeat([1.0, 0.0], ways) for ways in run])
        intervals = (
            clustered_interval(data, labels, "rate"),
            clustered_bootstrap(data, labels, resamples=499),
            wilson(float(data.mean()), len(data)),
        )
        found += [low <= 0.35 <= high for low, high in intervals]
    ours, bootstrap, independent = 100 * found / len(counts)
    assert ours > 92 and bootstrap < 90 and independent < 92


def test_simulated_episodes_of_a_scene_are_correlated_as_asked():
    counts = draw_outcome_counts([0.3, 0.1, 0.6], [2] * 4, 0.4, 100_000, np.random.default_rng(1))
    assert counts.sum(-1).min() == counts.sum(-1).max() == 2
    sums, squares = sum_by_scene(counts, [1, -1, 0])
    mean, variance = 0.2, 0.4 - 0.2**2
    assert sums.mean() / 2 == pytest.approx(mean, abs=0.005)
    assert sums.var() == pytest.approx(2 * variance * 1.4, rel=0.02)  # two episodes: 2 v (1 + correlation)
    assert squares.mean() == pytest.approx(8 * 0.4, rel=0.01)
