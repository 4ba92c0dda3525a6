# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of manipulation tasks by those who know where things are, for networks to learn from.

Each demonstration is a function of the seed, its task and its number; a file is renamed to its name once it is whole.
Hence a collection that was stopped goes on, and ends as any other.
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
from wiw.files import sweep, whole_file
from wiw.render import resolve_backend
from wiw.tabletop.kinds import KINDS
from wiw.tabletop.workbench import CAMERAS
from wiw.training.demonstrate import Collection, demonstrated

Progress = Callable[[str, int, int, int], None]
"""Told the task, how many of its demonstrations are done, of how many, and the tables failed at."""


def collect(
    out: str | Path,
    tasks: str | Sequence[str] = "all",
    *,
    workers: int = 1,
    progress: Progress | None = None,
    **asked: Any,
) -> Demonstrations:
    """Lets experts play manipulation tasks and writes what was seen; goes on where it was stopped.

    Args:
        out: folder that is new, or was begun by the same call.
        tasks: "all", or names of `wiw.tabletop.kinds.KINDS`.
        workers: processes; the files are the same for any number of them.
        progress: told whenever a file is done.
        **asked: episodes, seed, size, frames, format, depth, keep_failed, backend, as in
            `wiw.training.demonstrate.Collection`.

    Raises:
        BackendError: the renderer that is asked for does not work here.
        DependencyError: pyarrow is not installed.
        ArgumentError: something that cannot be collected, or another collection in the folder.
        FileError: the folder cannot be written.
        InfrastructureError: an expert fails at one table after another, or a worker process has died.
    """
    shards.require_pyarrow()
    collection, folder, names = Collection(**asked), Path(out), _named(tasks)
    collection = replace(collection, backend=resolve_backend(collection.backend))
    if workers < 1:
        raise ArgumentError(f"collect: expected 1 worker or more, got {workers}")
    config = {"wiw": wiw.__version__, "tasks": names, **asdict(collection)}
    _begin(folder, config)
    paths = zip(*(shard_paths(folder, config, task) for task in names), strict=True)
    jobs = [  # in turn, so that what a stopped collection has is of all tasks alike
        _Job(task, shard_range(number, collection.episodes), path, collection)
        for number, each in enumerate(paths)
        for task, path in zip(names, each, strict=True)
    ]
    tally = _Tally(collection.episodes, names, progress)
    before = {job: job.failed_before() for job in jobs}
    for job, failed in before.items():
        if failed is not None:
            tally.add(job, failed)
    for job, failed in _made([job for job in jobs if before[job] is None], workers):
        tally.add(job, failed)
    return Demonstrations(folder)


@dataclass(frozen=True)
class _Job:
    """A file to be made."""

    task: str
    episodes: range
    path: Path
    collection: Collection

    def failed_before(self) -> int | None:
        """Tables failed at, as the file says; None where there is none, or a damaged one."""
        try:
            return int(shards.Shard(self.path).facts["failed"])
        except FileError:
            return None

    def make(self) -> int:
        """Writes the file; returns the number of tables failed at."""
        made = [demonstrated(KINDS[self.task], episode, self.collection) for episode in self.episodes]
        failed = sum(failed for _, failed in made)
        facts = {"wiw": wiw.__version__, "task": self.task, "failed": failed, "camera": _camera(self.collection.size)}
        shards.write(self.path, [demonstration for demonstration, _ in made], facts)
        return failed


class _Tally:
    """Counts what is done, task by task."""

    def __init__(self, episodes: int, tasks: Sequence[str], progress: Progress | None) -> None:
        self._episodes, self._progress = episodes, progress
        self._done, self._failed = dict.fromkeys(tasks, 0), dict.fromkeys(tasks, 0)

    def add(self, job: _Job, failed: int) -> None:
        self._done[job.task] += len(job.episodes)
        self._failed[job.task] += failed
        if self._progress is not None:
            self._progress(job.task, self._done[job.task], self._episodes, self._failed[job.task])


def _named(tasks: str | Sequence[str]) -> list[str]:
    names = list(KINDS) if tasks == "all" else tasks.split(",") if isinstance(tasks, str) else list(tasks)
    if not names or len(set(names)) < len(names) or not set(names) <= set(KINDS):
        raise ArgumentError(f"collect: expected tasks as all, or different ones of {', '.join(KINDS)}, got {tasks}")
    return names


def _camera(size: int) -> dict[str, Any]:
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


def _begin(folder: Path, config: Mapping[str, Any]) -> None:
    """Makes the folder and its manifest, or sees that the one that is there asks for the same."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder)
        if not any(folder.iterdir()):
            with whole_file(folder / MANIFEST) as draft:
                draft.write_text(json.dumps(config, indent=2) + "\n")
    except OSError as error:
        raise FileError(f"{folder}: cannot be written ({error.strerror}); name another folder with --out") from error
    before = read_manifest(folder)
    if differing := [name for name in {**config, **before} if before.get(name) != config.get(name)]:
        said = ", ".join(f"{name} {before.get(name)} there and {config.get(name)} asked" for name in differing)
        raise ArgumentError(f"{folder} holds another collection: {said}; ask for the same, or name another with --out")


# -- workers -----------------------------------------------------------------------------------------------------------


def _made(jobs: Sequence[_Job], workers: int) -> Iterator[tuple[_Job, int]]:
    """Jobs as they are done, with the tables failed at."""
    if workers == 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, job.make()
        return
    context, count = get_context("spawn"), min(workers, len(jobs))
    life, ours = context.Pipe(duplex=False)
    threads = max(1, len(os.sched_getaffinity(0)) // count)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_live, initargs=(life, threads))
    try:
        running = {pool.submit(job.make): job for job in jobs}
        for each in as_completed(running):
            yield running[each], each.result()
    except BrokenProcessPool as error:
        raise InfrastructureError(
            "collect: a worker process died, perhaps for lack of memory; run the same again, with fewer workers"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        ours.close()


def _live(life: Connection, threads: int) -> None:
    """A worker's beginning; it ends at once when the other end of `life` is closed, be it that its owner was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    os.environ.setdefault("WIW_NUM_THREADS", str(threads))
    threading.Thread(target=lambda: (wait([life]), os._exit(1)), daemon=True).start()
