# SPDX-License-Identifier: Apache-2.0
"""Run episodes in this process, or in several worker processes that report to it.

Workers are spawned, never forked: a forked child hangs in an OpenGL context it did not make. Each asks for one job at a
time and sends rows back; this process alone writes them. A worker that dies takes no episode with it: what it had not
finished is run again, those episodes that were live one at a time, and only one during which a worker has died twice is
recorded as failed.
One that has a job and sends nothing for long is hung, in code that has no deadline of its own, and is killed.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing import active_children, get_context
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, NoReturn, Protocol

from wiw._core import core
from wiw.errors import Error, InfrastructureError
from wiw.isolation.source import end_idle_processes
from wiw.process_limits import end_with_parent
from wiw.runs.compose import RunContext
from wiw.runs.limits import Limits
from wiw.runs.rows import AgentRow, DecisionRow, LostRow, OutcomeRow, RestartRow, decision_row, outcome_row
from wiw.runs.sources import require_unchanged
from wiw.types import DecisionRecord, Episode, EpisodeResult

Row = RestartRow | AgentRow | DecisionRow | LostRow | OutcomeRow


_RESEED = 0x52455345
"""Keeps the seeds of arms that repeat another apart from all other draws."""
TRIES = 2
"""How often an episode is started if its worker dies."""
LOOK = 1.0
"""Seconds between two looks whether workers have ended, whose pipes processes that they have started may hold open."""
CLOSING = 2.0
"""Seconds that workers have to end at the end of a run, before they are killed."""
NUMBERS = {2: "twice", 3: "three times"}


class ReportReceiver(Protocol):
    """The receiver of the workers' reports."""

    def write(self, row: Row) -> None:
        """Write that an agent was built, a decision was taken, or an episode has ended."""

    def discard(self, arm: str, episodes: Iterable[int]) -> None:
        """Note that these episodes are run again from their beginning."""

    def note(self, text: str) -> None:
        """Show a sentence about the run."""


@dataclass(frozen=True)
class WorkerSpec:
    """Everything that a worker process needs to run any job."""

    task: Any
    """Recipe."""
    agents: Mapping[str, Any]
    """Recipes by arm."""
    seed: int
    salt: str
    """Salt of keys and seeds; see `wiw.loop.keys`."""
    live: int
    """Episodes kept live at a time in one process."""
    pictures: frozenset[int]
    """Episodes whose decisions keep pictures."""
    limits: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of every agent beyond its recipe; see `AgentRecipe.build`."""
    episodes: Sequence[Episode] = ()
    """All episodes of the run, for placebos, which use the observations of other episodes."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """Digests of the user's own source files, which every agent is built of."""


@dataclass(frozen=True)
class Job:
    """Episodes of one arm, run together."""

    arm: str
    episodes: tuple[tuple[int, Episode], ...]
    attempt: int = 0


class RowSink:
    """Converts the loop's records into rows of the store."""

    def __init__(self, job: Job, spec: WorkerSpec, send: Any) -> None:
        self._job, self._spec, self._send = job, spec, send

    def decision(self, record: DecisionRecord) -> None:
        """Record a decision that was taken and carried out."""
        self._send(decision_row(self._job.arm, record, record.episode in self._spec.pictures))

    def episode(self, result: EpisodeResult) -> None:
        """Record that an episode has ended."""
        self._send(outcome_row(self._job.arm, result))

    def record_restart(self, episodes: Sequence[int]) -> None:
        """Note that these episodes begin anew."""
        self._send(RestartRow(self._job.arm, tuple(episodes)))

    def record_lost(self, spent: Mapping[str, float]) -> None:
        """Record that a decision has failed."""
        self._send(LostRow(self._job.arm, dict(spent)))


class Runner:
    """Runs jobs in the present process. Only the agent of the current arm is kept: models may fill the memory."""

    def __init__(self, spec: WorkerSpec) -> None:
        self._spec = spec
        self._task = spec.task.build()
        self._arm: str | None = None
        self._agent: Any = None

    def run(self, job: Job, send: Any) -> None:
        """Run a job's episodes and send their rows."""
        from wiw.loop.scheduler import run_episodes

        recipe = self._spec.agents[job.arm]
        seed = mix_seed(self._spec.seed, recipe.reseed)
        if self._arm != job.arm:
            self._agent = None
            self._agent = recipe.build(
                RunContext(self._task, self._spec.episodes, seed, self._spec.salt),
                Limits(**self._spec.limits),
            )
            require_unchanged(self._spec.sources)
            self._arm = job.arm
            send(AgentRow(job.arm, self._agent.describe()))
        sink = RowSink(job, self._spec, send)
        run_episodes(
            self._task,
            self._agent,
            job.episodes,
            seed=seed,
            salt=self._spec.salt,
            live=self._spec.live,
            sink=sink,
            pictured=self._spec.pictures,
        )


def mix_seed(seed: int, reseed: int | None) -> int:
    """Return the seed of an arm's decisions: the run's, or another one for an arm that repeats one."""
    return seed if reseed is None else int(core.fold_key([seed, reseed, _RESEED]))


def run_here(spec: WorkerSpec, jobs: Iterable[Job], receiver: ReportReceiver) -> None:
    """Run all jobs in this process."""
    runner = Runner(spec)
    for job in jobs:
        runner.run(job, receiver.write)


def run_in_workers(spec: WorkerSpec, jobs: Iterable[Job], receiver: ReportReceiver, workers: int) -> None:
    """Run all jobs in `workers` processes.

    Raises:
        InfrastructureError: the task or an agent cannot be sent, or workers cannot start.
        Error: what a worker raised on purpose, such as a broken contract.
    """
    end_idle_processes()
    pool = _WorkerPool(spec, deque(jobs), receiver, workers)
    try:
        pool.run()
    finally:
        pool.stop()


def pickle_spec(spec: WorkerSpec) -> bytes:
    """Return what a worker needs as bytes.

    Raises:
        InfrastructureError: task or agent cannot be sent.
    """
    try:
        return pickle.dumps(spec)
    except Exception as error:
        raise InfrastructureError(
            f"task or agent cannot be sent to worker processes ({error}); give names instead of objects "
            "(wiw.runs.recipes.AgentRecipe, or `wiw run --world-model path.py:Class`), or use workers=1"
        ) from error


@dataclass
class Silence:
    """How long nothing has come from a worker that is at work."""

    seconds: float = 0.0

    def note(self, has_news: bool, waited: float) -> None:
        """Note how long news was waited for, which is no longer than was intended if the machine slept meanwhile."""
        self.seconds = 0.0 if has_news else self.seconds + waited

    def describe(self) -> str:
        """Return why the worker was ended."""
        return f"no news for {self.seconds:.0f} s: hung, or slower than --stall allows"


def choose_tick(patience: float) -> float:
    """Return for how long to wait for news at a time."""
    return min(60.0, patience / 4)


@dataclass
class _Worker:
    process: Any
    pipe: Connection
    ready: bool = False
    job: Job | None = None
    unfinished: dict[int, Episode] = field(default_factory=dict)
    silence: Silence = field(default_factory=Silence)


class _WorkerPool:
    """The parent's side: assigns jobs to workers, receives their rows, and replaces workers that died or hang."""

    def __init__(self, spec: WorkerSpec, jobs: deque[Job], receiver: ReportReceiver, size: int) -> None:
        self._spec, self._jobs, self._receiver, self._live = pickle_spec(spec), jobs, receiver, spec.live
        self._patience = Limits(**spec.limits).patience
        self._size = min(size, len(jobs))
        self._workers: list[_Worker] = []

    def run(self) -> None:
        while self._jobs or any(worker.job for worker in self._workers):
            for worker in [worker for worker in self._workers if self._is_free(worker)]:
                self._assign(worker)
            while len(self._workers) < self._size and self._jobs:
                self._workers.append(_start(self._spec, self._size))
            self._await_news()

    def _await_news(self) -> None:
        """Wait for messages, receive them, and kill workers that have sent none for too long."""
        by_pipe = {worker.pipe: worker for worker in self._workers}
        began, tick = time.monotonic(), min(LOOK, choose_tick(self._patience))
        ready = wait(list(by_pipe), tick)
        for worker in [worker for worker in self._workers if not self._hangs(worker)]:
            has_news = worker.job is None or worker.pipe in ready  # one that starts or waits has none to send
            worker.silence.note(has_news, min(time.monotonic() - began, tick))
            if self._hangs(worker):
                worker.process.kill()
        for pipe in ready:
            self._receive(by_pipe[pipe])  # type: ignore[index]
        for worker in [worker for worker in self._workers if worker.process.exitcode is not None]:
            if not worker.pipe.poll():  # a process that it has forked may hold its pipe open
                self._replace_dead_worker(worker)

    def _is_free(self, worker: _Worker) -> bool:
        return worker.ready and worker.job is None and not self._hangs(worker)

    def _hangs(self, worker: _Worker) -> bool:
        return worker.silence.seconds > self._patience

    def stop(self) -> None:
        for worker in self._workers:
            worker.pipe.close()
            worker.process.terminate()
        until = time.monotonic() + CLOSING
        for worker in self._workers:
            worker.process.join(max(0.0, until - time.monotonic()))
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
        self._receiver.write(message)
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
        """Run the unfinished episodes of a dead worker again, or record them as errors.

        Raises:
            InfrastructureError: the worker died before it asked for a job, as any other in its place would.
        """
        self._workers.remove(worker)
        worker.pipe.close()
        worker.process.join()
        cause = worker.silence.describe() if self._hangs(worker) else _describe_exit(worker.process.exitcode)
        if not worker.ready:
            raise InfrastructureError(
                f"a worker process could not start ({cause}). In a script, call wiw.evaluate under "
                "`if __name__ == '__main__':`, as each worker imports the script again; otherwise the task or "
                "the agent could not be built there, and the output above says why"
            )
        if worker.job is None:
            return
        self._jobs.extend(lease_again(worker.job, worker.unfinished, self._live, self._receiver, TRIES, cause))


def lease_again(
    job: Job, unfinished: Mapping[int, Episode], live: int, receiver: ReportReceiver, tries: int, cause: str
) -> list[Job]:
    """Return jobs for what a lost worker had not finished: one for each episode that was live, which has had a try, and
    one for those that had not begun; record live ones without tries left.

    Args:
        job: that the worker had.
        unfinished: its episodes that have not ended, by index, in the order in which they begin.
        live: how many are live at a time.
        receiver: discards what it was told of them, and records errors.
        tries: how often an episode is started.
        cause: why the worker was lost.
    """
    receiver.discard(job.arm, list(unfinished))
    begun, waiting = list(unfinished.items())[:live], tuple(unfinished.items())[live:]
    rest = [replace(job, episodes=waiting)] if waiting else []
    if job.attempt + 1 < tries:
        return [Job(job.arm, (item,), attempt=job.attempt + 1) for item in begun] + rest
    for index, episode in begun:
        error = f"the worker process died {NUMBERS[tries]} on this episode, last: {cause}"
        result = EpisodeResult(index, episode.episode_id, episode.scene, "error", error=error, kind="worker")
        receiver.write(OutcomeRow(job.arm, result))
    return rest


def _describe_exit(exit_code: int) -> str:
    if exit_code >= 0:
        return f"exit code {exit_code}"
    name = signal.Signals(-exit_code).name
    return f"{name}, perhaps out of memory" if name == "SIGKILL" else name


def _start(spec: bytes, workers: int) -> _Worker:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_run_worker, args=(theirs, os.getpid()))  # no daemon, so it may start processes
    with _share_threads(workers):
        process.start()
    theirs.close()
    own = Connection(os.dup(ours.fileno()), readable=False)  # no other thread closes it while it is written to
    threading.Thread(target=_send_spec, args=(own, spec), daemon=True, name="wiw worker start").start()
    return _Worker(process, ours)


def _send_spec(pipe: Connection, spec: bytes) -> None:
    """Send a worker what it needs: a pipe takes no more than a part of it until the worker reads, and others start
    meanwhile. One that has died is found by the end of its own pipe.
    """
    with pipe, suppress(OSError):
        pipe.send_bytes(spec)


@contextmanager
def _share_threads(workers: int) -> Iterator[None]:
    """Give each worker its share of the cores, through variables that it reads when it starts."""
    share = str(max(1, len(os.sched_getaffinity(0)) // workers))
    added = [name for name in ("WIW_NUM_THREADS", "OMP_NUM_THREADS") if name not in os.environ]
    os.environ.update(dict.fromkeys(added, share))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _run_worker(pipe: Connection, parent: int) -> None:
    """Run the worker's loop: it sends None to request a job; a closed pipe means that the parent has ended.

    It ends without Python's shutdown, which aborts where a model's thread is still inside compiled code, and ends the
    processes that it has started by `multiprocessing`, unless it is killed.
    """
    end_with_parent(parent)
    signal.signal(signal.SIGTERM, _end_worker)
    for number in (signal.SIGINT, signal.SIGUSR2):  # reach the whole group, or all of a job; the parent decides
        signal.signal(number, signal.SIG_IGN)
    try:
        _serve(pipe)
    except (EOFError, BrokenPipeError):
        pass
    except Exception as error:
        pipe.send(make_portable(error))
    pipe.close()
    sys.stdout.flush()
    sys.stderr.flush()
    _end_worker()


def _end_worker(number: int | None = None, frame: FrameType | None = None) -> NoReturn:
    """End this process and those that it has started, by the signal if there is one."""
    for child in active_children():
        child.kill()
    if number is not None:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(0)


def _serve(pipe: Connection) -> None:
    import cv2

    cv2.setNumThreads(int(os.environ.get("WIW_NUM_THREADS", "1")))
    runner = Runner(unpickle_spec(pipe.recv_bytes()))
    while True:
        pipe.send(None)
        runner.run(pipe.recv(), pipe.send)


def unpickle_spec(data: bytes) -> WorkerSpec:
    """Return what `pickle_spec` has made, in a worker of the same run.

    Raises:
        InfrastructureError: task or agent cannot be built again there.
    """
    try:
        return pickle.loads(data)  # noqa: S301 - made by the parent process
    except Exception as error:
        raise InfrastructureError(
            f"task or agent cannot be rebuilt in a worker process ({error}); define its class in a file and give "
            "path.py:Class or package.module:Class, or use workers=1"
        ) from error


def make_portable(error: BaseException) -> Exception:
    """Return the exception itself where it survives pickling and is ours; else its text."""
    if isinstance(error, Error):
        try:
            pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
            return error
        except Exception:
            return InfrastructureError(str(error))
    import traceback

    return InfrastructureError("a worker process failed:\n" + "".join(traceback.format_exception(error)))
