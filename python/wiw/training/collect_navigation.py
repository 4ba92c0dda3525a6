# SPDX-License-Identifier: Apache-2.0
"""Collect a navigation dataset: posed panoramas with depth and actions along traversals of scenes, for post-training.

Follows Algorithm 1 and the appendix on post-training data of the World-in-World paper. A scene's segments are functions
of (scene, seed, pass, options); each is stored as soon as it is recorded, and a file gets its name once it is complete,
so that a collection killed at any moment can be resumed and ends with the same bytes.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

import wiw
from wiw.datasets.navigation import (
    CARD,
    NavigationData,
    count_totals,
    read_meta,
    read_navigation_manifest,
    write_meta,
)
from wiw.datasets.navigation_files import (
    FORMAT,
    SEGMENTS,
    FrameFile,
    build_table,
    describe_file,
    navigation_schema,
    write_frames,
    write_segment_list,
)
from wiw.datasets.navigation_segment import describe_segment
from wiw.datasets.parquet_files import require_pyarrow
from wiw.datasets.scene_sources import digest_scenes
from wiw.datasets.scene_splits import find_evaluation_split, name_scenes
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError, BackendError, Error, FileError, InfrastructureError
from wiw.files import atomic_file
from wiw.ray_cluster import HERE, Engine
from wiw.scenes import resolve
from wiw.training.jobs import open_folder, run_jobs, write_manifest
from wiw.training.navigation_recording import HFOV_DEG, NavigationCollection, read_collection, record_segment
from wiw.training.traversal import Traversal, plan_scene

Progress = Callable[[str, int, int, int], None]
"""Called with a scene that is finished, the number of passes over scenes that are, of how many, and their frames."""

MAX_FILE_BYTES = 500 * 10**6
"""Largest Parquet file, for the Hub and its viewer; a single segment may be larger."""
RECORDS, PARTS, DATA = "scenes", "parts", "data"
"""Folders: what is known about each finished pass, segments of unfinished ones, frames."""


def collect_navigation(
    out: str | Path,
    scenes: str | PathLike[str] | Sequence[str | PathLike[str]] = "apartments:train:80",
    *,
    preset: str = "default",
    rules: Mapping[str, object] | None = None,
    workers: int = 1,
    place: Engine = HERE,
    skip_errors: bool = False,
    progress: Progress | None = None,
    **asked: Any,
) -> NavigationData:
    """Record what an agent sees on traversals of scenes; resume an interrupted collection.

    Args:
        out: a new folder, or one that the same call started.
        scenes: scene specs of train splits: "apartments:train:80", or files of meshes and worlds.
        preset: "default", or "paper" (waypoints within 3 m count as visited).
        rules: fields of `wiw.training.navigation_rules.NavigationRules` to replace.
        workers: number of processes; the files do not depend on it.
        place: where they run: on this machine, or as tasks on a Ray cluster whose machines all see the folder.
        skip_errors: whether to skip scenes that cannot be opened; otherwise they are an error, once all others are
            recorded.
        progress: called whenever a pass over a scene is finished.
        **asked: passes, seed, perspective, size, height, depth, lossless, backend, as in
            `wiw.training.navigation_recording.NavigationCollection`.

    Raises:
        BackendError: the requested renderer does not work here.
        DependencyError: pyarrow is not installed.
        ArgumentError: an option is unknown or out of range, a scene is of a val or test split, or the folder holds a
            different collection, or one of scenes whose files have changed.
        FileError: a scene is missing, or the folder cannot be written.
        InfrastructureError: scenes cannot be opened, or a worker process has died.
    """
    require_pyarrow("navigation datasets")
    options = read_collection(preset, rules, asked)
    place.require_valid("collect")
    if workers < 1:
        raise ArgumentError(f"collect: expected 1 worker or more, got {workers}")
    folder, specs = Path(out), resolve_train_scenes(scenes)
    config: dict[str, Any] = {"what": "navigation", "wiw": wiw.__version__, "scenes": list(specs)}
    config |= {"sources": digest_scenes(specs), **options.describe()}
    jobs = [
        SceneJob(number * options.passes + index, name, spec, index, folder, options)
        for number, (name, spec) in enumerate(specs.items())
        for index in range(options.passes)
    ]
    open_folder(folder, config, partial(_read_manifest, config=config, jobs=jobs))
    finished = {job.number: record for job in jobs if (record := job.read_record()) is not None}
    records, errors = _record_passes(jobs, finished, workers, place, progress)
    if errors and not (skip_errors and len(errors) < len(specs)):
        raise _build_scene_error(errors, len(specs))
    if not any(record["segments"] for record in records.values()):
        raise InfrastructureError(
            f"collect: expected a frame of one scene at least, got none of {', '.join([*specs][:3])}: nothing of their "
            "floor leads from one waypoint to another. Choose other scenes, or lower --rule spacing"
        )
    if len(finished) < len(jobs) or not _is_described(folder):
        _finish(folder, config, options, [records[number] for number in sorted(records)], errors)
    return NavigationData(folder)


def _build_scene_error(errors: Mapping[str, str], total: int) -> InfrastructureError:
    """Return the error that some scenes, or all, cannot be recorded.

    Args:
        errors: by the names of the scenes.
        total: number of scenes that were requested.
    """
    some = len(errors) < total
    return InfrastructureError(
        f"collect: {len(errors)} of {total} scenes cannot be recorded{', the others are' if some else ''}: "
        + "; ".join(f"{scene}: {error}" for scene, error in errors.items())
        + f". Fix them and repeat the command, or {'skip them with --skip-errors' if some else 'choose others'}"
    )


def _read_manifest(folder: Path, config: Mapping[str, Any], jobs: Sequence[SceneJob]) -> dict[str, Any]:
    """Return the manifest of a folder, with the present digests of scenes where they may be these.

    Scenes of which nothing is recorded may have changed: one that could not be opened is mended so.

    Raises:
        FileError: there is no manifest, or it cannot be written.
        ArgumentError: a scene has changed since something of it was recorded, or may have.
    """
    found = read_navigation_manifest(folder)
    present = {**found, "sources": config["sources"]}
    if present == config and found != config:
        _require_same_content(folder, found, config["sources"], {job.scene for job in jobs if job.has_begun()})
        write_manifest(folder, config)
    return present


def _require_same_content(
    folder: Path, manifest: Mapping[str, Any], sources: Mapping[str, str], begun: AbstractSet[str]
) -> None:
    """Check that scenes of which something is recorded are as they were then; they are known by their digests."""
    known = manifest.get("sources", {})
    others = [name for name, digest in sources.items() if name in begun and known.get(name) != digest]
    if others:
        why = "have changed since" if "sources" in manifest else "may have changed since, as it has no digests of them"
        names = ", ".join(others[:3]) + (" and others" if others[3:] else "")
        raise ArgumentError(
            f"{folder} holds a different collection: the files of {names} {why}; "
            "repeat the command with the files that it was started with, or choose another folder with --out"
        )


def _record_passes(
    jobs: Sequence[SceneJob],
    finished: Mapping[int, dict[str, Any]],
    workers: int,
    place: Engine,
    progress: Progress | None,
) -> tuple[dict[int, dict[str, Any]], dict[str, str]]:
    """Record the passes that are not finished; return the records of all by number, and errors by scene."""
    records, errors, tally = dict(finished), dict[str, str](), _Tally(len(jobs), progress)
    for job in jobs:
        if job.number in finished:
            tally.add(job.scene, finished[job.number])
    for job, record in run_jobs([job for job in jobs if job.number not in finished], workers, place):
        if "error" in record:
            errors[job.scene] = record["error"]
        else:
            records[job.number] = record
            tally.add(job.scene, record)
    return records, errors


def resolve_train_scenes(scenes: str | PathLike[str] | Sequence[str | PathLike[str]]) -> dict[str, str]:
    """Return the single scenes of some specs, by the names that they have in a dataset.

    Raises:
        ArgumentError: a scene is of a split that is for evaluation, or is given twice.
        FileError: the file does not exist.
    """
    given = [scenes] if isinstance(scenes, str | PathLike) else list(scenes)
    specs = [single for each in given for single in resolve(each)]
    for spec in specs:
        _check_train_split(spec)
    if not specs:
        raise ArgumentError("collect: expected scenes (--scenes apartments:train:80), got none")
    return name_scenes(specs)


def _check_train_split(spec: str) -> None:
    """Refuse scenes on which world models are evaluated."""
    if (split := find_evaluation_split(spec)) is not None:
        raise ArgumentError(
            f"collect: expected scenes of a train split, got {spec}, which is of {split}: a model trained on scenes "
            "used for evaluation would be tested on what it has seen. Choose train scenes, such as apartments:train:80"
        )


# -- one pass over one scene -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneJob:
    """A pass over a scene, to be recorded."""

    number: int
    scene: str
    """Its name in the dataset."""
    spec: str
    pass_index: int
    folder: Path
    options: NavigationCollection

    def read_record(self) -> dict[str, Any] | None:
        """Return what is known about the finished pass; None if it is not finished or its files are not whole."""
        try:
            record: dict[str, Any] = json.loads(self._record_path.read_text())
            sizes = [(self.folder / name).stat().st_size == file["bytes"] for name, file in record["files"].items()]
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return record if all(sizes) else None

    def has_begun(self) -> bool:
        """Return whether anything of the pass is recorded."""
        return self._record_path.exists() or self._part(0).parent.exists()

    def run(self) -> dict[str, Any]:
        """Record the pass; return what is known about it, or an "error" where the scene cannot be opened."""
        try:
            place = world(self.spec, self.options.backend)
            rules, roofs = self.options.rules, place.roofs
            traversals = plan_scene(place.navmesh, self.scene, self.options.seed, self.pass_index, rules, roofs)
        except BackendError:
            raise
        except Error as error:
            return {"error": str(error)}
        files, segments = self.record_files(place, traversals)
        record = {
            "scene": self.scene,
            "pass": self.pass_index,
            "files": files,
            "segments": segments,
            "traversals": [_describe_traversal(place, each) for each in traversals],
        }
        with atomic_file(self._record_path) as draft:
            draft.write_text(json.dumps(record) + "\n")
        shutil.rmtree(self._part(0).parent, ignore_errors=True)
        return record

    def record_files(
        self, place: World, traversals: Sequence[Traversal]
    ) -> tuple[dict[str, dict[str, Any]], list[dict[str, Any]]]:
        """Record the segments that are not there yet and write the files of all; return what is in each of both.

        Raises:
            FileError: a file cannot be written.
        """
        schema = navigation_schema(self.options.depth, describe_data(self.options))
        jobs = [(traversal, index) for traversal in traversals for index in range(len(traversal.segments))]
        for number, (traversal, index) in enumerate(jobs):
            if not self._holds(number, traversal, index):
                made = record_segment(place, self.scene, self.pass_index, number, traversal, index, self.options)
                write_frames(self._part(number), schema, [build_table(made, schema)])
        return self._merge_parts(jobs, schema)

    @property
    def _record_path(self) -> Path:
        return self.folder / RECORDS / f"{self.number:05d}.json"

    def _part(self, number: int) -> Path:
        return self.folder / PARTS / f"{self.number:05d}" / f"{number:05d}.parquet"

    def _holds(self, number: int, traversal: Traversal, index: int) -> bool:
        """Return whether a segment has been recorded already, as planned."""
        planned = traversal.segments[index]
        try:
            found = FrameFile(self._part(number)).read_segment(0)
        except FileError:
            return False
        return np.array_equal(found.actions, planned.actions) and found.island == traversal.island

    def _merge_parts(
        self, jobs: Sequence[tuple[Traversal, int]], schema: Any
    ) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        """Write the frames of all segments into files; return what is in each file and each segment."""
        files: dict[str, Any] = {}
        segments: list[dict[str, Any]] = []
        for index, numbers in enumerate(self._group_parts(len(jobs))):
            name = f"{DATA}/train-{self.number:05d}-{index:02d}.parquet"
            found: list[dict[str, Any]] = []

            def tables(numbers: Sequence[int] = numbers, name: str = name, found: Any = found) -> Iterator[Any]:
                for row_group, number in enumerate(numbers):
                    part = FrameFile(self._part(number))
                    traversal, at = jobs[number]
                    where = {"file": name, "row_group": row_group, "ending": traversal.segments[at].ending}
                    found.append({**describe_segment(part.read_segment(0)), **where})
                    yield part.read(0).replace_schema_metadata(schema.metadata)

            write_frames(self.folder / name, schema, tables())
            segments += found
            files[name] = describe_file(self.folder / name, sum(row["frames"] for row in found))
        return files, segments

    def _group_parts(self, count: int) -> list[list[int]]:
        """Return the numbers of the segments in each file, in order, as many as fit."""
        groups: list[list[int]] = []
        room = 0
        for number in range(count):
            size = self._part(number).stat().st_size
            if not groups or size > room:
                groups.append([])
                room = MAX_FILE_BYTES
            groups[-1].append(number)
            room -= size
        return groups


def _describe_traversal(place: World, traversal: Traversal) -> dict[str, Any]:
    """Return JSON values: the figures of a traversal, and what a map of it needs, x and z in metres."""
    outline, owner = place.navmesh.outline()
    walls = outline[owner == traversal.island][:, :, [0, 2]].reshape(-1, 4)
    return {
        "island": traversal.island,
        "north": traversal.north,
        "area": round(traversal.area, 2),
        "coverage": round(traversal.coverage, 4),
        "frames": traversal.frames,
        "waypoints": traversal.waypoints[:, [0, 2]].astype(np.float64).round(3).tolist(),
        "dropped": traversal.dropped,
        "walls": walls.astype(np.float64).round(3).tolist(),
    }


class _Tally:
    """Counts finished passes and their frames."""

    def __init__(self, total: int, progress: Progress | None) -> None:
        self._total, self._progress = total, progress
        self._done = self._frames = 0

    def add(self, scene: str, record: Mapping[str, Any]) -> None:
        self._done += 1
        self._frames += sum(row["frames"] for row in record["segments"])
        if self._progress is not None:
            self._progress(scene, self._done, self._total, self._frames)


# -- the whole dataset -------------------------------------------------------------------------------------------------


def _is_described(folder: Path) -> bool:
    """Return whether the dataset has its card, its description, and the list of segments that this describes."""
    try:
        listed = read_meta(folder)["files"][SEGMENTS] == describe_file(folder / SEGMENTS, 0)
        return bool(listed and (folder / CARD).is_file())
    except (FileError, OSError, KeyError):
        return False


def describe_data(options: NavigationCollection) -> dict[str, Any]:
    """Return what holds for all frames, as JSON values."""
    panorama = not options.perspective
    camera = {
        "projection": "equirectangular" if panorama else "perspective",
        "size": list(options.image_size),
        "height_m": options.height,
        "axes": "T_world_camera maps camera to world; the camera looks along -Z, +X right, +Y up; metres",
    }
    depth = {
        "unit": "millimetre",
        "measure": "distance along the ray" if panorama else "planar",
        "nothing": 0,
        "largest": 65535,
    }
    return {
        "wiw": wiw.__version__,
        "split": "train",
        "camera": camera if panorama else {**camera, "hfov_deg": HFOV_DEG},
        "color": "WebP, lossless" if options.lossless else "JPEG, quality 95, 4:4:4",
        "depth": depth if options.depth else None,
        "actions": {"0": "null", "1": "forward 0.2 m", "2": "turn left 22.5 deg", "3": "turn right 22.5 deg"},
    }


def _finish(
    folder: Path,
    config: Mapping[str, Any],
    options: NavigationCollection,
    records: Sequence[dict[str, Any]],
    errors: Mapping[str, str],
) -> None:
    """Write the list of segments, the card and, last of all, the description of the dataset."""
    rows = [row for record in records for row in record["segments"]]
    write_segment_list(folder / SEGMENTS, rows)
    files = {name: file for record in records for name, file in record["files"].items()}
    files[SEGMENTS] = describe_file(folder / SEGMENTS, 0)
    meta = {
        "format": FORMAT,
        **describe_data(options),
        "config": config,
        "totals": count_totals(rows, files, records),
        "left_out": dict(sorted(errors.items())),
        "files": files,
        "passes": [
            {"scene": record["scene"], "pass": record["pass"], "traversals": record["traversals"]} for record in records
        ],
    }
    write_meta(folder, meta)
    shutil.rmtree(folder / PARTS, ignore_errors=True)
