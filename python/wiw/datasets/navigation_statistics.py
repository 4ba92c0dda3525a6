# SPDX-License-Identifier: Apache-2.0
"""Figures of a navigation dataset: frames, actions, lengths, coverage, sizes. Nothing but its lists is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.navigation import NavigationData

ACTIONS = ("forward", "turn_left", "turn_right")


@dataclass(frozen=True)
class SceneFigures:
    """Figures of all passes over one scene."""

    scene: str
    area: float
    """Square metres of the islands that were traversed, the mean over passes."""
    frames: int
    segments: int
    coverage: float
    """Share of that area within 1 m of a frame, the mean over passes."""
    dropped: int


@dataclass(frozen=True)
class NavigationStatistics:
    """Figures of a dataset."""

    totals: dict[str, int]
    """As in `meta.json`: scenes, segments, frames, pictures, bytes, dropped, and the number of each action."""
    lengths: NDArray[np.int64]
    """int64 [S]: frames of each segment."""
    endings: dict[str, int]
    """Number of segments that reached their waypoint, got stuck, or were cut at the cap."""
    scenes: tuple[SceneFigures, ...]
    """Figures of each scene, least coverage first."""

    @property
    def coverage(self) -> float:
        """Share of all floor within 1 m of a frame."""
        area = sum(each.area for each in self.scenes)
        return sum(each.coverage * each.area for each in self.scenes) / area if area else 0.0

    def count_windows(self, length: int) -> int:
        """Return the number of clips of `length` frames that begin one frame apart."""
        return int(np.maximum(0, self.lengths - length + 1).sum())


def compute_statistics(data: NavigationData) -> NavigationStatistics:
    """Compute the figures of a dataset."""
    names = sorted({record["scene"] for record in data.meta["passes"]})
    scenes = [_compute_scene(data, name) for name in names]
    endings = [row["ending"] for row in data.segments]
    return NavigationStatistics(
        totals=data.meta["totals"],
        lengths=np.array([row["frames"] for row in data.segments], np.int64),
        endings={ending: endings.count(ending) for ending in sorted(set(endings))},
        scenes=tuple(sorted(scenes, key=lambda each: each.coverage)),
    )


def _compute_scene(data: NavigationData, scene: str) -> SceneFigures:
    passes = [record["traversals"] for record in data.meta["passes"] if record["scene"] == scene]
    islands: list[dict[str, Any]] = [each for traversals in passes for each in traversals]
    area = sum(each["area"] for each in islands)
    covered = sum(each["coverage"] * each["area"] for each in islands)
    return SceneFigures(
        scene=scene,
        area=area / len(passes),
        frames=sum(each["frames"] for each in islands),
        segments=sum(row["scene"] == scene for row in data.segments),
        coverage=covered / area if area else 0.0,
        dropped=sum(each["dropped"] for each in islands),
    )
