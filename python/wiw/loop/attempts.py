# SPDX-License-Identifier: Apache-2.0
"""Asking a world model until it answers as agreed: a few tries a call, each within a deadline.

A call that outlives its deadline is abandoned, as Python cannot end a thread: it continues until it returns or the
process ends, with its memory, and on a GPU with its place in the queue. The next try waits once more for it, so that a
model that is merely slow is never entered twice at a time; then it calls in a new thread, which recovers from a lost
request to a server. A GPU kernel that never ends lets every try pass its deadline, and the episode fails. Compiled code
that hangs while it holds Python's lock stops the process: nothing in it can look at a clock.

A model in a separate process (`wiw.isolation`) is asked in the caller's thread: where it is late, its process is
killed, and the next try finds a new one.

A model cannot end the process: `sys.exit()` in it counts as an error like any exception. Threads that it starts in its
constructor or in a call are daemons unless it says otherwise, for they are started in one.
"""

from __future__ import annotations

import inspect
import queue
import sys
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from contextvars import copy_context
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ConstructionError, ContractError, RolloutError, is_stop_request, read_text
from wiw.isolation.failures import EndedError, ExitError, LateError, RaisedError
from wiw.isolation.models import IsolatedModel, construction_deadline
from wiw.loop.limits import DEADLINE
from wiw.loop.model_wrapper import ModelWrapper
from wiw.registry import WORLD_MODELS, world_model
from wiw.types import Conditioning, Control
from wiw.world_models.base import WorldModel, answer_deadline, check_rollout

TRIES = 3
KINDS = (ContractError, RolloutError, LateError, ExitError, EndedError, RaisedError)
"""Errors that say their own kind."""
PAUSES = (0.2, 1.0)
"""Seconds before the second and the third try; a server that restarts may be back by then."""


class Attempted(ModelWrapper):
    """A world model whose rollouts are checked against the contract and limited by a deadline.

    Args:
        model: what is asked.
        deadline: seconds that a call may take; `math.inf` waits for ever. A model that is given the simulator is asked
            in the caller's own thread, without a deadline: a graphics context belongs to the thread that made it.
        checks_pictures: whether frames must show the observed place; those of a world that an experiment changes do
            not.
    """

    def __init__(self, model: WorldModel, deadline: float = DEADLINE, checks_pictures: bool = True) -> None:
        if not deadline > 0:
            raise ArgumentError(f"deadline: expected seconds above 0 (inf waits for ever), got {deadline}")
        super().__init__(model)
        self.deadline, self._checks_pictures = deadline, checks_pictures
        self._tally: Counter[str] = Counter()
        self._thread: _WorkerThread | None = None

    def __reduce__(self) -> Any:
        return Attempted, (self.model, self.deadline, self._checks_pictures)

    @property
    def spent(self) -> Mapping[str, float]:
        """Requests so far, on top of what the model says itself.

        `calls` that the model has answered or not, their `rows` and `frames` (padding and frames that other rows answer
        left out), and `retries`, calls that repeat one that gave nothing.
        """
        return {**super().spent, **self._tally}

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Call the model until it gives a valid rollout.

        Raises:
            RolloutError: every try failed. An answer that breaks the contract in the same way twice is not asked for a
                third time.
        """
        errors: list[str] = []
        for attempt in range(TRIES):
            self._count(controls)
            try:
                return self.once(observations, controls, seeds)
            except Exception as error:
                errors.append(_describe_error(error))
                repeated = isinstance(error, ContractError) and errors.count(errors[-1]) > 1
                if attempt + 1 == TRIES or repeated:
                    raise self._build_error(error, errors) from error
                self._tally["retries"] += 1
                time.sleep(PAUSES[attempt])
        raise AssertionError("unreachable")

    def once(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Call the model once, without retries and without counting.

        Raises:
            LateError: no answer within the deadline.
            ContractError: the answer breaks the contract.
            ExitError: the model tried to end the process; and whatever else the model raises.
        """
        wanted = self.model, observations, controls, seeds
        return self._ask(lambda: _catch_exit(lambda: check_rollout(*wanted, checks_pictures=self._checks_pictures)))

    def _count(self, controls: Sequence[Control]) -> None:
        self._tally["calls"] += 1
        self._tally["rows"] += len(controls)
        self._tally["frames"] += sum(max(0, control.length - control.shared) for control in controls)

    def _build_error(self, error: Exception, errors: Sequence[str]) -> RolloutError:
        kind = error.kind if isinstance(error, KINDS) else "raised"
        name = type(self.model.unwrapped).__name__
        return RolloutError(
            f"{name} gave no usable answer in {len(errors)} attempts; the last error: {errors[-1]}", kind
        )

    def _ask(self, work: Callable[[], NDArray[np.uint8]]) -> NDArray[np.uint8]:
        if self.deadline > threading.TIMEOUT_MAX or "simulator" in self.model.accepts.needs:
            return work()
        if isinstance(self.model.unwrapped, IsolatedModel):
            try:
                with answer_deadline(self.deadline):
                    return work()
            except LateError as error:
                text = f"no answer within {self.deadline:g} s (deadline); its process was killed"
                raise LateError(text) from error
        if self._thread is not None and not self._thread.wait_until_idle(self.deadline):
            self._thread = None
        if self._thread is None:
            self._thread = _WorkerThread()
        with answer_deadline(self.deadline):
            return self._thread.call(work, self.deadline)


def make_model(what: Any, deadline: float = DEADLINE, **options: Any) -> WorldModel | None:
    """Make a world model as `wiw.world_model` does, within a deadline; None for "none".

    A model whose class declares published weights (`requires.weights`) has no deadline: fetching them the first time
    may take hours, and the library that fetches them has its own timeouts.

    Raises:
        RegistryError: unknown name, or options that do not fit.
        ConstructionError: the constructor raised, or did not return in time; and other errors of wiw that it raises.
    """
    found = WORLD_MODELS.find(what) if isinstance(what, str) else what
    isolated = inspect.isclass(found) and issubclass(found, IsolatedModel) and options.get("isolate", True)
    makes = inspect.isclass(found) or isinstance(found, partial) or inspect.isfunction(found)
    fetches = inspect.isclass(found) and issubclass(found, WorldModel) and bool(found.requires.weights)
    make = partial(world_model, what, **options)
    if isolated and not fetches:
        with construction_deadline(deadline):
            return cast(WorldModel, make())
    if not makes or fetches or deadline > threading.TIMEOUT_MAX:
        made: WorldModel | None = make()
        return made
    try:
        made = _WorkerThread().call(make, deadline)
    except LateError as error:
        name = what if isinstance(what, str) else getattr(what, "__qualname__", repr(what))
        raise ConstructionError(
            f"world model '{name}' cannot be built: its constructor did not return within {deadline:g} s (deadline). "
            "Is it waiting for a download, a lock, a server or a prompt? If it is just slow, give a longer deadline",
            "deadline",
        ) from error
    return made


def _catch_exit(work: Callable[[], Any]) -> Any:
    """Call `work`; turn a model's attempt to end the process into an `ExitError`."""
    try:
        return work()
    except BaseException as error:
        if isinstance(error, Exception) or is_stop_request(error):
            raise
        raise ExitError(
            f"{error!r}, as if to end the process; a model that cannot answer should raise an Exception"
        ) from error


class _WorkItem:
    """A function to call, and its result."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self.work: Callable[[], Any] | None = work
        self.context, self.torch = copy_context(), _read_torch_state()
        self.ended = threading.Event()
        self.value: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        assert self.work is not None
        try:
            with _apply_torch_state(self.torch):
                self.value = self.context.run(self.work)
        except BaseException as error:
            self.error = error
        self.work = None
        self.ended.set()


class _WorkerThread:
    """A thread that makes calls for another one; always the same thread, as libraries keep thread-local state."""

    def __init__(self) -> None:
        self._items: queue.SimpleQueue[_WorkItem | None] = queue.SimpleQueue()
        self._last: _WorkItem | None = None
        threading.Thread(target=_serve, args=(self._items,), daemon=True, name="wiw world model").start()
        weakref.finalize(self, self._items.put, None)

    def wait_until_idle(self, seconds: float) -> bool:
        """Return whether the thread is idle within so many seconds."""
        return self._last is None or self._last.ended.wait(seconds)

    def call(self, work: Callable[[], Any], seconds: float) -> Any:
        item = self._last = _WorkItem(work)
        self._items.put(item)
        if not item.ended.wait(seconds):
            raise LateError(f"no answer within {seconds:g} s (deadline); the call was abandoned")
        self._last = None
        if item.error is not None:
            raise item.error
        return item.value


def _serve(items: queue.SimpleQueue[_WorkItem | None]) -> None:
    while (item := items.get()) is not None:
        item.run()
        del item  # else its frames would stay until the next one comes


def _describe_error(error: Exception) -> str:
    text = read_text(error)
    told = ContractError | LateError | ExitError | EndedError | RaisedError
    return text if isinstance(error, told) else f"{type(error).__name__}: {text}"


def _read_torch_state() -> tuple[bool, bool, int | None] | None:
    """Return torch's thread-local state: gradients, inference mode, GPU."""
    torch = sys.modules.get("torch")
    if torch is None:
        return None
    gpu = torch.cuda.current_device() if torch.cuda.is_initialized() else None
    return torch.is_grad_enabled(), torch.is_inference_mode_enabled(), gpu


@contextmanager
def _apply_torch_state(state: tuple[bool, bool, int | None] | None) -> Iterator[None]:
    """Apply the caller's torch state in the worker thread."""
    with ExitStack() as stack:
        if state is not None:
            torch, (gradients, inference, gpu) = sys.modules["torch"], state
            stack.enter_context(torch.inference_mode(inference))
            stack.enter_context(torch.set_grad_enabled(gradients))
            if gpu is not None:
                torch.cuda.set_device(gpu)
        yield
