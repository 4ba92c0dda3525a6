# SPDX-License-Identifier: Apache-2.0
"""Demonstrations of manipulation tasks, as `wiw collect` writes them.

    for each in Demonstrations("demos"):
        each.instruction, each.images, each.poses, each.actions

`docs/demonstrations.md` describes the files.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.demonstration import DEPTH_UNITS, Demonstration, Outline
from wiw.datasets.parquet_files import MANIFEST
from wiw.datasets.shards import Shard, require_pyarrow
from wiw.errors import ArgumentError, FileError
from wiw.mapping_files import read_json_object

SHARD = 10
"""Demonstrations a file."""
QUALITY = 95
"""JPEG quality; colours are as fine as brightness (4:4:4)."""

Format = Literal["jpeg", "png"]


@dataclass(frozen=True)
class FrontCamera:
    """The camera that took the images. It looks along its -z, +y is up; the world's z is up."""

    intrinsics: NDArray[np.float64]
    """float64 [3, 3]: a point (x, y, z) before it is seen at K (x, -y, -z) / -z, in pixels right and down."""
    T_world_camera: NDArray[np.float64]
    """float64 [4, 4]."""


class Demonstrations(Sequence[Demonstration]):
    """A folder that `wiw collect` has written: its demonstrations, task by task.

    Args:
        folder: with the manifest.
        tasks: "all", or names of those to read.
        partial: whether to read what exists of an unfinished collection.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such collection, or a file of it is missing or damaged.
        ArgumentError: a task that was not collected.
    """

    def __init__(self, folder: str | Path, tasks: str | Sequence[str] = "all", partial: bool = False) -> None:
        require_pyarrow()
        self.folder = Path(folder)
        self.config = read_manifest(self.folder)
        """Options of the collection."""
        paths = [path for task in self._resolve_tasks(tasks) for path in shard_paths(self.folder, self.config, task)]
        self.files = [Shard(path) for path in paths if not partial or path.exists()]
        """Files of demonstrations, in order."""
        self._ends = list(accumulate(len(shard) for shard in self.files))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: Any) -> Any:
        """Return one demonstration, or a list of those of a slice.

        Raises:
            FileError: its file is damaged.
        """
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"expected one of {len(self)} demonstrations, got {index}")
        shard = bisect_right(self._ends, at)
        return self.files[shard][at - (self._ends[shard - 1] if shard else 0)]

    def __iter__(self) -> Iterator[Demonstration]:
        return (shard[index] for shard in self.files for index in range(len(shard)))

    def read_outlines(self) -> list[Outline]:
        """Return the outline of each demonstration; pictures are not read.

        Raises:
            FileError: a file is damaged.
        """
        return [shard.read_outline(index) for shard in self.files for index in range(len(shard))]

    def digest(self) -> str:
        """Return the SHA-256 of the collection's options, of which each demonstration is a function, and its files'
        sizes.
        """
        sizes = {shard.path.name: shard.path.stat().st_size for shard in self.files}
        return sha256(json.dumps([self.config, sizes], sort_keys=True).encode()).hexdigest()

    @property
    def failed(self) -> dict[str, int]:
        """Tables that experts failed at, by task; each was replaced by another one, unless they were kept.

        Raises:
            FileError: a file is damaged.
        """
        counts = dict.fromkeys(self.config["tasks"], 0)
        for shard in self.files:
            with shard.blame_damage():
                counts[shard.facts["task"]] += shard.facts["failed"]
        return counts

    @property
    def camera(self) -> FrontCamera:
        """Camera of the front view.

        Raises:
            FileError: nothing has been collected yet, or a file is damaged.
        """
        if not self.files:
            raise FileError(f"{self.folder}: nothing has been collected yet")
        with self.files[0].blame_damage():
            facts = self.files[0].facts["camera"]
            return FrontCamera(_read_matrix(facts["intrinsics"], 3), _read_matrix(facts["T_world_camera"], 4))

    @property
    def wrist_intrinsics(self) -> NDArray[np.float64] | None:
        """Intrinsics float64 [3, 3] of the wrist camera, as in `FrontCamera`; None if its views were not collected.

        Raises:
            FileError: nothing has been collected yet, or a file is damaged.
        """
        if not self.files:
            raise FileError(f"{self.folder}: nothing has been collected yet")
        with self.files[0].blame_damage():
            facts = self.files[0].facts.get("wrist_camera")
            return None if facts is None else _read_matrix(facts["intrinsics"], 3)

    def _resolve_tasks(self, tasks: str | Sequence[str]) -> list[str]:
        known = self.config["tasks"]
        names = known if tasks == "all" else tasks.split(",") if isinstance(tasks, str) else list(tasks)
        if unknown := [name for name in names if name not in known]:
            raise ArgumentError(f"{self.folder}: expected tasks among {', '.join(known)}, got {', '.join(unknown)}")
        return list(names)


def _read_matrix(rows: Any, side: int) -> NDArray[np.float64]:
    return np.array(rows, np.float64).reshape(side, side)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the settings with which a folder was collected.

    Raises:
        FileError: the manifest does not exist or cannot be read.
    """
    path = folder / MANIFEST
    found = read_json_object(path, "a manifest of `wiw collect`, in a folder that it has written")
    if not isinstance(found.get("tasks"), list) or type(found.get("episodes")) is not int:
        raise FileError(
            f"{path}: expected a manifest of `wiw collect` with a list of tasks and a number of episodes, got "
            f"{', '.join(found) or 'no keys'}"
        )
    return found


def shard_paths(folder: Path, config: Mapping[str, Any], task: str) -> list[Path]:
    """Return the files of a task, of `SHARD` demonstrations each but for the last."""
    return [folder / f"{task}-{number:05d}.parquet" for number in range(-(-config["episodes"] // SHARD))]


def shard_range(number: int, episodes: int) -> range:
    """Return the range of demonstrations in a file, of so many in all."""
    return range(SHARD * number, min(SHARD * (number + 1), episodes))


def encode_image(image: NDArray[np.uint8], kind: Format) -> bytes:
    """Encode a picture as JPEG or PNG."""
    fine = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, *fine] if kind == "jpeg" else []
    return bytes(cv2.imencode(f".{kind}", image[..., ::-1], options)[1])


def encode_depth(depth: NDArray[np.float32]) -> bytes:
    """Encode metres as a 16-bit PNG; what is further away than 13 m is as far."""
    units = np.clip(np.rint(depth * DEPTH_UNITS), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    return bytes(cv2.imencode(".png", units)[1])
