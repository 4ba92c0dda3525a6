# SPDX-License-Identifier: Apache-2.0
"""Corpora that models are post-trained on, as clips of frames with the action that belongs to each frame.

corpus = open_corpus("data", "train")     # of `wiw collect navigation` or `wiw collect manipulation`
clip = corpus.clips(13)[0]
clip.images, clip.actions                 # uint8 [13, H, W, 3]; ids int8 [13], or poses float64 [13, 7]
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.datasets.demonstration import Outline, name_demonstration
from wiw.datasets.demonstrations import Demonstrations, read_manifest
from wiw.datasets.navigation import META, Clips, NavigationData, Part, part_of
from wiw.datasets.parquet_files import MANIFEST
from wiw.datasets.scene_splits import list_evaluation_scenes, match_names
from wiw.errors import ArgumentError, FileError
from wiw.training.held_out_clips import HeldOutClips
from wiw.training.held_out_demonstrations import DemonstratedPlan, select_demonstrations
from wiw.training.held_out_panoramas import select_panoramas
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
    """Clips of one length; each is read when it is requested."""

    @abstractmethod
    def describe(self, index: int) -> str:
        """Return where a clip is in its corpus, in words."""


class Corpus(ABC):
    """A folder of frames and actions."""

    space: ClassVar[str]
    """Plan space of its actions, a name of `wiw.loop.plan_space`."""
    unit: ClassVar[str]
    """Noun for what is held out as a whole."""
    command: ClassVar[str]
    """Command that makes such folders."""
    view: View
    """View that its frames show."""
    data: NavigationData | Demonstrations
    part: Part
    """Part of the data that it has."""

    @property
    @abstractmethod
    def units(self) -> set[str]:
        """Names of the scenes or demonstrations that it has."""

    def list_shared(self, other: Corpus) -> list[str]:
        """Return the names of its scenes or demonstrations that another corpus of the kind may have, too, sorted."""
        return sorted(self.units & other.units)

    @property
    @abstractmethod
    def camera_height(self) -> float | None:
        """Metres of its cameras above the floor, where that is the same in all frames and known."""

    @abstractmethod
    def clips(self, frames: int) -> CorpusClips:
        """Return all clips with this number of frames.

        Raises:
            ArgumentError: there is none.
        """

    @abstractmethod
    def select_clips(self, frames: int, count: int, seed: int, size: tuple[int, int]) -> HeldOutClips[Any]:
        """Select clips that a model is measured on, which sees the corpus as it is.

        Args:
            frames: of a clip.
            count: how many; all where there are fewer.
            seed: of the choice.
            size: (height, width) that frames are brought to.

        Raises:
            ArgumentError: there is none.
            FileError: a picture is damaged.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return what identifies the corpus, as JSON values: a digest of its files, and which part of them."""


def open_corpus(folder: str | Path, part: Part, held_out: float = 0.05) -> Corpus:
    """Open a folder of `wiw collect navigation` or `wiw collect manipulation`, with all of its files in place.

    Args:
        folder: as the command left it.
        part: "train", which leaves a share for validation, "held-out", which is that share, or "all".
        held_out: share of the scenes, or of the demonstrations, that "train" leaves out.

    Raises:
        FileError: it is neither, not finished, or damaged, or a file of it is missing or cut short.
        DependencyError: pyarrow is not installed.
    """
    folder = Path(folder)
    if is_demonstrations(folder):
        return DemonstrationCorpus(Demonstrations(folder), part, held_out)
    return NavigationCorpus(NavigationData(folder, part, held_out), part)


def require_training_split(corpus: Corpus) -> None:
    """Raise ArgumentError where a corpus has scenes of a split for evaluation, on which nothing is trained."""
    if not isinstance(corpus, NavigationCorpus):
        return
    found, stated = list_evaluation_scenes(corpus.units), corpus.data.meta.get("split", "train")
    if not found and stated == "train":
        return
    what = f"scene {found[0][0]} of split {found[0][1]}" if found else f"split {stated}"
    raise ArgumentError(
        f"{corpus.data.folder}: expected scenes of a train split, got {what}: a model trained on scenes that it is "
        "evaluated on proves nothing; collect from a train split, such as apartments:train:80"
    )


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

    Raises:
        FileError: a file is missing or cut short, of which a clip might come up after hours of training.
    """

    space = PRIMITIVES
    unit = "scene"
    command = "wiw collect navigation"
    data: NavigationData

    def __init__(self, data: NavigationData, part: Part, front: tuple[int, int] | None = None) -> None:
        data.require_files()
        self.data, self.part = data, part
        panoramic = data.meta.get("camera", {}).get("projection") == "equirectangular"
        self._crop = front if panoramic else None
        self.view: View = "panorama" if panoramic and not front else "perspective"

    def show_front(self, size: tuple[int, int]) -> NavigationCorpus:
        """Return the corpus with front views, which are cut out of panoramas where it has those."""
        return NavigationCorpus(self.data, self.part, size)

    @property
    def units(self) -> set[str]:
        """Names of the scenes, without their edits."""
        return self.data.scenes

    def list_shared(self, other: Corpus) -> list[str]:
        """Return the names of its scenes that may be of a scene of the other one: a name depends on the other scenes.

        Names are alike whose ends are: "mesh" and "a/mesh".
        """
        return sorted({own for own, _ in match_names(self.units, other.units)})

    @property
    def camera_height(self) -> float | None:
        """Metres of the camera above the floor."""
        height = self.data.meta.get("camera", {}).get("height_m")
        return None if height is None else float(height)

    def cut_views(self, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return pictures [N, H, W, 3] of the dataset as the corpus shows them."""
        return cut_front_views(images, self._crop) if self._crop else images

    def clips(self, frames: int) -> CorpusClips:
        """Return all windows with this number of frames; see `Corpus.clips`."""
        return NavigationClips(self.data.clips(frames), self.cut_views)

    def select_clips(self, frames: int, count: int, seed: int, size: tuple[int, int]) -> HeldOutClips[Any]:
        """Select clips of panoramas; see `Corpus.select_clips`."""
        require_panoramas("validation", self)
        return select_panoramas(self.data.clips(frames), count, seed, size)

    def describe(self) -> dict[str, Any]:
        """Return a digest of the files' checksums, which part, how many segments."""
        return {"sha256": self.data.digest(), "part": self.part, "segments": len(self.data), "view": self.view}


class NavigationClips(CorpusClips):
    """Windows of navigation segments; `cut` maps pictures [N, H, W, 3] to views of the corpus."""

    def __init__(self, clips: Clips, cut: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> None:
        self._clips, self._cut = clips, cut

    def __len__(self) -> int:
        return len(self._clips)

    def __getitem__(self, index: Any) -> Any:
        """Return a clip.

        Raises:
            FileError: a picture is damaged.
        """
        segment = self._clips[index]
        return Clip(self._cut(segment.images), segment.actions)

    def describe(self, index: int) -> str:
        """Return scene, segment and first frame."""
        return self._clips.describe(index)


def cut_front_views(panoramas: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return front views of a size (height, width) out of panoramas [N, H, W, 3], as the loop cuts them."""
    return np.asarray(panorama.to_perspective(panoramas, HFOV_DEG, size))


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
    unit = "demonstration"
    command = "wiw collect manipulation"
    view: View = "perspective"
    data: Demonstrations

    def __init__(self, data: Demonstrations, part: Part, held_out: float) -> None:
        self.data, self.part, self.held_out = data, part, held_out

    @property
    def units(self) -> set[str]:
        """Names of the demonstrations, by task and seed of the table."""
        return {name_demonstration(outline) for _, outline in self._outlines}

    @property
    def camera_height(self) -> None:
        """Not one number: the camera looks down on a table."""
        return None

    def clips(self, frames: int) -> CorpusClips:
        """Return the clips of all plans of at most `frames` - 1 actions; see `Corpus.clips`."""
        return DemonstrationClips(self._find_plans(frames))

    def select_clips(self, frames: int, count: int, seed: int, size: tuple[int, int]) -> HeldOutClips[Any]:
        """Select plans and their frames; see `Corpus.select_clips`."""
        return select_demonstrations(self._find_plans(frames), count, seed, size)

    def _find_plans(self, frames: int) -> DemonstratedPlans:
        plans = DemonstratedPlans(self.data, self._outlines, frames)
        if not plans:
            raise ArgumentError(
                f"{self.data.folder}: expected demonstrations with an action in the part '{self.part}', got none; "
                "collect more"
            )
        return plans

    @cached_property
    def _outlines(self) -> list[tuple[int, Outline]]:
        """Demonstrations of the part, each with its number in the dataset."""
        outlines = enumerate(self.data.read_outlines())
        return [each for each in outlines if self.part in ("all", part_of(name_demonstration(each[1]), self.held_out))]

    def describe(self) -> dict[str, Any]:
        """Return a digest of the manifest, of which demonstrations are a function, which part of them, how many."""
        count = len(self._outlines)
        return {"sha256": self.data.digest(), "part": self.part, "demonstrations": count, "view": self.view}


class DemonstratedPlans(Sequence[DemonstratedPlan]):
    """Plans within demonstrations: from the end of any action, or the start, to the end of a later one.

    Args:
        data: the demonstrations.
        outlines: of those whose plans are listed, each with its number in `data`.
        frames: spread evenly over each plan.
    """

    def __init__(self, data: Demonstrations, outlines: Sequence[tuple[int, Outline]], frames: int) -> None:
        self._data, self._frames = data, frames
        self._plans = [
            (number, first, last)
            for number, outline in outlines
            for first, last in _list_plans(outline.ended, frames - 1)
        ]

    def __len__(self) -> int:
        return len(self._plans)

    def __getitem__(self, index: Any) -> Any:
        """Return a plan.

        Raises:
            FileError: a picture is damaged.
        """
        number, first, last = self._plans[index]
        demonstration = self._data[number]
        ends = find_ends(demonstration.ended)[first : last + 1]
        images = demonstration.decode(spread_frames(ends, self._frames))
        name = name_demonstration(demonstration)
        return DemonstratedPlan(name, images, demonstration.poses[ends[0]], demonstration.actions[ends[1:]])

    def describe(self, index: int) -> str:
        """Return task, demonstration and actions."""
        number, first, last = self._plans[index]
        return f"clip {index} (demonstration {number} of the dataset, actions {first + 1} to {last})"


class DemonstrationClips(CorpusClips):
    """Plans within demonstrations as clips: their frames, and a pose for each."""

    def __init__(self, plans: DemonstratedPlans) -> None:
        self._plans = plans

    def __len__(self) -> int:
        return len(self._plans)

    def __getitem__(self, index: Any) -> Any:
        """Return a clip.

        Raises:
            FileError: a picture is damaged.
        """
        plan = self._plans[index]
        return Clip(plan.images, plan.spread(plan.targets))

    def describe(self, index: int) -> str:
        """Return task, demonstration and actions."""
        return self._plans.describe(index)


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
