# SPDX-License-Identifier: Apache-2.0
"""The navigation dataset, as `wiw collect navigation` writes it.

    data = NavigationData("data")
    for segment in data:
        segment.images, segment.depths, segment.actions, segment.poses
    clips = data.clips(14)                      # every window of 14 frames; clips[i] reads one row group
    train, held_out = NavigationData("data", part="train"), NavigationData("data", part="held-out")

`docs/collecting-navigation.md` describes the files.
"""

from __future__ import annotations

import json
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from hashlib import blake2b, sha256
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, get_args

from wiw.datasets.navigation_card import build_card
from wiw.datasets.navigation_files import FORMAT, SEGMENTS, FrameFile, read_segment_list
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.datasets.parquet_files import MANIFEST, require_pyarrow
from wiw.datasets.scene_splits import find_shared_scene, shorten_name
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.mapping_files import read_json_object
from wiw.scenes import strip_edits

META, CARD = "meta.json", "README.md"
Part = Literal["all", "train", "held-out"]


class NavigationData(Sequence[NavigationSegment]):
    """A folder that `wiw collect navigation` has finished: its segments, scene by scene.

    Args:
        folder: with `meta.json`.
        part: "all"; or "train" or "held-out", two parts without a scene in common; an edited apartment is in the
            part of the one that it is a copy of.
        held_out: share of the scenes that are held out, chosen by a hash of their names; those of files of one name
            are together.

    Raises:
        DependencyError: pyarrow is not installed.
        FileError: there is no such dataset, it is not finished, or a file of it is missing or damaged.
        ArgumentError: no such part, or a share that is not one.
    """

    def __init__(self, folder: str | Path, part: Part = "all", held_out: float = 0.05) -> None:
        require_pyarrow("navigation datasets")
        if part not in get_args(Part) or not 0 <= held_out <= 1:
            raise ArgumentError(
                f"expected a part among {', '.join(get_args(Part))} and a held_out from 0 to 1, got {part}, {held_out}"
            )
        self.folder = Path(folder)
        self.meta = read_meta(self.folder)
        """Camera, encoding, rules, scenes and checksums."""
        rows = read_segment_list(self.folder / SEGMENTS)
        self.segments = [row for row in rows if part == "all" or part == part_of(shorten_name(row["scene"]), held_out)]
        """Rows of `segments.parquet`: scene, file, row group, frames and action counts of each segment."""
        self._files: dict[str, FrameFile] = {}

    def __len__(self) -> int:
        return len(self.segments)

    def __getitem__(self, index: Any) -> Any:
        """Return one segment, or a list of those of a slice; only their row groups are read.

        Raises:
            FileError: a file is missing or damaged.
        """
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        return self.read(index)

    def __iter__(self) -> Iterator[NavigationSegment]:
        return (self.read(index) for index in range(len(self)))

    def read(self, index: int, pictures: bool = True) -> NavigationSegment:
        """Return a segment, without its pictures where they are not wanted.

        Raises:
            FileError: a file is missing or damaged.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"expected one of {len(self)} segments, got {index}")
        row = self.segments[index]
        if row["file"] not in self._files:
            self._files[row["file"]] = FrameFile(self.folder / row["file"])
        return self._files[row["file"]].read_segment(row["row_group"], pictures)

    @property
    def scenes(self) -> set[str]:
        """Names of its scenes, without their edits: an edited apartment is the same home."""
        return {strip_edits(row["scene"]) for row in self.segments}

    def find_shared(self, specs: Iterable[str]) -> str | None:
        """Return the first of some scenes that may be in the dataset too, whatever its edits; None if none may.

        Only names are known: a file may be one of the dataset's if the end of its path is the name of that.
        """
        return find_shared_scene(specs, self.scenes)

    @property
    def frames(self) -> int:
        """Number of frames of all segments."""
        return sum(row["frames"] for row in self.segments)

    def digest(self) -> str:
        """Return the SHA-256 of the files' checksums, which identifies the dataset."""
        return sha256(json.dumps(self.meta["files"], sort_keys=True).encode()).hexdigest()

    def require_files(self) -> None:
        """Check that all files are there in the size that `meta.json` says; none is read.

        Raises:
            FileError: one is missing or of another size.
        """
        for name, recorded in self.meta["files"].items():
            _require_size(self.folder / name, recorded.get("bytes"))

    def clips(self, length: int, stride: int = 1) -> Clips:
        """Return all windows of `length` frames that begin `stride` frames apart within a segment.

        Raises:
            ArgumentError: a length or stride below 1, or no segment is that long.
        """
        return Clips(self, length, stride)


class Clips(Sequence[NavigationSegment]):
    """Windows of one length, in order; each is read when it is requested."""

    def __init__(self, data: NavigationData, length: int, stride: int = 1) -> None:
        if length < 1 or stride < 1:
            raise ArgumentError(f"expected clips of 1 frame or more and a stride of 1 or more, got {length}, {stride}")
        self._data, self._length, self._stride = data, length, stride
        counts = [max(0, row["frames"] - length + stride) // stride for row in data.segments]
        self._ends = list(accumulate(counts))
        if not len(self):
            longest = max((row["frames"] for row in data.segments), default=0)
            raise ArgumentError(
                f"{data.folder}: no segment has {length} frames, the longest has {longest}; use shorter clips"
            )

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: Any) -> Any:
        """Return one clip, or a list of those of a slice; only the row groups of their segments are read.

        Raises:
            FileError: a file is missing or damaged.
        """
        if isinstance(index, slice):
            return [self[each] for each in range(*index.indices(len(self)))]
        segment, start = self.locate(index)
        return self._data.read(segment).clip(start, self._length)

    def describe(self, index: int) -> str:
        """Return scene, segment and first frame of a clip, in words."""
        segment, start = self.locate(index)
        scene = self[index].scene
        return f"clip {index} (scene {scene}, segment {segment} of the dataset, from frame {start})"

    def locate(self, index: int) -> tuple[int, int]:
        """Return the segment of a clip, and the frame of it that the clip begins with."""
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(f"expected one of {len(self)} clips, got {index}")
        segment = bisect_right(self._ends, at)
        return segment, (at - (self._ends[segment - 1] if segment else 0)) * self._stride


class SelectedClips(Sequence[NavigationSegment]):
    """Some of the clips of a dataset.

    Args:
        clips: all of them.
        rows: int [N]: which ones.
    """

    def __init__(self, clips: Clips, rows: Sequence[int]) -> None:
        self._clips, self._rows = clips, list(rows)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: Any) -> Any:
        """Return one clip, or a list of those of a slice, as `Clips` does."""
        if isinstance(index, slice):
            return [self._clips[row] for row in self._rows[index]]
        return self._clips[self._rows[index]]

    def describe(self, index: int) -> str:
        """Return scene, segment and first frame of a clip, in words."""
        return self._clips.describe(self._rows[index])

    def locate(self, index: int) -> tuple[int, int]:
        """Return the segment of a clip, and the frame of it that the clip begins with."""
        return self._clips.locate(self._rows[index])


def _require_size(path: Path, expected: int | None) -> None:
    """Raise FileError unless a file is there and, where its size is known, has it."""
    remedy = "copy it again, or repeat `wiw collect navigation` to recreate it"
    try:
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise FileError(f"{path} is missing; {remedy}") from error
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    if expected not in (None, size):
        raise FileError(
            f"{path}: expected {expected} bytes, as in {META}, got {size}; {remedy} (`wiw data verify` finds what else "
            "is damaged)"
        )


def part_of(name: str, held_out: float) -> Literal["train", "held-out"]:
    """Return the part that a scene or demonstration belongs to, by a hash of its name: adding some moves no other.

    The name of a scene is the one that it has whatever other scenes there are, `scene_splits.shorten_name`.

    An edited apartment belongs to the part of the one that it is a copy of.
    """
    number = int.from_bytes(blake2b(strip_edits(name).encode(), digest_size=8).digest(), "little")
    return "held-out" if number < held_out * 2**64 else "train"


def read_meta(folder: Path) -> dict[str, Any]:
    """Return what `meta.json` says about a finished dataset.

    Raises:
        FileError: there is none, it is of another format, or the dataset is not finished.
    """
    path = folder / META
    if not path.exists() and (folder / MANIFEST).exists():
        read_navigation_manifest(folder)  # demonstrations have a manifest of their own, and no meta.json
        raise FileError(
            f"{path} is missing; `wiw collect navigation` writes it at the end: repeat that command until it finishes"
        )
    found = read_json_object(path, "the description of a navigation dataset, which `wiw collect navigation` writes")
    files = found.get("files")
    if not isinstance(files, dict) or not all(isinstance(each, dict) for each in files.values()):
        raise FileError(f"{path}: expected the description of a navigation dataset, got no list of files")
    if found.get("format") != FORMAT:
        raise FileError(f"{path}: expected a navigation dataset of format {FORMAT}, got {found.get('format')}")
    return found


def count_totals(
    rows: Sequence[Mapping[str, Any]], files: Mapping[str, Any], passes: Sequence[Mapping[str, Any]]
) -> dict[str, int]:
    """Return the totals of `meta.json` from rows of `segments.parquet`, its files, and its passes over scenes."""
    totals = Counter({"segments": len(rows), "bytes": sum(file["bytes"] for file in files.values())})
    for row in rows:
        totals.update({name: row[name] for name in ("frames", "pictures", "forward", "turn_left", "turn_right")})
    totals["dropped"] = sum(each["dropped"] for record in passes for each in record["traversals"])
    return {"scenes": len({record["scene"] for record in passes}), **totals}


def write_meta(folder: Path, meta: Mapping[str, Any]) -> None:
    """Write the card and, last of all, `meta.json`, with which a dataset is finished.

    Raises:
        FileError: they cannot be written.
    """
    with atomic_file(folder / CARD) as draft:
        draft.write_text(build_card(meta))
    with atomic_file(folder / META) as draft:
        draft.write_text(json.dumps(meta) + "\n")


def read_navigation_manifest(folder: Path) -> dict[str, Any]:
    """Return the settings with which a folder was started.

    Raises:
        FileError: there is no manifest, or it is not one of a navigation dataset.
    """
    path = folder / MANIFEST
    found = read_json_object(path, "a new folder, or one that `wiw collect navigation` has started")
    if found.get("what") != "navigation":
        other = "`wiw collect manipulation`" if "tasks" in found else found.get("what")
        raise FileError(f"{path}: expected a manifest of `wiw collect navigation`, got one of {other}")
    return found
