# SPDX-License-Identifier: Apache-2.0
"""Programs that draw the curves of a training while it runs: trackio, wandb and tensorboard, through accelerate."""

from __future__ import annotations

import uuid
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

from wiw.errors import ArgumentError, DependencyError
from wiw.files import atomic_file

TRACKERS = ("trackio", "wandb", "tensorboard")
RUN_ID = "tracker-run-id"
"""File in a training's log folder."""


class Tracker(Protocol):
    """An object that receives numbers by step; `accelerate.tracking.GeneralTracker` is one."""

    def log(self, values: dict[str, Any], step: int | None = None) -> None:
        """Take numbers by name."""

    def finish(self) -> None:
        """Write what is left."""


def open_tracker(name: str, run: str, folder: Path, config: Mapping[str, Any]) -> Tracker:
    """Start a tracker, or go on with the run of the same training before it was stopped.

    Args:
        name: one of `TRACKERS`.
        run: name of the training: the tracker's project.
        folder: of the training's log, which keeps the run's id. tensorboard writes there; the others have their own
            places.
        config: numbers and texts that the training is made with.

    Raises:
        ArgumentError: the name is unknown.
        DependencyError: it, or accelerate, is not installed.
        FileError: the folder cannot be written.
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
    elif name == "trackio":  # which knows runs by their names
        tracker = tracking.TrackioTracker(run, name=f"{run}-{_read_run_id(folder)}", resume="allow")
    else:
        tracker = tracking.WandBTracker(run, id=_read_run_id(folder), resume="allow")
    tracker.start()
    tracker.store_init_configuration(
        {key: value if isinstance(value, bool | int | float | str) else str(value) for key, value in config.items()}
    )
    return tracker


def _read_run_id(folder: Path) -> str:
    """Return the id of a training's run, which is kept in its folder from the first time on."""
    file = folder / RUN_ID
    if not file.exists():
        with atomic_file(file) as draft:
            draft.write_text(f"{uuid.uuid4().hex[:12]}\n", encoding="utf-8")
    return file.read_text(encoding="utf-8").strip()
