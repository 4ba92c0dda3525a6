# SPDX-License-Identifier: Apache-2.0
"""Every registered metric is a column of the tables; so is a stranger's, found through an entry point."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import wiw
from wiw.analysis.summary import list_columns, load_metrics, summarise
from wiw.cli import main
from wiw.errors import ContractError
from wiw.registry import METRICS
from wiw.runs.recipes import AgentRecipe

STRANGER = """
import wiw

NEAR = wiw.Metric(
    "near", "Near", "rate", True, of=lambda metrics: metrics["distance_to_goal"] < 1e9, about="Whether it came near."
)
ELSEWHERE = wiw.Metric("elsewhere", "Elsewhere", "length", False, of=lambda metrics: metrics["nobody_measures"])
"""


@pytest.fixture
def strangers_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An installed distribution of one file that declares entry points and nothing else; one of them is broken."""
    (tmp_path / "near_metric.py").write_text(STRANGER)
    info = tmp_path / "near_metric-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: near-metric\nVersion: 1.0\n")
    points = ("near = near_metric:NEAR", "elsewhere = near_metric:ELSEWHERE", "gone = near_metric:GONE")
    (info / "entry_points.txt").write_text("\n".join(["[wiw.metrics]", *points]))
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("near_metric", None)


def outcomes(**more: float) -> list[dict]:
    answers = {"answer_score": 0.75, "answered": 1.0, "grounded": 1.0, "path_length": 4.0}
    metrics = {"success": 1.0, "spl": 0.5, "actions": 9.0, "refused": 0.0, **answers, **more}
    rows = ({"arm": arm, "episode": i, "scene": f"s{i % 3}"} for arm in ("none", "warp") for i in range(6))
    return [{**row, "status": "done", "metrics": metrics} for row in rows]


@pytest.mark.parametrize("name", METRICS.names())
def test_it_is_a_column_with_a_name(name: str) -> None:
    metric = METRICS.make(name)
    assert isinstance(metric, wiw.Metric) and metric.label and metric.about
    assert metric.kind in ("rate", "length") and metric in load_metrics()
    summary = summarise(["none", "warp"], outcomes(), 6)
    assert metric in list_columns(summary) and metric.name in summary["warp"].estimates
    assert summary.difference("warp", "none", metric.name).estimate.value == 0


def test_a_strangers_metric_is_a_column_of_every_table(
    strangers_package: None, tmp_path: Path, two_rooms: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "near" in wiw.registry.list_metrics()
    task = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=1)
    with pytest.warns(RuntimeWarning, match="metric 'gone' cannot be loaded"):
        log = wiw.evaluate(
            task, AgentRecipe("heuristic"), 2, out=tmp_path / "run", progress=False, arms=["none", "copy"]
        )
        summary = log.numbers()
    assert summary["copy"].estimates["near"].value == 100.0 and "elsewhere" not in summary["copy"].estimates
    assert summary.difference("copy", "none", "near").wins == 0
    assert "Near % ↑" in str(summary) and log.table()[0]["near"] == 100.0
    assert "Near" in log.report().read_text()
    assert "near" not in log.episodes[0]["metrics"]  # computed from what was measured, not stored
    assert main(["list"]) == 0 and "Whether it came near." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "message"), [(1.5, "a number from 0 to 1, got 1.5"), (float("nan"), "a number from 0 to 1, got nan")]
)
def test_values_that_are_none_of_its_kind_are_refused(value: float, message: str) -> None:
    metric = wiw.Metric("odd", "Odd", "rate", True, of=lambda metrics: metrics["success"] * value)
    with pytest.raises(ContractError, match=f"metric 'odd': expected {message}"):
        metric.add_to({"success": 1.0})
    assert metric.add_to({}) == {} and metric.add_to({"odd": 7.0}) == {"odd": 7.0}


def test_what_follows_from_nothing_measured_is_not_measured_either() -> None:
    metric = wiw.Metric("half", "Half", "rate", True, of=lambda metrics: metrics["success"] / 2)
    assert math.isnan(metric.add_to({"success": math.nan, "actions": 3.0})["half"])
    odd = wiw.Metric("odd", "Odd", "length", True, of=lambda metrics: metrics["actions"] * math.inf)
    with pytest.raises(ContractError, match="metric 'odd': expected a finite number, got inf"):
        odd.add_to({"success": math.nan, "actions": 3.0})


def test_what_it_raises_is_named() -> None:
    metric = wiw.Metric("odd", "Odd", "length", True, of=lambda metrics: 1 / metrics["actions"])
    assert metric.add_to({"actions": 4.0})["odd"] == 0.25
    with pytest.raises(ContractError, match="metric 'odd': ZeroDivisionError"):
        metric.add_to({"actions": 0.0})


def test_the_old_name_warns_and_is_the_same_class() -> None:
    with pytest.warns(DeprecationWarning, match="wiw.Headline is now called wiw.Metric"):
        assert wiw.Headline is wiw.Metric
    assert "Headline" not in dir(wiw)
