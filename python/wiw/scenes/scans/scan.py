# SPDX-License-Identifier: Apache-2.0
"""Parts that readers of scans share: the files they read, tables of objects, and which way is up."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import _core
from wiw.errors import FileError

MOST_OBJECTS = 1_000_000
"""Largest id of an object; more is damage."""
UNLABELLED = "unlabelled"
"""Name of the instance of all surface that no object has."""


@dataclass
class Imported:
    """A scene and the files it was read from."""

    scene: _core.scene.Scene
    read: list[Path] = field(default_factory=list)
    absent: list[Path] = field(default_factory=list)
    """Files that were looked for in vain; the scan is read again once one of them is there."""


@dataclass(frozen=True)
class ScanObject:
    """One object of a scan, as the dataset's own table has it."""

    name: str
    category: str
    attributes: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class InstanceTable:
    """The instances of a scan: an object's id in the dataset is its instance id, from 1 on.

    Ids that the dataset leaves out, and objects that have no surface, stay as instances without triangles. An object
    with id 0, which is "nothing" in an instance image, comes behind the others; the last instance is the unlabelled
    surface.
    """

    instances: list[dict[str, Any]]
    ids: Mapping[int, int]
    """Instance ids by the dataset's."""

    @property
    def unlabelled_id(self) -> int:
        """Id of the instance of all surface that no object has."""
        return len(self.instances)

    def number(self, labels: NDArray[np.int64]) -> NDArray[np.uint32]:
        """Return instance ids uint32 of the dataset's ids, of any shape; unlabelled if that object does not exist."""
        table = np.full(max(self.ids, default=0) + 2, self.unlabelled_id, np.uint32)
        for source, instance in self.ids.items():
            table[source] = instance
        known = (labels >= 0) & (labels < len(table) - 1)
        return table[np.where(known, labels, len(table) - 1)]


def number_objects(objects: Mapping[int, ScanObject], shown: Iterable[int], path: Path) -> InstanceTable:
    """Number the objects of a scan.

    Args:
        objects: by their ids in the dataset.
        shown: ids that have surface; an object without any has no category, so that no one looks for it.
        path: the file of the table, for errors.
    """
    first, last = min(objects, default=0), max(objects, default=0)
    if first < 0 or last > MOST_OBJECTS:
        wrong = first if first < 0 else last
        raise FileError(f"{path}: names object {wrong}; expected ids from 0 to {MOST_OBJECTS} (damaged file?)")
    visible = set(shown)
    instances: list[dict[str, Any]] = [{"name": f"(no object {i})"} for i in range(1, last + 1)]
    ids: dict[int, int] = {}
    for source, thing in sorted(objects.items()):
        instances.extend([{}] * (source == 0))
        ids[source] = source or len(instances)
        instances[ids[source] - 1] = {
            "name": thing.name,
            "category": thing.category.lower() if source in visible else "",
            "attributes": {"scan_id": str(source), **thing.attributes},
        }
    return InstanceTable([*instances, {"name": UNLABELLED}], ids)


def to_y_up(points: NDArray[Any], up: str) -> NDArray[Any]:
    """Return points or directions [..., 3] of a file whose axis `up` is "y" or "z" in the world's frame."""
    if up == "y":
        return points
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def box_to_y_up(low: Iterable[float], high: Iterable[float], up: str) -> NDArray[np.float32]:
    """Return the corners float32 [2, 3] of a box in the world's frame."""
    corners = to_y_up(np.array([list(low), list(high)], np.float32), up)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def rotation_of(quaternion: Iterable[float]) -> NDArray[np.float64]:
    """Return the rotation [3, 3] of a quaternion in order wxyz, of any length but zero."""
    w, x, y, z = np.array(list(quaternion), float)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    if not length > 0 or not np.isfinite(length):
        raise ValueError("a rotation is not a quaternion")
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_text(path: Path, most_bytes: int = 256 << 20) -> str:
    """Return a text file; bytes that are not UTF-8 are replaced.

    Raises:
        FileError: it is missing, cannot be read, or is larger than `most_bytes`.
    """
    try:
        if path.stat().st_size > most_bytes:
            raise FileError(f"{path}: is larger than {most_bytes} bytes (damaged file?)")
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise FileError(f"{path}: {error.strerror or error}") from error


def split_cells(path: Path, lines: Iterable[str]) -> list[list[str]]:
    """Return the cells of lines of comma-separated values.

    Raises:
        FileError: they are damaged; names the file that they are from.
    """
    try:
        return list(csv.reader(lines))
    except csv.Error as error:
        raise FileError(f"{path}: not a table of comma-separated values: {error}") from error


def require_file(path: Path, why: str) -> Path:
    """Return the path of a file that must be there.

    Raises:
        FileError: it is not; says why it is needed.
    """
    if not path.is_file():
        raise FileError(f"{path}: no such file; {why}")
    return path


def require_folder(folder: Path, split: str) -> Path:
    """Return a dataset's folder, or that of a split in it.

    Raises:
        FileError: there is none.
    """
    folder = folder.expanduser()
    place = folder / split
    if not place.is_dir():
        there = sorted(entry.name for entry in folder.iterdir() if entry.is_dir()) if folder.is_dir() else []
        raise FileError(
            f"{place}: no such folder; expected a dataset of scans with its own layout, see docs/real-scans.md"
            f"{'; there is ' + ', '.join(there[:20]) if there else ''}"
        )
    return place


def require_scans(found: list[Path], folder: Path, expected: str) -> list[Path]:
    """Return the scans of a folder, sorted.

    Raises:
        FileError: there are none; says what was expected.
    """
    if not found:
        raise FileError(f"{folder}: holds no scan; expected {expected}")
    return sorted(found)


def import_options(options: Mapping[str, Any], up: str) -> dict[str, Any]:
    """Return the options of `wiw.scenes.basis.import_scan` for the mesh of a scan."""
    known = {name: options[name] for name in ("ceiling", "limits", "texture_folders") if name in options}
    return known | {"up": up, "allow_missing": bool(options.get("allow_missing_textures"))}
