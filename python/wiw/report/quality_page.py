# SPDX-License-Identifier: Apache-2.0
"""The paper's two figures, success against quality and against controllability, as pictures and as one page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wiw.analysis.quality import QualityTable
from wiw.files import write_files
from wiw.report import plots
from wiw.report.quality_tables import ABOUT, RANK_TITLES, arm_rows, explain, label_measure, show_rank
from wiw.report.templating import environment
from wiw.runs.rows import encode_jpeg


def write_quality(table: QualityTable, pictures: Mapping[str, Sequence[Any]], numbers: str, folder: Path) -> list[Path]:
    """Write quality.html, quality.svg, quality.png and quality.json into a folder, and return their paths.

    Args:
        table: the numbers.
        pictures: some of the frames by arm, uint8 [H, W, 3], the same of each.
        numbers: the table as JSON.
        folder: made where it does not exist.

    Raises:
        FileError: it cannot be written.
    """
    drawn = list_drawn_measures(table)
    contents: dict[str, str | bytes] = {
        "quality.html": render_quality(table, pictures),
        "quality.svg": plots.draw_success_by_measures(table, drawn, "svg"),
        "quality.png": plots.draw_success_by_measures(table, drawn, "png"),
        "quality.json": numbers,
    }
    return write_files(folder, contents)


def render_quality(table: QualityTable, pictures: Mapping[str, Sequence[Any]]) -> str:
    """Return the page as self-contained HTML. All text from the run and the scorers is escaped."""
    titles, rows = arm_rows(table)
    ranks = {one.measure: one for one in table.correlations}
    figures = [
        (
            plots.success_by_measure(table, name, label),
            label,
            dict(zip(RANK_TITLES, show_rank(ranks[name]), strict=True)),
        )
        for name, label in list_drawn_measures(table).items()
    ]
    return (
        environment()
        .get_template("quality.html.j2")
        .render(
            outcome=table.outcome,
            titles=titles,
            about=ABOUT,
            lines=[(line.arm, cells) for line, cells in zip(table.arms, rows, strict=True)],
            colors=plots.arm_colors([line.arm for line in table.arms]),
            figures=figures,
            rank_titles=RANK_TITLES,
            ranks=[(one.measure, show_rank(one)) for one in table.correlations],
            notes=explain(table),
            pictures={
                name: [base64.b64encode(encode_jpeg(frame)).decode() for frame in frames]
                for name, frames in pictures.items()
            },
        )
    )


def list_drawn_measures(table: QualityTable) -> dict[str, str]:
    """Return the measures that are drawn, with labels: quality, and controllability where it is known."""
    names = [table.quality, *([table.control] if table.control else [])]
    return {name: label_measure(table, name) for name in names}
