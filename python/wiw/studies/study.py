# SPDX-License-Identifier: Apache-2.0
"""Run what a study's file lists, and show its tables and figures on one page (`wiw.studies.study_file`)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from wiw.analysis.costs import costs
from wiw.analysis.quality import QualityTable
from wiw.analysis.statistics import Difference, adjust_p_values
from wiw.analysis.statistics import compare as compare_arms
from wiw.analysis.stopping import find_units
from wiw.analysis.summary import select_metrics, split_outcomes
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.report.tables import SummaryTable, print_summary
from wiw.runs.rows import to_json
from wiw.studies.evaluate import run_arms
from wiw.studies.quality import quality, require_scorers
from wiw.studies.run_log import RunLog
from wiw.studies.study_file import StudyPlan, StudyRun, load_study

FILE = "study.yaml"
"""The study file with its variables filled in, in the study's folder."""


@dataclass(frozen=True)
class StudyPart:
    """The outcome of one run of a study."""

    run: StudyRun
    log: RunLog
    numbers: SummaryTable
    differences: tuple[Difference, ...]
    """Differences of the pairs that the study compares, Holm-adjusted over those of all its runs."""
    rollouts: Mapping[str, float]
    """Imagined futures per episode, by arm."""
    quality: QualityTable | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the numbers as plain values."""
        return {
            "run": self.run.name,
            "arms": [  # a line may be no arm's: the best guess from a question's text
                {**line, **({"rollouts": self.rollouts[arm]} if (arm := line["arm"]) in self.rollouts else {})}
                for line in self.log.table()
            ],
            "differences": [asdict(each) for each in self.differences],
            **({} if self.quality is None else {"quality": self.quality.as_dict()}),
        }


@dataclass(frozen=True)
class Study:
    """The result of `wiw.study`."""

    plan: StudyPlan
    parts: tuple[StudyPart, ...]
    out: Path
    """Folder of the study, which `save` writes into."""

    @property
    def invalid(self) -> tuple[str, ...]:
        """Reasons why runs must not be reported; empty for a valid study."""
        return tuple(f"{part.run.name}: {reason}" for part in self.parts for reason in part.numbers.invalid)

    def summary(self) -> None:
        """Print the tables of all runs."""
        from wiw.report.study_page import group_pairs

        for part in self.parts:
            heading = part.run.name if len(self.parts) > 1 else ""
            print_summary(part.numbers, heading, group_pairs(part.differences))

    def to_json(self) -> str:
        """Return the numbers as JSON."""
        values = {"title": self.plan.title, "variables": self.plan.variables, "runs": [p.as_dict() for p in self.parts]}
        return json.dumps(json.loads(to_json(values)), indent=2)

    def save(self) -> list[Path]:
        """Write study.html, study.json and an SVG file of each figure into `out`, and return their paths."""
        from wiw.report.study_page import write_study

        return write_study(self.plan, self.parts, self.to_json(), self.out)


def study(
    name: str | Path,
    *,
    out: str | Path | None = None,
    variables: Mapping[str, Any] | None = None,
    small: bool = False,
    workers: int = 1,
    progress: bool = True,
) -> Study:
    """Run a study: execute the runs listed in its file one after another, or what is missing of them.

        found = wiw.study("front-vs-panorama", small=True)
        found.summary()
        found.save()                       # study.html, study.json and figures

    A second call continues where the first one stopped. Runs and arms that were added to the file since are run as
    well; everything else must be unchanged. Rollouts of cacheable models and answers of language models are cached, so
    that no run repeats what another has computed.

    Args:
        name: name of a built-in study (`wiw list studies`), or the path of a YAML file.
        out: folder to write; by default runs/study-NAME, or runs/study-NAME-small with the small values.
        variables: values that override the file's.
        small: whether to use the file's small values.
        workers: number of processes; results do not depend on it.
        progress: whether to show progress bars.

    Raises:
        ArgumentError: no such study, or one that cannot be run; says where in the file the problem is.
        StoreError: the folder holds runs with other settings, or with arms that have changed or are now left out.
    """
    plan = load_study(name, variables, small)
    own = f"study-{Path(name).stem}{'-small' if small else ''}"
    folder = Path(out) if out is not None else Path("runs") / own
    for run in plan.runs:
        _require(run)
    if not (folder / FILE).exists():
        _write_plan(plan, folder)
    parts = _adjust([_run(run, folder, workers, progress) for run in plan.runs])
    _write_plan(plan, folder)  # only now: what is there stays where a run refuses other settings
    return Study(plan, parts, folder)


def _write_plan(plan: StudyPlan, folder: Path) -> None:
    with atomic_file(folder / FILE) as draft:
        draft.write_text(yaml.safe_dump(dict(plan.content), sort_keys=False, allow_unicode=True), encoding="utf-8")


def _require(run: StudyRun) -> None:
    """Check that a run can start, before spending time on any.

    Raises:
        Error: its task, its agents or the scorers of its frames cannot be.
    """
    task = run.task.build()
    count = task.default_episodes if run.settings.episodes is None else run.settings.episodes
    for arm, agent in run.agents.items():
        agent.describe()
        agent.require(task, count)
        if run.quality is not None and not agent.is_named:
            raise ArgumentError(
                f"study: {run.name}: arm '{arm}' is not a name; quality can only be measured on stored runs"
            )
    if run.quality is not None:
        require_scorers(**{name: value for name, value in run.quality.items() if name != "frames"})


def _run(run: StudyRun, folder: Path, workers: int, progress: bool) -> StudyPart:
    """Execute one run, or what is left of it, and measure what the study requires."""
    settings = replace(run.settings, out=folder / run.name, resume=True, workers=workers, progress=progress)
    log = run_arms(run.task, run.agents, more_arms=True, config=settings)
    imagined = {line.arm: line.calls.get("rows", 0.0) / line.episodes for line in costs(log) if line.episodes}
    table = None if run.quality is None else quality(log, **run.quality).table
    everyone = {arm: imagined.get(arm, 0.0) for arm in log.arms}
    return StudyPart(run, log, log.numbers(), _compare(run, log), everyone, table)


def _adjust(parts: Sequence[StudyPart]) -> tuple[StudyPart, ...]:
    """Return the parts with p-values adjusted for the pairs of all of them together."""
    adjusted = iter(adjust_p_values([each for part in parts for each in part.differences]))
    return tuple(replace(part, differences=tuple(next(adjusted) for _ in part.differences)) for part in parts)


def _compare(run: StudyRun, log: RunLog) -> tuple[Difference, ...]:
    """Return the differences of one run's pairs; p-values hold at any look, where the run is looked at early."""
    done, _ = split_outcomes(log.arms, log.store.outcomes())
    seed, looked_at = log.store.config["seed"], "until" in log.store.info
    units = find_units(log.store.episodes(), log.store.outcomes(), log.arms) if looked_at else None
    found = [
        compare_arms(arm, base, done, metric, seed, units)
        for arm, base in run.compare
        for metric in select_metrics(done)
    ]
    return tuple(each for each in found if each is not None)
