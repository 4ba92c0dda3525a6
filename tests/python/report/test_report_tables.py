# SPDX-License-Identifier: Apache-2.0
"""Tables in terminals of any usual width: no number is ever cut."""

from __future__ import annotations

import io
import json
import sqlite3

import pytest
from fakes import LineAgent, LineTask
from rich.console import Console

from wiw.analysis.costs import COLUMNS, costs
from wiw.analysis.fidelity import choose_columns, fidelity
from wiw.analysis.summary import show_estimate, summarise, summarise_run
from wiw.cli import main
from wiw.cli.run import finish
from wiw.report import page, tables
from wiw.report.page import summary_html
from wiw.report.tables import SummaryTable
from wiw.runs.store_file import store_path
from wiw.studies import run_log
from wiw.studies.evaluate import run_arms
from wiw.types import TableSpec

ARMS = ("none", "copy", "warp", "placebo-shuffled:a_model_with_a_long_name", "oracle")
FIDELITY = {"scores": [0.25, 0.5], "rank": 0.5, "regret": 0.125, "best": False, "psnr": [21.5] * 2, "ssim": [0.75] * 2}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    out = tmp_path_factory.mktemp("tables") / "run"
    agents = {name: LineAgent(0.3 + 0.15 * number) for number, name in enumerate(ARMS)}
    log = run_arms(LineTask(), agents, 6, out=out, progress=False)
    with sqlite3.connect(store_path(out)) as store:
        store.execute("UPDATE decision SET fidelity = ? WHERE arm = 'warp'", (json.dumps(FIDELITY),))
    return log


@pytest.fixture
def terminal(monkeypatch):
    """A function that prints into a terminal of a width and returns the text."""

    def show(width, print_tables):
        console = Console(width=width, file=io.StringIO(), record=True, force_terminal=True)
        monkeypatch.setattr(tables, "Console", lambda *_, **__: console)
        print_tables()
        return console.export_text()

    return show


def squeeze(text):
    return " ".join(text.split())


@pytest.mark.parametrize("width", [60, 80, 100, 140])
def test_costs_are_stacked_rather_than_cut(log, terminal, width):
    shown = terminal(width, lambda: tables.print_costs(log))
    assert "…" not in shown and all(len(line.rstrip()) <= width for line in shown.splitlines())
    for line in costs(log):
        for cell in line.cells(COLUMNS):
            assert cell in shown.split() or all(part in shown.split() for part in cell.split())
    assert ("Costs per episode (continued)" in shown) == (width < 140)
    assert "s / success" in shown and shown.count("none") == shown.count("oracle") >= 1


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_summary_shows_every_estimate_whole(log, terminal, width):
    shown = terminal(width, lambda: tables.print_summary(log.numbers()))
    assert "…" not in shown and all(len(line.rstrip()) <= width for line in shown.splitlines())
    for line in log.numbers().arms:
        for estimate in line.estimates.values():
            assert show_estimate(estimate) in shown
    for difference in log.numbers().differences:
        estimate = show_estimate(difference.estimate, signed=True)
        assert all(part in squeeze(shown) for part in estimate.split(" ", 1))


def test_fidelity_is_printed_where_it_was_measured(log, terminal, tmp_path, capsys):
    shown = terminal(80, lambda: tables.print_fidelity(log))
    assert "Fidelity of imagination" in shown and "warp" in shown and "none" not in shown
    assert all(number in shown.split() for number in ("0.50", "0.125", "21.5", "0.750"))
    plain = run_arms(LineTask(), {"none": LineAgent()}, 2, out=tmp_path / "plain", progress=False)
    assert terminal(80, lambda: tables.print_fidelity(plain)) == ""


def test_fidelity_says_over_how_many_decisions_each_mean_is(tmp_path):
    log = run_arms(LineTask(), {"warp": LineAgent(0.3)}, 5, out=tmp_path / "run", progress=False)
    unranked, replanned = {**FIDELITY, "rank": None}, {**FIDELITY, "rank": None, "regret": None, "best": None}
    with sqlite3.connect(store_path(log.path)) as store:
        store.execute("UPDATE decision SET fidelity = NULL")
        for episode, found in enumerate((FIDELITY, FIDELITY, unranked, replanned)):
            row = (json.dumps(found), episode)
            changed = store.execute("UPDATE decision SET fidelity = ? WHERE episode = ? AND decision = 0", row)
            assert changed.rowcount == 1
    (line,) = fidelity(log)
    assert (line.decisions, line.ranked, line.chosen) == (4, 2, 3)
    columns = choose_columns([line])
    cells = dict(zip((column.title for column in columns), line.cells(columns), strict=True))
    assert (cells["n"], cells["n rank"], cells["n regret"]) == ("4", "2", "3") and cells["regret"] == "0.125"


@pytest.mark.parametrize("width", [60, 140])
def test_a_breakdown_says_how_many_episodes_its_arms_have(width):
    """One arm lacks three of six episodes of a kind, so that its number is not the other's."""
    rows = [
        {"arm": arm, "episode": i, "scene": f"s{i}", "status": "done", "metrics": {"success": 1.0}, "task": kind}
        for arm in ("none", "half")
        for i, kind in enumerate(["near"] * 6 + ["far"] * 4)
        if arm == "none" or i >= 3
    ]
    spec = TableSpec(kinds=("success",), kind="category")
    found = SummaryTable.of(summarise(["none", "half"], rows, 10, tables=spec))
    (breakdown,) = found.breakdowns
    assert breakdown.counts == {"near": "3-6", "far": "4"}
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(found)
    assert any(
        line.split()[0] == "near" and line.split()[-1] == "3-6"
        for line in console.export_text().splitlines()
        if line.strip()
    )
    assert '<td class="number">3-6</td>' in summary_html(found)


def test_the_end_of_a_run_prints_fidelity(log, capsys):
    assert main(["report", str(log.path)]) == 0
    assert "Fidelity of imagination" in capsys.readouterr().out
    assert finish(log, report=False) == 0 and "Fidelity of imagination" in capsys.readouterr().out


def test_the_end_of_a_run_summarises_it_once(tmp_path, monkeypatch, capsys):
    log = run_arms(LineTask(), {"none": LineAgent()}, 2, out=tmp_path / "run", progress=False)
    calls = []
    for module in (run_log, page):
        monkeypatch.setattr(module, "summarise_run", lambda run: calls.append(run) or summarise_run(run))
    assert finish(log, report=True, remark="As agreed.") == 0 and calls == [log]
    assert f"report  {log.path / 'report.html'}" in capsys.readouterr().out
    assert "As agreed." in (log.path / "report.html").read_text()


@pytest.mark.parametrize("width", [60, 140])
def test_a_metric_that_one_arm_lacks_is_shown_of_the_others(width):
    rows = [
        {"arm": arm, "episode": i, "scene": f"s{i}", "status": "done", "metrics": {"success": float(i % 2)}}
        for arm in ("none", "half", "whole")
        for i in range(4)
    ]
    for row in rows:
        if row["arm"] != "half":
            row["metrics"] |= {"grounded": float(row["arm"] == "whole"), "spl": 0.5}  # type: ignore[operator]
    found = SummaryTable.of(summarise(["none", "half", "whole"], rows, 4))
    console = Console(width=width, file=io.StringIO(), record=True)
    console.print(found)
    shown = squeeze(console.export_text().partition("Difference from none")[2])
    assert "Grounded % ↑" in shown and "+100.0" in shown and "SPL" not in shown.partition("none:")[0]
    html = summary_html(found).partition("differences")[2]
    assert html.count('<td class="number">–</td>') == 1 and "Grounded, points" in html and "SPL, points" not in html


def test_brackets_in_names_are_no_markup(terminal):
    names = ["none", "svd[fps=7]", "copy", "[red]x", "oracle"]
    rows = [
        {"arm": arm, "episode": i, "scene": f"s{i}", "status": "done", "metrics": {"success": float(i % 2)}}
        for arm in names
        for i in range(4)
    ]
    shown = terminal(100, lambda: tables.print_summary(SummaryTable.of(summarise(names, rows, 4))))
    listed = [line.split()[0] for line in shown.splitlines() if line.split()]
    assert shown.count("svd[fps=7]") >= 3 and listed.count("svd[fps=7]") == listed.count("[red]x") >= 3
    printed = terminal(100, lambda: tables.print_stacked("T[b]", ["a"], ["SR[i]"], [["1[u]"]], "arm[s]"))
    assert printed.split()[:3] == ["T[b]", "arm[s]", "SR[i]"] and "1[u]" in printed
