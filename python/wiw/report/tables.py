# SPDX-License-Identifier: Apache-2.0
"""A summary as tables for the terminal; where that is narrow, intervals go below their estimates."""

from __future__ import annotations

import io
from dataclasses import fields
from typing import Any

from rich import box
from rich.console import Console
from rich.console import Group as Lines
from rich.table import Table
from rich.text import Text

from wiw.analysis.statistics import Estimate
from wiw.analysis.summary import (
    ArmSummary,
    Group,
    Summary,
    column_title,
    list_columns,
    notes,
    show_estimate,
    show_p,
    show_utility,
)
from wiw.metrics.metric import SUCCESS
from wiw.report.page import summary_html

COUNTS = (("n", "judged", ""), ("errors", "errors", "red"), ("to run", "pending", ""))
"""Column, attribute of `ArmSummary`, style; all but the first are left out where they are zero."""


NARROW = 3
"""Arms that fit beside each other with their intervals on one line."""
ROOMY = 96
"""Columns that a table of differences takes with an estimate and its interval on one line."""


class SummaryTable(Summary):
    """A summary that shows itself: as tables in a terminal, as HTML in Jupyter."""

    @classmethod
    def of(cls, summary: Summary) -> SummaryTable:
        """Return the same numbers as a table."""
        return cls(**{field.name: getattr(summary, field.name) for field in fields(Summary)})

    def __str__(self) -> str:
        return as_text(self)

    def __rich_console__(self, console: Any, options: Any) -> Any:
        yield summary_tables(self, options.max_width)

    def _repr_html_(self) -> str:
        return summary_html(self)


def print_summary(summary: SummaryTable) -> None:
    """Prints the tables, as wide as the terminal; a file or a pipe sets no limit."""
    console = Console()
    Console(width=None if console.is_terminal else max(console.width, ROOMY)).print(summary)


def as_text(summary: SummaryTable) -> str:
    """The tables as plain text."""
    console = Console(width=ROOMY, file=io.StringIO(), record=True)
    console.print(summary)
    return console.export_text()


def summary_tables(summary: Summary, width: int) -> Any:
    """Something that rich can print into so many columns."""
    parts: list[Any] = [_arms(summary)]
    if summary.utilities:
        parts.append(_utilities(summary))
    if len(summary.kinds) > 1:
        parts.append(_kinds(summary, "\n" if len(summary.arms) > NARROW else " "))
    parts += [_differences(summary, group, " " if width >= ROOMY else "\n") for group in summary.groups()]
    styled = [Text(note, style="bold red" if note.startswith("INVALID") else "dim") for note in notes(summary)]
    return Lines(*parts, *styled)


def _table(title: str) -> Table:
    return Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )


def _arms(summary: Summary) -> Table:
    which = "on the same episodes" if summary.same_episodes else "each on the episodes scored in it"
    table = _table(f"Arms, {which}")
    counts = [count for count in COUNTS if count[0] == "n" or any(getattr(line, count[1]) for line in summary.arms)]
    _add_arm_column(table, [line.name for line in summary.arms])
    for metric in list_columns(summary):
        table.add_column(column_title(metric), justify="right")
    for name, _, style in counts:
        table.add_column(name, justify="right", style=style)
    for line in summary.arms:
        cells = [_cell(line, metric.name) for metric in list_columns(summary)]
        table.add_row(line.name, *cells, *(str(getattr(line, attribute)) for _, attribute, _ in counts))
    return table


def _cell(line: ArmSummary, metric: str) -> str:
    estimate = line.estimates.get(metric)
    return "–" if estimate is None else show_estimate(estimate)


def _add_arm_column(table: Table, names: list[str]) -> None:
    table.add_column("arm", style="bold", min_width=min(16, max(map(len, names), default=0)))


def _utilities(summary: Summary) -> Table:
    table = _table("Utility U, from copy (0) to oracle (1)")
    _add_arm_column(table, [found.arm for found in summary.utilities])
    for title in ("U ↑", "n"):
        table.add_column(title, justify="right")
    table.add_column("")
    for found in summary.utilities:
        style = "" if found.is_defined and not found.reference else "dim"
        shown = Text(show_utility(found), style=style)
        table.add_row(found.arm, shown, str(found.n), Text("reference" if found.reference else "", style="dim"))
    return table


def _kinds(summary: Summary, gap: str) -> Table:
    """`gap` stands between an estimate and its interval."""
    table = _table(f"{column_title(SUCCESS)} by kind of task")
    table.add_column("task", style="bold")
    for line in summary.arms:
        table.add_column(line.name, justify="right")
    table.add_column("n", justify="right")
    for kind, found in summary.kinds.items():
        cells = [show_estimate(found[line.name]) if line.name in found else "–" for line in summary.arms]
        count = max(estimate.n for estimate in found.values())
        table.add_row(kind, *(cell.replace(" ", gap, 1) for cell in cells), str(count))
    return table


def _differences(summary: Summary, group: Group, gap: str) -> Table:
    """`gap` stands between an estimate and its interval."""
    table = _table(group.title)
    _add_arm_column(table, list(group.rows))
    for metric in list_columns(summary):
        table.add_column(column_title(metric), justify="right")
    for title in ("W/L", "p"):
        table.add_column(title, justify="right", min_width=5)
    for label, row in group.rows.items():
        found = [row[metric.name] for metric in list_columns(summary)]
        score = f"{found[0].wins}/{found[0].losses}"
        table.add_row(label, *(_signed(d.estimate, gap) for d in found), score, show_p(found[0].p_adjusted))
    return table


def _signed(estimate: Estimate, gap: str) -> Text:
    shown = show_estimate(estimate, signed=True).replace(" ", gap, 1)
    return Text(shown, style="bold" if estimate.excludes_zero else "")
