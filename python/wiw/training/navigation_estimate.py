# SPDX-License-Identifier: Apache-2.0
"""Estimate a navigation dataset before it is recorded: frames, hours and gigabytes."""

from __future__ import annotations

import math
import resource
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from wiw.datasets.navigation_files import FrameFile
from wiw.datasets.worlds import World, world
from wiw.errors import BackendError, Error, InfrastructureError
from wiw.nav import Ground, NavMesh
from wiw.render import Renderer
from wiw.scenes import apartment, is_generated, open_outline
from wiw.scenes.specs import parse_single
from wiw.training.collect_navigation import SceneJob, resolve_train_scenes
from wiw.training.navigation_recording import NavigationCollection, find_sources, read_collection
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
    opening_hours: float
    """Hours of one core of this machine, for opening each scene once, as one worker does; less where the cache has the
    files of scenes already."""
    planning_hours: float
    recording_hours: float
    """For rendering, encoding and writing the pictures."""
    left_out: Mapping[str, str]
    """Why planned scenes cannot be opened, by name; they are not in any number."""

    @property
    def core_hours(self) -> float:
        """Hours of one core of this machine, without the start of the workers."""
        return self.opening_hours + self.planning_hours + self.recording_hours

    def __str__(self) -> str:
        planned = "" if self.planned_scenes == self.scenes else f" (estimated from {self.planned_scenes} of them)"
        error = f" (standard error {self.frames_error:,})" if self.frames_error else ""
        return (
            f"{self.scenes} scenes{planned}: {self.frames:,} frames{error} in {self.segments:,} segments, "
            f"{self.windows:,} windows of {CLIP} frames\n"
            f"coverage {self.coverage:.0%} of the floor within 1 m; {self.dropped} waypoints dropped\n"
            f"{self.pictures:,} pictures, {self.gigabytes:.1f} GB, {self.core_hours:.1f} core hours on this machine: "
            f"{self.opening_hours:.1f} to open scenes, {self.planning_hours:.1f} to plan, {self.recording_hours:.1f} "
            "to record"
        )


def estimate_collection(
    scenes: str | Sequence[str],
    *,
    preset: str = "default",
    rules: Mapping[str, object] | None = None,
    skip_errors: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    **asked: Any,
) -> Estimate:
    """Plan a sample of the scenes, record a segment of a few of them, and extrapolate.

    Args:
        scenes: as in `wiw.collect_navigation`.
        preset: likewise.
        rules: likewise.
        skip_errors: likewise; scenes that are not among those planned count as if they could be opened.
        progress: called with a scene, the number of planned scenes and of how many.
        **asked: likewise.

    Raises:
        Error: as `wiw.collect_navigation`; InfrastructureError where planned scenes cannot be opened, with all of them.
    """
    options = read_collection(preset, rules, asked)
    specs = list(resolve_train_scenes(scenes).items())
    chosen = _spread(specs, PLANNED_SCENES)
    recorded = _spread(chosen, RECORDED_SCENES)
    cost, plans = _Cost(), dict[str, list[Traversal]]()
    errors: dict[str, str] = {}
    for done, (name, spec) in enumerate(chosen, 1):
        try:
            plans[name] = _plan(name, spec, options, cost)
        except BackendError:
            raise
        except Error as error:
            errors[name] = str(error)
        if progress is not None:
            progress(name, done, len(chosen))
    if errors and not (skip_errors and plans):
        raise _build_scene_error(errors, len(chosen))
    for name, spec in recorded:
        if name in plans:
            _record_sample(name, spec, plans[name], options, cost)
    left = [spec for name, spec in specs if name not in errors]
    return _extrapolate([*plans.values()], cost, left, options, errors)


def _build_scene_error(errors: Mapping[str, str], planned: int) -> InfrastructureError:
    """Return the error that some of the planned scenes, or all, cannot be opened, by their names."""
    remedy = "leave them out with --skip-errors" if len(errors) < planned else "choose others"
    return InfrastructureError(
        f"collect: {len(errors)} of {planned} scenes that were planned cannot be opened: "
        + "; ".join(f"{scene}: {error}" for scene, error in errors.items())
        + f". Fix them, or {remedy}"
    )


def _spread(specs: Sequence[tuple[str, str]], count: int) -> list[tuple[str, str]]:
    """Return so many of the scenes, or all if there are fewer, evenly spread."""
    step = max(1.0, len(specs) / count)
    return [specs[int(number * step)] for number in range(min(count, len(specs)))]


@dataclass
class _Cost:
    """The cost of samples: seconds of one core, and bytes."""

    opening: dict[bool, list[float]] = field(default_factory=lambda: {True: [], False: []})
    """Seconds of each scene that was opened, of apartments (True) and files."""
    planning: list[float] = field(default_factory=list)
    """Seconds of each pass that was planned."""
    recording: float = 0.0
    """Seconds for all `pictures`."""
    pictures: int = 0
    bytes: int = 0
    """Size of all pictures."""

    def estimate_opening(self, specs: Sequence[str]) -> float:
        """Return the seconds that opening scenes takes, each as others of its kind that were opened."""
        mean = {kind: _divide(sum(times), len(times)) for kind, times in self.opening.items()}
        return sum(mean[is_generated(spec)] for spec in specs)


def _divide(total: float, count: int) -> float:
    """Return the mean; 0 of nothing."""
    return total / count if count else 0.0


def _read_clock() -> float:
    """Return the seconds that cores have spent on this process, and on those that read files of scenes for it."""
    used = [resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def _plan(name: str, spec: str, options: NavigationCollection, cost: _Cost) -> list[Traversal]:
    """Return the first pass over a scene, and count what opening and planning take."""
    navmesh, roofs = _open_floors(spec, options, cost)
    began = _read_clock()
    plan = plan_scene(navmesh, name, options.seed, 0, options.rules, roofs)
    cost.planning.append(_read_clock() - began)
    return plan


def _open_floors(spec: str, options: NavigationCollection, cost: _Cost) -> tuple[NavMesh, Collection[int]]:
    """Return a scene's navigation mesh and its roofs.

    An apartment is opened without its textures and light, in a fraction of the time; it has no roof to walk on.
    """
    if is_generated(spec):
        return NavMesh.build(open_outline(spec)), ()
    place = _open_world(spec, options, cost)
    return place.navmesh, place.roofs


def _open_world(spec: str, options: NavigationCollection, cost: _Cost) -> World:
    """Return a scene as it is opened for recording, and count what that takes.

    An apartment is generated even if the cache has it, as there is no room for those of a large collection.
    """
    began = _read_clock()
    place = _generate_world(spec, options) if is_generated(spec) else world(spec, options.backend)
    _ = place.roofs  # which a pass looks for before it is planned
    cost.opening[is_generated(spec)].append(_read_clock() - began)
    return place


def _generate_world(spec: str, options: NavigationCollection) -> World:
    """Return an apartment that is neither taken from a cache nor kept there."""
    seed, split, edits = parse_single(spec)
    scene = apartment(seed, split, cache=False, edits=edits)
    renderer = Renderer(scene, backend=options.backend)
    return World(spec, scene, renderer, NavMesh.build(scene), Ground(scene), options.backend)


def _record_sample(
    name: str, spec: str, traversals: Sequence[Traversal], options: NavigationCollection, cost: _Cost
) -> None:
    """Record the first segment of a scene, write its files, and count what that takes."""
    place = _open_world(spec, options, cost) if is_generated(spec) else world(spec, options.backend)
    walked = [replace(each, segments=each.segments[:1]) for each in traversals if each.segments][:1]
    if not walked:
        return
    with TemporaryDirectory(prefix="wiw-estimate-") as folder:
        began = _read_clock()
        files, _ = SceneJob(0, name, spec, 0, Path(folder), options).record_files(place, walked)
        cost.recording += _read_clock() - began
        (segment,) = (FrameFile(Path(folder) / file).read_segment(0) for file in files)
    cost.pictures += sum(each is not None for each in segment.encoded_images)
    cost.bytes += sum(len(data or b"") for data in (*segment.encoded_images, *(segment.encoded_depths or ())))


def _extrapolate(
    plans: Sequence[Sequence[Traversal]],
    cost: _Cost,
    specs: Sequence[str],
    options: NavigationCollection,
    left_out: Mapping[str, str],
) -> Estimate:
    scenes, factor = len(specs), len(specs) / len(plans) * options.passes
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
        coverage=sum(each.coverage * each.area for each in traversals) / area if area else 0.0,
        dropped=round(factor * sum(each.dropped for each in traversals)),
        gigabytes=pictures * _divide(cost.bytes, cost.pictures) / 1e9,
        opening_hours=cost.estimate_opening(specs) / 3600,
        planning_hours=factor * sum(cost.planning) / 3600,
        recording_hours=pictures * _divide(cost.recording, cost.pictures) / 3600,
        left_out=left_out,
    )
