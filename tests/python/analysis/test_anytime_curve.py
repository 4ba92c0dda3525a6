# SPDX-License-Identifier: Apache-2.0
"""The anytime curve over decisions: what every episode would score if it had been cut there."""

from __future__ import annotations

from typing import Any

import pytest

from wiw.analysis.statistics import estimate_difference, estimate_mean
from wiw.analysis.summary import Summary, summarise
from wiw.metrics.metric import SUCCESS
from wiw.report.page import summary_html
from wiw.report.tables import SummaryTable, as_text
from wiw.types import TableSpec

SCENES = ("a", "a", "b", "c")
ANSWERS = {
    "none": [[0, 0, 0], [1, 0, 0], [0, 1], [0, 0, 1]],
    "oracle": [[0, 1, 1], [1], [1, 1], [0, 0, 0]],
}
"""Whether each answer is right; an episode that has ended keeps its last one."""


def make_outcome(arm: str, episode: int, right: list[int], answers: bool) -> dict[str, Any]:
    metrics = {"success": float(right[-1]), "decisions": float(len(right)), "actions": float(len(right))}
    details = {"right_after": [bool(each) for each in right]} if answers else {}
    return {
        "arm": arm,
        "episode": episode,
        "scene": SCENES[episode],
        "status": "done",
        "metrics": metrics,
        "details": details,
    }


def summarise_answers(found: dict[str, list[list[int]]], answers: bool = True, **options: Any) -> Summary:
    outcomes = [make_outcome(arm, i, own, answers) for arm, each in found.items() for i, own in enumerate(each)]
    return summarise(list(found), outcomes, len(SCENES), **options)


def test_answers_count_as_they_stood() -> None:
    curve, gain = summarise_answers(ANSWERS).breakdowns
    assert (curve.name, gain.name, gain.base) == ("anytime", "anytime_differences", "none")
    assert curve.keys == gain.keys == ("1", "2", "3") and curve.cut_unit == gain.cut_unit == "decisions"
    assert {row["unit"] for each in (curve, gain) for row in each.list_cells()} == {"decisions"}
    none, oracle = ([0, 0, 1, 0], [1, 1, 1, 0])  # after two decisions, by hand
    assert curve.estimates["none"]["2"] == estimate_mean(none, SCENES, SUCCESS)
    assert curve.estimates["oracle"]["2"] == estimate_mean(oracle, SCENES, SUCCESS)
    assert gain.estimates["oracle"]["2"] == estimate_difference(oracle, none, SCENES, SUCCESS)
    assert [curve.estimates["none"][cut].value for cut in curve.keys] == [25, 25, 50]


def test_the_end_of_the_curve_is_the_success_rate() -> None:
    for answers in (True, False):
        found = summarise_answers(ANSWERS, answers)
        curve = found.breakdowns[0]
        for line in found.arms:
            assert curve.estimates[line.name][curve.keys[-1]] == line.estimates["success"]


def test_without_answers_an_episode_has_succeeded_from_its_end_on() -> None:
    curve = summarise_answers(ANSWERS, answers=False).breakdowns[0]
    assert [curve.estimates["oracle"][cut].value for cut in curve.keys] == [25, 50, 75]


def test_a_part_of_a_success_counts_as_a_part() -> None:
    rows = [make_outcome("none", i, [0] * i + [1], answers=False) for i in range(3)]
    rows = [{**row, "metrics": {**row["metrics"], "success": 0.5}} for row in rows]
    curve = summarise(["none"], rows, 3).breakdowns[0]
    assert [curve.estimates["none"][cut].value for cut in curve.keys] == pytest.approx([50 / 3, 100 / 3, 50])


def test_long_episodes_are_cut_at_some_decisions_and_single_ones_not_at_all() -> None:
    curve = summarise_answers({"none": [[0] * 24 + [1]] * 4}).breakdowns[0]
    assert curve.keys == ("1", "3", "6", "9", "12", "15", "18", "21", "24", "25")
    assert summarise_answers({"none": [[1]] * 4}).breakdowns == ()


def test_a_task_that_names_cuts_has_no_curve_over_decisions() -> None:
    assert summarise_answers(ANSWERS, tables=TableSpec(cuts=(30, 60))).breakdowns == ()


def test_it_is_for_pages_and_exports_not_for_the_terminal() -> None:
    found = SummaryTable.of(summarise_answers(ANSWERS))
    assert "oracle" in as_text(found) and "within N" not in as_text(found)
    assert "oracle" in summary_html(found) and "within N" not in summary_html(found)


def test_a_run_that_was_looked_at_has_bold_differences_by_the_betting_test() -> None:
    """Seven scenes of twenty are won: enough for a test at a fixed number of episodes, not for one at any look."""
    outcomes = [
        {
            "arm": arm,
            "episode": i,
            "scene": f"s{i}",
            "status": "done",
            "metrics": {"success": float(arm == "oracle" and i < 7), "decisions": 2.0},
        }
        for arm in ("none", "oracle")
        for i in range(20)
    ]
    for anytime in (False, True):
        found = summarise(["none", "oracle"], outcomes, 20, units=[[i] for i in range(20)] if anytime else None)
        (gain,) = [each for each in found.breakdowns if each.name == "anytime_differences"]
        assert found.difference("oracle", "none").is_shown == bool(gain.shown) == (not anytime)
