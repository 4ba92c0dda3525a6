# SPDX-License-Identifier: Apache-2.0
"""A navigation dataset at a small size, in memory: every picture decoded once, any window at once.

Small networks learn faster than Parquet's pictures are decoded. Windows are those of `NavigationData.clips`, in the
same order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.navigation import NavigationData
from wiw.datasets.navigation_segment import DEPTH_UNITS, NavigationSegment
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file

TURNS = 16
"""Turns in a circle, which roll a panorama by whole columns."""


@dataclass(frozen=True)
class ShrunkNavigation:
    """P pictures, F frames that show them, and W windows of L frames."""

    images: NDArray[np.uint8]
    """uint8 [P, H, W, 3]."""
    distances: NDArray[np.float16]
    """float16 [P, H, W]: metres along the ray, 0 where nothing is hit."""
    sources: NDArray[np.int32]
    """int32 [F]: the picture of each frame."""
    rolls: NDArray[np.int32]
    """int32 [F]: columns to roll it by, to the right."""
    actions: NDArray[np.int8]
    """int8 [F]: the action that led to each frame."""
    starts: NDArray[np.int32]
    """int32 [W]: first frame of each window."""
    scenes: NDArray[np.str_]
    """[W]: scene of each window."""
    length: int
    """L."""

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the pictures."""
        return int(self.images.shape[1]), int(self.images.shape[2])

    def plans(self, windows: NDArray[np.int64]) -> NDArray[np.int8]:
        """Return the actions of windows, int8 [B, L - 1]."""
        return self.actions[self.starts[windows][:, None] + np.arange(1, self.length)]

    def show(self, windows: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return frames [B, N] of windows [B], uint8 [B, N, H, W, 3]."""
        return self._roll(self.images, windows, frames)

    def show_distances(self, windows: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[np.float16]:
        """Return the distances in the same frames, float16 [B, N, H, W].

        Raises:
            ArgumentError: the dataset has no depth.
        """
        if not self.distances.size:
            raise ArgumentError("expected a dataset with depth; collect it without --no-depth")
        return self._roll(self.distances, windows, frames)

    def _roll(self, pictures: NDArray[Any], windows: NDArray[np.int64], frames: NDArray[np.int64]) -> NDArray[Any]:
        places = self.starts[windows][:, None] + frames
        columns = (np.arange(self.size[1]) - self.rolls[places][..., None]) % self.size[1]
        columns = columns.reshape(*places.shape, 1, -1, *([1] * (pictures.ndim - 3)))
        return np.take_along_axis(pictures[self.sources[places]], columns, axis=3)


def shrink_navigation(
    data: NavigationData,
    size: tuple[int, int],
    length: int,
    cache: Path,
    threads: int = 2,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ShrunkNavigation:
    """Decode and shrink a dataset's pictures, or read them from where an earlier call has kept them.

    Args:
        data: of panoramas.
        size: height and width; widths are multiples of 16, so that turns roll by whole columns.
        length: frames of the windows.
        cache: file of the shrunk pictures (.npz), of this very dataset, part and size.
        threads: that decode.
        progress: called with the number of segments that are done, and of all.

    Raises:
        ArgumentError: a width that 16 does not divide, or windows that no segment has.
        FileError: a picture is damaged, or the cache cannot be written.
    """
    if size[1] % TURNS or min(size) < TURNS:
        raise ArgumentError(f"expected a size of {TURNS} rows or more and a width that {TURNS} divides, got {size}")
    clips = data.clips(length)
    if not cache.exists():
        _write_cache(data, size, cache, threads, progress)
    try:
        with np.load(cache, allow_pickle=False) as stored:
            parts = {name: stored[name] for name in ("images", "distances", "sources", "rolls", "actions")}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise FileError(f"{cache}: expected shrunk pictures, got {error}; delete it") from error
    firsts = np.concatenate([[0], np.cumsum([row["frames"] for row in data.segments])])
    located = [clips.locate(index) for index in range(len(clips))]
    starts = np.array([firsts[segment] + start for segment, start in located], np.int32)
    scenes = np.array([data.segments[segment]["scene"] for segment, _ in located])
    return ShrunkNavigation(**parts, starts=starts, scenes=scenes, length=length)


def _write_cache(
    data: NavigationData, size: tuple[int, int], cache: Path, threads: int, progress: Callable[[int, int], None]
) -> None:
    columns: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("images", "distances", "sources", "rolls", "actions")
    }
    pictures = 0
    for done, part in enumerate(_shrink_segments(data, size, threads), 1):
        part["sources"] = part["sources"] + pictures
        pictures += len(part["images"])
        for name, values in part.items():
            columns[name].append(values)
        progress(done, len(data))
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    with atomic_file(cache) as draft, draft.open("wb") as file:
        np.savez(file, **joined)  # type: ignore[arg-type]


def _shrink_segments(data: NavigationData, size: tuple[int, int], threads: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the parts of each segment, decoded by several threads, in order."""
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(lambda index: _shrink_segment(data[index], size), range(len(data)))


def _shrink_segment(segment: NavigationSegment, size: tuple[int, int]) -> dict[str, NDArray[Any]]:
    height, width = size
    own, sources = np.unique(segment.sources, return_inverse=True)
    decoded = [segment.decode(int(frame)) for frame in own]
    full = decoded[0][0].shape[1]
    images = [cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA) for color, _ in decoded]
    depths = [
        cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) / DEPTH_UNITS
        for _, depth in decoded
        if depth is not None
    ]
    return {
        "images": np.stack(images),
        "distances": np.array(depths, np.float16).reshape(len(depths), height, width),
        "sources": sources.astype(np.int32),
        "rolls": (segment.rolls * width // full).astype(np.int32),
        "actions": segment.actions,
    }
