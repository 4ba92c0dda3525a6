# SPDX-License-Identifier: Apache-2.0
"""Record one demonstration: an expert at its table, and the front view of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.demonstrations import Demonstration, Format, encode_depth, encode_image
from wiw.errors import ArgumentError, InfrastructureError
from wiw.render import Output, resolve_backend
from wiw.tabletop.base import TableSetup, TabletopTask
from wiw.tabletop.workbench import WRIST, Film, Workbench
from wiw.typed_values import read_values
from wiw.types import check_seed

Backend = Literal["auto", "cpu", "gpu"]
POSES = 15
"""Maximum number of poses of an expert, as in an episode of the evaluation."""
ATTEMPTS = 20
"""Tables set up for one demonstration before its expert counts as broken."""
FIRST_SEED = 2**31
"""Evaluation draws the seeds of its tables below this, so that no table occurs in both."""


@dataclass(frozen=True)
class Collection:
    """Options of a collection.

    Raises:
        ArgumentError: a number is out of range.
    """

    episodes: int = 200
    """Demonstrations of each task."""
    seed: int = 0
    size: int = 480
    """Height and width of the front view in pixels."""
    frames: int = 150
    """Frames of each demonstration."""
    format: Format = "jpeg"
    depth: bool = False
    wrist: bool = False
    """Whether the wrist camera's views are recorded too, with their depths where those of the front view are."""
    keep_failed: bool = False
    """Whether a failed demonstration is kept and marked as failed; otherwise another table replaces it."""
    backend: Backend = "auto"
    """Renderer; images of different ones differ slightly."""

    def __post_init__(self) -> None:
        for name, least in (("episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ArgumentError(f"collect: expected {name} of {least} or more, got {getattr(self, name)}")
        check_seed(self.seed)
        if not 16 <= self.size <= 4096:
            raise ArgumentError(f"collect: expected a size from 16 to 4096 pixels, got {self.size}")
        if self.frames <= POSES:
            raise ArgumentError(
                f"collect: expected over {POSES} frames, so that there is one for each action's end, got {self.frames}"
            )


def read_collection(given: Mapping[str, Any]) -> Collection:
    """Return the options of a collection, with a renderer that works here.

    Args:
        given: fields of `Collection`, by name.

    Raises:
        ArgumentError: an option is unknown, of another type or out of range.
        BackendError: the requested renderer does not work here.
    """
    collection = Collection(**read_values(Collection, given, "collect", "option"))
    return replace(collection, backend=resolve_backend(collection.backend))


def record_demonstration(task: TabletopTask, episode: int, collection: Collection) -> tuple[Demonstration, int]:
    """Record a demonstration; return it with the number of tables that its expert failed at.

    Raises:
        InfrastructureError: it failed at too many.
    """
    variation = episode % task.variations
    for attempt in range(ATTEMPTS):
        seed = table_seed(collection.seed, episode, attempt)
        setup = task.create_setup(seed, variation)
        played = _ExpertRun(task, setup, setup.build_workbench(collection.backend))
        if played.success or collection.keep_failed:
            named = {"task": task.name, "variation": variation, "seed": seed, "episode": episode}
            return played.build_demonstration(collection, named), attempt + (not played.success)
    raise InfrastructureError(
        f"collect: the expert of {task.name} failed at {ATTEMPTS} tables in a row (demonstration {episode}, seed "
        f"{collection.seed}); tests/benchmark/expert_success.py measures how often it should"
    )


def table_seed(seed: int, episode: int, attempt: int) -> int:
    """Return the seed of a table, which evaluation never uses."""
    return FIRST_SEED + int(core.fold_key([seed, episode, attempt])) % FIRST_SEED


class _ExpertRun:
    """Everything that an expert did at a table, every physics step of it."""

    def __init__(self, task: TabletopTask, setup: TableSetup, bench: Workbench) -> None:
        self._setup, self._start = setup, bench.fork()
        self._actions: list[NDArray[np.float64]] = []
        self._films: list[Film] = []
        self._after: list[Workbench] = []
        while len(self._actions) < POSES and not task.is_success(bench, setup):
            for pose in task.plan_expert(bench.get_poses(setup.objects), setup.target)[: POSES - len(self._actions)]:
                self._actions.append(pose)
                self._films.append(bench.film(pose)[1])
                self._after.append(bench.fork())
                if task.is_success(bench, setup):
                    break
        self.success = task.is_success(bench, setup)

    def build_demonstration(self, collection: Collection, named: dict[str, Any]) -> Demonstration:
        """Render `collection.frames` frames; `named` are the demonstration's other fields."""
        steps, keys, ended = self._sample_frames(collection.frames)
        outputs: tuple[Output, ...] = ("color", "depth") if collection.depth else ("color",)
        seconds, poses, wrist_poses = [], [], []
        cameras = ("front", WRIST) if collection.wrist else ("front",)
        images: dict[str, list[bytes]] = {camera: [] for camera in cameras}
        depths: dict[str, list[bytes]] = {camera: [] for camera in cameras if collection.depth}
        for moment in self._iterate_states(steps, keys, ended):
            seconds.append(moment.seconds - self._start.seconds)
            poses.append(moment.pose)
            wrist_poses.append(moment.get_camera_pose(WRIST))
            for camera in cameras:
                seen = moment.render_view(camera, (collection.size, collection.size), outputs)
                images[camera].append(encode_image(seen["color"], collection.format))
                if collection.depth:
                    depths[camera].append(encode_depth(seen["depth"]))
        return Demonstration(
            **named,
            instruction=self._setup.instruction,
            success=self.success,
            places=self._start.get_poses(self._setup.objects),
            seconds=np.array(seconds),
            poses=np.stack(poses),
            actions=np.stack(self._actions)[np.maximum(keys, 1) - 1],
            keys=keys,
            ended=ended,
            encoded_images=tuple(images["front"]),
            encoded_depths=tuple(depths["front"]) if "front" in depths else None,
            encoded_wrist_images=tuple(images[WRIST]) if WRIST in images else None,
            encoded_wrist_depths=tuple(depths[WRIST]) if WRIST in depths else None,
            wrist_poses=np.stack(wrist_poses) if collection.wrist else None,
        )

    def _sample_frames(self, frames: int) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.bool_]]:
        """Return for each frame the physics step of its action, the action's number, and whether the action ends
        there.
        """
        ends = np.cumsum([0, *(len(film) - 1 for film in self._films)])
        at, shown = choose_end_frames(ends, frames), np.arange(frames)
        steps = np.rint(np.interp(shown, at, ends)).astype(np.int64)
        keys = np.searchsorted(at, shown).astype(np.int32)
        return steps - ends[np.maximum(keys, 1) - 1], keys, np.isin(shown, at[1:])

    def _iterate_states(
        self, steps: NDArray[np.int64], keys: NDArray[np.int32], ended: NDArray[np.bool_]
    ) -> Iterator[Workbench]:
        yield self._start
        for step, key, end in zip(steps[1:], keys[1:], ended[1:], strict=True):
            yield self._after[key - 1] if end else self._films[key - 1][step]


def choose_end_frames(ends: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
    """Return int64 [K + 1]: the frames that show the steps `ends` [K + 1], in proportion and at least one apart."""
    last, order = frames - 1, np.arange(len(ends))
    wanted = np.rint(ends / max(1, ends[-1]) * last).astype(np.int64)
    wanted[-1] = last  # also where nothing has moved
    rising = np.maximum.accumulate(wanted - order) + order
    return np.minimum(rising, last - order[::-1])
