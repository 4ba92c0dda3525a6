# SPDX-License-Identifier: Apache-2.0
"""A summary as tables for the terminal; where that is narrow, intervals go below their estimates."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from wiw.evaluation.statistics import Estimate
from wiw.evaluation.summary import ArmSummary, Summary, column_title, notes, show_estimate, show_p, shown_headlines

COUNTS = (("n", "judged", ""), ("failed", "failed", "red"), ("to run", "pending", ""))
"""Column, attribute of `ArmSummary`, style; all but the first are left out where they are zero."""


ROOMY = 96
"""Columns that a table of differences takes with an estimate and its interval on one line."""


def print_summary(summary: Summary) -> None:
    """Prints the tables, as wide as the terminal; a file or a pipe sets no limit."""
    console = Console()
    Console(width=None if console.is_terminal else max(console.width, ROOMY)).print(summary)


def summary_tables(summary: Summary, width: int) -> Any:
    """Something that rich can print into so many columns."""
    parts: list[Any] = [_arms(summary)]
    for base in dict.fromkeys(d.base for d in summary.differences):
        parts.append(_differences(summary, base, " " if width >= ROOMY else "\n"))
    styled = [Text(note, style="bold red" if note.startswith("INVALID") else "dim") for note in notes(summary)]
    return Group(*parts, *styled)


def _table(title: str) -> Table:
    return Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )


def _arms(summary: Summary) -> Table:
    which = "on the same episodes" if summary.same_episodes else "each on the episodes that it has finished"
    table = _table(f"Arms, {which}")
    counts = [count for count in COUNTS if count[0] == "n" or any(getattr(line, count[1]) for line in summary.arms)]
    _add_arm_column(table, [line.name for line in summary.arms])
    for headline in shown_headlines(summary):
        table.add_column(column_title(headline), justify="right")
    for name, _, style in counts:
        table.add_column(name, justify="right", style=style)
    for line in summary.arms:
        cells = [_cell(line, headline.metric) for headline in shown_headlines(summary)]
        table.add_row(line.name, *cells, *(str(getattr(line, attribute)) for _, attribute, _ in counts))
    return table


def _cell(line: ArmSummary, metric: str) -> str:
    estimate = line.estimates.get(metric)
    return "–" if estimate is None else show_estimate(estimate)


def _add_arm_column(table: Table, names: list[str]) -> None:
    table.add_column("arm", style="bold", min_width=min(16, max(map(len, names), default=0)))


def _differences(summary: Summary, base: str, gap: str) -> Table:
    """`gap` stands between an estimate and its interval."""
    table = _table(f"Difference to {base}, paired by episode")
    _add_arm_column(table, [line.name for line in summary.arms])
    for headline in shown_headlines(summary):
        table.add_column(column_title(headline), justify="right")
    for title in ("W/L", "p"):
        table.add_column(title, justify="right", min_width=5)
    for arm in dict.fromkeys(d.arm for d in summary.differences if d.base == base):
        found = [summary.difference(arm, base, headline.metric) for headline in shown_headlines(summary)]
        score = f"{found[0].wins}/{found[0].losses}"
        table.add_row(arm, *(_signed(d.estimate, gap) for d in found), score, show_p(found[0].p_value))
    return table


def _signed(estimate: Estimate, gap: str) -> Text:
    shown = show_estimate(estimate, signed=True).replace(" ", gap, 1)
    return Text(shown, style="bold" if estimate.excludes_zero else "")
