# SPDX-License-Identifier: Apache-2.0
"""Watches what a world model does to the arrays that it is given, and to those that it has answered with."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.isolation.child import Host
from wiw.isolation.models import IsolatedModel
from wiw.loop.model_wrapper import ModelWrapper
from wiw.types import Conditioning, Control
from wiw.world_models.base import WorldModel
from wiw.world_models.pictures import sample

REMEMBERED = 4
"""Answers that are looked at again."""
PLAN = ("actions", "trajectory", "viewpoints", "ids")
"""Arrays of a control."""
PAST = ("images", "poses", "actions", "lengths", "count")
"""Arrays of a history."""
Frames = NDArray[np.uint8]


@dataclass
class Watched:
    """Record of what a model has done so far."""

    changed: tuple[str, ...] = ()
    """Names of the inputs that it has changed."""
    reuses: bool = False
    """Whether an answer lay in the memory of an earlier one."""
    rewrites: bool = False
    """Whether an answer has changed after it was given."""


class CallWatch(ModelWrapper):
    """Passes calls on, and compares arrays before and after."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__(model)
        self._changed: set[str] = set()
        self._reuses = self._rewrites = False
        self._answers: deque[tuple[Frames, Frames]] = deque(maxlen=REMEMBERED)
        """The latest answers themselves, and what a sample of their pixels was when they came."""

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return what the model returns."""
        given = list_arrays(observations, controls, seeds)
        kept = [array.copy() for _, array in given]
        frames = self.model.rollout(observations, controls, seeds)
        self._changed |= {
            name for (name, array), before in zip(given, kept, strict=True) if not np.array_equal(array, before)
        }
        if isinstance(frames, np.ndarray):
            self._reuses |= any(np.may_share_memory(frames, earlier) for earlier, _ in self._answers)
            self._look_again()
            self._answers.append((frames, sample(frames).copy()))
        return frames

    def read(self) -> Watched:
        """Return what was seen, with another look at the recent answers."""
        self._look_again()
        return Watched(tuple(sorted(self._changed)), self._reuses, self._rewrites)

    def _look_again(self) -> None:
        self._rewrites |= any(not np.array_equal(sample(frames), before) for frames, before in self._answers)


def list_arrays(
    observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
) -> list[tuple[str, NDArray[Any]]]:
    """Return the arrays of a request with their names."""
    given = [("seeds", seeds)]
    given += [(f"observations.{name}", getattr(observations, name)) for name in ("image", "depth", "semantic")]
    if observations.history is not None:
        given += [(f"observations.history.{name}", getattr(observations.history, name)) for name in PAST]
    given += [(f"control.{name}", getattr(control, name)) for control in controls for name in PLAN]
    return [(name, array) for name, array in given if array is not None]


def watch_calls(model: WorldModel) -> WorldModel:
    """Return a model that `read_watch` tells of: a wrapper, or the model itself where it is watched in its process."""
    if not isinstance(model, IsolatedModel):
        return CallWatch(model)
    model.ask(_watch_hosted)
    return model


def read_watch(model: WorldModel) -> Watched:
    """Return what was seen of a model that is watched."""
    if isinstance(model, CallWatch):
        return model.read()
    assert isinstance(model, IsolatedModel)
    changed, reuses, rewrites = model.ask(_read_hosted)
    return Watched(tuple(map(str, changed)), bool(reuses), bool(rewrites))


def _watch_hosted(host: Host) -> None:
    host.made = CallWatch(host.made)


def _read_hosted(host: Host) -> tuple[tuple[str, ...], bool, bool]:
    found = host.made.read() if isinstance(host.made, CallWatch) else Watched()  # another process than the watched one
    return found.changed, found.reuses, found.rewrites
