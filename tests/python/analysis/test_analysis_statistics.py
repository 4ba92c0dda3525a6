# SPDX-License-Identifier: Apache-2.0
import io
import math
import pickle
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from scipy import stats

import wiw
from wiw.analysis import flip_test, intervals, statistics
from wiw.analysis.flip_test import DRAWS, approximate_flips, find_p_value, flip_signs
from wiw.analysis.intervals import (
    clustered_bootstrap,
    clustered_interval,
    count_degrees,
    count_effective,
    design_effect,
    interval_of_sums,
    jackknife_covariance,
    p_value_of_sums,
    sum_by_cluster,
    tango,
    wilson,
)
from wiw.analysis.statistics import compare, compute_p_value, estimate_difference, estimate_mean, holm
from wiw.analysis.summary import load_metrics, notes, show_estimate, summarise
from wiw.errors import ArgumentError
from wiw.registry import METRICS
from wiw.report.page import sentence, summary_html
from wiw.report.tables import SummaryTable

SR, SPL, TRAJ = (next(each for each in load_metrics() if each.name == name) for name in ("success", "spl", "actions"))


@pytest.mark.parametrize(("successes", "n"), [(0, 6), (3, 7), (40, 164), (12, 12)])
def test_wilson_is_scipys(successes, n):
    expected = stats.binomtest(successes, n).proportion_ci(method="wilson")
    assert wilson(successes / n, n) == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize("method", ["bca", "percentile"])
def test_bootstrap_is_scipys_where_every_episode_is_its_own_scene(method):
    data = np.random.default_rng(1).exponential(1.0, 40)
    expected = stats.bootstrap((data,), np.mean, method=method, n_resamples=40_000, rng=5).confidence_interval
    assert clustered_bootstrap(data, np.arange(40), method=method, resamples=40_000) == pytest.approx(
        (expected.low, expected.high), abs=0.03
    )


def test_bootstrap_spread_is_the_clustered_standard_error_of_statsmodels():
    sm = pytest.importorskip("statsmodels.api")
    rng = np.random.default_rng(2)
    scenes = np.repeat(np.arange(60), 4)
    data = rng.normal(0, 1, 60)[scenes] + rng.normal(0, 0.3, 240)
    fit = sm.OLS(data, np.ones(240)).fit(cov_type="cluster", cov_kwds={"groups": scenes})
    low, high = clustered_bootstrap(data, scenes)
    assert high - low == pytest.approx(2 * 1.96 * fit.bse[0], rel=0.06)
    independent = clustered_bootstrap(data, np.arange(240))
    assert high - low > 1.6 * (independent[1] - independent[0])


def test_bootstrap_weighs_scenes_by_their_episodes():
    values, scenes = [1.0] * 30 + [0.0] * 2, ["a"] * 30 + ["b"] * 2
    low, high = clustered_bootstrap(values, scenes, method="percentile")
    assert (low, high) == (0.0, 1.0)
    assert estimate_mean(values, scenes, SR).value == pytest.approx(100 * 30 / 32)


def test_bootstrap_is_keyed_by_its_seed_and_refuses_nonsense():
    data, scenes = np.arange(12.0), np.repeat([0, 1, 2], 4)
    assert clustered_bootstrap(data, scenes, seed=3) == clustered_bootstrap(data, scenes, seed=3)
    with pytest.raises(ArgumentError, match="at least 2 clusters, got 1"):
        clustered_bootstrap(data, np.zeros(12))
    with pytest.raises(ArgumentError, match="bca or percentile"):
        clustered_bootstrap(data, scenes, method="magic")


def test_flips_of_single_episodes_are_mcnemars_test():
    tables = pytest.importorskip("statsmodels.stats.contingency_tables")
    rng = np.random.default_rng(3)
    arm, base = (rng.random(50) < 0.6).astype(float), (rng.random(50) < 0.3).astype(float)
    table = [[((arm == a) & (base == b)).sum() for b in (0, 1)] for a in (0, 1)]
    assert flip_signs(arm - base) == pytest.approx(tables.mcnemar(table, exact=True).pvalue)
    assert flip_signs(np.zeros(2)) == 1.0
    with pytest.raises(ArgumentError, match="expected finite sums"):
        flip_signs(np.array([math.nan, 1.0, 2.0]))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-4, 4), min_size=8, max_size=9), st.floats(0.1, 3.0))
def test_flips_of_scenes_are_scipys_permutations(sums, scale):
    """Whole numbers are convolved, others enumerated; scipy tries all flips by itself."""
    found = stats.permutation_test(
        (np.asarray(sums, float),),
        lambda x, axis: np.abs(x.sum(axis)),
        permutation_type="samples",
        alternative="greater",
    )
    assert flip_signs(np.asarray(sums, float)) == pytest.approx(found.pvalue)
    assert flip_signs(scale * np.asarray(sums, float)) == pytest.approx(found.pvalue)


def test_many_flips_are_drawn_by_the_seed():
    sums = np.random.default_rng(4).normal(0.3, 1, 40)
    p_value = flip_signs(sums, seed=1)
    assert p_value == flip_signs(sums, seed=1) and p_value >= 1 / (DRAWS + 1)
    expected = 2 * stats.norm.sf(abs(sums.sum()) / np.sqrt(np.square(sums).sum()))
    assert p_value == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("size", [1e9, 1e13, 1e19])
def test_flips_of_large_whole_numbers_take_little_memory(size):
    sums = np.array([1.0, 2, 3, -1, 1, 1, 1, 1])
    assert flip_signs(size * sums) == pytest.approx(flip_signs(sums))


def test_approximate_flips_are_near_the_exact_ones():
    sums = np.random.default_rng(5).integers(-3, 4, (400, 20)).astype(float)
    exact = np.array([flip_signs(one) for one in sums])
    assert np.abs(approximate_flips(sums) - exact).max() < 0.06
    assert np.mean((approximate_flips(sums) <= 0.05) != (exact <= 0.05)) < 0.02


def test_which_test_is_used():
    """Whole scenes from 8 on, the interval's below, episodes of a single one."""
    won = np.array([1.0, 0.0, 1.0, 0.0] * 8)
    scenes = np.repeat(np.arange(8), 4)
    assert find_p_value(won, list(scenes), "difference") == pytest.approx(2 / 2**8)
    assert find_p_value(won, ["house"] * 32, "difference") == pytest.approx(2 / 2**16)
    few = find_p_value(won[:12], list(scenes[:12]), "difference")
    assert few == pytest.approx(
        float(p_value_of_sums(*(np.array(x) for x in ([2.0] * 3, 6.0, [4.0] * 3)), "difference"))  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("kind", ["difference", "length"])
def test_p_is_where_the_interval_ends_at_zero(kind):
    rng = np.random.default_rng(6)
    sums, counts = rng.integers(-1, 4, 6).astype(float), np.array([4.0, 5, 5, 6, 5, 4])
    squares, reach = float(np.abs(sums).sum()) + 4, (-0.75, 0.75)
    p_value = float(p_value_of_sums(sums, squares, counts, kind, reach))
    low, high = interval_of_sums(sums, squares, counts, kind, 1 - p_value, reach)
    assert min(abs(low), abs(high)) < 1e-6 and 0 < p_value < 1


def test_tango_by_its_score_equation():
    """At either end the score statistic, with the share lost that fits best there, is the normal quantile."""
    wins, losses, n = 9, 2, 40
    differences = [1.0] * wins + [-1.0] * losses + [0.0] * (n - wins - losses)
    for gap in tango(differences):
        shares = np.linspace(max(0, -gap), (1 - gap) / 2, 200_001)[1:-1]
        likelihood = wins * np.log(shares + gap) + losses * np.log(shares)
        likelihood += (n - wins - losses) * np.log(1 - 2 * shares - gap)
        lost = shares[likelihood.argmax()]
        score = (wins - losses - n * gap) / math.sqrt(n * (2 * lost + gap - gap**2))
        assert abs(score) == pytest.approx(1.959964, abs=1e-3)


def test_tango_where_no_episode_differs():
    z = 1.959964
    assert tango(np.zeros(25)) == pytest.approx((-z * z / (25 + z * z), z * z / (25 + z * z)), abs=1e-6)


def test_tango_covers():
    """Exact coverage over all outcomes of 20 pairs, with 25 % wins and 10 % losses."""
    n, win, loss = 20, 0.25, 0.10
    covered = 0.0
    for wins in range(n + 1):
        for losses in range(n + 1 - wins):
            low, high = tango([1.0] * wins + [-1.0] * losses + [0.0] * (n - wins - losses))
            if low <= win - loss <= high:
                covered += stats.multinomial.pmf([wins, losses, n - wins - losses], n, [win, loss, 1 - win - loss])
    assert 0.94 < covered < 0.985


def test_coverage_with_few_scenes():
    """The wider of the two intervals holds the truth where the bootstrap alone does not: 4 scenes of 5 episodes."""
    rng = np.random.default_rng(4)
    scenes = list(np.repeat(["a", "b", "c", "d"], 5))
    rates = rng.beta(2.27, 3.4, (150, 4))  # mean 0.4, intra-scene correlation 0.15
    held = [
        (e.low <= 40 <= e.high)
        for rate in rates
        for e in [estimate_mean((rng.random((4, 5)) < rate[:, None]).ravel().astype(float), scenes, SR)]
    ]
    assert np.mean(held) > 0.88


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from("abc")), min_size=2, max_size=12))
def test_intervals_hold_their_mean_and_stay_in_range(pairs):
    values, scenes = zip(*pairs, strict=True)
    found = estimate_mean(values, scenes, SPL)
    assert 0 <= found.low <= found.value + 1e-9 and found.value - 1e-9 <= found.high <= 100
    difference = estimate_difference(values, values[::-1], scenes, SPL)
    assert -100 <= difference.low <= difference.value + 1e-9 and difference.value - 1e-9 <= difference.high <= 100


def test_all_alike_is_not_certainty():
    zero = estimate_mean([0.0] * 6, ["a", "b"] * 3, SR)
    assert (zero.value, zero.low) == (0.0, 0.0) and zero.high > 30
    same = estimate_difference([1.0] * 6, [1.0] * 6, ["a", "b"] * 3, SR)
    assert same.low < -10 and same.high > 10 and not same.excludes_zero


def outcome(arm, episode, success, status="done", actions=30.0):
    metrics = {"success": success, "actions": actions, "spl": success} if status == "done" else {}
    return {"arm": arm, "episode": episode, "scene": f"s{episode % 3}", "status": status, "metrics": metrics}


def shown(summary, width=100):
    console = Console(file=io.StringIO(), width=width)
    console.print(summary)
    return console.file.getvalue()


def test_the_table_claims_the_same_episodes_only_where_they_are():
    rows = [outcome(arm, i, 1) for arm in ("none", "warp") for i in range(3)]
    assert "on the same episodes" in shown(SummaryTable.of(summarise(["none", "warp"], rows, 3)))
    rows[-1] = outcome("warp", 2, 0, status="error")
    assert "each on the episodes scored in it" in shown(SummaryTable.of(summarise(["none", "warp"], rows, 3)))


def test_episodes_that_were_not_judged_are_counted_and_said():
    outcomes = [outcome("none", i, 0.0) for i in range(4)] + [outcome("warp", i, 1.0) for i in range(3)]
    outcomes.append(outcome("warp", 3, 0.0, status="error"))
    summary = summarise(["none", "warp"], outcomes, episodes=5)
    assert (summary["warp"].done, summary["warp"].errors, summary["warp"].pending) == (3, 1, 1)
    assert summary["warp"].estimates["success"].value == 100.0
    difference = summary.difference("warp", "none")
    assert (difference.estimate.n, difference.wins, difference.losses) == (3, 3, 0)
    assert summary["warp"].total == 5
    assert (summary["warp"].scored_of_total, summary["none"].scored_of_total) == ("3/5", "4/5")
    said = " ".join(notes(summary))
    assert "warp: 3 of 5 episodes are scored; 1 infrastructure error is excluded from scores; 1 still to run" in said
    assert "Over all 5, SR would be between 60.0 and 100.0 %" in said


@pytest.mark.parametrize(("errors", "invalid"), [(0, False), (2, False), (3, True)])
def test_a_run_is_invalid_where_over_one_percent_of_an_arm_are_errors(errors, invalid):
    outcomes = [outcome("warp", i, 1.0, status="error" if i < errors else "done") for i in range(200)]
    summary = summarise(["warp"], outcomes, episodes=200)
    assert bool(summary.invalid) == invalid
    assert any("INVALID RUN" in note and "3 of 200" in note for note in notes(summary)) == invalid


@pytest.mark.parametrize(("errors", "invalid"), [(0, False), (1, True)])
def test_episodes_still_to_run_do_not_hide_a_share_of_errors(errors, invalid):
    """One of 20 that have ended is 5 %, however many hundred are still to run."""
    outcomes = [outcome("warp", i, 1.0, status="error" if i < errors else "done") for i in range(20)]
    summary = summarise(["warp"], outcomes, episodes=400)
    assert bool(summary.invalid) == invalid and summary["warp"].pending == 380
    assert any("1 of 20 episodes of warp" in reason and "5.0 %" in reason for reason in summary.invalid) == invalid


def test_the_most_frequent_error_of_each_arm_is_told():
    causes = ["Traceback\n  File x\nOSError: gone", "ValueError: odd", "Traceback\nValueError: odd\n"]
    outcomes = [{**outcome("warp", i, 0.0, status="error"), "error": cause} for i, cause in enumerate(causes)]
    outcomes += [{**outcome("oracle", 0, 0.0, status="error"), "error": f"\x1b[31m{'x' * 500}"}]
    outcomes += [outcome("none", i, 1.0) for i in range(3)] + [outcome("oracle", i, 1.0) for i in (1, 2)]
    summary = summarise(["none", "warp", "oracle"], outcomes, 3)
    assert (summary["none"].cause, summary["warp"].cause) == ("", "2 of 3: ValueError: odd")
    assert summary["oracle"].cause.startswith("1 of 1: \ufffd[31mxxx") and len(summary["oracle"].cause) < 220
    text = " ".join(shown(SummaryTable.of(summary)).split())
    assert "Most frequent error, 2 of 3: ValueError: odd" in text and text.count("Most frequent error") == 2
    assert "Most frequent error, 2 of 3: ValueError: odd" in summary_html(SummaryTable.of(summary))


def test_differences_are_paired_by_episode_and_signed_towards_the_better():
    done = {
        "a": {i: outcome("a", i, 1.0, actions=20.0) for i in (0, 1, 2)},
        "b": {i: outcome("b", i, 0.0) for i in (1, 2, 3)},
    }
    rate, length = compare("a", "b", done, SR), compare("a", "b", done, TRAJ)
    assert (rate.estimate.n, rate.wins, rate.estimate.value) == (2, 2, 100.0) and 0.2 < rate.p_value < 1
    assert (length.estimate.value, length.wins) == (-10.0, 2) and 0.2 < length.p_value < 1
    assert compare("a", "b", {"a": {0: done["a"][0]}, "b": {3: done["b"][3]}}, SR) is None


def test_one_scene_uses_intervals_over_episodes():
    found = estimate_mean([1.0, 0.0, 0.0, 1.0], ["house"] * 4, SR)
    assert found.method == "Wilson" and (found.low / 100, found.high / 100) == pytest.approx(wilson(0.5, 4))


def test_empty_run_has_no_numbers():
    summary = summarise(["none"], [], episodes=3)
    assert summary["none"].pending == 3 and not summary["none"].estimates and summary.differences == ()
    with pytest.raises(KeyError, match="it has none"):
        summary["warp"]


POLICIES: dict[str, dict[str, str]] = {"none": {}, "heuristic": {}, "geometric": {}}
"""Descriptions of agents without a world model."""


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_table_keeps_every_number(width):
    arms = ["none", "copy", "heuristic", "geometric"]
    outcomes = [outcome(arm, i, float((i + len(arm)) % 3 == 0)) for arm in arms for i in range(120)]
    summary = SummaryTable.of(summarise(arms, outcomes, 120, agents=POLICIES | {"copy": {"model": "copy"}}))
    with Console(width=width, file=io.StringIO(), record=True) as console:
        console.print(summary)
    shown = console.export_text()
    assert "…" not in shown and all(len(line.rstrip()) <= width for line in shown.splitlines())
    for difference in summary.differences:
        assert f"{difference.wins}/{difference.losses}" in shown
        assert show_estimate(difference.estimate, signed=True).split(" ", 1)[1] in shown


def test_arms_say_what_they_are():
    summary = summarise(["none", "geometric", "warp"], [], 3, agents={**POLICIES, "warp": {"model": "warp"}})
    roles = [line.role for line in summary.arms]
    assert roles == ["policy without a world model", "another policy without a world model", "world model"]


def test_variance_over_scenes_is_the_cluster_robust_one_of_statsmodels():
    sm = pytest.importorskip("statsmodels.api")
    rng = np.random.default_rng(5)
    scenes = np.repeat(np.arange(12), 4)
    data = rng.normal(0, 1, 12)[scenes] + rng.normal(0, 1, 48)
    fit = sm.OLS(data, np.ones(48)).fit(cov_type="cluster", cov_kwds={"groups": scenes})
    sums, counts = sum_by_cluster(data, scenes)
    assert jackknife_covariance(sums, sums, counts) == pytest.approx(fit.bse[0] ** 2)


def test_draws_in_blocks_are_those_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(3).normal(0.1, 1, 60)
    found = [(flip_signs(values), clustered_bootstrap(values, np.arange(60)))]
    monkeypatch.setattr(intervals, "BLOCK", 1000)
    found.append((flip_signs(values), clustered_bootstrap(values, np.arange(60))))
    assert found[0] == found[1]


def test_many_whole_numbers_are_flipped_at_random(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(3).integers(-9, 11, 80).astype(float)
    exact = flip_signs(values)
    monkeypatch.setattr(flip_test, "MOST_WORK", 0)
    assert flip_signs(values) != exact and flip_signs(values) == pytest.approx(exact, abs=0.015)


@pytest.mark.parametrize("scenes", [1, 4, 20])
def test_what_a_task_did_not_measure_shows_nothing(scenes: int) -> None:
    rows = []
    for arm, base in (("none", 0.1), ("warp", 0.6)):
        for i in range(20):
            spl = (None if i == 2 else math.nan if i == 3 else base + 0.01 * i) if arm == "warp" else base
            metrics = {"success": 1.0, "actions": 9.0, "spl": spl}
            rows.append({"arm": arm, "episode": i, "scene": f"s{i % scenes}", "status": "done", "metrics": metrics})
    summary = summarise(["none", "warp"], rows, 20)
    (found,) = [each for each in summary.differences if each.metric == "spl"]
    assert math.isnan(found.estimate.value) and found.p_value == 1 and not found.is_shown
    assert "the task has measured no number in some episodes" in " ".join(notes(summary))


def test_notes_say_which_intervals_are_over_fewer_scenes() -> None:
    def list_rows(arm: str, scenes: int) -> list[dict[str, Any]]:
        metrics = {"success": 1.0, "actions": 9.0}
        row = {"arm": arm, "status": "done", "metrics": metrics}
        return [{**row, "episode": i, "scene": f"s{i // 2}"} for i in range(2 * scenes)]

    said = " ".join(notes(summarise(["none", "warp"], [*list_rows("none", 1), *list_rows("warp", 20)], 40)))
    assert "95 % intervals over 20 scenes. So far, intervals of none over 1." in said
    assert "they do not generalise" not in said


def test_lengths_over_many_scenes_are_students() -> None:
    data = np.random.default_rng(6).normal(40, 9, 2000)
    expected = stats.ttest_1samp(data, 0).confidence_interval()
    found = clustered_interval(data, np.arange(2000), "length", reach=(0.0, 80.0))
    assert found == pytest.approx((expected.low, expected.high), abs=0.02)


def test_made_up_lengths_are_as_many_scenes_worth() -> None:
    """By hand: every episode thrice, as scenes of three; a made-up one then counts for three, at 0 and at 60."""
    once = np.array([60.0, 60, 60, 60, 20, 60, 60, 50])
    data, scenes = np.repeat(once, 3), np.repeat(np.arange(8), 3)
    sums, counts = sum_by_cluster(data, scenes)
    effect = float(design_effect(sums, np.square(data).sum(), counts, 60.0))
    weight = 2 * effect
    center = (data.sum() + weight * 30) / (24 + weight)
    variance = (np.square(data).sum() + weight * 1800) / (24 + weight) - center**2
    half = stats.t.ppf(0.975, count_degrees(sums, counts)) * math.sqrt(effect * variance / (24 + weight))
    assert 2.5 < effect < 4
    low, high = clustered_interval(data, scenes, "length", reach=(0.0, 60.0))
    assert (low, high) == pytest.approx((center - half, max(center + half, data.mean())))
    assert center < data.mean() < high


def test_lengths_that_are_all_alike_are_no_certainty():
    found = estimate_mean([60.0] * 4, list("abcd"), TRAJ)
    assert found.value == 60 and found.low < 40 and found.high > 75
    same = estimate_difference([60.0] * 4, [60.0] * 4, list("abcd"), TRAJ)
    assert same.low < -10 and same.high > 10
    one = estimate_mean([60.0] * 4, ["a"] * 4, TRAJ)
    assert one.low < 50 and one.high > 70
    assert math.isnan(estimate_mean([3.0], ["a"], TRAJ).low)


@pytest.mark.parametrize("scenes", [["a"] * 6, list("aabbcc"), list("abcdef")])
def test_lengths_that_are_all_the_least_have_an_unknown_interval_and_not_one_of_no_width(scenes):
    """Six paths of 0 m are no certainty of 0 m, and nothing says how long a seventh may be."""
    unbounded = wiw.Metric("bonus", "Bonus", "length", True)
    for found in (
        estimate_mean([0.0] * 6, scenes, TRAJ),
        estimate_difference([0.0] * 6, [0.0] * 6, scenes, TRAJ),
        estimate_mean([7.0] * 6, scenes, unbounded),
    ):
        assert math.isnan(found.low) and math.isnan(found.high) and found.bootstrap is None
        assert not found.excludes_zero and "all values are equal" in found.method
    assert compute_p_value([0.0] * 6, [0.0] * 6, scenes, TRAJ) == 1
    known = estimate_mean([0.0] * 5 + [1.0], scenes, TRAJ)
    assert known.low == 0 and known.high > 0.3


def test_an_unmeasured_episode_leaves_all_other_numbers(monkeypatch):
    half = wiw.Metric("half", "Half", "length", True, of=lambda metrics: metrics["actions"] / 2)
    monkeypatch.setitem(METRICS.registered, "half", half)
    rows = [outcome(arm, i, 1.0, actions=None if i == 3 else 9.0) for arm in ("none", "warp") for i in range(6)]
    found = summarise(["none", "warp"], rows, 6)
    assert math.isnan(found["warp"].estimates["half"].value) and found["warp"].estimates["success"].value == 100
    assert math.isnan(found.difference("warp", "none", "half").estimate.value)


def test_the_bootstrap_is_computed_when_it_is_read(monkeypatch):
    rows = [outcome(arm, i, float(i % 2), actions=i) for arm in ("none", "warp") for i in range(6)]
    calls = []
    monkeypatch.setattr(
        statistics, "clustered_bootstrap", lambda *a, **k: calls.append(a) or clustered_bootstrap(*a, **k)
    )
    found = SummaryTable.of(summarise(["none", "warp"], rows, 6))
    assert "0.0" in shown(found) and not calls
    data, scenes = np.arange(6.0), [f"s{i % 3}" for i in range(6)]
    once = found["none"].estimates["actions"]
    assert once.bootstrap == once.bootstrap == clustered_bootstrap(data, scenes) and len(calls) == 1
    again, kept = estimate_mean(data, scenes, TRAJ), estimate_mean(data, scenes, TRAJ)
    data[:] = 0
    assert once == again == pickle.loads(pickle.dumps(kept)) and asdict(kept)["bootstrap"] == once.bootstrap


def test_an_unknown_interval_is_explained():
    rows = [outcome(arm, i, float(i % 2), actions=0.0) for arm in ("none", "oracle") for i in range(6)]
    text = " ".join(shown(SummaryTable.of(summarise(["none", "oracle"], rows, 6))).split())
    assert "0.0 [?]" in text and "[?]: unknown, as lengths of one episode, or that are all 0" in text
    moving = summarise(["none"], [outcome("none", i, 1.0) for i in range(6)], 6)
    assert "[?]" not in shown(SummaryTable.of(moving))


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("scenes", [["a"] * 6, list("aabbcc"), list("abcdef")])
def test_rates_that_are_all_alike_are_never_narrower_than_wilson_over_episodes(value, scenes):
    found, (low, high) = estimate_mean([value] * 6, scenes, SPL), wilson(value, 6)
    assert found.low <= 100 * low + 1e-9 and found.high >= 100 * high - 1e-9


def test_unequal_scenes_count_as_fewer():
    assert count_effective(np.full(7, 5.0)) == pytest.approx(7)
    assert count_effective(np.array([40.0] + [1.0] * 9)) == pytest.approx(49**2 / 1609)
    values = [1.0, 0.0] * 24 + [1.0]
    equal = estimate_mean(values, [f"s{i // 5}" for i in range(49)], SR)
    unequal = estimate_mean(values, ["big"] * 40 + [f"s{i}" for i in range(9)], SR)
    assert equal.high - equal.low < 40 and unequal.high - unequal.low > 90


def test_a_design_effect_that_nothing_shows_is_the_usual_one():
    counts = np.full(6, 5.0)
    assert design_effect(np.zeros(6), 0.0, counts) == pytest.approx(1 + 0.2 * 4)
    assert design_effect(np.array([0, 5.0, 5, 0, 5, 0]), 15.0, counts) == pytest.approx(6.0, abs=0.2)


def test_clusters_are_at_least_two():
    with pytest.raises(ArgumentError, match="at least 2 clusters, got 1"):
        clustered_interval(np.zeros(4), np.zeros(4), "rate")


@settings(max_examples=10)  # statsmodels collects all garbage at every call
@given(st.lists(st.floats(0, 1), min_size=1, max_size=9))
def test_holm_is_statsmodels(p_values):
    multitest = pytest.importorskip("statsmodels.stats.multitest")
    assert holm(p_values) == pytest.approx(multitest.multipletests(p_values, method="holm")[1])


def test_arms_of_one_table_are_one_family_of_tests():
    wins = {"none": 0, "copy": 1, "warp": 6, "oracle": 9}
    rows = [outcome(arm, i, float(i < wins[arm])) for arm in wins for i in range(12)]
    summary = summarise(list(wins), [{**row, "scene": str(row["episode"])} for row in rows], episodes=12)
    found = [summary.difference(arm, "none") for arm in ("copy", "warp", "oracle")]
    assert [d.p_value for d in found] == pytest.approx([1.0, 2 / 2**6, 2 / 2**9])
    assert [d.p_adjusted for d in found] == pytest.approx([1.0, 2 * 2 / 2**6, 3 * 2 / 2**9])
    assert summary.difference("warp", "copy").p_adjusted == pytest.approx(2 * 2 / 2**5 / 2)  # two arms, the larger p


def test_bold_and_the_sentence_go_by_the_adjusted_test():
    """6 won and none lost: p = 0.03 and an interval above 0, but not as one of five arms."""
    wins = {"none": 0, "mine": 6, "a": 0, "b": 0, "c": 0, "d": 0}
    rows = [
        {**outcome(arm, i, float(i < wins[arm]), actions=9.0 + i % 2), "scene": str(i)}
        for arm in wins
        for i in range(12)
    ]
    alone = summarise(["none", "mine"], rows[:24], episodes=12)
    among = summarise(list(wins), rows, episodes=12)
    for found, is_shown in ((alone, True), (among, False)):
        difference = found.difference("mine", "none")
        assert difference.estimate.excludes_zero and difference.p_value == pytest.approx(2 / 2**6)
        assert difference.is_shown == is_shown
        console = Console(file=io.StringIO(), width=120, force_terminal=True)
        console.print(SummaryTable.of(found))
        assert any("\x1b[1m+50.0" in line for line in console.file.getvalue().splitlines()) == is_shown
        assert ('class="number shown"' in summary_html(found)) == is_shown
        assert ("no evidence" in sentence(found)) != is_shown


def test_columns_beside_success_are_adjusted_together():
    rng = np.random.default_rng(7)
    rows = [
        {**outcome(arm, i, float(rng.random() < 0.5), actions=rng.uniform(1, 60)), "scene": str(i)}
        for arm in ("none", "x", "y")
        for i in range(30)
    ]
    found = [each for each in summarise(["none", "x", "y"], rows, 30).differences if each.metric != "success"]
    expected = holm([each.p_value for each in found])
    assert len(found) == 4 and [each.p_adjusted for each in found] == pytest.approx(list(expected))


def test_few_scenes_that_happen_to_be_alike_do_not_make_an_interval_narrow():
    spl = [0.9, 0.0, 0.88, 0.0, 0.0, 0.91]  # one of two reached in each of three scenes
    low, high = clustered_interval(spl, ["a", "a", "b", "b", "c", "c"], "rate")
    assert high - low > 0.6


def test_intervals_of_means_end_where_values_do():
    actions, scenes = [3, 60, 60, 60], ["a", "a", "b", "b"]
    found, plain = (estimate_mean(actions, scenes, metric) for metric in (TRAJ, replace(TRAJ, least=-math.inf)))
    assert plain.low < 0 and found.low == 0 and found.high > 60
    worse = estimate_difference([0, 0, 50, 50], [3, 60, 60, 60], scenes, TRAJ)
    assert worse.low < 0
