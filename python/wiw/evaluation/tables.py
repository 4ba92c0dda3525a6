# SPDX-License-Identifier: Apache-2.0
"""A summary as tables for the terminal, narrow enough for 80 columns."""

from __future__ import annotations

from typing import Any

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from wiw.evaluation.statistics import Estimate
from wiw.evaluation.summary import ArmSummary, Summary, column_title, notes, show_estimate, show_p, shown_headlines

COUNTS = (("n", "done", ""), ("failed", "failed", "red"), ("to run", "pending", ""))
"""Column, attribute of `ArmSummary`, style; all but the first are left out where they are zero."""


def summary_tables(summary: Summary) -> Any:
    """Something that rich can print."""
    parts: list[Any] = [_arms(summary)]
    parts += [_differences(summary, base) for base in dict.fromkeys(d.base for d in summary.differences)]
    return Group(*parts, *(Text(note, style="dim") for note in notes(summary)))


def _table(title: str) -> Table:
    return Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )


def _arms(summary: Summary) -> Table:
    table = _table("Arms, on the same episodes")
    counts = [count for count in COUNTS if count[0] == "n" or any(getattr(line, count[1]) for line in summary.arms)]
    table.add_column("arm", style="bold", no_wrap=True)
    for headline in shown_headlines(summary):
        table.add_column(column_title(headline), justify="right", no_wrap=True)
    for name, _, style in counts:
        table.add_column(name, justify="right", style=style)
    for line in summary.arms:
        cells = [_cell(line, headline.metric) for headline in shown_headlines(summary)]
        table.add_row(line.name, *cells, *(str(getattr(line, attribute)) for _, attribute, _ in counts))
    return table


def _cell(line: ArmSummary, metric: str) -> str:
    estimate = line.estimates.get(metric)
    return "–" if estimate is None else show_estimate(estimate)


def _differences(summary: Summary, base: str) -> Table:
    table = _table(f"Difference to {base}, paired by episode")
    table.add_column("arm", style="bold", no_wrap=True)
    for headline in shown_headlines(summary):
        table.add_column(column_title(headline), justify="right", no_wrap=True)
    table.add_column("W/L", justify="right", no_wrap=True)
    table.add_column("p", justify="right", no_wrap=True, min_width=5)
    for arm in dict.fromkeys(d.arm for d in summary.differences if d.base == base):
        found = [summary.difference(arm, base, headline.metric) for headline in shown_headlines(summary)]
        score = f"{found[0].wins}/{found[0].losses}"
        table.add_row(arm, *(_signed(d.estimate) for d in found), score, show_p(found[0].p_value))
    return table


def _signed(estimate: Estimate) -> Text:
    return Text(show_estimate(estimate, signed=True), style="bold" if estimate.excludes_zero else "")
