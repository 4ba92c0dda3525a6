# SPDX-License-Identifier: Apache-2.0
"""A study as one page: the figures and tables of its runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any, Protocol

import yaml
from markupsafe import Markup

from wiw.analysis.quality import QualityTable
from wiw.analysis.statistics import Difference
from wiw.analysis.summary import Group
from wiw.files import write_files
from wiw.report import plots
from wiw.report.page import list_table_values
from wiw.report.quality_page import list_drawn_measures
from wiw.report.quality_tables import RANK_TITLES, arm_rows, explain, show_rank
from wiw.report.templating import environment

Figures = list[tuple[str, str, Markup]]
"""Title, explanation and drawing."""


class Part(Protocol):
    """One run of a study, as `wiw.studies.study.StudyPart` has it."""

    run: Any
    numbers: Any
    differences: tuple[Difference, ...]
    rollouts: Mapping[str, float]
    quality: QualityTable | None


def write_study(plan: Any, parts: Sequence[Any], numbers: str, folder: Path) -> list[Path]:
    """Write study.html, study.json and an SVG file of each figure into a folder, and return their paths.

    Args:
        plan: the study (`wiw.studies.study_file.StudyPlan`).
        parts: what came of its runs.
        numbers: the same as JSON.
        folder: that exists.

    Raises:
        FileError: it cannot be written.
    """
    figures = [list_figures(part) for part in parts]
    contents = {"study.html": render_study(plan, parts, figures), "study.json": numbers}
    for part, own in zip(parts, figures, strict=True):
        for title, _, drawing in own:
            name = re.sub(r"\W+", "-", f"{part.run.name} {title}".lower()).strip("-")
            names = chain([f"{name}.svg"], (f"{name}-{number}.svg" for number in count(2)))
            contents[next(each for each in names if each not in contents)] = str(drawing)
    return write_files(folder, contents)


def render_study(plan: Any, parts: Sequence[Any], figures: Sequence[Figures]) -> str:
    """Return the page as self-contained HTML. All text from the study is escaped."""
    shown = [
        {
            **list_table_values(part.numbers, part.differences),
            "name": part.run.name,
            "task": part.run.task.name,
            "figures": own,
            "compared": group_pairs(part.differences),
            "quality": _list_quality(part.quality),
        }
        for part, own in zip(parts, figures, strict=True)
    ]
    file = yaml.safe_dump(dict(plan.content), sort_keys=False, allow_unicode=True)
    return environment().get_template("study.html.j2").render(title=plan.title, text=plan.text, parts=shown, file=file)


def list_figures(part: Part) -> Figures:
    """Return the figures that a study asks of a run."""
    found: Figures = []
    for name in part.run.plots:
        if name == "success":
            found.append(("Success by arm", "Bars are 95 % intervals.", plots.success_by_arm(part.numbers)))
        elif name == "rollouts":
            about = "One point per arm: success against futures imagined per episode."
            found.append(("Success by imagined futures", about, _plot_rollouts(part)))
        elif part.quality is not None:
            found += _plot_quality(part.quality)
    return found


def _plot_quality(table: QualityTable) -> Figures:
    ranks = {one.measure: dict(zip(RANK_TITLES, show_rank(one), strict=True)) for one in table.correlations}
    return [
        (
            f"{table.outcome} and {label}",
            "One point per arm. Spearman {Spearman} {95 %}, p = {p}, {arms} arms.".format_map(ranks[measure]),
            plots.success_by_measure(table, measure, label),
        )
        for measure, label in list_drawn_measures(table).items()
    ]


def _plot_rollouts(part: Part) -> Markup:
    arms = [line for line in part.numbers.arms if "success" in line.estimates]
    return plots.success_by_rollouts(
        {line.name: [(part.rollouts[line.name], line.estimates["success"], "")] for line in arms}
    )


def group_pairs(differences: Sequence[Difference]) -> Group | None:
    """Return the compared pairs as one table; None if nothing is compared."""
    rows: dict[str, dict[str, Difference]] = {}
    for each in differences:
        rows.setdefault(f"{each.arm} - {each.base}", {})[each.metric] = each
    return Group("Comparisons, paired by episode", "Comparisons", "Arm minus arm", rows) if rows else None


def _list_quality(table: QualityTable | None) -> dict[str, Any] | None:
    """Return the table of quality and controllability, with notes; None if it was not measured."""
    if table is None:
        return None
    titles, rows = arm_rows(table)
    return {
        "titles": titles,
        "lines": [(line.arm, cells) for line, cells in zip(table.arms, rows, strict=True)],
        "notes": explain(table),
    }
