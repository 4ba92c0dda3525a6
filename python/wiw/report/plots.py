# SPDX-License-Identifier: Apache-2.0
"""Plots as inline SVG with the text colour of the page, for light and dark themes alike."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from wiw.analysis.blame import Blame
from wiw.analysis.breakdowns import Breakdown
from wiw.analysis.data_scaling import EQUAL_UPDATES, FEWER_SCENES, ONE_EPOCH, ScalingTable
from wiw.analysis.errors import METRES, PSNR, ErrorLine, ErrorTable
from wiw.analysis.fidelity import ArmFidelity
from wiw.analysis.marks import BLIND
from wiw.analysis.quality import QualityTable
from wiw.analysis.statistics import estimate_mean
from wiw.analysis.summary import Summary
from wiw.metrics.metric import SUCCESS, is_success
from wiw.scenes import strip_edits
from wiw.types import Wording

LONGEST_LINE, LONGEST_WORD = 16, 28
"""Characters of an arm's name beside an axis: on a line, and of a part that cannot be broken where its parts end."""
LONGEST_LABEL, LABEL_LINE = 48, 30
"""Characters of an arm's name in a legend that stands on one line, and of a line of a longer one."""
INK = "#010203"
"""Stands for the page's text colour."""
PALETTE = (
    "#4c78a8", "#8e6bbf", "#d1495b", "#17899b", "#b5651d", "#5a7d2a",
    "#d977b0", "#3949ab", "#7c6f00", "#e8743b", "#00a884", "#8d5a4a",
)  # fmt: skip
MARKERS = "osD^"
"""Tell arms of one colour apart."""
ROLE_COLORS = {"none": "#8b9099", "copy": "#c98a2b", "oracle": "#2e9e6b", BLIND: "#a39a86"}
BLAME_COLORS = {
    "imagination": "#4c78a8",
    "scoring": "#d1495b",
    "proposals": "#b5651d",
    "perception": "#d1495b",
    "exploration": "#b5651d",
    "joint": "#8e6bbf",
    "beyond": "#8b9099",
    "answering": "#8b9099",
}
TICKS = 5
"""Maximum number of intervals between the numbers of an axis: more collide where names of arms or fonts are wide."""
WIDEST_LABEL = 36
"""Characters on a line of a long label beside an axis."""
HEIGHT, LINE = 3.1, 0.2
"""Inches: of a plot, and what each line of a name, or row of a legend, needs where that is more."""
LEGEND_ROWS = 4
"""Rows of a legend for which a plot has room."""
LEGEND_WIDTH = 50
"""Characters that fit beside each other in a legend as wide as one plot, of which each entry needs six for its mark."""
FEW = 24
"""Below this many episodes single outcomes are shown instead of binned rates."""

Outcomes = Mapping[str, Sequence[Mapping[str, Any]]]


def arm_colors(arms: Sequence[str]) -> dict[str, str]:
    """Return a colour per arm; the references always have the same."""
    others = [arm for arm in arms if arm not in ROLE_COLORS]
    return {**ROLE_COLORS, **{arm: PALETTE[i % len(PALETTE)] for i, arm in enumerate(others)}}


def arm_markers(arms: Sequence[str]) -> dict[str, str]:
    """Return a marker per arm, which differs between arms of one colour."""
    others = [arm for arm in arms if arm not in ROLE_COLORS]
    return {
        **dict.fromkeys(ROLE_COLORS, "o"),
        **{arm: MARKERS[i // len(PALETTE) % len(MARKERS)] for i, arm in enumerate(others)},
    }


def success_by_arm(summary: Summary) -> Markup:
    """Plot success rates with their intervals; floor and oracle as lines through the others."""
    lines = [line for line in summary.arms if "success" in line.estimates]
    colors = arm_colors([line.name for line in summary.arms])
    figure, axes = _make_figure([line.name for line in lines])
    for y, line in enumerate(reversed(lines)):
        found = line.estimates["success"]
        if line.name in ("copy", "oracle"):
            axes.axvline(found.value, color=colors[line.name], lw=1, ls=(0, (4, 3)), alpha=0.7, zorder=0)
        axes.plot([found.low, found.high], [y, y], color=colors[line.name], lw=5, alpha=0.35, solid_capstyle="round")
        axes.plot(found.value, y, "o", color=colors[line.name], ms=9)
    axes.set_yticks(range(len(lines)), [_fold(line.name) for line in reversed(lines)])
    axes.set_ylim(-0.6, len(lines) - 0.4)
    axes.set_xlim(-2, 102)
    axes.xaxis.set_major_locator(MaxNLocator(TICKS))
    axes.set_xlabel("success rate, %")
    axes.grid(axis="x", color=INK, alpha=0.08)
    return _render_svg(figure, "success-by-arm")


def success_by_rollouts(series: Mapping[str, Sequence[tuple[float, Any, str]]]) -> Markup:
    """Plot success rates with their intervals against imagined futures; each series has (rollouts, estimate, label)."""
    colors = arm_colors(list(series))
    figure, axes = _make_figure()
    for name, points in series.items():
        axes.plot(
            [x for x, _, _ in points],
            [found.value for _, found, _ in points],
            "-o",
            color=colors[name],
            label=_label(name),
        )
        for x, found, label in points:
            axes.plot([x, x], [found.low, found.high], color=colors[name], lw=4, alpha=0.3, solid_capstyle="round")
            axes.annotate(label, (x, found.value), textcoords="offset points", xytext=(6, 6), fontsize=8, color=INK)
    axes.set_ylim(-2, 102)
    axes.set_xlim(left=0)
    axes.set_xlabel("imagined futures per episode")
    axes.set_ylabel("success rate, %")
    axes.grid(axis="y", color=INK, alpha=0.08)
    _draw_legend(axes)
    return _render_svg(figure, "success-by-rollouts")


def success_by_rank(truths: Sequence[ArmFidelity], summary: Summary) -> Markup:
    """Plot success rates with their intervals against rank agreement, a point per arm."""
    colors = arm_colors([line.name for line in summary.arms])
    figure, axes = _make_figure()
    for line in truths:
        estimate = summary[line.arm].estimates["success"]
        axes.plot([line.rank] * 2, [estimate.low, estimate.high], color=colors[line.arm], lw=4, alpha=0.35)
        axes.plot(line.rank, estimate.value, "o", color=colors[line.arm], ms=9, label=_label(line.arm))
    axes.set_xlim(-1.05, 1.05)
    axes.set_ylim(-3, 103)
    axes.set_xlabel("rank agreement, Kendall's tau")
    axes.set_ylabel("success rate, %")
    _draw_legend(axes)
    return _render_svg(figure, "success-by-rank")


def success_by_measure(found: QualityTable, measure: str, label: str) -> Markup:
    """Plot success rates against a measure of imagined frames, a point per arm, with the intervals of both."""
    figure, axes = _make_figure()
    _draw_success_by_measure(axes, found, measure, label)
    _draw_legend(axes)
    return _render_svg(figure, f"success-by-{measure}")


def draw_success_by_measures(found: QualityTable, measures: Mapping[str, str], form: str) -> bytes:
    """Return one picture of success against several measures side by side, on white.

    Args:
        found: the numbers.
        measures: label of each measure.
        form: "svg" or "png".
    """
    figure = Figure(figsize=(4.7 * len(measures), 3.5), layout="constrained")
    for axes, (measure, label) in zip(np.atleast_1d(figure.subplots(1, len(measures))), measures.items(), strict=True):
        _style_axes(axes)
        _draw_success_by_measure(axes, found, measure, label)
    handles, texts = figure.axes[0].get_legend_handles_labels()
    longest = _measure_longest(texts)
    columns = max(1, min(6, len(texts), LEGEND_WIDTH * len(measures) // (longest + 6)))
    figure.legend(handles, texts, frameon=False, labelcolor=INK, fontsize=9, ncols=columns, loc="outside upper left")
    return _draw_on_white(figure, form, "quality")


def _draw_success_by_measure(axes: Axes, found: QualityTable, measure: str, label: str) -> None:
    arms = [line.arm for line in found.arms]
    colors, markers = arm_colors(arms), arm_markers(arms)
    for line in found.arms:
        success, color, value = line.success, colors[line.arm], line.scores.get(measure)
        if value is None:
            continue
        axes.plot([value.value] * 2, [success.low, success.high], color=color, lw=4, alpha=0.35, solid_capstyle="round")
        if not math.isnan(value.low):
            axes.plot([value.low, value.high], [success.value] * 2, color=color, lw=1.2, alpha=0.6)
        axes.plot(value.value, success.value, markers[line.arm], color=color, ms=9, label=_label(line.arm))
    axes.set_ylim(-3, 103)
    axes.xaxis.set_major_locator(MaxNLocator(TICKS))
    axes.set_xlabel(label)
    axes.set_ylabel("success rate, %" if found.outcome == "SR" else f"{found.outcome.lower()}, %")


def scaling_curves(found: ScalingTable) -> Markup:
    """Plot the primary measures of a data-scaling study over numbers of clips."""
    return _render_svg(_draw_scaling(found), "data-scaling")


def draw_scaling(found: ScalingTable, form: str) -> bytes:
    """Return the same picture on white, as "svg" or "png"."""
    return _draw_on_white(_draw_scaling(found), form, "data-scaling")


def _draw_scaling(found: ScalingTable) -> Figure:
    """Draw a row of axes a model, with an axes a primary measure."""
    rows, columns = len(found.models), len(found.primary)
    figure = Figure(figsize=(4.7 * columns, 3.1 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey="col")
    for model, own in zip(found.models, grid, strict=True):
        for (measure, label), axes in zip(found.primary.items(), own, strict=True):
            _style_axes(axes)
            _draw_scaling_measure(axes, found, model, measure)
            axes.set_title(model, loc="left", fontsize=11, color=INK)
            axes.set_xlabel("clips")
            axes.set_ylabel(fill(label, WIDEST_LABEL), fontsize=9)
    handles, texts = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, frameon=False, labelcolor=INK, fontsize=9, ncols=4, loc="outside upper left")
    return figure


def _draw_scaling_measure(axes: Axes, found: ScalingTable, model: str, measure: str) -> None:
    arms = {name: found.find_curve(model, name, measure) for name in (ONE_EPOCH, EQUAL_UPDATES)}
    clips = arms[ONE_EPOCH].arm.amounts
    for (name, curve), color, shift in zip(arms.items(), PALETTE, (0.97, 1.03), strict=False):
        x = shift * np.array(clips)
        bars = [[each.value - each.low, each.high - each.value] for each in curve.values]
        middle = [each.value for each in curve.values]
        axes.errorbar(
            x, middle, np.clip(np.array(bars).T, 0, None), fmt="o", color=color, ms=6, elinewidth=2, label=name
        )
        for at, seeds in zip(x, curve.by_seed, strict=True):
            axes.plot([at] * len(seeds), seeds, "_", color=color, ms=9, alpha=0.7)
        if curve.fit is not None:
            fine = np.geomspace(clips[0], clips[-1], 60)
            fitted = curve.fit.a.value + curve.fit.b.value * (fine / clips[0]) ** -curve.fit.c.value
            axes.plot(fine, fitted, color=color, lw=1.4, ls=(0, (4, 3)))
    few = found.find_curve(model, FEWER_SCENES, measure)
    for scenes, each, color in zip(few.arm.amounts[:-1], few.values, PALETTE[2:], strict=False):
        axes.errorbar(
            few.arm.clips,
            each.value,
            [[max(0, each.value - each.low)], [max(0, each.high - each.value)]],
            fmt="D",
            color=color,
            ms=6,
            elinewidth=2,
            label=f"from {scenes} scenes",
        )
    low, high = _find_range(found, measure)
    axes.set_ylim(low, high)
    levels = sorted((values[measure], name) for name, values in found.references.items() if measure in values)
    for row, (level, name) in enumerate(each for each in levels if low < each[0] < high):
        axes.axhline(level, color=ROLE_COLORS["none"], lw=1, ls=":")
        at, side = (clips[-1 - row], level), "center" if row else "right"
        axes.annotate(name, at, (0, 2), textcoords="offset points", ha=side, fontsize=8, color=INK)
    far = ", ".join(f"{name} {level:.3g}" for level, name in levels if not low < level < high)
    axes.set_title(f"out of range: {far}" if far else "", loc="right", fontsize=8, color=INK)
    axes.set_xscale("log")
    axes.set_xticks(clips, [f"{each:,}" for each in clips])
    axes.minorticks_off()


def _find_range(found: ScalingTable, measure: str) -> tuple[float, float]:
    """Return the limits of an axis that has room for all values of a measure with their intervals."""
    values = [each for curve in found.curves if curve.measure == measure for each in curve.values]
    low, high = min(each.low for each in values), max(each.high for each in values)
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


FAMILY_COLORS = {"looks": "#4c78a8", "flicker": "#8e6bbf", "control": "#d1495b", "content": "#b5651d"}
ERROR_PANELS = (("looks", "flicker"), ("control",), ("content",))
"""Families of errors that share axes."""


def error_curves(tables: Sequence[ErrorTable]) -> Markup:
    """Plot success and regret over the distance of frames from the true ones, a line for each kind of error."""
    return _render_svg(_draw_errors(tables), "errors")


def draw_errors(tables: Sequence[ErrorTable], form: str) -> bytes:
    """Return the same picture on white, as "svg" or "png"."""
    return _draw_on_white(_draw_errors(tables), form, "errors")


def _draw_errors(tables: Sequence[ErrorTable]) -> Figure:
    """Draw two rows of axes a task, success and regret: a column for each panel, then by PSNR and by place."""
    columns = len(ERROR_PANELS) + 2
    figure = Figure(figsize=(3.2 * columns, 5.6 * len(tables)), layout="constrained")
    grid = figure.subplots(2 * len(tables), columns, squeeze=False, sharey="row")
    for number, table in enumerate(tables):
        for row, regret in zip(grid[2 * number : 2 * number + 2], (False, True), strict=True):
            for families, axes in zip(ERROR_PANELS, row[:-2], strict=True):
                _draw_error_kinds(axes, table, families, table.distance, regret)
                axes.set_title("" if regret else f"{table.task}: {' and '.join(families)}", loc="left", fontsize=10)
            _draw_error_families(row[-2], table, PSNR, regret)
            _draw_error_kinds(row[-1], table, ("control",), METRES, regret)
            for axes, label in zip(row[-2:], ("PSNR, dB", "metres from the place"), strict=True):
                axes.set_xlabel(label, fontsize=9)
            row[0].set_ylabel("regret, less the oracle's" if regret else f"{table.label}, %", fontsize=9)
    return figure


def _draw_error_kinds(axes: Axes, table: ErrorTable, families: Sequence[str], measure: str, regret: bool) -> None:
    """Draw a line for each kind of error in some families, from the oracle to its largest dose."""
    lines = [line for line in table.lines if line.family in families and measure in line.measures]
    ceiling = _prepare_error_axes(axes, table, regret)
    axes.set_visible(bool(lines))
    axes.set_xlabel(measure, fontsize=9)
    for kind, color in zip(dict.fromkeys(line.kind for line in lines), (*PALETTE, INK), strict=False):
        own = [line for line in lines if line.kind == kind]
        points = [(line.measures[measure].value, found) for line in own if (found := _find_error_point(line, regret))]
        if not points:
            continue
        x, y = [0.0, *(at for at, _ in points)], [ceiling, *(found.value for _, found in points)]
        axes.plot(x, y, color=color, lw=1.2, alpha=0.8)
        bars = np.array([[found.value - found.low, found.high - found.value] for _, found in points]).T
        axes.errorbar(
            x[1:], y[1:], np.clip(bars, 0, None), fmt="o", color=color, ms=4, elinewidth=1, alpha=0.8, label=kind
        )
    if lines and not regret:
        axes.legend(frameon=False, labelcolor=INK, fontsize=8, ncols=2)


def _draw_error_families(axes: Axes, table: ErrorTable, measure: str, regret: bool) -> None:
    """Draw a dot for each arm, in the colour of its family."""
    _prepare_error_axes(axes, table, regret)
    for family in dict.fromkeys(line.family for line in table.lines):
        own = [line for line in table.lines if line.family == family and measure in line.measures]
        points = [(line.measures[measure].value, found) for line in own if (found := _find_error_point(line, regret))]
        x, y = [at for at, _ in points], [found.value for _, found in points]
        axes.plot(x, y, "o", color=FAMILY_COLORS[family], ms=5, alpha=0.8, label=family)
    if table.lines and not regret:
        axes.legend(frameon=False, labelcolor=INK, fontsize=8, ncols=2)


def _prepare_error_axes(axes: Axes, table: ErrorTable, regret: bool) -> float:
    """Draw the levels of the references; return that of the oracle."""
    _style_axes(axes)
    ceiling = 0.0 if regret else table.references["oracle"].value
    axes.axhline(ceiling, color=ROLE_COLORS["oracle"], lw=1, ls=(0, (4, 3)))
    if not regret:
        axes.axhline(table.references["none"].value, color=ROLE_COLORS["none"], lw=1, ls=":")
    return ceiling


def _find_error_point(line: ErrorLine, regret: bool) -> Any:
    """Return the success of an arm, or its regret beyond the oracle's; None if it was not measured."""
    if not regret:
        return line.outcome
    return None if line.regret is None else line.regret.estimate


def blame_by_arm(found: Blame) -> Markup:
    """Plot each arm's failures by the stage to blame, as stacked bars."""
    lines = list(reversed(found.arms))
    figure, axes = _make_figure([line.arm for line in lines])
    left = np.zeros(len(lines))
    for verdict in found.scheme.verdicts:
        color = BLAME_COLORS[verdict]
        counts = np.array([line.verdicts[verdict] for line in lines], np.float64)
        axes.barh(range(len(lines)), counts, left=left, height=0.55, color=color, label=verdict)
        for y, (start, count) in enumerate(zip(left, counts, strict=True)):
            if count:
                axes.text(
                    start + count / 2,
                    y,
                    f"{count:.0f}",
                    ha="center",
                    va="center",
                    color=_choose_text_color(color),
                    fontsize=9,
                )
        left += counts
    axes.set_yticks(range(len(lines)), [_fold(line.arm) for line in lines])
    axes.set_ylim(-0.6, len(lines) - 0.4)
    axes.xaxis.set_major_locator(MaxNLocator(TICKS, integer=True))
    axes.set_xlabel("failures, episodes")
    axes.grid(visible=False, axis="y")
    _draw_legend(axes)
    return _render_svg(figure, "blame-by-arm")


def success_by_distance(outcomes: Outcomes, words: Wording) -> Markup:
    """Plot success by path length: single episodes where there are few, else rates in bins of equal counts."""
    colors = arm_colors(list(outcomes))
    single = shows_single_outcomes(outcomes)
    figure, axes = _make_figure(list(outcomes) if single else ())
    if single:
        _draw_outcome_dots(axes, outcomes, colors)
    else:
        _draw_binned_rates(axes, outcomes, colors)
    axes.set_xlim(left=0)
    axes.xaxis.set_major_locator(MaxNLocator(TICKS))
    axes.set_xlabel(f"shortest path {words.way}, m")
    return _render_svg(figure, "success-by-distance")


def shows_single_outcomes(outcomes: Outcomes) -> bool:
    """Return whether there are so few episodes that `success_by_distance` shows each instead of rates."""
    return max((len(rows) for rows in outcomes.values()), default=0) < FEW


def _draw_outcome_dots(axes: Axes, outcomes: Outcomes, colors: Mapping[str, str]) -> None:
    for y, (arm, rows) in enumerate(reversed(list(outcomes.items()))):
        for row in rows:
            filled = colors[arm] if is_success(row["metrics"]) else "none"
            axes.plot(row["geodesic"], y, "o", ms=9, mfc=filled, mec=colors[arm], mew=1.6, alpha=0.9, clip_on=False)
    axes.set_yticks(range(len(outcomes)), [_fold(arm) for arm in reversed(list(outcomes))])
    axes.set_ylim(-0.6, len(outcomes) - 0.4)


def _draw_binned_rates(axes: Axes, outcomes: Outcomes, colors: Mapping[str, str]) -> None:
    lengths = np.array([row["geodesic"] for rows in outcomes.values() for row in rows])
    edges = np.unique(np.quantile(lengths, np.linspace(0, 1, 5)))
    span = edges[-1] - edges[0]
    if len(edges) == 1:  # all are equally long: one bin
        edges, span = np.repeat(edges, 2), edges[0] or 1.0
        axes.set_xlim(right=edges[0] + 0.03 * span * (1 + len(outcomes) / 2))
    for shift, (arm, rows) in enumerate(outcomes.items()):
        ways = np.array([row["geodesic"] for row in rows])
        reached = np.array([row["metrics"].get("success", 0.0) for row in rows])
        scenes = np.array([strip_edits(row["scene"]) for row in rows])
        which = np.clip(np.searchsorted(edges, ways, side="right") - 1, 0, len(edges) - 2)
        bins = [i for i in range(len(edges) - 1) if (which == i).any()]
        rates = [estimate_mean(reached[which == i], scenes[which == i].tolist(), SUCCESS) for i in bins]
        offset = 0.03 * span * (shift - (len(outcomes) - 1) / 2)
        x = [(edges[i] + edges[i + 1]) / 2 + offset for i in bins]
        y = [rate.value for rate in rates]
        bars = [[rate.value - rate.low for rate in rates], [rate.high - rate.value for rate in rates]]
        axes.errorbar(
            x,
            y,
            yerr=np.clip(bars, 0, None),
            color=colors[arm],
            marker="o",
            ms=6,
            lw=1.6,
            elinewidth=1,
            label=_label(arm),
        )
    axes.set_ylim(-3, 103)
    axes.set_ylabel("success rate, %")
    _draw_legend(axes)


def anytime_curve(found: Breakdown) -> Markup:
    """Plot the score within N primitives or decisions, with bands; blind answers dashed."""
    figure, axes = _make_figure()
    colors, cuts = arm_colors(list(found.estimates)), [int(key) for key in found.keys]
    blind = found.estimates.get(BLIND)
    _draw_bands(axes, found, colors)
    if blind is not None:
        level = blind[str(cuts[0])].value
        axes.plot([0, cuts[-1]], [level, level], color=colors[BLIND], lw=1.4, ls=(0, (4, 3)), label=BLIND)
        for arm, estimates in found.estimates.items():
            first = estimates[str(cuts[0])]
            if arm != BLIND and first.n == blind[str(cuts[0])].n:  # nothing is answered before anything is done
                axes.plot([0, cuts[0]], [level, first.value], color=colors[arm], lw=1.2, alpha=0.6)
    axes.set_ylim(-3, 103)
    axes.set_ylabel(f"{_name_score(found)}, %")
    _draw_legend(axes)
    return _render_svg(figure, "anytime-curve")


def anytime_differences(found: Breakdown) -> Markup:
    """Plot the gain in score over a base within N primitives or decisions, with bands."""
    figure, axes = _make_figure()
    _draw_bands(axes, found, arm_colors([found.base, *found.estimates]))
    axes.axhline(0, color=INK, lw=1, alpha=0.5)
    axes.set_ylabel(f"{_name_score(found)}, points")
    _draw_legend(axes)
    return _render_svg(figure, f"anytime-differences-{found.base}")


def _name_score(found: Breakdown) -> str:
    return "success rate" if found.metric.name == SUCCESS.name else found.metric.label.lower()


def _draw_bands(axes: Axes, found: Breakdown, colors: Mapping[str, str]) -> None:
    """Draw each arm's estimates over the cuts as a line with a band."""
    cuts = [int(key) for key in found.keys]
    for arm, estimates in found.estimates.items():
        if arm == BLIND:
            continue
        points = [(int(key), one) for key, one in estimates.items()]
        x, values = [cut for cut, _ in points], [one.value for _, one in points]
        bands = [one.low for _, one in points], [one.high for _, one in points]
        axes.fill_between(x, *bands, color=colors[arm], alpha=0.14, lw=0)
        axes.plot(x, values, "-o", color=colors[arm], lw=2, ms=5, label=_label(arm))
    axes.set_xlim(0, cuts[-1] * 1.03)
    axes.set_xticks([0, *cuts])
    axes.set_xlabel(found.cut_unit)


def _choose_text_color(color: str) -> str:
    """Return black or white, whichever stands out more from a colour."""
    linear = [((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
    luminance = float(np.dot(linear, (0.2126, 0.7152, 0.0722)))
    return "white" if 1.05 / (luminance + 0.05) >= 4.5 else "black"


def _fold(arm: str) -> str:
    """Return an arm's name on lines of at most `LONGEST_LINE` characters, broken after -, + and : where it can be, and
    of at most `LONGEST_WORD` wherever it is.
    """
    lines = [""]
    for piece in re.findall(r"[^-+:_]*[-+:_]?", arm):
        if lines[-1] and len(lines[-1]) + len(piece) > LONGEST_LINE:
            lines.append("")
        lines[-1] += piece
    return "\n".join(_break(line, LONGEST_WORD) for line in lines)


def _label(arm: str) -> str:
    """Return an arm's name for a legend, on several lines where it is longer than `LONGEST_LABEL`.

    matplotlib leaves out names that begin with an underscore.
    """
    shown = f" {arm}" if arm.startswith("_") else arm
    return shown if len(shown) <= LONGEST_LABEL else _break(shown, LABEL_LINE)


def _break(text: str, most: int) -> str:
    """Return a text on lines of at most `most` characters."""
    return "\n".join(text[begin : begin + most] for begin in range(0, max(1, len(text)), most))


def _make_figure(rows: Sequence[str] = ()) -> tuple[Figure, Axes]:
    """Return a plot, high enough for the names of arms beside its axis, if these are its `rows`."""
    lines = sum(_fold(arm).count("\n") + 1 for arm in rows)
    figure = Figure(figsize=(4.7, max(HEIGHT, 0.6 + LINE * lines)), layout="constrained")
    axes = figure.add_subplot()
    _style_axes(axes)
    return figure, axes


def _style_axes(axes: Axes) -> None:
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(INK)
    axes.spines["bottom"].set_alpha(0.3)
    axes.tick_params(colors=INK, length=0, labelsize=10)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.grid(axis="y", color=INK, alpha=0.08)
    axes.set_axisbelow(True)


def _measure_longest(texts: Sequence[str]) -> int:
    """Return the characters of the longest line of a legend's texts."""
    return max((len(line) for text in texts for line in text.split("\n")), default=0)


def _draw_legend(axes: Axes) -> None:
    texts = axes.get_legend_handles_labels()[1]
    if not texts:
        return
    longest = _measure_longest(texts)
    widest = 4 if longest < 11 else 2 if longest < 20 else 1  # columns that fit the drawing's width
    columns = math.ceil(len(texts) / math.ceil(len(texts) / widest))  # rows of about equal length
    broken = sum(text.count("\n") for text in texts)
    more = math.ceil(len(texts) / columns) + broken - LEGEND_ROWS
    if isinstance(figure := axes.figure, Figure):
        figure.set_figheight(figure.get_figheight() + LINE * max(0, more))
    axes.legend(frameon=False, labelcolor=INK, fontsize=9, ncols=columns, loc="lower left", bbox_to_anchor=(0, 1))


def _draw_on_white(figure: Figure, form: str, salt: str) -> bytes:
    """Return a figure as "svg" or "png"; `salt` makes ids in SVG."""
    buffer = io.BytesIO()
    metadata: dict[str, Any] = {"Date": None, "Creator": None} if form == "svg" else {"Software": None}
    _show_text_as_it_is(figure)
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": salt, "font.family": "sans-serif"}):
        figure.savefig(buffer, format=form, dpi=160, facecolor="white", metadata=metadata)
    return buffer.getvalue()


def _show_text_as_it_is(figure: Figure) -> None:
    """Draw dollar signs, which names of arms may have, instead of formulas between them."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def _render_svg(figure: Figure, name: str) -> Markup:
    buffer = io.StringIO()
    _show_text_as_it_is(figure)
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "font.family": "sans-serif"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = buffer.getvalue().replace(INK, "currentColor")
    drawing = re.sub(r"<metadata>.*?</metadata>|font-family: [^;]*; ", "", drawing[drawing.index("<svg") :], flags=re.S)
    return Markup(drawing)  # matplotlib escapes the text it draws
