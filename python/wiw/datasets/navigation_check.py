# SPDX-License-Identifier: Apache-2.0
"""Check navigation datasets: checksums, frames against their actions and poses, duplicates, leaks between splits."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from wiw.action import FORWARD, NULL, STOP, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.datasets.navigation import META, NavigationData
from wiw.datasets.navigation_files import FrameFile
from wiw.datasets.navigation_segment import NavigationSegment, describe_segment
from wiw.datasets.parquet_files import hash_file
from wiw.datasets.scene_splits import list_evaluation_scenes, match_names
from wiw.errors import FileError

STEP_TOLERANCE = 0.011
"""Metres: a step's end is moved onto the mesh by up to a centimetre."""
HEADINGS = 16
LISTED_PROBLEMS = 50
"""Problems of each kind that are listed; the rest are counted."""

Progress = Callable[[str, int, int], None]
"""Called with a file that is checked, the number of those, and of how many."""


@dataclass
class Verification:
    """Findings of a verification."""

    files: int = 0
    segments: int = 0
    frames: int = 0
    pictures: int = 0
    duplicates: int = 0
    """Pictures equal to one from another position of the same scene: blank walls, say. No problem by themselves."""
    problems: dict[str, list[str]] = field(default_factory=dict)
    """Messages by kind: file, frame, picture, split, leak."""

    @property
    def sound(self) -> bool:
        """Whether there is no problem."""
        return not self.problems

    def add(self, kind: str, message: str) -> None:
        """Add a problem."""
        self.problems.setdefault(kind, []).append(message)

    def __str__(self) -> str:
        counts = f"{self.files} files, {self.segments:,} segments, {self.frames:,} frames, {self.pictures:,} images"
        lines = [f"{counts} checked"]
        if self.duplicates:
            lines.append(f"{self.duplicates} images equal one from another position in the same scene")
        for kind, messages in self.problems.items():
            lines += [f"{kind}: {message}" for message in messages[:LISTED_PROBLEMS]]
            if len(messages) > LISTED_PROBLEMS:
                lines.append(f"{kind}: and {len(messages) - LISTED_PROBLEMS} more")
        lines.append("sound" if self.sound else f"{sum(map(len, self.problems.values()))} problems")
        return "\n".join(lines)


def verify_datasets(
    folders: Sequence[str | Path], pictures: bool = True, progress: Progress | None = None
) -> Verification:
    """Check one dataset, or several that must share no scene, such as one to train on and one held out.

    Args:
        folders: of the datasets.
        pictures: whether to decode every image and compare it with all others, which takes most of the time.
        progress: called after each file of frames.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: a folder is not a finished dataset.
    """
    found, datasets = Verification(), [NavigationData(folder) for folder in folders]
    total = sum(len(_frame_files(data)) for data in datasets)
    seen = _Pictures()
    for data in datasets:
        _check_files(data, found)
        _check_splits(data, found)
        for name in _frame_files(data):
            _check_frames(data, name, found, seen if pictures else None)
            found.files += 1
            if progress is not None:
                progress(name, found.files, total)
    _check_leaks(datasets, found)
    seen.report(found)
    return found


def _frame_files(data: NavigationData) -> list[str]:
    return [name for name, file in data.meta["files"].items() if file["frames"]]


def _check_files(data: NavigationData, found: Verification) -> None:
    """Compare every file with its size and checksum, and look for files that are not listed."""
    for name, expected in data.meta["files"].items():
        path = data.folder / name
        try:
            digest = hash_file(path)
        except OSError as error:
            found.add("file", f"{path}: {error.strerror}; repeat the `wiw collect` command to recreate it")
            continue
        if digest != expected["sha256"]:
            found.add(
                "file",
                f"{path}: its SHA-256 differs from {META}; delete it and repeat `wiw collect` to recreate it",
            )
    listed = {data.folder / name for name in data.meta["files"]}
    for path in sorted((data.folder / "data").glob("*")):
        if path not in listed:
            found.add("file", f"{path}: is not listed in {META}, but `datasets` would read it; delete it")


def _check_splits(data: NavigationData, found: Verification) -> None:
    """Look for scenes that evaluation uses."""
    if data.meta["split"] != "train":
        found.add("split", f"{data.folder}: expected split train, got {data.meta['split']}")
    for scene, split in list_evaluation_scenes(row["scene"] for row in data.segments):
        found.add("split", f"{data.folder}: {scene} is of split {split}, which is for evaluation")


def _check_leaks(datasets: Sequence[NavigationData], found: Verification) -> None:
    """Look for scenes that two datasets share; an edited apartment counts as the one it is a copy of."""
    for other, data in combinations(datasets, 2):
        for name, scene in match_names(other.scenes, data.scenes):
            alias = "" if name == scene else f", as {scene}"
            found.add("leak", f"{name} is in {other.folder} and in {data.folder}{alias}")


def _check_frames(data: NavigationData, name: str, found: Verification, seen: _Pictures | None) -> None:
    """Check the segments of a file, one by one."""
    rows = {row["row_group"]: row for row in data.segments if row["file"] == name}
    try:
        file = FrameFile(data.folder / name)
        if len(file) != len(rows):
            found.add("file", f"{data.folder / name}: expected {len(rows)} row groups, got {len(file)}")
        for row_group, row in rows.items():
            segment = file.read_segment(row_group)
            where = f"{name}, row group {row_group}"
            for message in (*find_row_errors(segment, row), *find_motion_errors(segment, data.meta["camera"])):
                found.add("frame", f"{where}: {message}")
            found.segments += 1
            found.frames += len(segment)
            if seen is not None:
                _check_pictures(data, segment, where, found, seen)
    except FileError as error:
        found.add("file", str(error))


def find_row_errors(segment: NavigationSegment, row: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a segment has otherwise than `segments.parquet` says."""
    for name, value in describe_segment(segment).items():
        if row[name] != value:
            yield f"expected {name} {row[name]} as in segments.parquet, got {value}"


def find_motion_errors(segment: NavigationSegment, camera: Mapping[str, Any]) -> Iterator[str]:
    """Yield where poses are not what the actions lead to, or rolls not what the poses say."""
    actions, poses = segment.actions, segment.poses
    if actions[0] != NULL or np.isin(actions[1:], (int(NULL), int(STOP))).any():
        yield f"expected action 0 in frame 0 and 1 to 3 after it, got {actions.tolist()}"
        return
    moved = np.hypot(*np.diff(poses[:, [0, 2], 3], axis=0).T)
    wrong = np.abs(moved - np.where(actions[1:] == FORWARD, ActionSpace().forward_m, 0)) > STEP_TOLERANCE
    yaws = np.arctan2(poses[:, 0, 2], poses[:, 0, 0])
    turned = (actions == TURN_LEFT).astype(float) - (actions == TURN_RIGHT)
    unit = 2 * np.pi / HEADINGS
    wrong |= np.abs(_wrap(np.diff(yaws) - turned[1:] * unit)) > 1e-6
    for frame in np.flatnonzero(wrong)[:3] + 1:
        yield f"frame {frame} is not where action {actions[frame]} leads from frame {frame - 1}"
    frames = np.arange(len(segment))
    if (segment.sources > frames).any() or (segment.sources[segment.sources] != segment.sources).any():
        yield "expected each source to be an earlier frame with a picture"
    elif [data is not None for data in segment.encoded_images] != (segment.sources == frames).tolist():
        yield "expected an image in each frame that is its own source, and in no other"
    elif camera["projection"] == "equirectangular":
        columns = _wrap(yaws - yaws[segment.sources]) / (2 * np.pi) * camera["size"][1]
        off = (columns - segment.rolls + camera["size"][1] / 2) % camera["size"][1] - camera["size"][1] / 2
        for frame in np.flatnonzero(np.abs(off) > 1e-3)[:3]:
            yield f"frame {frame}: expected a roll by {columns[frame]:.0f} columns, got {segment.rolls[frame]}"


def _wrap(angles: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return angles in radians from -pi to pi."""
    return np.asarray(np.remainder(angles + np.pi, 2 * np.pi) - np.pi)


def _check_pictures(
    data: NavigationData, segment: NavigationSegment, where: str, found: Verification, seen: _Pictures
) -> None:
    """Decode the images of a segment, check their size, and remember them."""
    size = tuple(data.meta["camera"]["size"])
    for frame, encoded in enumerate(segment.encoded_images):
        if encoded is None:
            continue
        found.pictures += 1
        seen.add(encoded, str(data.folder), segment.scene, segment.poses[frame])
        try:
            shapes = {image.shape[:2] for image in segment.decode(frame) if image is not None}
        except FileError as error:
            found.add("picture", f"{where}: {error}")
            continue
        if shapes != {size}:
            found.add("picture", f"{where}, frame {frame}: expected images of {size}, got {sorted(shapes)}")


class _Pictures:
    """Fingerprints of all images, with the place where each was first seen."""

    def __init__(self) -> None:
        self._first: dict[bytes, tuple[str, str, bytes]] = {}
        self._duplicates = 0
        self._shared: dict[tuple[str, str, str, str], int] = {}

    def add(self, encoded: bytes, folder: str, scene: str, pose: np.ndarray[Any, Any]) -> None:
        here = folder, scene, pose[:3, 3].round(3).tobytes()
        first = self._first.setdefault(blake2b(encoded, digest_size=12).digest(), here)
        if first[:2] != here[:2]:
            pair = (*first[:2], *here[:2])
            self._shared[pair] = self._shared.get(pair, 0) + 1
        elif first != here:
            self._duplicates += 1

    def report(self, found: Verification) -> None:
        """Add duplicates: within a scene as a number, between scenes and datasets as leaks."""
        found.duplicates = self._duplicates
        for (folder, scene, other_folder, other_scene), count in self._shared.items():
            pictures = "1 image is" if count == 1 else f"{count} images are"
            found.add("leak", f"{pictures} in {scene} of {folder} and in {other_scene} of {other_folder}")
