# SPDX-License-Identifier: Apache-2.0
"""Run work on a Ray cluster, possibly of this machine alone: connections, tasks, and batches for pools of actors.

Only plain values are sent and returned; Ray does not influence results. Ray is imported only when needed.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from tyro.conf import arg

from wiw.errors import ArgumentError, DependencyError, Error, InfrastructureError, find_error_class

Item = TypeVar("Item")
STORE_BYTES = 200_000_000
"""Size of a local cluster's object store in bytes: messages are small, and containers often have 64 MB of shared
memory."""
RETRIES = 2
"""Maximum number of repetitions of a task whose process or node is lost."""
FAILED = "wiw error"
"""Column of a Ray Data result that is an error: the name of its class; "text" is the message."""


@dataclass(frozen=True, kw_only=True)
class Engine:
    """The processes that do a job's work, and where they run."""

    engine: Literal["processes", "ray"] = "processes"
    """processes (on this machine) or ray (actors of a Ray cluster); --workers is their number."""
    address: Annotated[str | None, arg(metavar="ADDRESS")] = None
    """Ray cluster, such as auto or HOST:6379. Default: a local one on this machine."""
    worker_gpus: Annotated[float, arg(metavar="N")] = 0
    """GPUs per Ray actor."""

    def require_valid(self, what: str) -> None:
        """Check the numbers, and that Ray's options are only given with Ray; `what` is the command.

        Raises:
            ArgumentError: an address or GPUs without Ray, or a number below 0.
        """
        if self.worker_gpus < 0:
            raise ArgumentError(f"{what}: expected worker_gpus of at least 0, got {self.worker_gpus}")
        if self.engine != "ray" and (self.address is not None or self.worker_gpus):
            raise ArgumentError(f"{what}: address and worker_gpus require engine ray: give --engine ray (engine=)")


HERE = Engine()
"""Processes on this machine."""


def import_ray() -> Any:
    """Return the module.

    Raises:
        DependencyError: it is not installed.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise DependencyError("engine ray needs ray: pip install 'wiw[ray]'") from None
    return ray


@contextmanager
def connect_cluster(address: str | None) -> Iterator[Any]:
    """Connect to a cluster, or start one of this machine, for as long as the context lasts; yield the module.

    Without an address the cluster is always a new one, also where others run here or `RAY_ADDRESS` names one.

    Raises:
        DependencyError: ray is not installed.
        InfrastructureError: no cluster at the address, or none could be started.
    """
    ray = import_ray()
    if ray.is_initialized():
        yield ray
        return
    handler = signal.getsignal(signal.SIGTERM)
    own: dict[str, Any] = {"address": address}
    if address is None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray would report to its makers
        own = {"address": "local"}  # with None, Ray joins a cluster that it knows of
        own |= {"num_cpus": len(os.sched_getaffinity(0)), "object_store_memory": STORE_BYTES}  # in a SLURM job: its own
        own |= {"include_dashboard": False}
    try:
        ray.init(**own, log_to_driver=False, logging_level="error")
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        if address is None:
            raise InfrastructureError(f"a Ray cluster cannot be started on this machine: {error}") from error
        raise InfrastructureError(
            f"no Ray cluster at {address}: {error}; expected the address of a cluster started with `ray start --head`, "
            "such as auto or HOST:6379, or none for a local cluster on this machine"
        ) from error
    try:
        _restore(handler)
        yield ray
    finally:
        ray.shutdown()
        _restore(handler)


def run_tasks(
    place: Engine, function: Callable[[Item], Any], items: Sequence[Item], workers: int
) -> Iterator[tuple[Item, Any]]:
    """Call a function on items as Ray tasks, at most `workers` at a time; yield items and results as they arrive.

    A task whose process or node is lost is repeated. Tasks run in this process's folder, so that relative paths hold.

    Raises:
        DependencyError, InfrastructureError: as of `connect_cluster`; a task was lost every time.
        Error: what the function raised.
    """
    with connect_cluster(place.address) as ray:
        task = ray.remote(num_cpus=1, num_gpus=place.worker_gpus, max_retries=RETRIES)(_call)
        left, running = list(reversed(items)), dict[Any, Item]()
        try:
            while left or running:
                while left and len(running) < workers:
                    item = left.pop()
                    running[task.remote(function, item, str(Path.cwd()))] = item
                (done,), _ = ray.wait(list(running))
                yield running.pop(done), _receive(ray, done)
        finally:
            for ref in running:
                ray.cancel(ref, force=True)


def map_batches(
    place: Engine,
    kind: type,
    arguments: Mapping[str, Any],
    rows: Iterable[Mapping[str, Any]],
    workers: int,
    batch: int,
) -> Iterator[dict[str, Any]]:
    """Give rows to a pool of actors, a batch at a time, by Ray Data; yield rows of their answers as they arrive.

    Args:
        place: where.
        kind: class that is made once in each actor, with `arguments`, and called with {name: [B]} for {name: [B]}.
        arguments: by name.
        rows: plain values by name.
        workers: number of actors.
        batch: rows of a call.

    Raises:
        DependencyError, InfrastructureError: as of `connect_cluster`; an actor was lost every time.
        Error: what an actor raised.
    """
    with connect_cluster(place.address) as ray:
        import ray.data as ray_data

        ray_data.DataContext.get_current().enable_progress_bars = False
        logging.getLogger("ray.data").setLevel(logging.ERROR)
        pool = ray_data.ActorPoolStrategy(size=workers)
        found = ray_data.from_items([dict(row) for row in rows], override_num_blocks=workers).map_batches(
            _ActorObject,
            fn_constructor_kwargs={"kind": kind, "arguments": dict(arguments), "folder": str(Path.cwd())},
            batch_size=batch,
            compute=pool,
            num_cpus=1,
            num_gpus=place.worker_gpus,
        )
        try:
            for row in found.iter_rows():
                if FAILED in row:
                    raise _remake_error(row[FAILED], row["text"])
                yield row
        except ray.exceptions.RayError as error:
            raise _find_cause(error) from error


class _ActorObject:
    """An object in an actor of Ray Data, in the folder of whoever asks it."""

    def __init__(self, kind: type, arguments: Mapping[str, Any], folder: str) -> None:
        os.chdir(folder)
        self._object = kind(**arguments)

    def __call__(self, batch: Mapping[str, Any]) -> Any:
        """Return the object's answer, or the error that it raised on purpose: Ray Data would send its text alone."""
        try:
            return self._object(batch)
        except Error as error:
            return {FAILED: [type(error).__name__], "text": [str(error)]}


def _call(function: Callable[[Item], Any], item: Item, folder: str) -> Any:
    """Call a function in another process; it has one core."""
    os.chdir(folder)
    os.environ.setdefault("WIW_NUM_THREADS", "1")
    return function(item)


def _receive(ray: Any, ref: Any) -> Any:
    try:
        return ray.get(ref)
    except ray.exceptions.RayError as error:
        raise _find_cause(error) from error


def _find_cause(error: Any) -> Exception:
    """Return the error that work on the cluster has raised on purpose, else that the work was lost."""
    found: BaseException | None = error
    while found is not None:
        cause = found.__cause__ if not hasattr(found, "cause") else found.cause
        if isinstance(found, Error):
            return found
        found = cause if isinstance(cause, BaseException) else None
    text = str(error).strip()
    return InfrastructureError(f"work on the Ray cluster was lost: {text}; repeat the command with fewer workers")


def _remake_error(name: str, text: str) -> Error:
    """Return an error from the name of its class."""
    return (find_error_class(name) or InfrastructureError)(text)


def _restore(handler: Any) -> None:
    """Put back the handler of SIGTERM, which Ray replaces: a run that is stopped is closed in order."""
    try:
        signal.signal(signal.SIGTERM, handler)
    except ValueError:  # not in the main thread, where Ray replaces none
        return
