# SPDX-License-Identifier: Apache-2.0
"""Run episodes in Ray actors, on this machine or on a Ray cluster. This process alone writes what they report.

An actor is a worker as in `workers.py`: it builds task and agents from recipes, leases one job at a time and sends its
rows as they come. Ray tells when an actor, its process or its node is lost; what the job had not finished is then
leased again, one episode at a time, at most `TRIES` times. No object of Ray's gets into the results.
"""

from __future__ import annotations

import os
import queue
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from wiw.errors import DependencyError, InfrastructureError
from wiw.runs.config import EngineConfig
from wiw.runs.rows import OutcomeRow
from wiw.runs.workers import (
    Job,
    ReportReceiver,
    Row,
    Runner,
    WorkerSpec,
    lease_again,
    make_portable,
    pickle_spec,
    unpickle_spec,
)
from wiw.types import Episode

TRIES = 3
"""How often an episode is begun whose actor is lost."""
STORE_BYTES = 200_000_000
"""Memory of a local cluster's object store: rows are small, and containers often have 64 MB of shared memory."""
START_SECONDS = 600.0
"""Time that the cluster has for giving an actor its resources."""


class EpisodeActor:
    """A worker's side. One thread does all the work, for graphics contexts belong to the thread that made them."""

    def __init__(self, spec: bytes, threads: int) -> None:
        import cv2

        cv2.setNumThreads(threads)
        self._thread = ThreadPoolExecutor(1)
        self._runner = self._thread.submit(lambda: Runner(unpickle_spec(spec))).result()

    def prepare(self) -> None:
        """Return once the actor is there."""

    def run(self, job: Job) -> Iterator[Row | Exception]:
        """Run a job's episodes and yield their rows; an exception that ends it is the last."""
        rows: queue.SimpleQueue[Row | Exception | None] = queue.SimpleQueue()
        self._thread.submit(self._run, job, rows)
        while (row := rows.get()) is not None:
            yield row

    def _run(self, job: Job, rows: queue.SimpleQueue[Row | Exception | None]) -> None:
        try:
            self._runner.run(job, rows.put)
        except Exception as error:
            rows.put(make_portable(error))
        finally:
            rows.put(None)


@dataclass
class _Lease:
    """A job and the actor that has it."""

    actor: Any
    job: Job | None = None
    rows: Any = None
    """Ray's generator of references to rows; before the first job a reference to the actor's start."""
    unfinished: dict[int, Episode] = field(default_factory=dict)


def run_on_ray(
    spec: WorkerSpec, jobs: Iterable[Job], receiver: ReportReceiver, workers: int, config: EngineConfig
) -> None:
    """Run all jobs in `workers` actors.

    Raises:
        DependencyError: ray is not installed.
        InfrastructureError: the cluster cannot be reached or has not the resources, or task or agents cannot be sent.
        Error: what an actor raised on purpose, such as a broken contract.
    """
    ray = _import_ray()
    data = pickle_spec(spec)
    with _connect(ray, config):
        pool = _ActorPool(ray, data, deque(jobs), receiver, workers, config)
        try:
            pool.run()
        finally:
            pool.stop()


class _ActorPool:
    """The driver's side: leases jobs to actors, receives rows, and replaces actors that are lost."""

    def __init__(
        self, ray: Any, spec: bytes, jobs: deque[Job], receiver: ReportReceiver, size: int, config: EngineConfig
    ) -> None:
        self._ray, self._spec, self._jobs, self._receiver = ray, spec, jobs, receiver
        self._size, self._gpus = min(size, len(jobs)), config.worker_gpus
        self._leases: list[_Lease] = []

    def run(self) -> None:
        while self._jobs or any(lease.job for lease in self._leases):
            for lease in self._leases:
                if lease.rows is None and self._jobs:  # had nothing to do until another one was lost
                    self._assign(lease)
            while len(self._leases) < self._size and self._jobs:
                self._leases.append(self._start())
            ready, _ = self._ray.wait([lease.rows for lease in self._leases if lease.rows], timeout=START_SECONDS)
            if not ready and not any(lease.job for lease in self._leases):
                raise InfrastructureError(
                    f"no actor could be started within {START_SECONDS:g} s: expected a Ray cluster with a free core"
                    f"{f' and {self._gpus:g} GPUs' if self._gpus else ''} for an actor; see `ray status`"
                )
            for lease in [lease for lease in self._leases if lease.rows in ready]:
                self._receive(lease)

    def stop(self) -> None:
        for lease in self._leases:
            self._ray.kill(lease.actor)

    def _start(self) -> _Lease:
        threads = max(1, len(os.sched_getaffinity(0)) // self._size)
        kind = self._ray.remote(num_cpus=1, num_gpus=self._gpus, max_restarts=0, max_task_retries=0)(EpisodeActor)
        actor = kind.remote(self._spec, threads)
        return _Lease(actor, rows=actor.prepare.remote())

    def _receive(self, lease: _Lease) -> None:
        try:
            if lease.job is None:
                self._ray.get(lease.rows)
                self._assign(lease)
                return
            row = self._ray.get(next(lease.rows))
        except StopIteration:
            self._assign(lease)
            return
        except self._ray.exceptions.RayActorError as error:
            self._replace(lease, error)
            return
        except self._ray.exceptions.RayTaskError as error:
            raise InfrastructureError(f"an actor of Ray failed: {error}") from error
        if isinstance(row, Exception):
            raise row
        self._receiver.write(row)
        if isinstance(row, OutcomeRow):
            lease.unfinished.pop(row.result.episode, None)

    def _assign(self, lease: _Lease) -> None:
        lease.job, lease.rows = None, None
        if self._jobs:
            lease.job = self._jobs.popleft()
            lease.unfinished = dict(lease.job.episodes)
            lease.rows = lease.actor.run.options(num_returns="streaming").remote(lease.job)

    def _replace(self, lease: _Lease, error: Exception) -> None:
        """Lease the unfinished episodes of a lost actor again, or record them as errors.

        Raises:
            InfrastructureError: the actor was lost before it had a job, as any other in its place would be.
        """
        self._leases.remove(lease)
        cause = str(error).strip().splitlines()[0]
        if lease.job is None:
            raise InfrastructureError(f"an actor of Ray could not start: {error}") from error
        self._jobs.extend(lease_again(lease.job, lease.unfinished, self._receiver, TRIES, cause))


@contextmanager
def _connect(ray: Any, config: EngineConfig) -> Iterator[None]:
    """Connect to a cluster, or start one of this machine, for as long as the context lasts.

    Raises:
        InfrastructureError: there is no cluster at the address.
    """
    if ray.is_initialized():
        yield
        return
    handler = signal.getsignal(signal.SIGTERM)
    own: dict[str, Any] = {"address": config.address}
    if config.address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
        own |= {"num_cpus": len(os.sched_getaffinity(0)), "object_store_memory": STORE_BYTES}  # in a SLURM job: its own
        own |= {"include_dashboard": False}
    try:
        ray.init(**own, log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise InfrastructureError(
            f"no Ray cluster at {config.address or 'this machine'}: {error}; expected an address of "
            "`ray start --head`, such as auto or HOST:6379, or none for a cluster of this machine alone"
        ) from error
    try:
        _restore(handler)
        yield
    finally:
        ray.shutdown()
        _restore(handler)


def _restore(handler: Any) -> None:
    """Put back the handler of SIGTERM, which Ray replaces: a run that is stopped is closed in order."""
    try:
        signal.signal(signal.SIGTERM, handler)
    except ValueError:  # not in the main thread, where Ray replaces none
        return


def _import_ray() -> Any:
    try:
        import ray
    except ModuleNotFoundError:
        raise DependencyError("engine ray needs ray: pip install 'wiw[ray]'") from None
    return ray
