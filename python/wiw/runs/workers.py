# SPDX-License-Identifier: Apache-2.0
"""Where episodes are run: in this process, or in several that report to it.

Workers are spawned, never forked: a forked child hangs in an OpenGL context it did not make. Each asks for one job at a
time and sends rows back; this process alone writes them. A worker that dies takes no episode with it: what it had not
finished is run once more, one episode at a time, and only an episode that kills its worker twice is recorded as failed.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from wiw.errors import Error, InfrastructureError
from wiw.loop.limits import Limits
from wiw.runs.compose import RunContext
from wiw.runs.rows import AgentRow, DecisionRow, LostRow, OutcomeRow, RestartRow, decision_row
from wiw.runs.sources import require_unchanged
from wiw.types import DecisionRecord, Episode, EpisodeResult

Row = RestartRow | AgentRow | DecisionRow | LostRow | OutcomeRow


class ReportReceiver(Protocol):
    """The receiver of the workers' reports."""

    def write(self, row: Row) -> None:
        """Write that an agent was built, a decision was taken, or an episode has ended."""

    def discard(self, arm: str, episodes: Iterable[int]) -> None:
        """Note that these episodes are run again from their beginning."""


@dataclass(frozen=True)
class Plan:
    """Everything a process must know to run any job."""

    task: Any
    """Recipe."""
    agents: Mapping[str, Any]
    """Recipes by arm."""
    seed: int
    live: int
    """Episodes kept live at a time in one process."""
    pictures: frozenset[int]
    """Episodes whose decisions keep pictures."""
    limits: Mapping[str, Any] = field(default_factory=dict)
    """What every agent is built with beyond its recipe; see `AgentRecipe.build`."""
    episodes: Sequence[Episode] = ()
    """All episodes of the run, for agents that are shown another one's."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Digests of the user's own source files, which every agent is built of."""


@dataclass(frozen=True)
class Job:
    """Episodes of one arm, run together."""

    arm: str
    episodes: tuple[tuple[int, Episode], ...]
    attempt: int = 0


class RowSink:
    """Turns what the loop reports into rows."""

    def __init__(self, job: Job, plan: Plan, send: Any) -> None:
        self._job, self._plan, self._send = job, plan, send

    def decision(self, record: DecisionRecord) -> None:
        """Record a decision that was taken and carried out."""
        self._send(decision_row(self._job.arm, record, record.episode in self._plan.pictures))

    def episode(self, result: EpisodeResult) -> None:
        """Record that an episode has ended."""
        self._send(OutcomeRow(self._job.arm, result))

    def again(self, episodes: Sequence[int]) -> None:
        """Note that these episodes begin anew."""
        self._send(RestartRow(self._job.arm, tuple(episodes)))

    def record_lost(self, spent: Mapping[str, float]) -> None:
        """Record that a decision has failed."""
        self._send(LostRow(self._job.arm, dict(spent)))


class Runner:
    """Runs jobs in the present process. Only the agent of the current arm is kept: models may fill the memory."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._task = plan.task.build()
        self._arm: str | None = None
        self._agent: Any = None

    def run(self, job: Job, send: Any) -> None:
        """Run a job's episodes and send their rows."""
        from wiw.loop.scheduler import run_episodes

        if self._arm != job.arm:
            self._agent = None
            self._agent = self._plan.agents[job.arm].build(
                RunContext(self._task, self._plan.episodes), Limits(**self._plan.limits)
            )
            require_unchanged(self._plan.sources)
            self._arm = job.arm
            send(AgentRow(job.arm, self._agent.describe()))
        sink = RowSink(job, self._plan, send)
        run_episodes(
            self._task,
            self._agent,
            job.episodes,
            seed=self._plan.seed,
            live=self._plan.live,
            sink=sink,
        )


def run_here(plan: Plan, jobs: Iterable[Job], desk: ReportReceiver) -> None:
    """Run all jobs in this process."""
    runner = Runner(plan)
    for job in jobs:
        runner.run(job, desk.write)


def run_in_workers(plan: Plan, jobs: Iterable[Job], desk: ReportReceiver, workers: int) -> None:
    """Run all jobs in `workers` processes.

    Raises:
        InfrastructureError: the task or an agent cannot be sent, or workers cannot start.
        Error: what a worker raised on purpose, such as a broken contract.
    """
    crew = _WorkerPool(_pickle_plan(plan), deque(jobs), desk, workers)
    try:
        crew.run()
    finally:
        crew.stop()


def _pickle_plan(plan: Plan) -> bytes:
    try:
        return pickle.dumps(plan)
    except Exception as error:
        raise InfrastructureError(
            f"task or agent cannot be sent to worker processes ({error}); give names instead of objects "
            "(wiw.runs.recipes.AgentRecipe, or `wiw run --world-model path.py:Class`), or use workers=1"
        ) from error


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    ready: bool = False
    job: Job | None = None
    unfinished: dict[int, Episode] = field(default_factory=dict)


class _WorkerPool:
    """The parent's side: hands out jobs, receives rows, replaces the dead."""

    def __init__(self, plan: bytes, jobs: deque[Job], desk: ReportReceiver, size: int) -> None:
        self._plan, self._jobs, self._desk = plan, jobs, desk
        self._size = min(size, len(jobs))
        self._workers: list[_Worker] = []

    def run(self) -> None:
        while self._jobs or any(worker.job for worker in self._workers):
            for worker in [worker for worker in self._workers if worker.ready and worker.job is None]:
                self._assign(worker)
            while len(self._workers) < self._size and self._jobs:
                self._workers.append(_start(self._plan, self._size))
            by_pipe = {worker.pipe: worker for worker in self._workers}
            for pipe in wait(list(by_pipe)):
                self._receive(by_pipe[pipe])  # type: ignore[index]

    def stop(self) -> None:
        for worker in self._workers:
            worker.pipe.close()
            worker.process.terminate()
        for worker in self._workers:
            worker.process.join(5)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _receive(self, worker: _Worker) -> None:
        try:
            message = worker.pipe.recv()
        except (EOFError, OSError):
            self._replace_dead_worker(worker)
            return
        if isinstance(message, BaseException):
            raise message
        if message is None:
            worker.ready, worker.job = True, None
            return
        self._desk.write(message)
        if isinstance(message, OutcomeRow):
            worker.unfinished.pop(message.result.episode, None)

    def _assign(self, worker: _Worker) -> None:
        if not self._jobs:
            return
        worker.job = self._jobs.popleft()
        worker.unfinished = dict(worker.job.episodes)
        try:
            worker.pipe.send(worker.job)
        except OSError:
            self._replace_dead_worker(worker)

    def _replace_dead_worker(self, worker: _Worker) -> None:
        """Run again what a dead worker left, or record it as failed.

        Raises:
            InfrastructureError: the worker died before it asked for a job, as any other in its place would.
        """
        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join()
        cause = _describe_exit(worker.process.exitcode)
        if not worker.ready:
            raise InfrastructureError(
                f"a worker process could not start ({cause}): the task could not be built there; a script that "
                "evaluates with workers must do so under `if __name__ == '__main__':`"
            )
        if worker.job is None:
            return
        self._desk.discard(worker.job.arm, list(worker.unfinished))
        for index, episode in worker.unfinished.items():
            if worker.job.attempt == 0:
                self._jobs.append(Job(worker.job.arm, ((index, episode),), attempt=1))
            else:
                error = f"the worker process died twice on this episode, last: {cause}"
                result = EpisodeResult(index, episode.episode_id, episode.scene, "error", error=error, kind="worker")
                self._desk.write(OutcomeRow(worker.job.arm, result))


def _describe_exit(exit_code: int) -> str:
    if exit_code >= 0:
        return f"exit code {exit_code}"
    name = signal.Signals(-exit_code).name
    return f"{name}, perhaps for lack of memory" if name == "SIGKILL" else name


def _start(plan: bytes, workers: int) -> _Worker:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=True)
    with _threads_shared(workers):
        process.start()
    theirs.close()
    ours.send_bytes(plan)
    return _Worker(process, ours)


@contextmanager
def _threads_shared(workers: int) -> Iterator[None]:
    """Give each worker its share of the cores, through variables that it reads when it starts."""
    share = str(max(1, len(os.sched_getaffinity(0)) // workers))
    added = [name for name in ("WIW_NUM_THREADS", "OMP_NUM_THREADS") if name not in os.environ]
    os.environ.update(dict.fromkeys(added, share))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _work(pipe: Connection) -> None:
    """Live as a worker: None means "give me a job"; an end of the pipe means that the parent has gone.

    It ends without Python's shutdown, which aborts where a model's thread is still inside compiled code.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    try:
        _serve(pipe)
    except (EOFError, BrokenPipeError):
        pass
    except Exception as error:
        pipe.send(_make_portable(error))
    pipe.close()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def _serve(pipe: Connection) -> None:
    import cv2

    cv2.setNumThreads(int(os.environ.get("WIW_NUM_THREADS", "1")))
    data = pipe.recv_bytes()
    try:
        plan = pickle.loads(data)  # made by the parent process
    except Exception as error:
        raise InfrastructureError(
            f"task or agent cannot be built again in a worker process ({error}); define its class in a file and give "
            "path.py:Class or package.module:Class, or use workers=1"
        ) from error
    runner = Runner(plan)
    while True:
        pipe.send(None)
        runner.run(pipe.recv(), pipe.send)


def _make_portable(error: Exception) -> Exception:
    """Return the exception itself where it survives pickling and is ours; else its text."""
    if isinstance(error, Error):
        try:
            pickle.loads(pickle.dumps(error))
            return error
        except Exception:
            return InfrastructureError(str(error))
    import traceback

    return InfrastructureError("a worker process failed:\n" + "".join(traceback.format_exception(error)))
