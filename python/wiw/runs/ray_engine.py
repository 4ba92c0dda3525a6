# SPDX-License-Identifier: Apache-2.0
"""Run episodes in Ray actors, on this machine or on a Ray cluster. This process alone writes what they report.

An actor is a worker as in `workers.py`: it builds task and agents from recipes, leases one job at a time and sends its
rows as they come, which are the lease's heartbeat: an actor that has a job and sends none for too long is hung, and is
killed. Ray tells when an actor, its process or its node is lost; what the job had not finished is then leased again,
one episode at a time, at most `TRIES` times. So is an episode that a lost server of the run (`ray_servers.py`) has
cost. No object of Ray's gets into the results.
"""

from __future__ import annotations

import os
import queue
import secrets
import sys
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from wiw.errors import InfrastructureError, RemoteError, VlmError
from wiw.isolation.source import end_idle_processes
from wiw.ray_cluster import connect_cluster, import_ray
from wiw.runs.config import EngineConfig
from wiw.runs.limits import Limits
from wiw.runs.ray_servers import PLACE_SECONDS, LostServersError, ServerPool, describe_loss
from wiw.runs.ray_servers import START_SECONDS as SERVER_SECONDS
from wiw.runs.rows import OutcomeRow
from wiw.runs.servers import ask_servers, find_served, write_commands, write_vlm_commands
from wiw.runs.workers import (
    Job,
    ReportReceiver,
    Row,
    Runner,
    Silence,
    WorkerSpec,
    choose_tick,
    lease_again,
    make_portable,
    pickle_spec,
    unpickle_spec,
)
from wiw.types import Episode, EpisodeResult

TRIES = 3
"""How often an episode is started if its actor or server is lost."""
UNREACHABLE = ("connection", "unreachable")
"""Kinds of errors that say that a server was lost, of world models and of language models; an episode's kind says
before them whose."""
TOGETHER = 0.02
"""Seconds that an actor waits for more rows before it sends some."""
NOTICE = 30.0
"""Seconds without any work until it is said what the cluster is waited for."""
LOST_SERVER = "its server was lost"


class EpisodeActor:
    """A worker's side. One thread does all the work, for graphics contexts belong to the thread that made them."""

    def __init__(self, spec: bytes, threads: int) -> None:
        limit_threads(threads)
        self._thread = ThreadPoolExecutor(1)
        self._runner = self._thread.submit(lambda: Runner(unpickle_spec(spec))).result()

    def prepare(self) -> None:
        """Return once the actor is there."""

    def run(self, job: Job) -> Iterator[list[Row | Exception]]:
        """Run a job's episodes and yield their rows, those together that come together, for each message of Ray's costs
        some milliseconds; an exception that ends the job is the last.
        """
        rows: queue.SimpleQueue[Row | Exception | None] = queue.SimpleQueue()
        self._thread.submit(self._run, job, rows)
        found: list[Row | Exception | None] = []
        while None not in found:
            found = [rows.get()]
            time.sleep(TOGETHER)
            with suppress(queue.Empty):
                while True:
                    found.append(rows.get_nowait())
            if told := [row for row in found if row is not None]:
                yield told

    def _run(self, job: Job, rows: queue.SimpleQueue[Row | Exception | None]) -> None:
        try:
            self._runner.run(job, rows.put)
        except BaseException as error:  # SystemExit too: else the job would seem to have ended
            rows.put(make_portable(error))
        finally:
            rows.put(None)


def limit_threads(count: int) -> None:
    """Let this process use a number of threads, or what its environment says: in the core, OpenCV and torch.

    Call it before any of them computes: the core and torch read their variables when they start their threads.
    """
    import cv2

    os.environ.setdefault("WIW_NUM_THREADS", str(count))
    os.environ.setdefault("OMP_NUM_THREADS", str(count))
    cv2.setNumThreads(int(os.environ["WIW_NUM_THREADS"]))
    if "torch" in sys.modules:  # it may have read its variable
        sys.modules["torch"].set_num_threads(int(os.environ["OMP_NUM_THREADS"]))


@dataclass
class _Lease:
    """A job and the actor that has it."""

    actor: Any
    job: Job | None = None
    rows: Any = None
    """Ray's generator of references to rows; before the first job a reference to the actor's start."""
    vlm: str | None = None
    """Address of the language model's server that it asks, if the run has such servers."""
    unfinished: dict[int, Episode] = field(default_factory=dict)
    silence: Silence = field(default_factory=Silence)


def run_on_ray(
    spec: WorkerSpec, jobs: Iterable[Job], receiver: ReportReceiver, workers: int, config: EngineConfig
) -> None:
    """Run all jobs in `workers` actors.

    Raises:
        DependencyError: ray is not installed.
        InfrastructureError: the cluster cannot be reached or has not the resources, or task or agents cannot be sent.
        Error: what an actor raised on purpose, such as a broken contract.
    """
    ray = import_ray()
    is_own = config.address is None and not ray.is_initialized()
    end_idle_processes()
    pickle_spec(spec)  # what cannot be sent is said before a cluster is started
    with connect_cluster(config.address) as ray:
        pool = _ActorPool(ray, spec, deque(jobs), receiver, workers, config, is_own)
        try:
            pool.run()
        finally:
            pool.stop()


class _ActorPool:
    """The driver's side: leases jobs to actors, receives rows, and replaces actors and servers that are lost."""

    def __init__(
        self,
        ray: Any,
        spec: WorkerSpec,
        jobs: deque[Job],
        receiver: ReportReceiver,
        size: int,
        config: EngineConfig,
        is_own: bool = False,
    ) -> None:
        """Make a pool; `is_own` says that the cluster is this run's alone."""
        self._ray, self._spec, self._jobs, self._receiver = ray, spec, jobs, receiver
        self._size, self._config = min(size, len(jobs)), config
        self._patience = Limits(**spec.limits).patience
        self._cores = max(1, len(os.sched_getaffinity(0)) // max(1, self._size)) if is_own else 1
        """Cores of Ray's that an actor asks for, and uses: an equal share of a cluster that nobody else uses."""
        self._leases: list[_Lease] = []
        self._waited = 0.0
        """Seconds without news and without any actor at work."""
        self._token = secrets.token_urlsafe()
        is_alone = config.address is None and len(ray.nodes()) == 1
        host = "127.0.0.1" if is_alone else None
        commands = write_commands(spec.task.build(), spec.agents, config) if config.servers else []
        self._models = ServerPool(ray, commands, host, self._token)
        self._vlms = ServerPool(ray, write_vlm_commands(spec.agents, config), host, self._token)
        self._addresses: set[str] = set()
        """Where the world model's servers were when the actors began."""
        if is_own:
            self._require_gpus()

    def _require_gpus(self) -> None:
        """Check that this machine has the GPUs without which nothing could begin: all servers, and one actor.

        Raises:
            InfrastructureError: it has not.
        """
        config = self._config
        asked = config.servers * config.server_gpus + config.vlm_servers * config.vlm_server_gpus + config.worker_gpus
        if asked and asked > (found := self._ray.cluster_resources().get("GPU", 0)) + 1e-6:
            raise InfrastructureError(
                f"the Ray cluster of this machine has {found:g} GPUs: expected at least {asked:g}, for the servers "
                "(servers, vlm_servers) and one actor (worker_gpus) together. Ask for fewer, for a share of one (such "
                "as server_gpus=0.5), or for a cluster that has them (address)"
            )

    def run(self) -> None:
        for pool in (self._models, self._vlms):
            pool.start()
        try:
            while self._jobs or any(lease.job for lease in self._leases):
                if self._models.serves and self._vlms.serves:
                    self._place_jobs()
                self._await_news()
        except LostServersError as error:
            self._record_lost(str(error))
            raise

    def _place_jobs(self) -> None:
        """Start actors and lease jobs to those that have none; begin with new actors where a server has moved."""
        if not (now := {*self._models.addresses}) <= self._addresses:
            self._withdraw_jobs()
        self._addresses = now
        for lease in [lease for lease in self._leases if self._has_lost_server(lease)]:
            self._end(lease)
            self._lease_again(lease, lease.unfinished)
        for lease in [lease for lease in self._leases if lease.rows is None][: len(self._jobs)]:
            if self._shares_crowded_server(lease):
                self._end(lease)
                self._leases.append(self._start())
            else:
                self._assign(lease)
        while len(self._leases) < self._size and self._jobs:
            self._leases.append(self._start())

    def _has_lost_server(self, lease: _Lease) -> bool:
        return lease.vlm is not None and lease.vlm not in self._vlms.serving

    def _shares_crowded_server(self, lease: _Lease) -> bool:
        """Return whether an actor asks a server that two more of them ask than another one, as of one that has come
        back.
        """
        if lease.vlm is None:
            return False
        askers = self._count_askers()
        return askers[lease.vlm] >= 2 + min(askers[server] for server in self._vlms.serving)

    def _count_askers(self) -> Counter[str | None]:
        """Return how many actors ask each server of the language model."""
        return Counter(lease.vlm for lease in self._leases)

    def _await_news(self) -> None:
        """Wait for rows, starts and losses, and deal with what has come."""
        servers = [*self._models.refs, *self._vlms.refs]
        waiting = [*(lease.rows for lease in self._leases if lease.rows), *servers]
        serves, began = self._models.serves and self._vlms.serves, time.monotonic()
        working = [lease for lease in self._leases if lease.job]
        most = PLACE_SECONDS if serves else SERVER_SECONDS + PLACE_SECONDS
        seconds = min(most, choose_tick(self._patience) if working else NOTICE)
        ready, _ = self._ray.wait(waiting, timeout=seconds)
        self._note_wait(0.0 if ready or working else seconds, most, serves)
        for pool in (self._models, self._vlms):
            pool.update_servers(ready)
        for lease in working:
            lease.silence.note(lease.rows in ready, min(time.monotonic() - began, seconds))
        for lease in [lease for lease in self._leases if lease.rows in ready]:
            self._receive(lease)
        for lease in [lease for lease in working if lease.silence.seconds > self._patience]:
            self._replace(lease, InfrastructureError(lease.silence.describe()))

    def _note_wait(self, seconds: float, most: float, serves: bool) -> None:
        """Note how long nothing has come while no actor was at work, and say once what is waited for.

        Raises:
            InfrastructureError: it has been `most` seconds.
        """
        before, self._waited = self._waited, self._waited + seconds if seconds else 0.0
        if self._waited >= most:
            raise InfrastructureError(self._describe_shortage(serves))
        if before < NOTICE <= self._waited:
            self._receiver.note(f"waiting for Ray: {self._describe_request(serves)}")

    def _describe_shortage(self, serves: bool) -> str:
        what, seconds = ("actor", PLACE_SECONDS) if serves else ("server", SERVER_SECONDS + PLACE_SECONDS)
        return f"no {what} could be started within {seconds:g} s: {self._describe_request(serves)}"

    def _describe_request(self, serves: bool) -> str:
        """Return what the cluster has to have for the next actor, or for the servers where these come first."""
        config = self._config
        if serves:
            cores = "a free core" if self._cores == 1 else f"{self._cores} free cores"
            expected = f"{cores}{f' and {config.worker_gpus:g} GPUs' if config.worker_gpus else ''} for each actor"
        else:
            gpus = max(config.server_gpus * bool(config.servers), config.vlm_server_gpus * bool(config.vlm_servers))
            expected = f"{gpus:g} free GPUs for each server, and weights that load in time"
        return f"expected a Ray cluster with {expected}; see `ray status`"

    def stop(self) -> None:
        for lease in self._leases:
            self._ray.kill(lease.actor)
        for pool in (self._models, self._vlms):
            pool.stop()

    def _start(self) -> _Lease:
        resources = {"num_cpus": self._cores, "num_gpus": self._config.worker_gpus}
        kind = self._ray.remote(**resources, max_restarts=0, max_task_retries=0)(EpisodeActor)
        vlm = min(self._vlms.serving, key=self._count_askers().__getitem__, default=None)
        actor = kind.remote(self._pickle_spec(vlm), self._cores)
        return _Lease(actor, rows=actor.prepare.remote(), vlm=vlm)

    def _pickle_spec(self, vlm: str | None) -> bytes:
        """Return what an actor needs that asks all of the world model's servers, and this one of the language model."""
        models = self._models.addresses
        if not models and vlm is None:
            return pickle_spec(self._spec)
        served = find_served(self._spec.agents, self._config.served).model if models else None
        return pickle_spec(replace(self._spec, agents=ask_servers(self._spec.agents, served, models, vlm, self._token)))

    def _receive(self, lease: _Lease) -> None:
        try:
            if lease.job is None:
                self._ray.get(lease.rows)
                lease.rows = None
                return
            rows = self._ray.get(next(lease.rows))
        except StopIteration:
            lease.job, lease.rows = None, None
            return
        except self._ray.exceptions.RayTaskError as error:
            raise InfrastructureError(f"a Ray actor failed: {error}") from error
        except self._ray.exceptions.RayError as error:  # not only RayActorError: Ray's kill for want of memory is none
            self._replace(lease, error)
            return
        for row in rows:
            self._receive_row(lease, lease.job, row)

    def _receive_row(self, lease: _Lease, job: Job, row: Row | Exception) -> None:
        if isinstance(row, Exception):
            if not self._may_try_again(job, row):
                raise row
            self._lease_again(lease, lease.unfinished)
        elif isinstance(row, OutcomeRow):
            self._receive_outcome(lease, row)
        else:
            self._receiver.write(row)

    def _receive_outcome(self, lease: _Lease, row: OutcomeRow) -> None:
        """Write an outcome; an episode that a lost server has cost is run again while it has tries left."""
        result = row.result
        if lease.job is not None and self._may_try_again(lease.job, result):
            self._lease_again(lease, {result.episode: lease.unfinished[result.episode]})
            return
        self._receiver.write(row)
        lease.unfinished.pop(result.episode, None)
        if result.status == "done":
            self._models.note_progress()
            self._vlms.note_progress()

    def _may_try_again(self, job: Job, error: Exception | EpisodeResult) -> bool:
        """Return whether an error is a lost server's, and the job has tries left."""
        kind = error.kind if isinstance(error, EpisodeResult | RemoteError | VlmError) else ""
        told = kind.rpartition("/")[2] in UNREACHABLE
        return told and bool(len(self._models) or len(self._vlms)) and job.attempt + 1 < TRIES

    def _lease_again(self, lease: _Lease, episodes: Mapping[int, Episode], cause: str = LOST_SERVER) -> None:
        """Take episodes from a lease to run them again, by any actor."""
        if lease.job is None:
            return
        self._jobs.extend(lease_again(lease.job, episodes, self._spec.live, self._receiver, TRIES, cause))
        lease.unfinished = {index: own for index, own in lease.unfinished.items() if index not in episodes}

    def _withdraw_jobs(self) -> None:
        """End all actors; what they have not finished is run by others, and this is not a try of theirs."""
        for lease in self._leases:
            self._ray.kill(lease.actor)
            if lease.job is not None and lease.unfinished:
                self._receiver.discard(lease.job.arm, list(lease.unfinished))
                self._jobs.appendleft(replace(lease.job, episodes=tuple(lease.unfinished.items())))
        self._leases = []

    def _record_lost(self, cause: str) -> None:
        """Record the episodes that were live as errors: one of them may be what ends the servers."""
        for job, unfinished in [(lease.job, lease.unfinished) for lease in self._leases]:
            if job is None:
                continue
            self._receiver.discard(job.arm, list(unfinished))
            for index, episode in list(unfinished.items())[: self._spec.live]:
                result = EpisodeResult(index, episode.episode_id, episode.scene, "error", error=cause, kind="server")
                self._receiver.write(OutcomeRow(job.arm, result))

    def _assign(self, lease: _Lease) -> None:
        lease.job = self._jobs.popleft()
        lease.unfinished = dict(lease.job.episodes)
        lease.rows = lease.actor.run.options(num_returns="streaming").remote(lease.job)

    def _replace(self, lease: _Lease, error: Exception) -> None:
        """End a lost actor, and lease its unfinished episodes again, or record them as errors.

        Raises:
            InfrastructureError: the actor was lost before it had a job, as any other in its place would be.
        """
        self._end(lease)
        if lease.job is None:
            raise InfrastructureError(f"a Ray actor could not start: {error}") from error
        self._lease_again(lease, lease.unfinished, describe_loss(error))

    def _end(self, lease: _Lease) -> None:
        """End an actor, also a lost one: where only its answer was lost, it would keep its core."""
        self._leases.remove(lease)
        self._ray.kill(lease.actor)
