# SPDX-License-Identifier: Apache-2.0
"""An episode on its scene's map, as values that the page's template draws as SVG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.runs.scene_map import to_pixels
from wiw.types import Episode

PIXELS_PER_METRE = 60.0
"""Scale of a map without a picture."""


@dataclass(frozen=True)
class MapFrame:
    """Frame of a map: its size, and how world points become its pixels."""

    width: float
    height: float
    world_to_pixel: NDArray[np.float64]

    @property
    def metre(self) -> float:
        """Pixels of one metre."""
        return float(self.world_to_pixel[0, 0])

    @property
    def view_box(self) -> str:
        """For the SVG element."""
        return f"0 0 {self.width:.0f} {self.height:.0f}"


@dataclass(frozen=True)
class Mark:
    """A place with a heading, e.g. the start."""

    x: float
    y: float
    heading_deg: float
    """Clockwise from up in the picture."""


@dataclass(frozen=True)
class Trail:
    """One arm's path."""

    arm: str
    points: str
    """For an SVG polyline."""
    stops: tuple[Mark, ...]
    """Places where decisions were taken, and at last where the episode ended."""


def frame_of_picture(size: tuple[int, int], world_to_pixel: Sequence[Sequence[float]]) -> MapFrame:
    """Return the frame of a kept scene map, `size` being (width, height)."""
    return MapFrame(size[0], size[1], np.asarray(world_to_pixel, np.float64))


def frame_of_points(points: NDArray[np.float64]) -> MapFrame:
    """Return a frame around world points [N, 3], for scenes without a picture."""
    low, high = points.min(0) - 0.8, points.max(0) + 0.8
    width, height = PIXELS_PER_METRE * (high[0] - low[0]), PIXELS_PER_METRE * (high[2] - low[2])
    shift = -PIXELS_PER_METRE * low[[0, 2]]
    return MapFrame(width, height, np.array([[PIXELS_PER_METRE, 0, shift[0]], [0, PIXELS_PER_METRE, shift[1]]]))


def start_and_goal(frame: MapFrame, episode: Episode) -> tuple[Mark, Mark | None]:
    """Return the start, and the place where the goal image was taken; None for a goal whose place is not known."""
    is_known = bool(np.isfinite([*episode.goal_position, episode.goal_yaw]).all())
    goal = _mark(frame, episode.goal_position, episode.goal_yaw) if is_known else None
    return _mark(frame, episode.start_position, episode.start_yaw), goal


def trail(frame: MapFrame, arm: str, decisions: Sequence[Mapping[str, Any]]) -> Trail:
    """Return the path that the decisions of one episode took."""
    path = np.concatenate([np.asarray(decision["path"], np.float64) for decision in decisions])
    pixels = to_pixels(frame.world_to_pixel, path)
    moved = np.concatenate([[True], np.linalg.norm(np.diff(pixels, axis=0), axis=1) > 0.01])
    stops = [_mark(frame, _place(decision, "before"), decision["before_yaw"]) for decision in decisions]
    stops.append(_mark(frame, _place(decisions[-1], "after"), decisions[-1]["after_yaw"]))
    return Trail(arm, " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels[moved]), tuple(stops))


def all_points(episode: Episode, decisions: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    """Return every world point that an episode touches, as far as they are known, float64 [N, 3]."""
    ends = np.array([episode.start_position, episode.goal_position], np.float64)
    points = np.concatenate([ends, *(np.asarray(decision["path"], np.float64) for decision in decisions)])
    return points[np.isfinite(points).all(axis=1)]


def _place(decision: Mapping[str, Any], when: str) -> tuple[float, float, float]:
    return decision[f"{when}_x"], decision[f"{when}_y"], decision[f"{when}_z"]


def _mark(frame: MapFrame, position: Sequence[float], yaw: float) -> Mark:
    ((x, y),) = to_pixels(frame.world_to_pixel, [position])
    return Mark(float(x), float(y), float(-np.rad2deg(yaw)))
