# SPDX-License-Identifier: Apache-2.0
"""Quality and controllability as tables, for the terminal and for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.text import Text

from wiw.analysis.quality import CONTROL, PAPER_QUALITY, QualityTable
from wiw.analysis.rank_correlation import Correlation
from wiw.analysis.statistics import Estimate
from wiw.analysis.summary import show_estimate, show_p
from wiw.report.tables import ROOMY, Column, make_text_console, show_count, stack_tables

ABOUT = {
    "SSIM": "Controllability: structural similarity of imagined and true frames, 1 for equal ones.",
    "1 - LPIPS": "Controllability as in the paper: 1 minus the perceptual distance of imagined and true frames.",
    PAPER_QUALITY: "Quality as in the paper: (10 aesthetic + MUSIQ) / 2, from 5 to 100.",
    "sharpness": "Variance of the Laplacian of the luma, in squared grey levels. Noise counts as sharp.",
    "colourfulness": "Hasler and Suesstrunk 2003: 0 grey, 15 slightly, 45 fairly, 109 extremely colourful.",
    "laion_aesthetic": "LAION's improved aesthetic predictor, about 1 to 10.",
}
"""Meaning of each measure, in a sentence."""
RANK_TITLES = ("Spearman", "95 %", "p", "arms")


def show_value(estimate: Estimate | None) -> str:
    """Return e.g. "0.812 [0.790, 0.834]", with as many digits as its size deserves; "–" for none."""
    if estimate is None or math.isnan(estimate.value):
        return "–"
    size = abs(estimate.value)
    form = ".3f" if size < 1.5 else ".2f" if size < 10 else ".1f" if size < 100 else ".0f"
    interval = "[?]" if math.isnan(estimate.low) else f"[{estimate.low:{form}}, {estimate.high:{form}}]"
    return f"{estimate.value:{form}} {interval}"


def show_rank(found: Correlation) -> list[str]:
    """Return the cells of a rank correlation: coefficient, interval, p, number of arms."""
    if math.isnan(found.rho):
        return ["–", "–", "–", str(found.arms)]
    interval = "–" if math.isnan(found.low) else f"[{found.low:+.2f}, {found.high:+.2f}]"
    return [f"{found.rho:+.2f}", interval, show_p(found.p), str(found.arms)]


def arm_rows(table: QualityTable) -> tuple[list[str], list[list[str]]]:
    """Return the titles, and the cells of each arm."""
    titles = [f"{table.outcome} %", *table.measures]
    rows = [
        [show_estimate(line.success), *(show_value(line.scores.get(name)) for name in table.measures)]
        for line in table.arms
    ]
    return titles, rows


def explain(table: QualityTable) -> list[str]:
    """Return what was measured, by whom, and what it does not show."""
    pictured, episodes = show_count(table.pictured, "episode"), show_count(table.episodes, "episode")
    sizes = (
        f"{table.frames} frames of each arm, the same ones, of {pictured} with pictures; {table.outcome} over "
        f"{episodes} of {show_count(table.scenes, 'scene')}, scored in every arm."
    )
    return [sizes, *table.notes, *(_describe(card) for card in table.scorers)]


def print_quality(table: QualityTable) -> None:
    """Print the table of arms, the rank correlations, and what to bear in mind."""
    console = Console()
    _print_to(Console(width=None if console.is_terminal else max(console.width, ROOMY)), table)


def as_text(table: QualityTable) -> str:
    """Return what `print_quality` prints as plain text."""
    console = make_text_console()
    _print_to(console, table)
    return console.export_text()


def label_measure(table: QualityTable, measure: str) -> str:
    """Return the label of a measure's axis."""
    role = "controllability" if measure in CONTROL else "quality"
    ranges = {name: span for card in table.scorers for name, span in card["scores"].items()}
    span = ranges.get(measure)
    scale = "5 to 100" if measure == PAPER_QUALITY else f"{span[0]:g} to {span[1]:g}" if span else ""
    return f"{role}: {measure}" + (f" ({scale})" if scale else "")


def _print_to(console: Console, table: QualityTable) -> None:
    titles, rows = arm_rows(table)
    arms, measures = [line.arm for line in table.arms], [one.measure for one in table.correlations]
    ranks, outcome = [show_rank(one) for one in table.correlations], f"Rank correlation with {table.outcome} over arms"
    for each in (
        *stack_tables("Imagined frames and success", arms, _columns(titles, rows), console.width),
        *stack_tables(outcome, measures, _columns(RANK_TITLES, ranks), console.width, "measure"),
        *(Text(note, style="dim") for note in explain(table)),
    ):
        console.print(each)


def _columns(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> list[Column]:
    return [Column(title, [row[index] for row in rows]) for index, title in enumerate(titles)]


def _describe(card: Mapping[str, object]) -> str:
    return f"Scorer {card['scorer']} {card['version']}, licence {card['licence']}."
