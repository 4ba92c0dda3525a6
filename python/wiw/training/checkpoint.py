# SPDX-License-Identifier: Apache-2.0
"""The state of a training in a file, so that an interrupted training resumes and ends with the same weights."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file


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
        return cls(out.with_name(f"{out.name}.checkpoint"), identity)

    def load(self) -> TrainingState | None:
        """Read the file; None if there is none.

        Raises:
            ArgumentError: it belongs to another training.
            FileError: it is damaged.
        """
        import torch

        if not self.path.exists():
            return None
        try:
            content = torch.load(self.path, weights_only=True, map_location="cpu", mmap=self.shared)
            identity = content["of"]
            state = TrainingState(content["epochs"], content["step"], content["state"])
        except Exception as error:  # what torch's unpickler meets in damaged bytes raises nearly anything
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

        packed = io.BytesIO()  # torch's own writer reports a full disk by a bare RuntimeError
        torch.save({"of": self._identity, "epochs": epochs, "step": step, "state": state}, packed)
        with atomic_file(self.path) as draft:
            draft.write_bytes(packed.getbuffer())

    def remove(self) -> None:
        """Delete the file at the end of training."""
        self.path.unlink(missing_ok=True)
