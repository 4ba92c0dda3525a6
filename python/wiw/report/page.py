# SPDX-License-Identifier: Apache-2.0
"""The report: one page with tables, plots and a few episodes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from wiw.analysis.blame import RERUNS, VERDICTS, Blame, read_blame
from wiw.analysis.costs import cost_columns, costs
from wiw.analysis.fidelity import ArmFidelity, choose_columns, fidelity
from wiw.analysis.statistics import Difference
from wiw.analysis.summary import Summary, list_columns, notes, summarise_run
from wiw.files import atomic_file
from wiw.report import plots
from wiw.report.episodes import read_stories, wording
from wiw.report.story import Album
from wiw.report.templating import environment, format_signed
from wiw.runs.run import Run
from wiw.types import Wording


def write_report(run: Run, path: Path) -> Path:
    """Write a run's report and return its path.

    Raises:
        FileError: the file cannot be written; what was there before is kept.
    """
    page = render(run)
    with atomic_file(path) as draft:
        draft.write_text(page, encoding="utf-8")
    return path


def render(run: Run) -> str:
    """Return a run's report as self-contained HTML. All text from the run is escaped."""
    summary, config, info = summarise_run(run), run.store.config, run.store.info
    album = Album()
    shown, maps = read_stories(run.store, run.arms, album)
    truths, ledger, blamed = fidelity(run), costs(run), read_blame(run.store)
    measured, paid = choose_columns(truths), cost_columns(ledger)
    return (
        environment()
        .get_template("page.html.j2")
        .render(
            **_common(summary),
            title=f"{config['task'].get('task', 'run')} · {run.path.name}",
            task=config["task"],
            created=run.store.created,
            version=run.store.wiw_version,
            words=wording(run.store),
            whole=Album.whole,
            sentence=sentence(summary, wording(run.store)),
            plots=_plots(run, summary, truths, blamed),
            stories=shown,
            maps=maps,
            pictures=album.pictures,
            costs=[(line, line.cells()[: len(paid)]) for line in ledger],
            cost_columns=paid,
            fidelity=[(line, line.cells(measured)) for line in truths],
            fidelity_columns=[(column.title, column.about) for column in measured],
            blame=blamed.arms if blamed else (),
            reruns=list(RERUNS),
            verdicts=VERDICTS,
            blame_notes=blamed.notes() if blamed else [],
            errors=[row for row in run.episodes if row["status"] == "error"],
            radius=config["task"].get("radius"),
            config=json.dumps(config, indent=2, ensure_ascii=False),
            platform=json.dumps(info["platform"], indent=2, ensure_ascii=False),
            command=" ".join(info["command"]),
        )
    )


def summary_html(summary: Summary) -> str:
    """Return the tables alone, for Jupyter."""
    return environment().get_template("summary.html.j2").render(**_common(summary))


def sentence(summary: Summary, words: Wording | None = None) -> str:
    """Return the result in a few sentences that claim no more than the intervals support."""
    judged = [line for line in summary.arms if "success" in line.estimates and line.name != "none"]
    shown = [line for line in judged if line.role == "world model"] or judged[-1:]
    parts = []
    for line in shown[:3]:
        share = line.estimates["success"].value
        rate = f"With {line.name}, the agent succeeded in {share:.1f} % of {line.scored_of_total} episodes"
        found = (_find_difference(summary, line.name, "none", metric) for metric in ("success", "actions"))
        parts.append(rate + _describe_gain(next(found)) + _describe_actions(next(found), words or Wording()))
    return " ".join(parts)


def _describe_gain(difference: Difference | None) -> str:
    if difference is None:
        return "."
    found = difference.estimate
    against = f"{abs(found.value):.1f} points {'more' if found.value >= 0 else 'fewer'} than without a world model"
    interval = f"95 % interval {format_signed(found.low)} to {format_signed(found.high)}"
    if found.excludes_zero:
        return f", {against} ({interval})."
    return f", {against}; the interval includes 0 ({interval})."


def _describe_actions(difference: Difference | None, words: Wording) -> str:
    """Return the difference in actions, if its interval excludes 0."""
    if difference is None or not difference.estimate.excludes_zero:
        return ""
    found = difference.estimate
    kind = "more" if found.value > 0 else "fewer"
    interval = f"{format_signed(found.low)} to {format_signed(found.high)}"
    return f" It took {abs(found.value):.1f} {kind} {words.steps} ({interval})."


def _find_difference(summary: Summary, arm: str, base: str, metric: str) -> Difference | None:
    wanted = (arm, base, metric)
    return next((d for d in summary.differences if (d.arm, d.base, d.metric) == wanted), None)


def _common(summary: Summary) -> dict[str, Any]:
    return {
        "summary": summary,
        "metrics": list_columns(summary),
        "notes": notes(summary),
        "groups": summary.groups(),
        "utilities": {found.arm: found for found in summary.utilities},
        "utility_ends": _utility_ends(summary),
        "colors": plots.arm_colors([line.name for line in summary.arms]),
        "reach": _reach(summary.differences),
    }


def _utility_ends(summary: Summary) -> tuple[float, float]:
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


def _plots(
    run: Run, summary: Summary, truths: Sequence[ArmFidelity], blamed: Blame | None
) -> list[tuple[str, str, Markup]]:
    """Return title, explanation and drawing of each plot."""
    done: dict[str, list[Mapping[str, Any]]] = {
        arm: [row for row in run.episodes if row["arm"] == arm and row["status"] == "done"] for arm in run.arms
    }
    if not any(rows and "success" in rows[0]["metrics"] for rows in done.values()):
        return []
    words = wording(run.store)
    budget = int(max(row["metrics"].get("decisions", 0) for rows in done.values() for row in rows))
    found = [
        (
            "Success by arm",
            "Bars are 95 % intervals; dashed lines mark floor (copy) and ceiling (oracle).",
            plots.success_by_arm(summary),
        ),
    ]
    ways = {arm: [row for row in rows if row["geodesic"] is not None] for arm, rows in done.items()}
    if any(ways.values()):
        about = "Do longer paths need the world model more?"
        found.append(("Success by distance", about, plots.success_by_distance(ways, words)))
    if budget:
        about = "Share of episodes that have succeeded after a number of decisions."
        found.append(("Decisions to success", about, plots.decisions_to_success(done, budget, words)))
    if sum(not math.isnan(line.rank) for line in truths) > 1:
        about = "Does an arm that ranks plans correctly also succeed? Kendall's tau against the true futures."
        found.append(("Rank agreement and success", about, plots.success_by_rank(truths, summary)))
    if blamed is not None and any(line.episodes for line in blamed.arms):
        about = "Failures by the stage whose ground truth turns them into successes."
        found.append(("Stage to blame", about, plots.blame_by_arm(blamed)))
    return found
