# SPDX-License-Identifier: Apache-2.0
"""Corpora that models are post-trained on, as clips of frames with the action that belongs to each frame.

corpus = open_corpus("data", "train")     # of `wiw collect navigation` or `wiw collect manipulation`
clip = corpus.clips(13)[0]
clip.images, clip.actions                 # uint8 [13, H, W, 3]; ids int8 [13], or poses float64 [13, 7]
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from wiw import action, panorama
from wiw.datasets.demonstrations import Demonstrations, read_manifest
from wiw.datasets.navigation import META, Clips, NavigationData, Part, part_of
from wiw.datasets.parquet_files import MANIFEST
from wiw.errors import ArgumentError, FileError
from wiw.types import GRIPPER_POSES, PRIMITIVES, View

CorpusPart = Literal["train", "all"]
HFOV_DEG = 90.0
"""Field of view of an agent's front view."""


@dataclass(frozen=True)
class Clip:
    """N frames, and what led to each."""

    images: NDArray[np.uint8]
    """uint8 [N, H, W, 3]."""
    actions: NDArray[Any]
    """int8 [N], wiw's primitives with Null in front; or float64 [N, 7], absolute poses of a gripper."""


class CorpusClips(Sequence[Clip], ABC):
    """Clips of one length; each is read when it is asked for."""

    @abstractmethod
    def describe(self, index: int) -> str:
        """Return where a clip is in its corpus, in words."""


class Corpus(ABC):
    """A folder of frames and actions."""

    space: ClassVar[str]
    """Plan space of its actions, a name of `wiw.loop.plan_space`."""
    view: View
    """View that its frames show."""

    @abstractmethod
    def clips(self, frames: int) -> CorpusClips:
        """Return all clips of so many frames.

        Raises:
            ArgumentError: there is none.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return what identifies the corpus, as JSON values: a digest of its files, and which part of them."""


def open_corpus(folder: str | Path, part: CorpusPart, held_out: float = 0.05) -> Corpus:
    """Open a folder of `wiw collect navigation` or `wiw collect manipulation`.

    Args:
        folder: as the command left it.
        part: "train", which leaves a share for validation, or "all".
        held_out: share of the scenes, or of the demonstrations, that "train" leaves out.

    Raises:
        FileError: it is neither, not finished, or damaged.
        DependencyError: pyarrow is not installed.
    """
    folder = Path(folder)
    if is_demonstrations(folder):
        return DemonstrationCorpus(Demonstrations(folder), part, held_out)
    return NavigationCorpus(NavigationData(folder, part, held_out), part)


def is_demonstrations(folder: Path) -> bool:
    """Return whether a folder is of `wiw collect manipulation`."""
    if (folder / META).exists() or not (folder / MANIFEST).exists():
        return False
    try:
        read_manifest(folder)
    except FileError:
        return False
    return True


# -- navigation --------------------------------------------------------------------------------------------------------


class NavigationCorpus(Corpus):
    """Segments of `wiw collect navigation`: panoramas or front views, and the primitive that led to each.

    Args:
        data: the segments.
        part: which of them they are.
        front: height and width of front views that are cut out of panoramas, as the loop does; None leaves panoramas.
    """

    space = PRIMITIVES

    def __init__(self, data: NavigationData, part: Part, front: tuple[int, int] | None = None) -> None:
        self.data, self.part = data, part
        panoramic = data.meta.get("camera", {}).get("projection") == "equirectangular"
        self._crop = front if panoramic else None
        self.view: View = "panorama" if panoramic and not front else "perspective"

    def show_front(self, size: tuple[int, int]) -> NavigationCorpus:
        """Return the corpus with front views, which are cut out of panoramas where it has those."""
        return NavigationCorpus(self.data, self.part, size)

    def clips(self, frames: int) -> CorpusClips:
        """Return all windows of so many frames; see `Corpus.clips`."""
        return NavigationClips(self.data.clips(frames), self._crop)

    def describe(self) -> dict[str, Any]:
        """Return a digest of the files' checksums, which part, how many segments."""
        return {"sha256": self.data.digest(), "part": self.part, "segments": len(self.data), "view": self.view}


class NavigationClips(CorpusClips):
    """Windows of navigation segments; `crop` is the size of front views that are cut out of panoramas."""

    def __init__(self, clips: Clips, crop: tuple[int, int] | None) -> None:
        self._clips, self._crop = clips, crop

    def __len__(self) -> int:
        return len(self._clips)

    def __getitem__(self, index: Any) -> Any:
        """Return a clip.

        Raises:
            FileError: a picture is damaged.
        """
        segment = self._clips[index]
        images = segment.images
        if self._crop:
            images = np.asarray(panorama.to_perspective(images, HFOV_DEG, self._crop))
        return Clip(images, segment.actions)

    def describe(self, index: int) -> str:
        """Return scene, segment and first frame."""
        return self._clips.describe(index)


def require_panoramas(name: str, corpus: Corpus) -> None:
    """Raise ArgumentError unless a corpus of primitives has panoramas, which models in the loop see."""
    if corpus.view != "panorama":
        raise ArgumentError(
            f"{name}: models that follow primitives see panoramas, but this dataset has {corpus.view} views; collect "
            "without --perspective"
        )


# -- manipulation ------------------------------------------------------------------------------------------------------


class DemonstrationCorpus(Corpus):
    """Demonstrations of `wiw collect manipulation`: front views and absolute poses of the gripper.

    A clip shows a plan as the loop puts it to a model. It begins where an action has ended and the arm is at rest, and
    its frames are spread evenly over the next K actions, for every K that the demonstration has. The pose of each frame
    is what `wiw.action.resample` makes of the commanded poses, from the measured one in the first frame on.
    """

    space = GRIPPER_POSES
    view: View = "perspective"

    def __init__(self, data: Demonstrations, part: CorpusPart, held_out: float) -> None:
        self.data, self.part, self.held_out = data, part, held_out

    def clips(self, frames: int) -> CorpusClips:
        """Return the clips of all plans of at most `frames` - 1 actions; see `Corpus.clips`."""
        return DemonstrationClips(self.data, self.part, self.held_out, frames)

    def describe(self) -> dict[str, Any]:
        """Return a digest of the manifest, of which demonstrations are a function, and which part of them it is."""
        return {"sha256": self.data.digest(), "part": self.part, "demonstrations": len(self.data), "view": self.view}


class DemonstrationClips(CorpusClips):
    """Plans within demonstrations: from the end of any action, or the start, to the end of a later one."""

    def __init__(self, data: Demonstrations, part: CorpusPart, held_out: float, frames: int) -> None:
        self._data, self._frames = data, frames
        self._plans = [
            (index, first, last)
            for index, outline in enumerate(data.read_outlines())
            if part == "all" or part == part_of(f"{outline.task} {outline.seed}", held_out)
            for first, last in _list_plans(outline.ended, frames - 1)
        ]
        if not self._plans:
            raise ArgumentError(
                f"{data.folder}: expected demonstrations with an action in the part '{part}', got none; collect more"
            )

    def __len__(self) -> int:
        return len(self._plans)

    def __getitem__(self, index: Any) -> Any:
        """Return a clip.

        Raises:
            FileError: a picture is damaged.
        """
        number, first, last = self._plans[index]
        demonstration = self._data[number]
        ends = find_ends(demonstration.ended)[first : last + 1]
        shown = spread_frames(ends, self._frames)
        start, plan = demonstration.poses[ends[0]], demonstration.actions[ends[1:]]
        poses = action.resample(plan, self._frames - 1, start=start)
        return Clip(demonstration.decode(shown), np.concatenate([start[None], poses]))

    def describe(self, index: int) -> str:
        """Return task, demonstration and actions."""
        number, first, last = self._plans[index]
        return f"clip {index} (demonstration {number} of the dataset, actions {first + 1} to {last})"


def _list_plans(ended: NDArray[np.bool_], longest: int) -> list[tuple[int, int]]:
    """List all plans of at most `longest` actions, each by how many actions had ended before it and at its end."""
    count = int(ended.sum())
    return [(first, last) for first in range(count) for last in range(first + 1, min(first + longest, count) + 1)]


def find_ends(ended: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return int64 [K + 1]: frame 0, and those in which the actions have ended."""
    return np.concatenate([[0], np.flatnonzero(ended)])


def spread_frames(ends: NDArray[np.int64], frames: int) -> NDArray[np.int64]:
    """Return int64 [frames]: frames spread evenly over the actions between `ends` [K + 1], however long each takes."""
    progress = np.linspace(0, len(ends) - 1, frames)
    return np.rint(np.interp(progress, np.arange(len(ends)), ends)).astype(np.int64)
