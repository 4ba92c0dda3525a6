# SPDX-License-Identifier: Apache-2.0
"""Collect demonstrations of manipulation tasks by experts that know all object poses, as training data.

Each demonstration is a pure function of the seed, its task and its number, and a file gets its name once it is
complete. An interrupted collection can therefore be resumed, and ends with the same files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

import wiw
from wiw.datasets import shards
from wiw.datasets.demonstrations import Demonstrations, read_manifest, shard_paths, shard_range
from wiw.errors import ArgumentError, FileError
from wiw.ray_cluster import HERE, Engine
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import CAMERAS, WRIST
from wiw.training.jobs import open_folder, run_jobs
from wiw.training.recording import Collection, read_collection, record_demonstration

Progress = Callable[[str, int, int, int], None]
"""Called with the task, how many of its demonstrations are done, of how many, and the number of tables failed at."""


def collect(
    out: str | Path,
    tasks: str | Sequence[str] = "all",
    *,
    workers: int = 1,
    place: Engine = HERE,
    progress: Progress | None = None,
    **asked: Any,
) -> Demonstrations:
    """Let experts perform manipulation tasks and record what the cameras see; resume an interrupted collection.

    Args:
        out: a new folder, or one that the same call started.
        tasks: "all", or names of `wiw.tabletop.tasks.TABLETOP_TASKS`.
        workers: number of processes; the files do not depend on it.
        place: where they run: on this machine, or as tasks on a Ray cluster whose machines all see the folder.
        progress: called whenever a file is complete.
        **asked: episodes, seed, size, frames, format, depth, wrist, keep_failed, backend, as in
            `wiw.training.recording.Collection`.

    Raises:
        BackendError: the requested renderer does not work here.
        DependencyError: pyarrow is not installed.
        ArgumentError: an option is unknown or out of range, or the folder holds a different collection.
        FileError: the folder cannot be written.
        InfrastructureError: an expert fails at one table after another, or a worker process has died.
    """
    shards.require_pyarrow()
    collection, folder, names = read_collection(asked), Path(out), _parse_tasks(tasks)
    place.require_valid("collect")
    if workers < 1:
        raise ArgumentError(f"collect: expected 1 worker or more, got {workers}")
    settings = asdict(collection)
    if not collection.wrist:
        del settings["wrist"]  # the manifest of a folder that was begun without knowing of it stays equal
    config = {"wiw": wiw.__version__, "tasks": names, **settings}
    open_folder(folder, config, read_manifest)
    paths = zip(*(shard_paths(folder, config, task) for task in names), strict=True)
    jobs = [  # in turn, so that what a stopped collection has is of all tasks alike
        _Job(task, shard_range(number, collection.episodes), path, collection)
        for number, each in enumerate(paths)
        for task, path in zip(names, each, strict=True)
    ]
    tally = _Tally(collection.episodes, names, progress)
    before = {job: job.read_failed_count() for job in jobs}
    for job, failed in before.items():
        if failed is not None:
            tally.add(job, failed)
    for job, failed in run_jobs([job for job in jobs if before[job] is None], workers, place):
        tally.add(job, failed)
    return Demonstrations(folder)


@dataclass(frozen=True)
class _Job:
    """A file to be written."""

    task: str
    episodes: range
    path: Path
    collection: Collection

    def read_failed_count(self) -> int | None:
        """Return the number of tables failed at, as the file says; None if the file is absent or damaged."""
        try:
            file = shards.Shard(self.path)
            with file.blame_damage():
                return int(file.facts["failed"])
        except FileError:
            return None

    def run(self) -> int:
        """Write the file; return the number of tables failed at."""
        made = [record_demonstration(TABLETOP_TASKS[self.task], episode, self.collection) for episode in self.episodes]
        failed = sum(failed for _, failed in made)
        facts = {
            "wiw": wiw.__version__,
            "task": self.task,
            "failed": failed,
            "camera": _describe_camera("front", self.collection.size),
        }
        if self.collection.wrist:
            facts["wrist_camera"] = _describe_camera(WRIST, self.collection.size)
        shards.write(self.path, [demonstration for demonstration, _ in made], facts)
        return failed


class _Tally:
    """Counts the finished demonstrations, task by task."""

    def __init__(self, episodes: int, tasks: Sequence[str], progress: Progress | None) -> None:
        self._episodes, self._progress = episodes, progress
        self._done, self._failed = dict.fromkeys(tasks, 0), dict.fromkeys(tasks, 0)

    def add(self, job: _Job, failed: int) -> None:
        self._done[job.task] += len(job.episodes)
        self._failed[job.task] += failed
        if self._progress is not None:
            self._progress(job.task, self._done[job.task], self._episodes, self._failed[job.task])


def _parse_tasks(tasks: str | Sequence[str]) -> list[str]:
    names = list(TABLETOP_TASKS) if tasks == "all" else tasks.split(",") if isinstance(tasks, str) else list(tasks)
    if not names or len(set(names)) < len(names) or not set(names) <= set(TABLETOP_TASKS):
        raise ArgumentError(
            f"collect: expected tasks as all, or different ones of {', '.join(TABLETOP_TASKS)}, got {tasks}"
        )
    return names


def _describe_camera(name: str, size: int) -> dict[str, Any]:
    """Return a camera's facts; where one on the hand is, each frame says."""
    camera = CAMERAS[name]
    focal = size / 2 / np.tan(np.radians(camera.hfov_deg) / 2)
    fixed = {} if camera.on_hand else {"T_world_camera": camera.pose.tolist()}
    return {
        "size": [size, size],
        "hfov_deg": camera.hfov_deg,
        "intrinsics": [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]],
        **fixed,
        "axes": "looks along -z, +x right, +y up; world z up; metres; centres of pixels at + 0.5",
    }
