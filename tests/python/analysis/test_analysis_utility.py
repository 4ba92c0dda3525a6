# SPDX-License-Identifier: Apache-2.0
import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from fakes import LineAgent, LineTask
from rich.console import Console
from scipy import stats

from wiw.analysis.statistics import estimate_difference
from wiw.analysis.summary import notes, role_of, summarise
from wiw.analysis.utility import ratio
from wiw.metrics.metric import SUCCESS
from wiw.report.page import summary_html
from wiw.report.tables import SummaryTable
from wiw.studies.evaluate import run_arms

RATES = {"none": 0.2, "copy": 0.2, "warp": 0.5, "placebo-shuffled:mine": 0.2, "mine": 0.6, "oracle": 0.8}


def run(rates, scenes=12, per_scene=5, seed=0):
    """Outcomes of arms that share how hard each episode is."""
    hardness = np.random.default_rng(seed).random(scenes * per_scene)
    return [
        {
            "arm": arm,
            "episode": i,
            "scene": f"s{i // per_scene}",
            "status": "done",
            "metrics": {"success": float(hardness[i] < rate), "actions": 9.0},
        }
        for arm, rate in rates.items()
        for i in range(len(hardness))
    ]


def summary(rates=RATES, **how):
    outcomes = run(rates, **how)
    return summarise(list(rates), outcomes, len(outcomes) // len(rates))


def test_utility_by_hand():
    found = summary()
    rate = {line.name: line.estimates["success"].value for line in found.arms}
    for arm in ("none", "warp", "mine"):
        one = found.utility(arm)
        assert one.value == pytest.approx((rate[arm] - rate["copy"]) / (rate["oracle"] - rate["copy"]))
        assert one.low < one.value < one.high and (one.n, one.scenes) == (60, 12)
    with pytest.raises(KeyError, match="needs episodes that are scored in the arm, copy and oracle"):
        found.utility("copy")


def test_the_report_shows_utilities_on_one_scale():
    found = summary({**RATES, "worse": 0.05})
    html, one = summary_html(found), found.utility("mine")
    assert f"<strong>{one.value:.2f}</strong>" in html and f"{one.low:.2f} – {one.high:.2f}" in html
    worse = found.utility("worse")
    assert worse.value < 0 and f"<strong>\u2212{-worse.value:.2f}</strong>" in html
    zero = re.findall(r'class="zero" style="left:([\d.]+)%', html.partition("differences")[0])
    assert len(zero) == 5 and len(set(zero)) == 1


def test_why_utility_is_undefined_agrees_with_the_table():
    rows = run({"copy": 0.0, "mine": 0.5, "oracle": 1.0}, per_scene=5)
    found = summarise(["copy", "mine", "oracle"], [row for row in rows if row["scene"] == "s0"], 5)
    assert not found.utility("mine").is_defined and found.difference("oracle", "copy").estimate.low > 0
    assert any("too little data for an interval of this ratio" in line for line in notes(found))


def test_only_the_world_model_under_test_is_no_reference():
    assert {one.arm for one in summary().utilities if not one.reference} == {"mine"}
    for arm in ("placebo-shuffled:mine", "placebo-swapped", "heuristic+placebo-swapped:mine"):
        assert role_of(arm).startswith("control: same compute")
    assert role_of("mine") == role_of("placebo") == "world model"


def test_interval_holds_the_quotients_that_a_t_test_does_not_reject():
    """Fieller's set by its definition: u such that the mean over scenes of gain - u span is not surely away from 0."""
    rng = np.random.default_rng(1)
    gains, spans, clusters = rng.uniform(-1, 1, 20), rng.uniform(-0.2, 1, 20), np.arange(20)
    many = np.repeat(gains, 300), np.repeat(spans, 300), np.repeat(clusters, 300)  # made-up episodes weigh nothing
    value, ends = ratio(*many)
    for u in ends:
        assert stats.ttest_1samp(gains - u * spans, 0).pvalue == pytest.approx(0.05, abs=2e-3)
    assert stats.ttest_1samp(gains - value * spans, 0).pvalue == pytest.approx(1)


def test_utility_is_undefined_where_the_interval_of_ceiling_minus_floor_includes_zero():
    for rates in ({**RATES, "oracle": 0.22}, {**RATES, "oracle": 0.1}):
        found = summary(rates)
        assert found.difference("oracle", "copy").estimate.low <= 0
        one = found.utility("mine")
        assert not one.is_defined and all(map(math.isnan, (one.value, one.low, one.high)))
        assert any(
            note == "Utility undefined: the interval for oracle - copy includes 0." for note in notes(found)
        ) and "<small>undefined</small>" in summary_html(found)
    assert summary().difference("oracle", "copy").estimate.low > 0 and summary().utility("mine").is_defined


def test_an_oracle_that_is_worse_than_the_floor_is_said_to_be():
    found = summary({**RATES, "copy": 0.8, "oracle": 0.1})
    assert found.difference("oracle", "copy").estimate.high < 0 and not found.utility("mine").is_defined
    assert "Utility undefined: the interval for oracle - copy lies below 0." in notes(found)


def test_why_utility_is_undefined_is_known_without_the_difference():
    """As in a comparison of runs, whose differences are between the runs, and whose arms may have other oracles."""
    worse, better = (summary({**RATES, "copy": copy, "oracle": oracle}) for copy, oracle in ((0.8, 0.1), (0.2, 0.22)))
    assert "Utility undefined: the interval for oracle - copy lies below 0." in notes(replace(worse, differences=()))
    both = replace(
        worse, differences=(), utilities=(worse.utility("mine"), better.utility("warp"), summary().utility("none"))
    )
    said = "the interval for oracle - copy lies below 0 (mine); the interval for oracle - copy includes 0 (warp)"
    assert f"Utility undefined: {said}." in notes(both)


def test_only_episodes_that_all_three_have_finished_count():
    outcomes = [row for row in run(RATES) if not (row["arm"] == "copy" and row["episode"] < 20)]
    one = summarise(list(RATES), outcomes, 60).utility("mine")
    assert (one.n, one.scenes) == (40, 8)
    none = [row for row in outcomes if row["arm"] != "copy"]
    assert summarise(list(RATES), none, 60).utilities == ()


def test_arms_that_do_as_the_floor_are_not_certain_to_be_worth_nothing():
    one = summary().utility("none")
    assert one.value == 0 and one.low < -0.02 < 0.02 < one.high


def test_an_arm_that_does_as_the_ceiling_is_not_certain_to_be_its_equal():
    one = summary({**RATES, "mine": 0.8}).utility("mine")
    assert one.value == 1 and one.low < 0.98 and one.high > 1.02


def test_one_scene_counts_its_episodes():
    one = summary(scenes=1, per_scene=60).utility("mine")
    assert one.is_defined and one.scenes == 1


def test_identifiability_is_the_sign_of_the_difference_shown():
    for seed in range(30):
        rows = run({**RATES, "oracle": 0.35}, scenes=6, per_scene=4, seed=seed)
        found = summarise(list(RATES), rows, 24)
        success = {arm: [r["metrics"]["success"] for r in rows if r["arm"] == arm] for arm in RATES}
        scenes = [r["scene"] for r in rows if r["arm"] == "copy"]
        shown = estimate_difference(success["oracle"], success["copy"], scenes, SUCCESS)
        assert found.utility("mine").is_defined == (shown.low > 0)


@pytest.mark.parametrize("width", [80, 120])
def test_a_terminal_shows_every_utility(width):
    with Console(width=width, file=io.StringIO(), record=True) as console:
        console.print(SummaryTable.of(summary()))
    shown = console.export_text()
    assert "…" not in shown and all(len(line.rstrip()) <= width for line in shown.splitlines())
    for one in summary().utilities:
        assert f"{one.value:.2f} [{one.low:.2f}, {one.high:.2f}]" in shown


def test_the_plain_table_of_a_run_has_utilities(tmp_path):
    arms = {"copy": LineAgent(0.3), "mine": LineAgent(0.6), "oracle": LineAgent(1.0)}
    log = run_arms(LineTask(), arms, 40, out=tmp_path / "run", progress=False)
    copy, mine, oracle = log.table()
    assert "utility" not in copy and "utility" not in oracle
    span = oracle["success"] - copy["success"]
    assert mine["utility"] == pytest.approx((mine["success"] - copy["success"]) / span)
    assert mine["utility_low"] < mine["utility"] < mine["utility_high"]
