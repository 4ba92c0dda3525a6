# SPDX-License-Identifier: Apache-2.0
"""Estimate a navigation dataset before it is recorded: frames, hours and gigabytes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wiw.datasets.worlds import world
from wiw.nav import NavMesh
from wiw.scenes import is_generated, open_outline
from wiw.training.collect_navigation import resolve_train_scenes
from wiw.training.navigation_recording import NavigationCollection, find_sources, read_collection, record_segment
from wiw.training.traversal import Traversal, plan_scene

PLANNED_SCENES, RECORDED_SCENES = 32, 4
"""Scenes of which all paths are planned, and of which one segment is recorded; spread evenly over all."""
CLIP = 14
"""Frames of the windows that are counted: the paper's clips of SVD."""


@dataclass(frozen=True)
class Estimate:
    """Size and cost of a planned collection."""

    scenes: int
    planned_scenes: int
    frames: int
    frames_error: int
    """Standard error of `frames`, as scenes differ; 0 where all are planned."""
    pictures: int
    """Frames that are not after a turn, each with a picture."""
    segments: int
    windows: int
    """Windows of `CLIP` frames, one frame apart."""
    coverage: float
    """Mean share of the floor within 1 m of a frame, weighted by area."""
    dropped: int
    gigabytes: float
    core_hours: float
    """Hours of one core of this machine."""

    def __str__(self) -> str:
        planned = "" if self.planned_scenes == self.scenes else f" (estimated from {self.planned_scenes} of them)"
        error = f" (standard error {self.frames_error:,})" if self.frames_error else ""
        return (
            f"{self.scenes} scenes{planned}: {self.frames:,} frames{error} in {self.segments:,} segments, "
            f"{self.windows:,} windows of {CLIP} frames\n"
            f"coverage {self.coverage:.0%} of the floor within 1 m; {self.dropped} waypoints dropped\n"
            f"{self.pictures:,} pictures, {self.gigabytes:.1f} GB, {self.core_hours:.1f} core hours on this machine"
        )


def estimate_collection(
    scenes: str | Sequence[str],
    *,
    preset: str = "default",
    rules: Mapping[str, object] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    **asked: Any,
) -> Estimate:
    """Plan a sample of the scenes, record a segment of a few of them, and extrapolate.

    Args:
        scenes: as in `wiw.collect_navigation`.
        preset: likewise.
        rules: likewise.
        progress: called with a scene, the number of planned scenes and of how many.
        **asked: likewise.

    Raises:
        Error: as `wiw.collect_navigation`.
    """
    options = read_collection(preset, rules, asked)
    specs = list(resolve_train_scenes(scenes).items())
    chosen = _spread(specs, PLANNED_SCENES)
    recorded = _spread(chosen, RECORDED_SCENES)
    plans = []
    for done, (name, spec) in enumerate(chosen, 1):
        navmesh, roofs = _open_floors(spec, options)
        plans.append(plan_scene(navmesh, name, options.seed, 0, options.rules, roofs))
        if progress is not None:
            progress(name, done, len(chosen))
    cost = _record_samples(
        [
            (spec, traversals)
            for (name, spec), traversals in zip(chosen, plans, strict=True)
            if (name, spec) in recorded
        ],
        options,
    )
    return _extrapolate(plans, cost, len(specs), options)


def _spread(specs: Sequence[tuple[str, str]], count: int) -> list[tuple[str, str]]:
    """Return so many of the scenes, or all if there are fewer, evenly spread."""
    step = max(1.0, len(specs) / count)
    return [specs[int(number * step)] for number in range(min(count, len(specs)))]


def _open_floors(spec: str, options: NavigationCollection) -> tuple[NavMesh, Collection[int]]:
    """Return a scene's navigation mesh and its roofs.

    An apartment is opened without its textures and light, in a fraction of the time; it has no roof to walk on.
    """
    if is_generated(spec):
        return NavMesh.build(open_outline(spec)), ()
    place = world(spec, options.backend)
    return place.navmesh, place.roofs


@dataclass(frozen=True)
class _Cost:
    """Mean cost of a picture."""

    bytes: float = 0.0
    seconds: float = 0.0


def _record_samples(scenes: Sequence[tuple[str, Sequence[Traversal]]], options: NavigationCollection) -> _Cost:
    """Record the first segment of each scene, and return what a picture takes."""
    size = count = 0
    seconds = 0.0
    for spec, traversals in scenes:
        for traversal in [each for each in traversals if each.segments][:1]:
            place = world(spec, options.backend)
            began = time.process_time()
            segment = record_segment(place, spec, 0, 0, traversal, 0, options)
            seconds += time.process_time() - began
            count += sum(each is not None for each in segment.encoded_images)
            size += sum(len(data or b"") for data in (*segment.encoded_images, *(segment.encoded_depths or ())))
    return _Cost(size / count, seconds / count) if count else _Cost()


def _extrapolate(
    plans: Sequence[Sequence[Traversal]], cost: _Cost, scenes: int, options: NavigationCollection
) -> Estimate:
    factor = scenes / len(plans) * options.passes
    traversals = [each for plan in plans for each in plan]
    segments = [segment for each in traversals for segment in each.segments]
    area = sum(each.area for each in traversals)
    by_scene = np.array([sum(each.frames for each in plan) for plan in plans], np.float64)
    spread = float(by_scene.std(ddof=1)) if len(plans) > 1 else 0.0
    unplanned = max(0.0, 1 - len(plans) / scenes)
    pictures = factor * sum(len(np.unique(find_sources(segment, options))) for segment in segments)
    return Estimate(
        scenes=scenes,
        planned_scenes=len(plans),
        frames=round(factor * sum(map(len, segments))),
        frames_error=round(scenes * options.passes * spread * math.sqrt(unplanned / len(plans))),
        pictures=round(pictures),
        segments=round(factor * len(segments)),
        windows=round(factor * sum(max(0, len(segment) - CLIP + 1) for segment in segments)),
        coverage=sum(each.coverage * each.area for each in traversals) / area,
        dropped=round(factor * sum(each.dropped for each in traversals)),
        gigabytes=pictures * cost.bytes / 1e9,
        core_hours=pictures * cost.seconds / 3600,
    )
