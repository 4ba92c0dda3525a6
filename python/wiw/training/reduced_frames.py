# SPDX-License-Identifier: Apache-2.0
"""Frames of a navigation dataset in the size of a small network, decoded once and kept on disk."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, fields
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.navigation import NavigationData
from wiw.datasets.navigation_files import SEGMENTS
from wiw.datasets.navigation_segment import DEPTH_UNITS, NavigationSegment
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_folder
from wiw.training.jobs import count_threads
from wiw.world_models.warpnet.model import shrink_panorama
from wiw.world_models.warpnet.network import FARTHEST, NEAREST

VERSION = 2
"""Version of the kept arrays; raised when they change."""
PICTURES = ("images", "log_distances")
"""Arrays of pictures, which take nearly all of the room."""
Bar = Callable[[Iterable[Any], str, int], Iterable[Any]]
"""Wraps an iterable of a given number of items in a progress bar: (items, text, total)."""


@dataclass(frozen=True)
class ReducedFrames:
    """P panoramas, one for each position, and the F frames that show them, one segment after another."""

    images: NDArray[np.uint8]
    """uint8 [P, H, W, 3]."""
    log_distances: NDArray[np.float16]
    """float16 [P, H, W]: of metres along the ray; empty [P, 0, 0] where no depth was collected."""
    poses: NDArray[np.float64]
    """float64 [P, 3]: x and z in the world in metres, and the heading in radians to the left of -Z."""
    pictures: NDArray[np.int64]
    """int64 [F]: the panorama of each frame."""
    starts: NDArray[np.int64]
    """int64 [S]: first frame of each segment."""

    def find_places(self, segment: int, start: int, length: int) -> NDArray[np.int64]:
        """Return the panoramas of a clip, each once, in order."""
        first = self.starts[segment] + start
        shown = self.pictures[first : first + length]
        return shown[np.concatenate([[True], np.diff(shown) != 0])]


def reduce_frames(
    data: NavigationData, size: tuple[int, int], folder: Path, bar: Bar = lambda items, text, total: items
) -> ReducedFrames:
    """Return the frames of a dataset in a size (height, width); what `folder` has of it is not decoded again.

    Raises:
        FileError: the dataset is damaged, or the folder cannot be written.
        ArgumentError: the dataset's panoramas cannot be turned by whole columns in that size.
    """
    place = folder / f"frames-{_compute_digest(data, size)}"
    if not place.is_dir():
        with atomic_folder(place) as draft:
            _write_arrays(data, size, draft, bar)
    return ReducedFrames(
        **{each.name: np.load(place / f"{each.name}.npy", mmap_mode="r") for each in fields(ReducedFrames)}
    )


def read_heading(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return headings [...] of cameras [..., 4, 4], in radians to the left of -Z."""
    return np.arctan2(poses[..., 0, 2], poses[..., 2, 2])


def _compute_digest(data: NavigationData, size: tuple[int, int]) -> str:
    rows = [(row["file"], row["row_group"]) for row in data.segments]
    identity = [VERSION, data.meta["files"], rows, list(size)]
    return blake2b(json.dumps(identity, sort_keys=True).encode(), digest_size=12).hexdigest()


def _write_arrays(data: NavigationData, size: tuple[int, int], folder: Path, bar: Bar) -> None:
    """Write the arrays; those of pictures segment by segment, since together they may be larger than the memory.

    Raises:
        FileError: a segment has other pictures than the list of segments says.
    """
    places = sum(row["pictures"] for row in data.segments)
    poses, pictures, at = [], [], 0
    with ThreadPoolExecutor(count_threads()) as pool, ExitStack() as opened:
        files = {name: opened.enter_context((folder / f"{name}.npy").open("wb")) for name in PICTURES}
        for row, segment in zip(data.segments, bar(data, "decoding segments", len(data)), strict=True):
            part = _reduce_segment(segment, size, pool)
            _require_listed(data, row, len(part["poses"]))
            for name, file in files.items():
                _append_rows(file, part[name], places)
            poses.append(part["poses"])
            pictures.append(part["pictures"] + at)
            at += len(part["poses"])
    starts = np.cumsum([0, *(len(shown) for shown in pictures[:-1])])
    for name, array in {"poses": np.concatenate(poses), "pictures": np.concatenate(pictures), "starts": starts}.items():
        np.save(folder / f"{name}.npy", array)


def _append_rows(file: IO[bytes], part: NDArray[Any], total: int) -> None:
    """Append rows to a file in NumPy's format that will have so many in all."""
    if not file.tell():
        about = {"descr": part.dtype.str, "fortran_order": False, "shape": (total, *part.shape[1:])}
        np.lib.format.write_array_header_1_0(file, about)
    file.write(part.tobytes())


def _require_listed(data: NavigationData, row: Mapping[str, Any], pictures: int) -> None:
    if pictures != row["pictures"]:
        raise FileError(
            f"{data.folder}: {row['scene']}, segment {row['segment']}: expected {row['pictures']} pictures as in "
            f"{SEGMENTS}, got {pictures}; delete {row['file']} and repeat `wiw collect` to recreate it"
        )


def _reduce_segment(segment: NavigationSegment, size: tuple[int, int], pool: Executor) -> dict[str, NDArray[Any]]:
    shown, pictures = np.unique(segment.sources, return_inverse=True)
    decoded = list(pool.map(partial(_decode_small, segment, size), shown.tolist()))
    poses = segment.poses[shown]
    headings = read_heading(poses)
    _require_whole_columns(segment, headings - headings[0], size[1])
    return {
        "images": np.stack([image for image, _ in decoded]),
        "log_distances": np.stack([log_distance for _, log_distance in decoded]),
        "poses": np.column_stack([poses[:, 0, 3], poses[:, 2, 3], headings]),
        "pictures": pictures,
    }


def reduce_depth(depth: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float16]:
    """Return log-distances [h, w] of metres [H, W], at pixels' middles; `FARTHEST` where nothing is hit (0)."""
    rows, columns = (
        ((np.arange(few) + 0.5) * many / few).astype(int) for few, many in zip(size, depth.shape, strict=True)
    )
    return compute_log_distances(depth[rows[:, None], columns]).astype(np.float16)


def compute_log_distances(metres: NDArray[Any]) -> NDArray[np.float32]:
    """Return the logarithms of distances, which are clamped; `FARTHEST` where nothing is hit (0)."""
    found = metres.astype(np.float32)
    return np.asarray(np.log(np.clip(np.where(found > 0, found, FARTHEST), NEAREST, FARTHEST)), np.float32)


def _decode_small(
    segment: NavigationSegment, size: tuple[int, int], frame: int
) -> tuple[NDArray[np.uint8], NDArray[np.float16]]:
    """Return a frame's picture, and its log-distances, empty if no depth was collected."""
    color, depth = segment.decode(frame)
    if depth is None:
        return shrink_panorama(color, size), np.zeros((0, 0), np.float16)
    return shrink_panorama(color, size), reduce_depth(depth.astype(np.float32) / np.float32(DEPTH_UNITS), size)


def _require_whole_columns(segment: NavigationSegment, turns: NDArray[np.float64], width: int) -> None:
    columns = turns / (2 * np.pi) * width
    if np.abs(columns - columns.round()).max() > 0.01:
        raise ArgumentError(
            f"{segment.scene}, segment {segment.segment}: expected turns by whole columns of panoramas {width} columns "
            f"wide, got one by {columns[np.abs(columns - columns.round()).argmax()]:.2f}"
        )
