# SPDX-License-Identifier: Apache-2.0
"""Gathers what the page shows and fills the template."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from wiw.analysis.blame import SWAPS, VERDICTS, Blame, blame
from wiw.analysis.costs import cost_columns, costs
from wiw.analysis.fidelity import ArmFidelity, fidelity, shown_columns
from wiw.analysis.statistics import Difference
from wiw.analysis.summary import Summary, notes, shown_headlines, summarise_run
from wiw.files import whole_file
from wiw.report import plots
from wiw.report.episodes import stories, wording
from wiw.report.story import Album
from wiw.report.templating import environment, signed
from wiw.runs.run import Run
from wiw.types import Wording


def write_report(run: Run, path: Path) -> Path:
    """Writes a run's report.

    Raises:
        FileError: the file cannot be written; what was there before is kept.
    """
    page = render(run)
    with whole_file(path) as draft:
        draft.write_text(page, encoding="utf-8")
    return path


def render(run: Run) -> str:
    """A run's report as HTML, without anything outside the page. All text from the run is escaped."""
    summary, config, info = summarise_run(run), run.store.config, run.store.info
    told, pictures = stories(run.store, run.arms)
    truths, ledger, blamed = fidelity(run), costs(run), blame(run.store)
    measured, paid = shown_columns(truths), cost_columns(ledger)
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
            stories=told,
            pictures=pictures,
            costs=[(line, line.cells()[: len(paid)]) for line in ledger],
            cost_columns=paid,
            fidelity=[(line, line.cells(measured)) for line in truths],
            fidelity_columns=[(column.title, column.about) for column in measured],
            blame=blamed.arms if blamed else (),
            swaps=list(SWAPS),
            verdicts=VERDICTS,
            blame_notes=blamed.notes() if blamed else [],
            failures=[row for row in run.episodes if row["status"] == "failed"],
            radius=config["task"].get("radius"),
            config=json.dumps(config, indent=2, ensure_ascii=False),
            platform=json.dumps(info["platform"], indent=2, ensure_ascii=False),
            command=" ".join(info["command"]),
        )
    )


def summary_html(summary: Summary) -> str:
    """The tables alone, for Jupyter."""
    return environment().get_template("summary.html.j2").render(**_common(summary))


def sentence(summary: Summary, words: Wording | None = None) -> str:
    """What the run shows, in a few sentences that claim no more than the intervals bear."""
    judged = [line for line in summary.arms if "success" in line.estimates and line.name != "none"]
    shown = [line for line in judged if line.role == "world model"] or judged[-1:]
    parts = []
    for line in shown[:3]:
        share = line.estimates["success"].value
        rate = f"With {line.name}, the agent succeeded in {share:.1f} % of {line.judged} episodes"
        found = (_found(summary, line.name, "none", metric) for metric in ("success", "actions"))
        parts.append(rate + _verdict(next(found)) + _way(next(found), words or Wording()))
    return " ".join(parts)


def _verdict(difference: Difference | None) -> str:
    if difference is None:
        return "."
    found = difference.estimate
    against = f"{abs(found.value):.1f} points {'more' if found.value >= 0 else 'fewer'} than without a world model"
    interval = f"95 % interval {signed(found.low)} to {signed(found.high)}"
    if found.excludes_zero:
        return f", {against} ({interval})."
    return f", {against}; with so few episodes that may be chance ({interval})."


def _way(difference: Difference | None, words: Wording) -> str:
    """What it took, if it differs."""
    if difference is None or not difference.estimate.excludes_zero:
        return ""
    found = difference.estimate
    kind = "more" if found.value > 0 else "fewer"
    return f" It took {abs(found.value):.1f} {words.steps} {kind} ({signed(found.low)} to {signed(found.high)})."


def _found(summary: Summary, arm: str, base: str, metric: str) -> Difference | None:
    wanted = (arm, base, metric)
    return next((d for d in summary.differences if (d.arm, d.base, d.metric) == wanted), None)


def _common(summary: Summary) -> dict[str, Any]:
    return {
        "summary": summary,
        "headlines": shown_headlines(summary),
        "notes": notes(summary),
        "groups": summary.groups(),
        "utilities": {found.arm: found for found in summary.utilities},
        "utility_ends": _utility_ends(summary),
        "colors": plots.arm_colors([line.name for line in summary.arms]),
        "reach": _reach(summary.differences),
    }


def _utility_ends(summary: Summary) -> tuple[float, float]:
    """From floor to ceiling, or as far as any arm, so that all bars share a scale; intervals are cut at -1 and 2."""
    shown = [found for found in summary.utilities if found.identifiable]
    low = min([0.0, *(max(-1.0, found.low) for found in shown), *(found.value for found in shown)])
    return low, max([1.0, *(min(2.0, found.high) for found in shown), *(found.value for found in shown)])


def _reach(differences: Sequence[Difference]) -> dict[str, float]:
    """For each metric the largest end of an interval, so that all bars share a scale."""
    reach: dict[str, float] = {}
    for difference in differences:
        ends = [abs(end) for end in (difference.estimate.low, difference.estimate.high) if not math.isnan(end)]
        reach[difference.metric] = max([reach.get(difference.metric, 1e-9), *ends])
    return reach


def _plots(
    run: Run, summary: Summary, truths: Sequence[ArmFidelity], blamed: Blame | None
) -> list[tuple[str, str, Markup]]:
    """Title, explanation and drawing of each plot."""
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
        about = "Do longer ways need the world model more?"
        found.append(("Success by distance", about, plots.success_by_distance(ways, words)))
    if budget:
        about = "How soon episodes succeed."
        found.append(("Decisions to success", about, plots.decisions_to_success(done, budget, words)))
    if sum(not math.isnan(line.rank) for line in truths) > 1:
        about = "Does the arm that orders plans rightly also succeed? Kendall's tau against the true futures."
        found.append(("Controllability and success", about, plots.success_by_rank(truths, summary)))
    if blamed is not None and any(line.episodes for line in blamed.arms):
        about = "Failed episodes by the stage that has to be told the truth to mend them."
        found.append(("Which stage is to blame", about, plots.blame_by_arm(blamed)))
    return found
