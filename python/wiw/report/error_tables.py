# SPDX-License-Identifier: Apache-2.0
"""A study of errors as tables and sentences, for the terminal and for the page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.text import Text

from wiw.analysis.errors import CEILING, METRES, PSNR, STEP, Cost, CostGap, ErrorLine, ErrorTable
from wiw.analysis.statistics import LEVEL, Difference, Estimate
from wiw.analysis.summary import show_estimate, show_p
from wiw.experiments.errors.kinds import ERRORS
from wiw.report.quality_tables import RANK_TITLES, show_rank
from wiw.report.tables import ROOMY, print_stacked, show_count

ABOUT: Mapping[str, str] = {
    "minus oracle": "Paired difference from the same agent with true futures, in points.",
    "p": "Test of this difference over scenes, Holm-adjusted over all arms.",
    "minus none": "Paired difference from the agent without imagination: what is left of the gain of foresight.",
    "p (none)": "Test of this difference over scenes, Holm-adjusted over all arms; of the oracle on its own.",
    "regret": "The reviser's score of the best true future minus that of the chosen plan's, minus the oracle's.",
    "n": "Episodes that are scored in the arm and in the oracle.",
    "n (regret)": "Episodes in which regret was measured in both; of costs, in all arms of the family.",
    "mean traj": "Executed actions per episode, in question answering metres, minus the oracle's.",
    "1 - SSIM": "Dissimilarity of imagined and true frames, as the reviser sees them.",
    "LPIPS": "Perceptual distance of imagined and true views of 256x256 pixels.",
    "PSNR": "PSNR of imagined and true frames, dB; 100 for equal ones.",
    "metres": "Distance of the imagined camera, or gripper, from its true place.",
}
COST_TITLES = ("points lost", "p", "regret", "n (regret)", "arms")
GAP_TITLES = ("points", "p", "regret", "n (regret)")


def list_titles(table: ErrorTable) -> list[str]:
    """Return the titles of the table of arms."""
    return [
        table.label,
        "minus oracle",
        "p",
        "minus none",
        "p (none)",
        "n",
        "regret",
        "n (regret)",
        "mean traj",
        *_list_measures(table),
    ]


def list_lines(table: ErrorTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of each arm, under `list_titles`."""
    return [
        *((arm, _show_reference(arm, found, table)) for arm, found in table.references.items()),
        *((line.arm, _show_line(line, table)) for line in table.lines),
    ]


def list_costs(table: ErrorTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of what each family costs, under `COST_TITLES`."""
    return [
        (
            f"{each.family}, per {_name_step(each.measure)}",
            [
                show_estimate(each.loss),
                show_p(each.p_adjusted),
                _show(each.regret),
                _count(each.regret),
                f"{each.arms}",
            ],
        )
        for each in table.costs
    ]


def list_gaps(table: ErrorTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of the differences between families, under `GAP_TITLES`."""
    return [
        (
            f"{each.family} - {each.base}, per {_name_step(each.measure)}",
            [show_estimate(each.loss, signed=True), show_p(each.p_adjusted), _show(each.regret), _count(each.regret)],
        )
        for each in table.gaps
    ]


def list_correlations(table: ErrorTable) -> list[tuple[str, list[str]]]:
    """Return name and cells of how each measure orders the arms by the outcome, under `RANK_TITLES`."""
    return [(each.measure, show_rank(each)) for each in table.correlations]


def describe_doses(tables: Sequence[ErrorTable]) -> list[tuple[str, str, str]]:
    """Return kind, unit and meaning of each error."""
    kinds = dict.fromkeys(line.kind for table in tables for line in table.lines)
    return [(kind, ERRORS[kind].unit, ERRORS[kind].about) for kind in kinds]


def explain(table: ErrorTable) -> list[str]:
    """Return what a task's numbers say, in sentences."""
    gain = table.gain
    found = []
    if gain is not None:
        sure = "" if gain.p_value <= LEVEL else ", which may be chance: little can be lost where little was gained"
        found.append(f"True futures gain {show_estimate(gain.estimate, signed=True)} points over none{sure}.")
    costs = [each for each in table.costs if each.measure == table.distance]
    found += [_describe_cost(each, table.label) for each in costs]
    found += [_describe_gap(each) for each in table.gaps if each.measure == table.distance]
    found += [_describe_cost(each, table.label) for each in table.costs if each.measure == METRES]
    if lost := [line for line in table.lines if _is_loss(line)]:
        found.append(
            "Significantly below the oracle, adjusted for all arms: " + ", ".join(line.arm for line in lost) + "."
        )
    else:
        found.append("No single arm is significantly below the oracle, adjusted for all arms.")
    found += _describe_over_none(table)
    if table.left_out:
        found.append(f"Left out, as they make no sense in {table.task}: {', '.join(table.left_out)}.")
    found.append(
        f"{table.episodes} episodes in {table.scenes} scenes, policy {table.policy}; costs are over episodes scored in "
        "all of their arms. Intervals: 95 %, over scenes. A cost assumes that losses are proportional to distance."
    )
    return found


def print_errors(tables: Sequence[ErrorTable]) -> None:
    """Print all tables and what they say."""
    console = Console()
    console = Console(width=None if console.is_terminal else max(console.width, ROOMY))
    for table in tables:
        for title, titles, rows, heading in (
            (f"{table.task}: errors of known doses", list_titles(table), list_lines(table), "arm"),
            ("Cost of each family of errors", COST_TITLES, list_costs(table), "family"),
            ("Differences between families", GAP_TITLES, list_gaps(table), "families"),
            (f"Rank correlation with {table.label} over arms", RANK_TITLES, list_correlations(table), "measure"),
        ):
            print_stacked(title, [name for name, _ in rows], titles, [cells for _, cells in rows], heading)
        for line in explain(table):
            console.print(Text(line, style="dim"))


def _list_measures(table: ErrorTable) -> list[str]:
    known = {name for line in table.lines for name in line.measures}
    return [name for name in (table.distance, PSNR, METRES) if name in known]


def _show_reference(arm: str, outcome: Estimate, table: ErrorTable) -> list[str]:
    """Return the cells of none or the oracle, of which only the oracle is compared with none."""
    cells = [show_estimate(outcome), *[""] * (len(list_titles(table)) - 1)]
    if arm == CEILING:
        cells[3:5] = _show_over_none(table.gain)
    return cells


def _show_over_none(found: Difference | None) -> list[str]:
    """Return the cells of a difference from none and its p; the oracle's is a single test, which nothing adjusts."""
    if found is None:
        return ["–", "–"]
    return [
        show_estimate(found.estimate, signed=True),
        show_p(found.p_value if found.arm == CEILING else found.p_adjusted),
    ]


def _show_line(line: ErrorLine, table: ErrorTable) -> list[str]:
    forms = {PSNR: ".1f"}
    measures = [
        f"{line.measures[name].value:{forms.get(name, '.3f')}}" if name in line.measures else "–"
        for name in _list_measures(table)
    ]
    return [
        show_estimate(line.outcome),
        show_estimate(line.loss.estimate, signed=True),
        show_p(line.loss.p_adjusted),
        *_show_over_none(line.over_none),
        f"{line.loss.estimate.n}",
        _show_difference(line.regret, ".3f"),
        _count(line.regret.estimate if line.regret else None),
        _show_difference(line.trajectory, ".1f"),
        *measures,
    ]


def _count(found: Estimate | None) -> str:
    """Return the episodes that an estimate is over."""
    return "–" if found is None else f"{found.n}"


def _show_difference(found: Difference | None, form: str) -> str:
    return "–" if found is None else _show(found.estimate, form)


def _show(found: Estimate | None, form: str = ".3f") -> str:
    """Return e.g. "+0.041 [0.012, 0.070]"; "–" where it is not known, "[?]" for one episode's interval."""
    if found is None or math.isnan(found.value):
        return "–"
    interval = "[?]" if math.isnan(found.low) else f"[{found.low:{form}}, {found.high:{form}}]"
    return f"{found.value:+{form}} {interval}"


def _name_step(measure: str) -> str:
    return f"{STEP:g} m" if measure == METRES else f"{STEP:g} in {measure}"


def _is_loss(line: ErrorLine) -> bool:
    return line.loss.is_shown and line.loss.estimate.value < 0


def _describe_cost(found: Cost, label: str) -> str:
    sure = "" if found.is_shown else ": this may be chance"
    return (
        f"Errors of {found.family} cost {show_estimate(found.loss)} points of {label} per {_name_step(found.measure)} "
        f"({show_count(found.arms, 'arm')}; p {show_p(found.p_adjusted)}, adjusted for all costs)"
        f"{sure}."
    )


def _describe_over_none(table: ErrorTable) -> list[str]:
    """Return which arms are surely better, and which worse, than no imagination at all."""
    shown = [
        (line.arm, line.over_none.estimate.value) for line in table.lines if line.over_none and line.over_none.is_shown
    ]
    above, below = [arm for arm, value in shown if value > 0], [arm for arm, value in shown if value < 0]
    return [
        f"Significantly {side} none, adjusted for all arms: {', '.join(arms)}."
        for side, arms in (("above", above), ("below", below))
        if arms
    ] or ["No arm is significantly above or below none, adjusted for all arms."]


def _describe_gap(found: CostGap) -> str:
    if not found.is_shown:
        verdict = "undecided"
    else:
        verdict = f"{found.family if found.loss.value > 0 else found.base} costs more"
    return (
        f"At equal distance, {found.family} minus {found.base}: {show_estimate(found.loss, signed=True)} points per "
        f"{_name_step(found.measure)} (p {show_p(found.p_adjusted)}, adjusted for all pairs): {verdict}."
    )
