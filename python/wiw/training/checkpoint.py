# SPDX-License-Identifier: Apache-2.0
"""Where a training stands, in a file, so that one that was stopped goes on to the same end."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from wiw.errors import ArgumentError, FileError
from wiw.files import whole_file


class Kept:
    """A lesson whose next step depends on how many it has done, on what it is taught, and on its `parts` alone."""

    parts: ClassVar[tuple[str, ...]]
    """Names of attributes with a state: networks, and what optimises them."""
    count = 0
    """Steps done."""

    def state(self) -> dict[str, Any]:
        """All that the next step depends on, but for what is taught and how."""
        return {"count": self.count, **{name: getattr(self, name).state_dict() for name in self.parts}}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Goes on from a state."""
        self.count = state["count"]
        for name in self.parts:
            getattr(self, name).load_state_dict(state[name])


@dataclass(frozen=True)
class Stand:
    """How far a training has come."""

    epochs: int
    """Of the whole training."""
    step: int
    """Steps done."""
    state: Mapping[str, Any]


class Checkpoint:
    """A file that is written about once a minute and removed at the end.

    Args:
        path: of the file.
        of: what is trained on and how, JSON-able; a file of another training is not gone on from.
        seconds: from one writing to the next.
    """

    def __init__(self, path: Path, of: Mapping[str, Any], seconds: float = 60.0) -> None:
        self.path, self.seconds = path, seconds
        self._of = json.dumps(dict(of), sort_keys=True)
        self._last = time.monotonic()

    def stand(self) -> Stand | None:
        """What the file says; None where there is none.

        Raises:
            ArgumentError: it is of another training.
            FileError: it is damaged.
        """
        import torch

        if not self.path.exists():
            return None
        try:
            held = torch.load(self.path, weights_only=True)
            of, stand = held["of"], Stand(held["epochs"], held["step"], held["state"])
        except Exception as error:  # what torch's unpickler meets in damaged bytes raises nearly anything
            raise FileError(f"{self.path}: damaged ({error}); delete it to begin anew") from error
        if of != self._of:
            raise ArgumentError(
                f"{self.path}: another training stopped there; delete it to begin anew, or ask for that"
            )
        return stand

    def keep(self, lesson: Kept, epochs: int, step: int) -> None:
        """Writes the file, whole or not at all, if the last time is long enough ago.

        Raises:
            FileError: it cannot be written.
        """
        import torch

        if time.monotonic() < self._last + self.seconds:
            return
        packed = io.BytesIO()  # torch's own writer tells a full disk by a bare RuntimeError
        torch.save({"of": self._of, "epochs": epochs, "step": step, "state": lesson.state()}, packed)
        with whole_file(self.path) as draft:
            draft.write_bytes(packed.getbuffer())
        self._last = time.monotonic()

    def remove(self) -> None:
        """At the end."""
        self.path.unlink(missing_ok=True)
