# SPDX-License-Identifier: Apache-2.0
"""A run's numbers as tables for the terminal; narrow ones stack columns and put intervals below estimates."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.console import Group as Lines
from rich.table import Table
from rich.text import Text

from wiw.analysis.breakdowns import Breakdown
from wiw.analysis.costs import cost_columns, costs
from wiw.analysis.fidelity import choose_columns, fidelity
from wiw.analysis.statistics import Difference, Estimate
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
from wiw.runs.run import Run

COUNTS = (("n", "scored_of_total", ""), ("errors", "errors", "red"), ("to run", "pending", ""))
"""Column, attribute of `ArmSummary`, style; all but the first are left out where they are zero."""
NARROW = 3
"""Arms that fit beside each other with their intervals on one line."""
ROOMY = 96
"""Terminal columns from which on an estimate and its interval stand on one line."""
LONGEST_NAME = 24
"""Terminal columns of an arm's name; longer ones take several lines."""
EDGES, GAP = 1, 2
"""Terminal columns of a table's edges, and between two of its columns."""


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
        from wiw.report.page import summary_html

        return summary_html(self)


def print_summary(summary: SummaryTable, heading: str = "", compared: Group | None = None) -> None:
    """Print the tables, as wide as the terminal; for a file or a pipe at least `ROOMY` columns wide.

    Args:
        summary: the numbers.
        heading: printed before them.
        compared: further differences, printed after them.
    """
    plain = Console()
    console = Console(width=None if plain.is_terminal else max(plain.width, ROOMY))
    if heading:
        console.print(Text(heading, style="bold underline"))
    console.print(summary)
    if compared is not None:
        gap = " " if console.width >= ROOMY else "\n"
        console.print(Lines(*_make_difference_tables(summary, compared, gap, console.width)))


def as_text(summary: SummaryTable) -> str:
    """Return the tables as plain text."""
    console = make_text_console()
    console.print(summary)
    return console.export_text()


def make_text_console() -> Console:
    """Return a console that shows nothing and keeps what is printed, for `export_text`."""
    return Console(width=ROOMY, file=io.StringIO(), record=True, force_jupyter=False)


def print_costs(run: Run) -> None:
    """Print what each arm cost per episode; nothing where no episode has ended."""
    lines = costs(run)
    columns = cost_columns(lines)
    titles, cells = [title for title, _ in columns], [line.cells(columns) for line in lines]
    print_stacked("Costs per episode", [line.arm for line in lines], titles, cells)


def print_fidelity(run: Run) -> None:
    """Print how accurate each arm's imagination was; nothing where the run did not measure it."""
    lines = fidelity(run)
    columns = choose_columns(lines)
    titles = [column.title for column in columns]
    print_stacked(
        "Fidelity of imagination, means over decisions",
        [line.arm for line in lines],
        titles,
        [line.cells(columns) for line in lines],
    )


def print_stacked(
    title: str, arms: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[str]], heading: str = "arm"
) -> None:
    """Print a row per arm, in several tables where the terminal is too narrow for one."""
    if not arms:
        return
    console = Console()
    console = Console(width=None if console.is_terminal else max(console.width, ROOMY))
    columns = [Column(title, [row[index] for row in rows]) for index, title in enumerate(titles)]
    for table in stack_tables(title, arms, columns, console.width, heading):
        console.print(table)


@dataclass(frozen=True)
class Column:
    """A column of numbers."""

    title: str
    cells: Sequence[str | Text]
    style: str = ""

    @property
    def width(self) -> int:
        """Terminal columns that it needs so that nothing is cut."""
        return max(cell_len(line) for cell in (self.title, *self.cells) for line in str(cell).split("\n"))


def show_count(number: int, noun: str) -> str:
    """Return e.g. "1 episode" or "3 episodes"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def stack_tables(
    title: str, names: Sequence[str], columns: Sequence[Column], width: int, heading: str = "arm"
) -> list[Table]:
    """Return as many tables as it takes to fit `columns` into a terminal, with a row per name in each.

    Long names are folded; numbers are never cut. All text is shown as it is, without rich's markup in brackets.
    """
    first = min(max(map(cell_len, names), default=0), LONGEST_NAME)
    groups: list[list[Column]] = [[]]
    for column in columns:
        needed = EDGES + first + sum(GAP + one.width for one in (*groups[-1], column))
        if groups[-1] and needed > width:
            groups.append([])
        groups[-1].append(column)
    tables: list[Table] = []
    for group in groups:
        table = _make_table(f"{title} (continued)" if tables else title)
        table.add_column(Text(heading), style="bold", width=max(first, len(heading)), overflow="fold")
        for column in group:
            head = Text(column.title)
            table.add_column(head, justify="right", style=column.style, no_wrap=True, min_width=column.width)
        for row, name in enumerate(names):
            cells = (column.cells[row] for column in group)
            table.add_row(Text(name), *(cell if isinstance(cell, Text) else Text(cell) for cell in cells))
        tables.append(table)
    return tables


def summary_tables(summary: Summary, width: int) -> Any:
    """Return what rich prints into `width` columns: all tables, then the arms and differences of each tier."""
    parts: list[Any] = [Text("All tiers", style="bold underline")] if summary.tiers else []
    parts += _list_tables(summary, width)
    for tier, own in summary.tiers.items():
        parts += [Text(f"Tier {tier}", style="bold underline"), *_list_tables(own, width)]
    styled = [Text(note, style="bold red" if note.startswith("INVALID") else "dim") for note in notes(summary)]
    return Lines(*parts, *styled)


def _list_tables(summary: Summary, width: int) -> list[Any]:
    """Return all tables of a summary but for those of its tiers."""
    gap = " " if width >= ROOMY else "\n"
    parts: list[Any] = [Text(summary.protocol, style="dim")] if summary.protocol else []
    parts += _make_arm_tables(summary, width)
    if summary.utilities:
        parts.append(_tabulate_utilities(summary))
    for breakdown in filter(lambda found: found.stands_in_terminal, summary.breakdowns):
        parts += _make_breakdown_tables(breakdown, "\n" if len(breakdown.columns) > NARROW else " ", width)
    for group in summary.groups():
        parts += _make_difference_tables(summary, group, gap, width)
    return parts


def _make_table(title: str) -> Table:
    return Table(
        title=Text(title, "bold"),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        min_width=cell_len(title),
    )


def _make_arm_tables(summary: Summary, width: int) -> list[Table]:
    which = "on the same episodes" if summary.same_episodes else "each on the episodes scored in it"
    if summary.marks is not None:
        which += f", marks by {summary.marks.judge.label}"
    lines = summary.lines
    counts = [count for count in COUNTS if count[0] == "n" or any(getattr(line, count[1]) for line in lines)]
    columns = [
        Column(column_title(metric), [_format_cell(line, metric.name) for line in lines])
        for metric in list_columns(summary)
    ]
    columns += [Column(name, [str(getattr(line, key)) for line in lines], style) for name, key, style in counts]
    return stack_tables(f"Arms, {which}", [line.name for line in lines], columns, width)


def _format_cell(line: ArmSummary, metric: str) -> str:
    estimate = line.estimates.get(metric)
    return "–" if estimate is None else show_estimate(estimate)


def _tabulate_utilities(summary: Summary) -> Table:
    table = _make_table("Utility U, from copy (0) to oracle (1)")
    table.add_column("arm", style="bold", overflow="fold")
    for title in ("U ↑", "n"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("")
    for found in summary.utilities:
        style = "" if found.is_defined and not found.reference else "dim"
        shown = Text(show_utility(found), style=style)
        note = Text("reference" if found.reference else "", style="dim")
        table.add_row(Text(found.arm), shown, str(found.n), note)
    return table


def _make_breakdown_tables(breakdown: Breakdown, gap: str, width: int) -> list[Table]:
    """Return a table by kind, budget or outcome; `gap` stands between an estimate and its interval."""
    rows = breakdown.rows

    def format_cell(name: str, title: str) -> Text:
        if title not in rows[name]:
            return Text("–")
        return _format_estimate(rows[name][title], gap, bool(breakdown.base), (name, title) in breakdown.shown)

    columns = [Column(title, [format_cell(name, title) for name in rows]) for title in breakdown.columns]
    count = "n" if breakdown.unit == "episodes" else breakdown.unit
    columns.append(Column(count, list(breakdown.counts.values())))
    return stack_tables(breakdown.title, list(rows), columns, width, breakdown.corner)


def _make_difference_tables(summary: Summary, group: Group, gap: str, width: int) -> list[Table]:
    """Return one group's paired differences; `gap` stands between an estimate and its interval."""
    rows = list(group.rows.values())
    metrics = [metric for metric in list_columns(summary) if any(metric.name in row for row in rows)]
    columns = [
        Column(column_title(metric), [_format_difference(row.get(metric.name), gap) for row in rows])
        for metric in metrics
    ]
    leading = [row.get(metrics[0].name) for row in rows]
    columns.append(Column("W/L", ["–" if one is None else f"{one.wins}/{one.losses}" for one in leading]))
    columns.append(Column("p", ["–" if one is None else show_p(one.p_adjusted) for one in leading]))
    return stack_tables(group.title, list(group.rows), columns, width)


def _format_difference(difference: Difference | None, gap: str) -> Text:
    if difference is None:
        return Text("–")
    return _format_estimate(difference.estimate, gap, True, difference.is_shown)


def _format_estimate(estimate: Estimate, gap: str, signed: bool, shown: bool) -> Text:
    return Text(show_estimate(estimate, signed).replace(" ", gap, 1), style="bold" if shown else "")
