# SPDX-License-Identifier: Apache-2.0
"""A data-scaling study as a figure and as one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wiw.analysis.data_scaling import ScalingTable
from wiw.analysis.summary import show_estimate
from wiw.files import write_files
from wiw.report import plots
from wiw.report.data_scaling_tables import (
    ABOUT,
    SPLIT_TITLES,
    TITLES,
    TREND_TITLES,
    count_trainings,
    explain,
    list_splits,
    list_trainings,
    list_trends,
)
from wiw.report.templating import environment


def write_scaling(table: ScalingTable, plan: Mapping[str, Any], numbers: str, folder: Path) -> list[Path]:
    """Write data-scaling.html, .svg, .png and .json into a folder, and return their paths.

    Args:
        table: the numbers.
        plan: what was settled before, as JSON values.
        numbers: the table as JSON.
        folder: made where it does not exist.

    Raises:
        FileError: it cannot be written.
    """
    contents: dict[str, str | bytes] = {
        "data-scaling.html": render_scaling(table, plan),
        "data-scaling.svg": plots.draw_scaling(table, "svg"),
        "data-scaling.png": plots.draw_scaling(table, "png"),
        "data-scaling.json": numbers,
    }
    return write_files(folder, contents)


def render_scaling(table: ScalingTable, plan: Mapping[str, Any]) -> str:
    """Return the page as self-contained HTML."""
    return (
        environment()
        .get_template("data_scaling.html.j2")
        .render(
            figure=plots.scaling_curves(table),
            findings=explain(table),
            tables=list_trainings(table),
            about={TITLES[name]: text for name, text in ABOUT.items()},
            split_titles=SPLIT_TITLES,
            splits=list_splits(table),
            trend_titles=TREND_TITLES,
            trends=list_trends(table),
            success=[(each.name, show_estimate(each.success)) for each in table.success],
            trainings=count_trainings(table.curves),
            plan=plan,
        )
    )
