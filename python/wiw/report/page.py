# SPDX-License-Identifier: Apache-2.0
"""The report: one page with tables, plots and a few episodes."""

from __future__ import annotations

import json
import math
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from wiw.analysis.blame import Blame, read_blame
from wiw.analysis.breakdowns import DECISIONS
from wiw.analysis.costs import cost_columns, costs
from wiw.analysis.fidelity import ArmFidelity, choose_columns, fidelity
from wiw.analysis.marks import BLIND
from wiw.analysis.statistics import Difference
from wiw.analysis.summary import ANOTHER_POLICY, WORLD_MODEL, Summary, list_columns, notes, show_p, summarise_run
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.metrics.metric import SPL_RULE
from wiw.report import plots
from wiw.report.episodes import make_title, read_stories, read_wording
from wiw.report.story import Album
from wiw.report.templating import environment, format_signed
from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.run import Run
from wiw.types import Wording

SCALES = (1.0, 0.85, 0.7, 0.6)
"""Sizes of pictures that are tried for a report of limited size; below the last, frames are hard to make out."""


def write_report(
    run: Run,
    path: Path,
    *,
    episodes: int | None = None,
    max_mb: float | None = None,
    remark: str = "",
    summary: Summary | None = None,
) -> Path:
    """Write a run's report and return its path.

    Args:
        run: to be reported.
        path: of the file.
        episodes: how many to show with pictures; all that kept them if not given.
        max_mb: most megabytes (10^6 bytes) of the file; pictures are made smaller, then episodes left out, until it
            fits.
        remark: sentence that the page shows below the result.
        summary: the run's numbers, where they are known already.

    Raises:
        ArgumentError: a number out of range, or less than the tables and plots take.
        FileError: the file cannot be written; what was there before is kept.
    """
    if episodes is not None and episodes < 0:
        raise ArgumentError(f"report: expected episodes of at least 0, got {episodes}")
    if max_mb is not None and not max_mb > 0:
        raise ArgumentError(f"report: expected max_mb above 0, got {max_mb}")
    findings = _gather_findings(run, summary)
    if max_mb is None:
        page = _render_page(run, findings, episodes, 1.0, remark)
    else:
        page = _render_within(run, findings, episodes, max_mb, remark)
    with atomic_file(path) as draft:
        draft.write_text(page, encoding="utf-8")
    return path


def _render_within(run: Run, findings: Mapping[str, Any], episodes: int | None, max_mb: float, remark: str) -> str:
    """Return the report with as many episodes, and then as large pictures, as `max_mb` megabytes hold."""

    def fits(page: str) -> bool:
        return len(page.encode()) <= max_mb * 10**6

    pictured = len(choose_pictured_episodes(run.store))
    most = pictured if episodes is None else min(episodes, pictured)
    count = bisect_left(
        range(1, most + 1), True, key=lambda each: not fits(_render_page(run, findings, each, SCALES[-1], remark))
    )  # the most that fit: each episode adds to the page
    if count > 0:
        return next(filter(fits, (_render_page(run, findings, count, scale, remark) for scale in SCALES)))
    bare = _render_page(run, findings, 0, 1.0, remark)
    if not fits(bare):
        size = len(bare.encode()) / 10**6
        raise ArgumentError(
            f"report: the tables and plots alone take {size:.2f} MB; expected a larger max_mb, got {max_mb}"
        )
    return bare


def render(run: Run, episodes: int | None = None, scale: float = 1.0, remark: str = "") -> str:
    """Return a run's report as self-contained HTML. All text from the run is escaped.

    Args:
        run: to be reported.
        episodes: how many to show with pictures; all that kept them if not given.
        scale: of the pictures of decisions.
        remark: sentence that the page shows below the result.
    """
    return _render_page(run, _gather_findings(run), episodes, scale, remark)


def _render_page(run: Run, findings: Mapping[str, Any], episodes: int | None, scale: float, remark: str) -> str:
    """Return the page with the findings, the episodes asked for and their pictures in this scale."""
    album = Album(scale)
    shown, maps = read_stories(run.store, run.arms, album, episodes)
    values = {"whole": Album.whole, "remark": remark, "stories": shown, "maps": maps, "pictures": album.pictures}
    return environment().get_template("page.html.j2").render(**findings, **values)


def _gather_findings(run: Run, summary: Summary | None = None) -> dict[str, Any]:
    """Return what the page shows whichever episodes have pictures: tables, plots and configuration."""
    summary, config, info = summary or summarise_run(run), run.store.config, run.store.info
    truths, ledger, blamed = fidelity(run), costs(run), read_blame(run.store)
    measured, paid = choose_columns(truths), cost_columns(ledger)
    words = read_wording(run.store)
    return {
        **_collect_common(summary),
        "title": make_title(run),
        "task": config["task"],
        "created": run.store.created,
        "version": f"{run.store.wiw_version}, benchmark {run.store.benchmark}",
        "words": words,
        "sentence": "" if summary.tiers else sentence(summary, words),
        "tiers": [{**tier, "sentence": sentence(tier["summary"], words)} for tier in _list_tiers(summary)],
        "terms": explain_metrics(summary, words),
        "plots": _draw_plots(run, summary, truths, blamed),
        "costs": [(line, line.cells(paid)) for line in ledger],
        "cost_columns": paid,
        "fidelity": [(line, line.cells(measured)) for line in truths],
        "fidelity_columns": [(column.title, column.about) for column in measured],
        "blame": blamed.arms if blamed else (),
        "reruns": blamed.scheme.reruns if blamed else {},
        "verdicts": blamed.scheme.verdicts if blamed else {},
        "blame_notes": blamed.notes() if blamed else [],
        "errors": [row for row in run.episodes if row["status"] == "error"],
        "radius": config["task"].get("radius"),
        "config": json.dumps(config, indent=2, ensure_ascii=False),
        "platform": json.dumps(info["platform"], indent=2, ensure_ascii=False),
        "command": " ".join(info["command"]),
    }


def summary_html(summary: Summary) -> str:
    """Return the tables alone, for Jupyter."""
    return environment().get_template("summary.html.j2").render(**list_table_values(summary))


def list_table_values(summary: Summary, more: Sequence[Difference] = ()) -> dict[str, Any]:
    """Return what the macros for tables take; `more` are differences that are shown besides the summary's."""
    reach = _reach([*summary.differences, *more])
    return {**_collect_common(summary), "reach": reach, "tiers": _list_tiers(summary)}


def _list_tiers(summary: Summary) -> list[dict[str, Any]]:
    return [{**_collect_common(own), "name": tier} for tier, own in summary.tiers.items()]


def sentence(summary: Summary, words: Wording | None = None) -> str:
    """Return the result in a few sentences that claim no more than the adjusted tests support."""
    judged = [line for line in summary.arms if "success" in line.estimates and line.name != "none"]
    models, policies = ([line for line in judged if line.role == role] for role in (WORLD_MODEL, ANOTHER_POLICY))
    shown = models or policies[-1:]
    parts = []
    for line in shown[:3]:
        share = line.estimates["success"].value
        count = f"{line.scored_of_total} episode{'' if line.scored_of_total == '1' else 's'}"
        rate = f"With {line.name}, the agent succeeded in {share:.1f} % of {count}"
        found = (_find_difference(summary, line.name, "none", metric) for metric in ("success", "actions"))
        base = "without a world model" if line.role == WORLD_MODEL else "none"
        parts.append(rate + _describe_gain(next(found), base) + _describe_actions(next(found), words or Wording()))
    return " ".join(parts)


def explain_metrics(summary: Summary, words: Wording) -> list[tuple[str, str]]:
    """Return what each column of the table of arms means in this task, and who gave the marks if there are any."""
    own = {
        "success": f"Success rate: percent of episodes that {words.succeeded}.",
        "spl": f"Success weighted by path length. {SPL_RULE}",
        "actions": f"Mean number of executed {words.steps}.",
        "refused": "Mean number of gripper motions that ended early: out of reach, or blocked.",
    }
    if summary.marks is not None:
        own["spl"] = (
            "Score weighted by path length: the score times the shortest walk to where the answer can be seen, over "
            "metres walked."
        )
    found = []
    for metric in list_columns(summary):
        name = f"{metric.label} ({metric.paper_name} in the paper)" if metric.paper_name else metric.label
        found.append((name, own.get(metric.name, metric.about)))
    if summary.marks is not None:
        found.append(
            ("Judge", f"{summary.marks.judge.full_label}: gave each answer a mark from 1 (wrong) to 5 (right).")
        )
    if summary.baselines:
        found.append((BLIND, "The most frequent answer to such a question in train scenes, given without looking."))
    return found


def _describe_gain(difference: Difference | None, base: str) -> str:
    if difference is None:
        return "."
    found = difference.estimate
    against = f"{abs(found.value):.1f} points {'more' if found.value >= 0 else 'fewer'} than {base}"
    interval = f"95 % interval {format_signed(found.low)} to {format_signed(found.high)}"
    if difference.is_shown:
        return f", {against} ({interval})."
    return f", {against} ({interval}, p {show_p(difference.p_adjusted)}: no evidence of a difference)."


def _describe_actions(difference: Difference | None, words: Wording) -> str:
    """Return the difference in actions, if the adjusted test finds one."""
    if difference is None or not difference.is_shown:
        return ""
    found = difference.estimate
    kind = "more" if found.value > 0 else "fewer"
    interval = f"{format_signed(found.low)} to {format_signed(found.high)}"
    return f" It took {abs(found.value):.1f} {kind} {words.steps} ({interval})."


def _find_difference(summary: Summary, arm: str, base: str, metric: str) -> Difference | None:
    wanted = (arm, base, metric)
    return next((d for d in summary.differences if (d.arm, d.base, d.metric) == wanted), None)


def _collect_common(summary: Summary) -> dict[str, Any]:
    return {
        "summary": summary,
        "metrics": list_columns(summary),
        "notes": notes(summary),
        "groups": summary.groups(),
        "utilities": {found.arm: found for found in summary.utilities},
        "utility_ends": _find_utility_ends(summary),
        "colors": plots.arm_colors([line.name for line in summary.lines]),
        "reach": _reach(summary.differences),
    }


def _find_utility_ends(summary: Summary) -> tuple[float, float]:
    """Return the ends of the utility scale: at least [0, 1], and wide enough for all arms within [-1, 2]."""
    shown = [found for found in summary.utilities if found.is_defined]
    low = min([0.0, *(max(-1.0, found.low) for found in shown), *(found.value for found in shown)])
    return low, max([1.0, *(min(2.0, found.high) for found in shown), *(found.value for found in shown)])


def _reach(differences: Sequence[Difference]) -> dict[str, float]:
    """Return the largest end of an interval per metric, so that all bars share a scale."""
    reach: dict[str, float] = {}
    for difference in differences:
        ends = [abs(end) for end in (difference.estimate.low, difference.estimate.high) if not math.isnan(end)]
        reach[difference.metric] = max([reach.get(difference.metric, 1e-9), *ends])
    return reach


def _draw_plots(
    run: Run, summary: Summary, truths: Sequence[ArmFidelity], blamed: Blame | None
) -> list[tuple[str, str, Markup]]:
    """Return title, explanation and drawing of each plot."""
    done: dict[str, list[Mapping[str, Any]]] = {
        arm: [row for row in run.episodes if row["arm"] == arm and row["status"] == "done"] for arm in run.arms
    }
    if not any(rows and "success" in rows[0]["metrics"] for rows in done.values()):
        return []
    words = read_wording(run.store)
    found = _plot_anytime_curves(summary)
    about = "Bars are 95 % intervals; dashed lines mark the floor (copy) and the oracle."
    found.append(("Success by arm", about, plots.success_by_arm(summary)))
    ways = {arm: [row for row in rows if row["geodesic"] is not None] for arm, rows in done.items()}
    if any(ways.values()):
        about = "Do longer paths benefit more from the world model?"
        if plots.shows_single_outcomes(ways):
            about += f" One circle per episode; filled: {words.won}, hollow: {words.lost}."
        found.append(("Success by distance", about, plots.success_by_distance(ways, words)))
    truths = [line for line in truths if "success" in summary[line.arm].estimates]
    if sum(not math.isnan(line.rank) for line in truths) > 1:
        about = "Does an arm that ranks plans correctly also succeed? Kendall's tau against the true futures."
        found.append(("Rank agreement and success", about, plots.success_by_rank(truths, summary)))
    if blamed is not None and any(line.episodes for line in blamed.arms):
        about = "Failures by the stage whose ground truth turns them into successes."
        found.append(("Stage to blame", about, plots.blame_by_arm(blamed)))
    return found


def _plot_anytime_curves(summary: Summary) -> list[tuple[str, str, Markup]]:
    """Return title, explanation and drawing of the anytime curve and of each paired difference, if there are any."""
    found = []
    for curve in summary.breakdowns:
        if curve.name == "anytime":
            about = "Score if every episode had been cut off there; bands are 95 % intervals."
            if BLIND in curve.estimates:
                about += " Dashed: the best guess from the question's text, which counts if nothing is answered."
            title = "Success by decisions" if curve.cut_unit == DECISIONS else "Score by budget"
            found.append((title, about, plots.anytime_curve(curve)))
        elif curve.name == "anytime_differences":
            about = "Paired by episode, if every episode had been cut off there; bands are 95 % intervals."
            found.append((f"Gain over {curve.base} by budget", about, plots.anytime_differences(curve)))
    return found
