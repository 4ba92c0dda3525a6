# SPDX-License-Identifier: Apache-2.0
"""Estimate a navigation dataset before it is recorded: frames, hours and gigabytes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wiw.datasets.worlds import world
from wiw.render import resolve_backend
from wiw.training.collect_navigation import resolve_train_scenes
from wiw.training.navigation_recording import NavigationCollection, find_sources, record_segment
from wiw.training.navigation_rules import make_rules
from wiw.training.traversal import Traversal, plan_scene

SAMPLE_SCENES = 16
"""Scenes that are planned, spread evenly over all; the rest are taken to be like them."""
CLIP = 14
"""Frames of the windows that are counted: the paper's clips of SVD."""


@dataclass(frozen=True)
class Estimate:
    """What a collection would be."""

    scenes: int
    planned_scenes: int
    frames: int
    frames_error: int
    """Standard error of `frames`, as scenes differ; 0 where all are planned."""
    pictures: int
    """Frames that are not after a turn, each with a picture."""
    segments: int
    windows: int
    """Of `CLIP` frames, one frame apart."""
    coverage: float
    """Mean share of the floor within 1 m of a frame, weighted by area."""
    dropped: int
    gigabytes: float
    core_hours: float
    """Of processor time on this machine."""

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
    """Plan a sample of the scenes, record one segment of each, and extrapolate.

    Args:
        scenes: as in `wiw.collect_navigation`.
        preset: likewise.
        rules: likewise.
        progress: called with a scene, the number of planned scenes and of how many.
        **asked: likewise.

    Raises:
        Error: as `wiw.collect_navigation`.
    """
    options = NavigationCollection(rules=make_rules(preset, rules), **asked)
    options = replace(options, backend=resolve_backend(options.backend))
    specs = list(resolve_train_scenes(scenes).items())
    step = max(1.0, len(specs) / SAMPLE_SCENES)
    chosen = [specs[int(number * step)] for number in range(min(SAMPLE_SCENES, len(specs)))]
    samples = []
    for done, (name, spec) in enumerate(chosen, 1):
        samples.append(_sample_scene(name, spec, options))
        if progress is not None:
            progress(name, done, len(chosen))
    return _extrapolate(samples, len(specs), options.passes)


@dataclass(frozen=True)
class _Sample:
    traversals: list[Traversal]
    pictures: int
    bytes_per_picture: float
    seconds_per_picture: float


def _sample_scene(name: str, spec: str, options: NavigationCollection) -> _Sample:
    place = world(spec, options.backend)
    traversals = plan_scene(place.navmesh, name, options.seed, 0, options.rules)
    pictures = sum(_count_pictures(each, options) for each in traversals)
    if not pictures:
        return _Sample(traversals, 0, 0.0, 0.0)
    began = time.process_time()
    segment = record_segment(place, name, 0, 0, traversals[0], 0, options)
    seconds, count = time.process_time() - began, sum(each is not None for each in segment.encoded_images)
    size = sum(len(data or b"") for data in (*segment.encoded_images, *(segment.encoded_depths or ())))
    return _Sample(traversals, pictures, size / count, seconds / count)


def _count_pictures(traversal: Traversal, options: NavigationCollection) -> int:
    return sum(len(set(find_sources(segment, options).tolist())) for segment in traversal.segments)


def _extrapolate(samples: Sequence[_Sample], scenes: int, passes: int) -> Estimate:
    factor = scenes / len(samples) * passes
    traversals = [each for sample in samples for each in sample.traversals]
    lengths = [len(segment) for each in traversals for segment in each.segments]
    area = sum(each.area for each in traversals)
    by_scene = np.array([sum(each.frames for each in sample.traversals) for sample in samples], np.float64)
    spread = float(by_scene.std(ddof=1)) if len(samples) > 1 else 0.0
    unplanned = max(0.0, 1 - len(samples) / scenes)
    return Estimate(
        scenes=scenes,
        planned_scenes=len(samples),
        frames=round(factor * sum(lengths)),
        frames_error=round(scenes * passes * spread * math.sqrt(unplanned / len(samples))),
        pictures=round(factor * sum(sample.pictures for sample in samples)),
        segments=round(factor * len(lengths)),
        windows=round(factor * sum(max(0, length - CLIP + 1) for length in lengths)),
        coverage=sum(each.coverage * each.area for each in traversals) / area,
        dropped=round(factor * sum(each.dropped for each in traversals)),
        gigabytes=factor * sum(sample.pictures * sample.bytes_per_picture for sample in samples) / 1e9,
        core_hours=factor * sum(sample.pictures * sample.seconds_per_picture for sample in samples) / 3600,
    )
