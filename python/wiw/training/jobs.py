# SPDX-License-Identifier: Apache-2.0
"""Jobs of a collection, in this process or in several, and the folder that they fill.

What a job writes is a function of the job alone, so that files do not depend on the number of processes, and an
interrupted collection resumes.
"""

from __future__ import annotations

import json
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from wiw.datasets.parquet_files import MANIFEST
from wiw.errors import ArgumentError, FileError, InfrastructureError
from wiw.files import atomic_file, remove_abandoned_drafts
from wiw.ray_cluster import HERE, Engine, run_tasks

Result = TypeVar("Result")
Made_co = TypeVar("Made_co", covariant=True)


class Job(Protocol, Generic[Made_co]):
    """A part of a collection that can be sent to another process."""

    def run(self) -> Made_co:
        """Write the job's files."""


def run_jobs(jobs: Sequence[Job[Result]], workers: int, place: Engine = HERE) -> Iterator[tuple[Any, Result]]:
    """Yield jobs as they finish, with their results; with several workers each has its share of the cores.

    On Ray each job is a task, and repeated where its process or node is lost.

    Raises:
        InfrastructureError: a worker process has died, or there is no Ray cluster.
        DependencyError: ray is not installed.
    """
    if place.engine == "ray" and jobs:
        yield from run_tasks(place, _run_job, jobs, workers)
        return
    if workers == 1 or len(jobs) <= 1:
        for job in jobs:
            yield job, job.run()
        return
    context, count = get_context("spawn"), min(workers, len(jobs))
    life, ours = context.Pipe(duplex=False)
    threads = max(1, len(os.sched_getaffinity(0)) // count)
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start_worker, initargs=(life, threads))
    try:
        running = {pool.submit(job.run): job for job in jobs}
        for each in as_completed(running):
            yield running[each], each.result()
    except BrokenProcessPool as error:
        raise InfrastructureError(
            "a worker process died, perhaps out of memory; repeat the command with fewer workers"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        ours.close()


def _run_job(job: Job[Result]) -> Result:
    return job.run()


def _start_worker(life: Connection, threads: int) -> None:
    """Initialise a worker process; it exits as soon as the other end of `life` is closed, even if its owner was
    killed.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    os.environ.setdefault("WIW_NUM_THREADS", str(threads))
    threading.Thread(target=lambda: (wait([life]), os._exit(1)), daemon=True).start()


def count_threads() -> int:
    """Return the number of threads that this process may use."""
    return int(os.environ.get("WIW_NUM_THREADS", "0")) or len(os.sched_getaffinity(0))


def open_folder(folder: Path, config: Mapping[str, Any], read: Callable[[Path], dict[str, Any]]) -> None:
    """Create the folder with its manifest, or check that the manifest there describes the same collection.

    Args:
        folder: of the collection.
        config: what is requested; JSON-able.
        read: reads the manifest of a folder; raises FileError if there is none.

    Raises:
        FileError: the folder cannot be written, or holds something else.
        ArgumentError: it holds another collection.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_abandoned_drafts(folder)
        if not any(folder.iterdir()):
            write_manifest(folder, config)
    except OSError as error:
        raise FileError(
            f"{folder}: cannot be written ({error.strerror}); expected a writable folder with free space: make room, "
            "or choose another with --out"
        ) from error
    before = read(folder)
    if differing := [name for name in {**config, **before} if before.get(name) != config.get(name)]:
        said = ", ".join(f"{name} was {before.get(name)}, now {config.get(name)}" for name in differing)
        raise ArgumentError(
            f"{folder} holds a different collection: {said}; repeat the same command, or choose another with --out"
        )


def write_manifest(folder: Path, config: Mapping[str, Any]) -> None:
    """Write what is requested of a collection into its folder.

    Raises:
        FileError: it cannot be written.
    """
    with atomic_file(folder / MANIFEST) as draft:
        draft.write_text(json.dumps(config, indent=2) + "\n")
