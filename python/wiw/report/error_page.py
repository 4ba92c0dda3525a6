# SPDX-License-Identifier: Apache-2.0
"""A study of errors as a figure and as one page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wiw.analysis.errors import ErrorTable
from wiw.files import write_files
from wiw.report import plots
from wiw.report.error_tables import (
    ABOUT,
    COST_TITLES,
    GAP_TITLES,
    describe_doses,
    explain,
    list_correlations,
    list_costs,
    list_gaps,
    list_lines,
    list_titles,
)
from wiw.report.quality_tables import RANK_TITLES
from wiw.report.templating import environment


def write_errors(tables: Sequence[ErrorTable], settings: Mapping[str, Any], numbers: str, folder: Path) -> list[Path]:
    """Write errors.html, .svg, .png and .json into a folder, and return their paths.

    Args:
        tables: one per task.
        settings: of the study.
        numbers: the tables as JSON.
        folder: made where it does not exist.

    Raises:
        FileError: it cannot be written.
    """
    contents: dict[str, str | bytes] = {
        "errors.html": render_errors(tables, settings),
        "errors.svg": plots.draw_errors(tables, "svg"),
        "errors.png": plots.draw_errors(tables, "png"),
        "errors.json": numbers,
    }
    return write_files(folder, contents)


def render_errors(tables: Sequence[ErrorTable], settings: Mapping[str, Any]) -> str:
    """Return the page as self-contained HTML."""
    shown = [
        {
            "table": table,
            "findings": explain(table),
            "titles": list_titles(table),
            "lines": list_lines(table),
            "costs": list_costs(table),
            "gaps": list_gaps(table),
            "ranks": list_correlations(table),
        }
        for table in tables
    ]
    return (
        environment()
        .get_template("errors.html.j2")
        .render(
            figure=plots.error_curves(tables),
            tasks=shown,
            settings=settings,
            doses=describe_doses(tables),
            about=ABOUT,
            cost_titles=COST_TITLES,
            gap_titles=GAP_TITLES,
            rank_titles=RANK_TITLES,
        )
    )
