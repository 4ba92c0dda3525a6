# SPDX-License-Identifier: Apache-2.0
"""Collect demonstrations of manipulation tasks by experts that know where objects are, as training data.

Each demonstration is a pure function of the seed, its task and its number, and a file gets its name once it is
complete. An interrupted collection therefore resumes, and ends with the same files.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

import wiw
from wiw.datasets import shards
from wiw.datasets.demonstrations import MANIFEST, Demonstrations, read_manifest, shard_paths, shard_range
from wiw.errors import ArgumentError, FileError, InfrastructureError
from wiw.files import atomic_file, remove_abandoned_drafts
from wiw.render import resolve_backend
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import CAMERAS
from wiw.training.recording import Collection, record_demonstration

Progress = Callable[[str, int, int, int], None]
"""Called with the task, how many of its demonstrations are done, of how many, and the number of tables failed at."""


def collect(
    out: str | Path,
    tasks: str | Sequence[str] = "all",
    *,
    workers: int = 1,
    progress: Progress | None = None,
    **asked: Any,
) -> Demonstrations:
    """Let experts perform manipulation tasks and record what the front camera sees; resume where it was interrupted.

    Args:
        out: a new folder, or one that the same call began.
        tasks: "all", or names of `wiw.tabletop.tasks.TABLETOP_TASKS`.
        workers: number of processes; the files do not depend on it.
        progress: called whenever a file is complete.
        **asked: episodes, seed, size, frames, format, depth, keep_failed, backend, as in
            `wiw.training.recording.Collection`.

    Raises:
        BackendError: the requested renderer does not work here.
        DependencyError: pyarrow is not installed.
        ArgumentError: an option is out of range, or the folder holds another collection.
        FileError: the folder cannot be written.
        InfrastructureError: an expert fails at one table after another, or a worker process has died.
    """
    shards.require_pyarrow()
    collection, folder, names = Collection(**asked), Path(out), _parse_tasks(tasks)
    collection = replace(collection, backend=resolve_backend(collection.backend))
    if workers < 1:
        raise ArgumentError(f"collect: expected 1 worker or more, got {workers}")
    config = {"wiw": wiw.__version__, "tasks": names, **asdict(collection)}
    _open_folder(folder, config)
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
    for job, failed in _run_jobs([job for job in jobs if before[job] is None], workers):
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
        """Return the number of tables failed at, as the file says; None where the file is absent or damaged."""
        try:
            return int(shards.Shard(self.path).facts["failed"])
        except FileError:
            return None

    def write_file(self) -> int:
        """Write the file; return the number of tables failed at."""
        made = [record_demonstration(TABLETOP_TASKS[self.task], episode, self.collection) for episode in self.episodes]
        failed = sum(failed for _, failed in made)
        facts = {
            "wiw": wiw.__version__,
            "task": self.task,
            "failed": failed,
            "camera": _describe_camera(self.collection.size),
        }
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


def _describe_camera(size: int) -> dict[str, Any]:
    camera = CAMERAS["front"]
    focal = size / 2 / np.tan(np.radians(camera.hfov_deg) / 2)
    return {
        "size": [size, size],
        "hfov_deg": camera.hfov_deg,
        "intrinsics": [[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]],
        "T_world_camera": camera.pose.tolist(),
        "axes": "looks along -z, +x right, +y up; world z up; metres; centres of pixels at + 0.5",
    }


# -- the folder --------------------------------------------------------------------------------------------------------


def _open_folder(folder: Path, config: Mapping[str, Any]) -> None:
    """Create the folder with its manifest, or check that the manifest there describes the same collection."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned_drafts(folder)
        if not any(folder.iterdir()):
            with atomic_file(folder / MANIFEST) as draft:
                draft.write_text(json.dumps(config, indent=2) + "\n")
    except OSError as error:
        raise FileError(f"{folder}: cannot be written ({error.strerror}); name another folder with --out") from error
    before = read_manifest(folder)
    if differing := [name for name in {**config, **before} if before.get(name) != config.get(name)]:
        said = ", ".join(f"{name} {before.get(name)} there and {config.get(name)} asked" for name in differing)
        raise ArgumentError(f"{folder} holds another collection: {said}; ask for the same, or name another with --out")


# -- workers -----------------------------------------------------------------------------------------------------------


def _run_jobs(jobs: Sequence[_Job], workers: int) -> Iterator[tuple[_Job, int]]:
    """Yield jobs as they finish, with the number of tables failed at."""
    if workers == 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, job.write_file()
        return
    context, count = get_context("spawn"), min(workers, len(jobs))
    life, ours = context.Pipe(duplex=False)
    threads = max(1, len(os.sched_getaffinity(0)) // count)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(life, threads))
    try:
        running = {pool.submit(job.write_file): job for job in jobs}
        for each in as_completed(running):
            yield running[each], each.result()
    except BrokenProcessPool as error:
        raise InfrastructureError(
            "collect: a worker process died, perhaps for lack of memory; run the same again, with fewer workers"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        ours.close()


def _start_worker(life: Connection, threads: int) -> None:
    """Initialise a worker process; it exits as soon as the other end of `life` is closed, even if its owner was
    killed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    os.environ.setdefault("WIW_NUM_THREADS", str(threads))
    threading.Thread(target=lambda: (wait([life]), os._exit(1)), daemon=True).start()
