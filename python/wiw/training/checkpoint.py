# SPDX-License-Identifier: Apache-2.0
"""The state of a training in a file, so that an interrupted training resumes and ends with the same weights."""

from __future__ import annotations

import errno
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, cast

from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.networks import is_out_of_memory


class _StateFile:
    """A file for torch to write, whose first error is raised at its end: torch would turn it into a RuntimeError."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._error: OSError | None = None

    def __enter__(self) -> _StateFile:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            self._file.close()
        except OSError as error:
            self._error = self._error or error
        if self._error is not None and kind is None:
            raise self._error

    def write(self, data: bytes | memoryview) -> int:
        """Write data unless an earlier write failed; return its length in any case."""
        self._attempt(lambda: self._file.write(data))
        return memoryview(data).nbytes

    def flush(self) -> None:
        """Hand on what is buffered."""
        self._attempt(self._file.flush)

    def _attempt(self, write: Callable[[], object]) -> None:
        if self._error is None:
            try:
                write()
            except OSError as error:
                self._error = error


class ResumableTrainer:
    """A trainer whose next step depends only on its step count, its data, its recipe and its `stateful_parts`."""

    stateful_parts: ClassVar[tuple[str, ...]]
    """Names of the attributes that have a state: networks and optimisers."""
    step_count = 0
    """Number of steps done."""

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next step depends on, except the data and the recipe."""
        return {"count": self.step_count, **{name: getattr(self, name).state_dict() for name in self.stateful_parts}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.step_count = state["count"]
        for name in self.stateful_parts:
            getattr(self, name).load_state_dict(state[name])


@dataclass(frozen=True)
class TrainingState:
    """The state of a training."""

    epochs: int
    """Epochs of the whole training."""
    step: int
    """Number of steps done."""
    state: Mapping[str, Any]


def locate_checkpoint(out: Path) -> Path:
    """Return the checkpoint of the training that writes `out`: the file beside it."""
    return out.with_name(f"{out.name}.checkpoint")


class Checkpoint:
    """A checkpoint file, written about once a minute during training and removed at the end.

    Args:
        path: the file.
        identity: JSON-able description of the data and the recipe; the checkpoint of another training is refused.
        seconds: least time between two writes.
        shared: whether several processes read the file, which then is in main memory once.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any], seconds: float = 60.0, *, shared: bool = False) -> None:
        self.path, self.seconds, self.shared = path, seconds, shared
        self._identity = json.dumps(dict(identity), sort_keys=True)
        self._last_saved = time.monotonic()

    @classmethod
    def beside(cls, out: Path, identity: Mapping[str, Any]) -> Checkpoint:
        """Return the checkpoint of the training that writes `out`, in the file beside it."""
        return cls(locate_checkpoint(out), identity)

    def load(self) -> TrainingState | None:
        """Read the file; None if there is none.

        Raises:
            ArgumentError: it belongs to another training.
            FileError: it cannot be read, or is damaged.
        """
        import torch

        if not self.path.exists():
            return None
        try:
            content = torch.load(self.path, weights_only=True, map_location="cpu", mmap=self.shared)
            identity = content["of"]
            state = TrainingState(content["epochs"], content["step"], content["state"])
        except Exception as error:  # what torch's unpickler meets in damaged bytes raises nearly anything
            if _is_of_machine(error):
                raise FileError(
                    f"{self.path}: cannot be read ({error}); expected a readable file and main memory for it: mend "
                    "this, then repeat the command to resume"
                ) from error
            raise FileError(f"{self.path}: damaged ({error}); delete it to start again") from error
        if identity != self._identity:
            raise ArgumentError(
                f"{self.path} is the checkpoint of a training with different data or options; delete it to start "
                "again, or resume with the same options"
            )
        return state

    def save_if_due(self, trainer: ResumableTrainer, epochs: int, step: int) -> None:
        """Write the file atomically, if the last write was long enough ago.

        Raises:
            FileError: it cannot be written.
        """
        if self.is_due():
            self.save(trainer, epochs, step)

    def is_due(self) -> bool:
        """Return whether the last write was long enough ago."""
        return time.monotonic() >= self._last_saved + self.seconds

    def save(self, trainer: ResumableTrainer, epochs: int, step: int) -> None:
        """Write the file atomically.

        Raises:
            FileError: it cannot be written.
        """
        self.write(trainer.state_dict(), epochs, step)
        self._last_saved = time.monotonic()

    def write(self, state: Mapping[str, Any], epochs: int, step: int) -> None:
        """Write a trainer's state atomically.

        Raises:
            FileError: it cannot be written.
        """
        import torch

        content = {"of": self._identity, "epochs": epochs, "step": step, "state": state}
        with atomic_file(self.path) as draft, _StateFile(draft.open("wb")) as file:
            torch.save(content, cast(BinaryIO, file))

    def remove(self) -> None:
        """Delete the file at the end of training."""
        self.path.unlink(missing_ok=True)


def require_unfinished(out: Path) -> None:
    """Check that a training would replace no finished weights: its file is new, or the checkpoint beside it is left.

    Raises:
        ArgumentError: the file exists, without a checkpoint.
    """
    if out.exists() and not locate_checkpoint(out).exists():
        raise ArgumentError(
            f"{out} exists, and there is no checkpoint of an unfinished training beside it: training would replace it; "
            "use it, delete it, or choose another file"
        )


def _is_of_machine(error: Exception) -> bool:
    """Return whether a file could not be read for a reason that says nothing of its content."""
    # EINVAL is of a place in the file that was read from damaged bytes.
    of_system = isinstance(error, OSError) and error.errno not in (None, errno.EINVAL)
    return of_system or is_out_of_memory(error)
