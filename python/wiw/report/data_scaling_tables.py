# SPDX-License-Identifier: Apache-2.0
"""A data-scaling study as tables and sentences, for the terminal and for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.text import Text

from wiw.analysis.data_scaling import (
    EQUAL_UPDATES,
    FEWER_SCENES,
    ONE_EPOCH,
    Curve,
    ModelSplit,
    PowerLaw,
    ScalingTable,
    Value,
)
from wiw.analysis.statistics import LEVEL
from wiw.analysis.summary import show_estimate, show_p
from wiw.report.tables import ROOMY, print_stacked, show_count

TITLES: Mapping[str, str] = {
    "error": "error ↓",
    "regret": "regret, m ↓",
    "psnr/4": "PSNR, dB ↑",
    "ssim/4": "SSIM ↑",
    "gap/displacements": "gap, dB ↑",
    "rank": "rank ↑",
}
"""Measures that tables show."""
ABOUT: Mapping[str, str] = {
    "error": "Root mean squared error in grey levels of held-out frames after 4 actions, from another place.",
    "regret": "How much further from the goal the chosen plan ends than the best plan.",
    "psnr/4": "Of the same frames as the error.",
    "ssim/4": "Of the same frames as the error.",
    "gap/displacements": "PSNR under the true actions minus that under another clip's, turned to the true heading.",
    "rank": "Kendall's tau between the plans' scores and those from true images.",
}


@dataclass(frozen=True)
class TrainingTable:
    """The trainings of an arm."""

    model: str
    arm: str
    titles: tuple[str, ...]
    names: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def lines(self) -> list[tuple[str, tuple[str, ...]]]:
        """Name and cells of each training."""
        return list(zip(self.names, self.rows, strict=True))


def list_trainings(table: ScalingTable) -> list[TrainingTable]:
    """Return a table of each model and arm."""
    measures = [name for name in TITLES if any(curve.measure == name for curve in table.curves)]
    found = []
    for model in table.models:
        for arm in (ONE_EPOCH, EQUAL_UPDATES, FEWER_SCENES):
            curves = [table.find_curve(model, arm, name) for name in measures]
            own = curves[0].arm
            noun = "scenes" if arm == FEWER_SCENES else "clips"
            names = tuple(f"{amount:,} {noun}" for amount in own.amounts)
            rows = tuple(
                (f"{updates:,}", *(_show_value(curve, row, table) for curve in curves))
                for row, updates in enumerate(own.updates)
            )
            found.append(TrainingTable(model, arm, ("updates", *(TITLES[name] for name in measures)), names, rows))
    return found


TREND_TITLES = ("gain", "Page's L", "p", "a", "b", "c")


def list_trends(table: ScalingTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of each curve that is tested and fitted, under `TREND_TITLES`."""
    return [
        (f"{curve.arm.model}, {curve.arm.name}, {curve.measure}", _show_trend(curve))
        for curve in table.curves
        if curve.trend is not None
    ]


SPLIT_TITLES = ("gain", "by updates", "by data", "updates' share", "verdict")


def list_splits(table: ScalingTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of each split, under `SPLIT_TITLES`."""
    return [(f"{each.model}, {each.measure}", _show_split(each)) for each in table.splits]


def explain(table: ScalingTable) -> list[str]:
    """Return what the study says, in sentences: the verdicts, fewer scenes, references, and how little it is."""
    lines = [_describe_split(each) for each in table.splits]
    lines += [
        _describe_scene_gain(table.find_curve(model, FEWER_SCENES, name))
        for model in table.models
        for name in table.primary
    ]
    lines += [
        f"For comparison, {name}: " + ", ".join(f"{measure} {value:.3g}" for measure, value in values.items()) + "."
        for name, values in table.references.items()
    ]
    lines += _describe_least_p(table)
    lines.append(
        f"Intervals: 95 %, over scenes and {show_count(table.seeds, 'seed')} resampled together; "
        + ("one seed says nothing about other seeds." if table.seeds == 1 else "so few seeds are a rough guide.")
    )
    return lines


def print_scaling(table: ScalingTable) -> None:
    """Print all tables and what they say."""
    for each in list_trainings(table):
        print_stacked(f"{each.model}, {each.arm}", each.names, each.titles, each.rows, "trained on")
    for title, titles, rows in (
        ("Trends and fits, a + b (K / smallest K)^-c", TREND_TITLES, list_trends(table)),
        ("The gain of one epoch, split", SPLIT_TITLES, list_splits(table)),
    ):
        print_stacked(title, [name for name, _ in rows], titles, [cells for _, cells in rows], "curve")
    if table.success:
        rates = [[show_estimate(each.success)] for each in table.success]
        print_stacked("ImageNav (secondary)", [each.name for each in table.success], ["SR % ↑"], rates, "training")
    console = Console()
    console = Console(width=None if console.is_terminal else max(console.width, ROOMY))
    for line in explain(table):
        console.print(Text(line, style="dim"))


def show_interval(found: Value, form: str) -> str:
    """Return e.g. "31.2 [29.8, 33.0]"; "–" for an unknown value."""
    if math.isnan(found.value):
        return "–"
    return f"{found.value:{form}} [{found.low:{form}}, {found.high:{form}}]".replace("-", "−")


def _choose_form(value: float) -> str:
    return ".1f" if abs(value) >= 10 else ".2f" if abs(value) >= 1 else ".3f"


def _show_value(curve: Curve, row: int, table: ScalingTable) -> str:
    """Return a value, with its interval where the measure is primary."""
    found = curve.values[row]
    form = _choose_form(max(abs(each.value) for each in curve.values))
    return show_interval(found, form) if curve.measure in table.primary else f"{found.value:{form}}".replace("-", "−")


def _show_trend(curve: Curve) -> list[str]:
    assert curve.trend is not None and curve.fit is not None
    known = not math.isnan(curve.trend.p)
    return [
        show_interval(curve.gain, _choose_form(curve.gain.value)),
        f"{curve.trend.statistic:g}" if known else "–",
        show_p(curve.trend.p) if known else "–",
        *_show_fit(curve.fit),
    ]


def _show_fit(fit: PowerLaw) -> list[str]:
    form = _choose_form(max(fit.a.value, fit.b.value))
    return [show_interval(fit.a, form), show_interval(fit.b, form), show_interval(fit.c, ".2f")]


def _show_split(found: ModelSplit) -> list[str]:
    split, form = found.split, _choose_form(found.split.total.value)
    parts = [show_interval(each, form) for each in (split.total, split.updates, split.data)]
    share = "–" if split.verdict == "no gain" else f"{show_interval(split.share, '.0f')} %"
    return [*parts, share, split.verdict]


def _describe_split(found: ModelSplit) -> str:
    split, form = found.split, _choose_form(found.split.total.value)
    who = f"{found.model}, {found.measure}"
    if split.verdict == "no gain":
        return (
            f"{who}: the interval of the gain from the smallest to the largest size is not above 0: nothing to split."
        )
    return (
        f"{who}: of the gain of {show_interval(split.total, form)} from the smallest to the largest size, "
        f"{show_interval(split.share, '.0f')} % is reached by the smallest size when trained as long: {split.verdict}."
    )


def _describe_least_p(table: ScalingTable) -> list[str]:
    """Return what the trend test can show at best; nothing where no curve was tested."""
    trends = [each.trend for each in table.curves if each.trend is not None and not math.isnan(each.trend.p)]
    return [
        f"p of a trend is over trainings, exact within seeds: {number} trainings cannot show less than p "
        f"{show_p(least)}{', so no trend can be shown' if least > LEVEL else ''}."
        for number, least in dict.fromkeys((each.trainings, each.least_p) for each in trends)
    ]


def _describe_scene_gain(curve: Curve) -> str:
    form = _choose_form(curve.gain.value)
    verdict = "" if curve.is_gain_shown else ": this may be chance"
    seeds = len(curve.by_seed[0])
    test = "" if curve.gain_p is None else f" (p {show_p(curve.gain_p)} over {show_count(seeds, 'seed')}, adjusted)"
    few, whole = curve.arm.amounts[0], curve.arm.amounts[-1]
    return (
        f"{curve.arm.model}, {curve.measure}: as many clips from all {whole} scenes instead of {few} gain "
        f"{show_interval(curve.gain, form)}{test}{verdict}."
    )


def count_trainings(curves: Sequence[Curve]) -> int:
    """Return the number of different trainings, each seed counted."""
    return len({name for curve in curves for name in curve.arm.trainings}) * len(curves[0].by_seed[0])
