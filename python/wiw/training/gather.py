# SPDX-License-Identifier: Apache-2.0
"""Training data built from many scenes or plays, cached on disk file by file, so that an interrupted command
resumes.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import scenes
from wiw.datasets.worlds import navmesh_file, world
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.perception.glimpses import Glimpses
from wiw.perception.scene_labels import CATEGORIES
from wiw.scenes.store import build_digest
from wiw.training.glimpse_sets import (
    HARD_LOOKS,
    WAY_SHARES,
    GlimpseSetRules,
    GlimpseSets,
    collect_glimpse_sets,
    collect_hard_sets,
    join_glimpse_sets,
    merge_glimpse_sets,
)
from wiw.training.goal_places import GoalPlaces, PlaceRules, record_goal_places, require_places
from wiw.training.jobs import run_jobs
from wiw.training.labelled_views import FIELDS as VIEW_FIELDS
from wiw.training.labelled_views import LabelledViews, ViewRules, change_states, merge_views, record_views
from wiw.training.preparation import ProgressBar
from wiw.training.walks import WalkRules, Walks, record_walks
from wiw.training.walks import merge_walks as merged_walks

Arrays = Mapping[str, NDArray[Any]]


def require_held_out(specs: str, val: str) -> None:
    """Check that no scene is both trained and evaluated on, whatever path or link leads to it, or an apartment's edits.

    Raises:
        ArgumentError: names a scene that is in both.
    """
    trained = {_identify(name) for name in scenes.resolve(specs)}
    shared = next((name for name in scenes.resolve(val) if _identify(name) in trained), None)
    if shared is not None:
        raise ArgumentError(
            f"--val: expected held-out scenes that are not among --scenes, got {shared} in both; choose others"
        )


def _identify(name: str) -> str:
    """Return what two names of one single scene have in common: the apartment without edits, or the file itself."""
    return scenes.strip_edits(name) if scenes.is_generated(name) else str(Path(name).expanduser().resolve())


@dataclass(frozen=True)
class Job:
    """The result that is built from each source."""

    name: str
    """Description for progress bars."""
    fields: tuple[str, ...]
    """Names of the arrays that `make` returns."""
    make: Callable[[str], Arrays]
    """Builds the arrays of a source, by the source's name. Runs in other processes: a function of a module, or a
    `partial` of one.
    """
    identity: tuple[Any, ...]
    """JSON-able: everything that the arrays depend on except the source, and a version to raise when `make` changes."""


GLIMPSE_SET_FIELDS = ("images", "boxes", "scalars", "owners", "kinds", "labels")
WALK_FIELDS = ("images", "distances", "places")
PLACE_FIELDS = ("bands", "depths", "distances", "bearings", "visible")


def gather_glimpse_sets(
    specs: str,
    categories: Sequence[str],
    seed: int,
    rules: GlimpseSetRules,
    folder: Path,
    workers: int,
    bar: ProgressBar,
) -> GlimpseSets:
    """Load the glimpse sets of all scenes of a spec, in order; build those that `folder` lacks in `workers` processes.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: the scenes have no object of `categories`.
    """
    make = partial(_build_glimpse_sets, seed=seed, categories=tuple(categories), rules=rules)
    job = Job(f"glimpses in {specs}", GLIMPSE_SET_FIELDS, make, (3, list(categories), seed, asdict(rules)))
    return merge_glimpse_sets(_gather_sets(specs, job, folder, workers, bar))


def gather_hard_sets(
    specs: str, categories: Sequence[str], seed: int, folder: Path, workers: int, bar: ProgressBar
) -> GlimpseSets:
    """Load the glimpse sets of all scenes of a spec whose first look is hard; build those that `folder` lacks.

    There are none where the scenes show nothing that is hard to see at first and clear from nearby.

    Raises:
        FileError: the folder cannot be written.
    """
    make = partial(_build_hard_sets, seed=seed, categories=tuple(categories))
    identity = ("hard", 2, list(categories), seed, asdict(HARD_LOOKS), list(WAY_SHARES))
    job = Job(f"hard looks in {specs}", GLIMPSE_SET_FIELDS, make, identity)
    return join_glimpse_sets(_gather_sets(specs, job, folder, workers, bar))


def _gather_sets(specs: str, job: Job, folder: Path, workers: int, bar: ProgressBar) -> list[GlimpseSets]:
    found = gather_arrays(_resolve_scenes(specs), job, folder, workers, bar)
    parts = [(Glimpses(a["images"], a["boxes"], a["scalars"]), a["owners"], a["kinds"], a["labels"]) for a in found]
    return [GlimpseSets(*part) for part in parts]


def gather_walks(specs: str, seed: int, rules: WalkRules, folder: Path, workers: int, bar: ProgressBar) -> Walks:
    """Load the walks through all scenes of a spec; build those that `folder` lacks in `workers` processes.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: nowhere in the scenes can one walk straight ahead.
    """
    job = Job(
        f"walks in {specs}",
        WALK_FIELDS,
        partial(_build_walks, seed=seed, rules=rules),
        ("walks", 1, seed, asdict(rules)),
    )
    return merged_walks(
        [
            Walks(*(a[name] for name in WALK_FIELDS))
            for a in gather_arrays(_resolve_scenes(specs), job, folder, workers, bar)
        ]
    )


def gather_goal_places(
    specs: str, seed: int, rules: PlaceRules, folder: Path, workers: int, bar: ProgressBar
) -> Sequence[GoalPlaces]:
    """Load the places of all scenes of a spec; build those that `folder` lacks in `workers` processes.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: nowhere in the scenes can one walk from a place to another.
    """
    make = partial(_build_goal_places, seed=seed, rules=rules)
    job = Job(f"places in {specs}", PLACE_FIELDS, make, ("goal places", 1, seed, asdict(rules)))
    found = gather_arrays(_resolve_scenes(specs), job, folder, workers, bar)
    return require_places([GoalPlaces(*(arrays[name] for name in PLACE_FIELDS)) for arrays in found])


def gather_views(
    specs: str, seed: int, rules: ViewRules, folder: Path, workers: int, bar: ProgressBar, change: bool = False
) -> LabelledViews:
    """Load the labelled views of all scenes of a spec; build those that `folder` lacks in `workers` processes.

    If `change`, each apartment is recorded once more, with other states of doors, lamps and so on.

    Raises:
        FileError: the folder cannot be written.
        ArgumentError: nowhere in the scenes can one stand.
    """
    make = partial(_build_views, seed=seed, rules=rules)
    identity = ("views", 3, list(CATEGORIES), seed, asdict(rules))
    job = Job(f"views of {specs}", VIEW_FIELDS, make, identity)
    sources = _resolve_scenes(specs)
    if change:
        sources |= {name: name for name in map(partial(change_states, seed=seed), sources) if name is not None}
    found = gather_arrays(sources, job, folder, workers, bar)
    return merge_views([LabelledViews(*(arrays[name] for name in VIEW_FIELDS)) for arrays in found])


def _resolve_scenes(specs: str) -> dict[str, str]:
    """Map the names of a spec's scenes to names that are valid in any working directory."""
    return {name: scenes.absolute(name) for name in scenes.resolve(specs)}


def _build_glimpse_sets(name: str, seed: int, categories: Sequence[str], rules: GlimpseSetRules) -> Arrays:
    return _list_arrays(collect_glimpse_sets(world(name), seed, categories, rules))


def _build_hard_sets(name: str, seed: int, categories: Sequence[str]) -> Arrays:
    return _list_arrays(collect_hard_sets(world(name), seed, categories))


def _list_arrays(sets: GlimpseSets) -> Arrays:
    glimpses = sets.glimpses
    values = (glimpses.images, glimpses.boxes, glimpses.scalars, sets.owners, sets.kinds, sets.labels)
    return dict(zip(GLIMPSE_SET_FIELDS, values, strict=True))


def _build_views(name: str, seed: int, rules: ViewRules) -> Arrays:
    views = record_views(world(name), seed, rules)
    return {field: getattr(views, field) for field in VIEW_FIELDS}


def _build_walks(name: str, seed: int, rules: WalkRules) -> Arrays:
    walks = record_walks(world(name), seed, rules)
    return {name: getattr(walks, name) for name in WALK_FIELDS}


def _build_goal_places(name: str, seed: int, rules: PlaceRules) -> Arrays:
    places = record_goal_places(world(name), seed, rules)
    return {field: getattr(places, field) for field in PLACE_FIELDS}


def gather_arrays(sources: Mapping[str, str], job: Job, folder: Path, workers: int, bar: ProgressBar) -> list[Arrays]:
    """Load the arrays of all sources, in order; build those that `folder` lacks in `workers` processes.

    Args:
        sources: maps the name of each source, which `job.make` takes, to one that means the same in any working
            directory, from which the name of its cache file is computed.
        job: what to build from each.
        folder: the cache.
        workers: number of processes.
        bar: shows the progress.

    Raises:
        FileError: the folder cannot be written, or a file cannot be read back.
        InfrastructureError: a worker process has died.
    """
    files = {name: folder / f"{_compute_digest(source, job)}.npz" for name, source in sources.items()}
    found = {name: _read_file(file, job) for name, file in files.items()}
    missing = [name for name, arrays in found.items() if arrays is None]
    list(bar(_build_missing(missing, files, job, workers), job.name, len(missing)))
    found |= {name: _read_file(files[name], job) for name in missing}
    return [_require_arrays(found[name], files[name], job) for name in sources]


def _require_arrays(arrays: Arrays | None, file: Path, job: Job) -> Arrays:
    if arrays is None:
        raise FileError(
            f"{job.name}: {file} was written but cannot be read back; is something else deleting or writing files "
            "there? Repeat the command, or choose another folder with --cache"
        )
    return arrays


def _build_missing(names: Sequence[str], files: Mapping[str, Path], job: Job, workers: int) -> Iterator[str]:
    """Build the files of the given sources; yield each name when its file is complete."""
    for built, _ in run_jobs([_FileJob(name, files[name], job) for name in names], workers):
        yield built.name


@dataclass(frozen=True)
class _FileJob:
    """The file of one source."""

    name: str
    file: Path
    job: Job

    def run(self) -> None:
        """Build and write the file."""
        arrays = self.job.make(self.name)
        with atomic_file(self.file) as draft, draft.open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]


def _read_file(file: Path, job: Job) -> Arrays | None:
    """Return the arrays of a cache file; None if it is absent or incomplete."""
    try:
        with np.load(file) as values:
            return {name: values[name] for name in job.fields}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _describe_files(source: str) -> list[tuple[int, int]]:
    """Return size and time of change of a scene's file and its navigation mesh; nothing of other sources.

    What was recorded in a file that has been edited since is not used.
    """
    files = (Path(source), navmesh_file(source))
    status = [file.stat() for file in files if file is not None and file.is_file()]
    return [(each.st_size, each.st_mtime_ns) for each in status]


def _compute_digest(source: str, job: Job) -> str:
    version, *rest = job.identity
    identity = [version, build_digest(), source, *_describe_files(source), *rest]
    return blake2b(json.dumps(identity).encode(), digest_size=12).hexdigest()
