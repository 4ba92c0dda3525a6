# SPDX-License-Identifier: Apache-2.0
"""The layout of LeRobot datasets, format v3.0: names of files, features, types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wiw.datasets.parquet_files import image_type

VERSION = "v3.0"
INFO, STATS, TASKS, SOURCE = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/wiw.json"
"""`meta/wiw.json` is not of LeRobot, which passes over it: what the dataset was exported from."""
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CHUNK_FILES = 1000
"""Files a folder."""
FILE_MEGABYTES, VIDEO_MEGABYTES = 100, 200
"""LeRobot's defaults; a single episode may have more."""


@dataclass(frozen=True)
class Feature:
    """A column of frames, as `meta/info.json` describes it."""

    about: str
    """A line for the card."""
    dtype: str
    """NumPy's name of a type, or "image"."""
    shape: tuple[int, ...] = (1,)
    """[height, width, channels] of images, [n] of vectors, [1] of numbers."""
    names: Sequence[str] | None = None
    """Names of the axes of an image, or of the entries of a vector."""
    info: Mapping[str, Any] = field(default_factory=dict)

    @property
    def is_image(self) -> bool:
        """Whether it is pictures, colour or depth."""
        return self.dtype == "image"

    @property
    def is_depth(self) -> bool:
        """Whether it is pictures of depth."""
        return bool(self.info.get("is_depth_map"))

    def describe(self) -> dict[str, Any]:
        """Return its entry in `meta/info.json`."""
        names = list(self.names) if self.names is not None else None
        entry = {"dtype": self.dtype, "shape": list(self.shape), "names": names}
        return entry | ({"info": dict(self.info)} if self.info else {})

    def arrow_type(self) -> Any:
        """Return the type of its column."""
        import pyarrow as pa

        if self.is_image:
            return image_type()
        kind = pa.from_numpy_dtype(self.dtype)
        return kind if self.shape == (1,) else pa.list_(kind, self.shape[0])


INDICES: Mapping[str, Feature] = {
    "timestamp": Feature("frame_index / fps, in seconds", "float32"),
    "frame_index": Feature("from 0 in each episode", "int64"),
    "episode_index": Feature("from 0", "int64"),
    "index": Feature("from 0 in the dataset", "int64"),
    "task_index": Feature("row of meta/tasks.parquet", "int64"),
}
"""Features that every LeRobot dataset has."""


def color_feature(about: str, size: Sequence[int]) -> Feature:
    """Return the feature of colour pictures of (height, width)."""
    return Feature(about, "image", (size[0], size[1], 3), ("height", "width", "channels"))


def depth_feature(about: str, size: Sequence[int], **info: Any) -> Feature:
    """Return the feature of depth pictures of (height, width), with what `info` says about them, such as the unit."""
    info = {"is_depth_map": True, **info}
    return Feature(about, "image", (size[0], size[1], 1), ("height", "width", "channels"), info)


@dataclass(frozen=True)
class Episode:
    """An episode on its way to or from a LeRobot dataset, of T frames."""

    instruction: str
    """LeRobot's task, in words."""
    columns: Mapping[str, Any]
    """T values by feature, `INDICES` left out: an array [T, ...], or encoded pictures."""
    facts: Mapping[str, Any]
    """Values of `meta/episodes` beyond LeRobot's own columns."""
