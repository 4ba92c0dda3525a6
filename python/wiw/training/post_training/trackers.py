# SPDX-License-Identifier: Apache-2.0
"""Programs that draw the curves of a training while it runs: trackio, wandb and tensorboard, through accelerate."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from wiw.errors import ArgumentError, DependencyError

TRACKERS = ("trackio", "wandb", "tensorboard")


class Tracker(Protocol):
    """An object that receives numbers by step; `accelerate.tracking.GeneralTracker` is one."""

    def log(self, values: dict[str, Any], step: int | None = None) -> None:
        """Take numbers by name."""

    def finish(self) -> None:
        """Write what is left."""


def open_tracker(name: str, run: str, folder: Path, config: Mapping[str, Any]) -> Tracker:
    """Start a tracker.

    Args:
        name: one of `TRACKERS`.
        run: name of the training: the tracker's project.
        folder: where tensorboard writes; the others have their own places.
        config: numbers and texts that the training is made with.

    Raises:
        ArgumentError: the name is unknown.
        DependencyError: it, or accelerate, is not installed.
    """
    if name not in TRACKERS:
        raise ArgumentError(f"tracker: expected one of {', '.join(TRACKERS)}, got '{name}'")
    for package, command in (("accelerate", "pip install 'wiw[diffusers]'"), (name, f"pip install {name}")):
        if find_spec(package) is None:
            raise DependencyError(f"tracker '{name}' needs {package}, which is not installed: {command}")
    from accelerate import PartialState, tracking

    PartialState()  # accelerate's trackers ask it which process they are in

    if name == "tensorboard":
        tracker = tracking.TensorBoardTracker(run, logging_dir=folder)
    else:
        tracker = {"trackio": tracking.TrackioTracker, "wandb": tracking.WandBTracker}[name](run)
    tracker.start()
    tracker.store_init_configuration(
        {key: value if isinstance(value, bool | int | float | str) else str(value) for key, value in config.items()}
    )
    return tracker
