# SPDX-License-Identifier: Apache-2.0
"""Does a world model improve with data, or with updates? (paper, "Data scaling".)

The paper trains on 400 to 80,000 clips for one epoch each, so that more clips are also more updates. Here the sizes are
also trained for one epoch, for equally many updates, and on clips from fewer scenes. `data_scaling_plan` defines what
is measured and how it is judged, which is written to the study's folder before anything is trained.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wiw.analysis.data_scaling import ScalingTable, Success, summarise_scaling
from wiw.datasets.decisions import save_decisions
from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.networks import resolve_device
from wiw.policies.matcher.policy import SOURCE
from wiw.scenes import resolve
from wiw.studies.data_scaling_plan import (
    FULL,
    PRIMARY,
    SMALL,
    SMALL_SCENES,
    SMALL_SIZE,
    ScalingPlan,
    ScalingSettings,
    Training,
    choose_scenes,
    choose_sizes,
)
from wiw.studies.data_scaling_training import (
    DECISIONS,
    FRAMES,
    Measures,
    TrainingJob,
    create_recipe,
    list_scenes,
    load_material,
    measure_references,
)
from wiw.training.jobs import run_jobs
from wiw.training.launcher import require_single_process
from wiw.training.learners import make_learner
from wiw.training.post_training.corpora import NavigationCorpus, require_panoramas

PLAN, DATA = "plan.json", "data"
"""Names inside a study's folder."""
MEASURING = 60
"""Number of updates that take about as long as evaluating a model."""

Watch = Callable[[str, int, int, str], None]
"""Called with what is being done, how much is done, out of how much, and a text."""


@dataclass(frozen=True)
class DataScaling:
    """The result of `wiw.data_scaling`."""

    table: ScalingTable
    plan: ScalingPlan
    out: Path
    """Folder of the study, which `save` writes into."""

    def summary(self) -> None:
        """Print the tables and findings."""
        from wiw.report.data_scaling_tables import print_scaling

        print_scaling(self.table)

    def to_json(self) -> str:
        """Return the numbers as JSON."""
        from wiw.runs.rows import to_json

        return json.dumps(json.loads(to_json(self.table.as_dict())), indent=2)

    def save(self) -> list[Path]:
        """Write data-scaling.html, .svg, .png and .json into `out`, and return their paths."""
        from wiw.report.data_scaling_page import write_scaling

        return write_scaling(self.table, self.plan.describe(), self.to_json(), self.out)


def data_scaling(
    data: str | Path | None = None,
    out: str | Path = "runs/data-scaling",
    settings: ScalingSettings = FULL,
    *,
    workers: int = 1,
    episodes: int = 0,
    device: str | None = None,
    watch: Watch = lambda *_: None,
) -> DataScaling:
    """Train small world models on nested subsets of a dataset, evaluate them, and split the gain into data and updates.

        found = wiw.data_scaling("data", "runs/scaling", workers=2)
        found.summary()
        found.save()

    The same call continues where an earlier one was stopped; an unfinished training resumes from its last checkpoint.

    Args:
        data: folder of `wiw collect navigation`, with panoramas and depth; None collects 16 apartments at 128x256 into
            `out`.
        out: folder of the study.
        settings: sizes, models, seeds and what is measured; `wiw.studies.data_scaling_plan.SMALL` is the small version.
        workers: number of processes, each with one thread of the CPU.
        episodes: episodes of ImageNav in which to run the first seed's models as well; 0 for none.
        device: of torch, for training; "cuda" if there is one, else "cpu". Several workers share it.
        watch: called with progress.

    Raises:
        ArgumentError: a number out of range, no such device, a dataset with too few clips or scenes, a folder with
            another study, or several processes of torchrun.
        DependencyError: torch or pyarrow is not installed.
        FileError: the dataset is missing or damaged, or a file cannot be written.
        DeviceMemoryError: the device's memory does not suffice for so many workers.
        InfrastructureError: a worker process has died.
        TrainingError: a loss is not finite.
    """
    require_single_process("data-scaling", "start one, which has --workers")
    if workers < 1 or episodes < 0:
        raise ArgumentError(
            f"data-scaling: expected 1 worker or more and 0 episodes or more, got {workers} and {episodes}"
        )
    if data is None and settings.clips > SMALL.clips:
        raise ArgumentError(
            f"data-scaling: expected a dataset for {settings.clips:,} clips (--data DIR, of `wiw collect navigation`); "
            "only the small version collects its own (--small)"
        )
    for name in settings.models:  # fails before anything takes time
        create_recipe(make_learner(name), settings, settings.clips, 0)
    choose_sizes(settings.clips, settings.batch, settings.sizes)
    resolve(settings.decision_scenes)
    where = resolve_device(device)
    folder = Path(out)
    source = Path(data) if data is not None else _collect(folder, workers, watch)
    plan = make_plan(source, settings)
    write_plan(plan, folder)
    _prepare(plan, source, folder, watch)
    jobs = [TrainingJob(training, plan, source, folder, where) for training in plan.list_trainings()]
    measures = _run_trainings(jobs, workers, watch)
    material = load_material(source, folder, settings)
    references = measure_references(material.held_out, material.decisions)
    success = _run_imagenav(jobs, plan, folder, episodes, workers) if episodes else []
    table = summarise_scaling(plan.describe_arms(), _group_by_setting(measures), PRIMARY, references, success)
    return DataScaling(table, plan, folder)


def make_plan(data: Path, settings: ScalingSettings) -> ScalingPlan:
    """Return the plan of a study on a dataset.

    Raises:
        ArgumentError: the dataset has too few clips or scenes, or a scene of the decisions among those to train on.
        FileError: the dataset is missing, incomplete or damaged.
    """
    trained, held_out = (NavigationData(data, part, settings.held_out) for part in ("train", "held-out"))
    require_panoramas("data-scaling", NavigationCorpus(trained, "train"))
    if not trained.meta["config"]["depth"]:
        raise ArgumentError(
            f"data-scaling: expected a dataset with depth, got {data}, which has none; collect it without --no-depth"
        )
    if not len(held_out) or not len(trained):
        raise ArgumentError(
            f"data-scaling: expected scenes to train on and others held out, got {len(trained)} segments to train on "
            f"and {len(held_out)} held out; choose another share (--held-out), or collect more scenes"
        )
    _require_unseen(settings.decision_scenes, trained)
    clips = trained.clips(settings.length)
    if len(clips) < settings.clips:
        raise ArgumentError(
            f"data-scaling: expected {settings.clips} clips of {settings.length} frames in scenes to train on, got "
            f"{len(clips)}; collect more scenes, or use fewer clips (--clips {len(clips)})"
        )
    _, windows = np.unique(list_scenes(trained, clips), return_counts=True)
    sizes = choose_sizes(settings.clips, settings.batch, settings.sizes)
    scenes, fewer_clips = choose_scenes(windows.tolist(), sizes)
    return ScalingPlan(settings, trained.digest(), sizes, scenes, fewer_clips)


def _require_unseen(decision_scenes: str, trained: NavigationData) -> None:
    """Check that no decision is made in a scene that is trained on, whatever the edits of an apartment.

    Raises:
        ArgumentError: names such a scene.
    """
    seen = trained.find_shared(resolve(decision_scenes))
    if seen is not None:
        raise ArgumentError(
            f"data-scaling: expected decisions in scenes that are not trained on, got {seen}; choose others "
            "(--decision-scenes), such as apartments:val:40"
        )


def write_plan(plan: ScalingPlan, folder: Path) -> None:
    """Write the plan into a new folder, or check that the one there is the same.

    Raises:
        ArgumentError: the folder holds another study.
        FileError: the plan cannot be read or written.
    """
    path, asked = folder / PLAN, plan.describe()
    if not path.exists():
        with atomic_file(path) as draft:
            draft.write_text(json.dumps(asked, indent=2) + "\n", encoding="utf-8")
        return
    try:
        there = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise FileError(f"{path}: expected the plan of a study, got {error}; name another folder with --out") from error
    if differing := [name for name in {**asked, **there} if there.get(name) != asked.get(name)]:
        said = ", ".join(f"{name} was {there.get(name)}, now {asked.get(name)}" for name in differing)
        raise ArgumentError(
            f"{folder} holds a different study: {said}; repeat it with the same settings, or choose another with --out"
        )


def _collect(folder: Path, workers: int, watch: Watch) -> Path:
    """Collect the dataset of the small version, or what is missing of it."""
    from wiw.training.collect_navigation import collect_navigation

    def show(scene: str, done: int, total: int, frames: int) -> None:
        watch("scenes", done, total, f"{done}/{total}, {frames:,} frames")

    collect_navigation(folder / DATA, SMALL_SCENES, size=SMALL_SIZE, workers=workers, progress=show)
    return folder / DATA


def _prepare(plan: ScalingPlan, data: Path, folder: Path, watch: Watch) -> None:
    """Construct the decisions, and decode the frames once for all trainings."""
    from wiw.training.construct_decisions import DecisionRules, collect_decisions
    from wiw.training.reduced_frames import reduce_frames

    settings = plan.settings
    if not (folder / DECISIONS).exists():
        rules = DecisionRules(size=settings.size)
        found = collect_decisions(
            settings.decision_scenes,
            settings.decisions_per_scene,
            rules=rules,
            progress=lambda scene, done, total: watch("decisions", done, total, f"{done}/{total} scenes"),
        )
        save_decisions(folder / DECISIONS, found)

    def bar(segments: Iterable[Any], text: str, total: int) -> Iterator[Any]:
        for done, segment in enumerate(segments, 1):
            yield segment
            watch("frames", done, total, f"{done}/{total} segments")

    reduce_frames(NavigationData(data, "train", settings.held_out), settings.size, folder / FRAMES, bar)


def _run_trainings(jobs: Sequence[TrainingJob], workers: int, watch: Watch) -> dict[Training, Measures]:
    """Run unfinished trainings, and return the measures of all."""
    found = {job.training: measures for job in jobs if (measures := job.read_measures()) is not None}
    costs = {job.training: job.training.updates + MEASURING for job in jobs}
    before, began = sum(costs[training] for training in found), time.monotonic()
    pending = [job for job in jobs if job.training not in found]
    for job, measures in run_jobs(pending, workers):
        found[job.training] = measures
        done, total = sum(costs[training] for training in found), sum(costs.values())
        minutes = (time.monotonic() - began) / 60 * (total - done) / (done - before)
        watch("trainings", done, total, f"{len(found)}/{len(jobs)}, about {minutes:.0f} min left")
    return {job.training: found[job.training] for job in jobs}


def _group_by_setting(measures: Mapping[Training, Measures]) -> dict[str, list[Measures]]:
    """Return the measures of each training, in the order of its seeds."""
    found: dict[str, list[Measures]] = {}
    for training in sorted(measures, key=lambda each: each.seed):
        found.setdefault(training.setting, []).append(measures[training])
    return found


def _run_imagenav(
    jobs: Sequence[TrainingJob], plan: ScalingPlan, folder: Path, episodes: int, workers: int
) -> list[Success]:
    """Run the models of the first seed in closed loop on the same episodes, or continue with that.

    Arms without a scored episode are left out.
    """
    from wiw.loop.agent import Agent
    from wiw.studies.evaluate import evaluate

    log = evaluate(
        "imagenav",
        Agent("matcher", "copy"),
        episodes,
        arms={"none": "none", **name_arms(jobs, plan.settings.seeds[0])},
        out=folder / f"imagenav-{episodes}",
        resume=True,
        workers=workers,
        keep_images=0,
        seed=0,
    )
    arms = log.numbers().arms
    return [Success(line.name, line.estimates["success"]) for line in arms if "success" in line.estimates]


def name_arms(jobs: Sequence[TrainingJob], seed: int) -> dict[str, str]:
    """Return the world models of a seed as arms of a run, by their trainings' names.

    They draw panoramas no larger than the matcher reads, which takes a fraction of the time, or as their networks do
    where that is larger.
    """
    return {
        job.training.setting: f"{job.training.model}?weights={job.weights.absolute()}&size={_choose_arm_size(job.plan)}"
        for job in jobs
        if job.training.seed == seed
    }


def _choose_arm_size(plan: ScalingPlan) -> list[int]:
    return [max(sides) for sides in zip(SOURCE, plan.settings.size, strict=True)]
