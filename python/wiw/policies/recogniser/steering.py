# SPDX-License-Identifier: Apache-2.0
"""Directions to a better view of a boxed object: towards it, or sideways around an occluder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.perception.boxes import Mask, box_width, find_box
from wiw.perception.glimpses import CAMERA_HEIGHT
from wiw.types import Observation

TURN = ActionSpace().turn_rad
OCCLUDER_GAP = 0.15
"""Metres that a neighbouring pixel must be closer than the target to count as something in front of it."""
OCCLUDED_SHARE = 0.25
"""Share of the target's rows that something must cut off for it to count as hidden on that side."""
LARGE_TARGET = np.radians(40.0)
"""A target that appears larger than this is viewed from other sides instead of from closer."""
DETOUR_ANGLE = 2 * TURN
"""Angle between a detour and the direction of the target."""
OBSTACLE_HEIGHTS = (0.15, 1.0)
"""Heights above the floor, in metres, between which surfaces are obstacles; the camera is at 1 m."""
MIN_CLEARANCE = 0.45
"""Metres that a heading must be free."""


@dataclass(frozen=True)
class TargetSighting:
    """The target's position in the real observation. Angles in radians, left positive."""

    bearing: float
    distance: float
    """Median distance of the visible part, in metres."""
    size: float
    """The larger of width and height."""
    hidden_left: float
    """Share of its rows that end at something closer on the left, 0 to 1."""
    hidden_right: float

    @property
    def side(self) -> int:
        """1 if more will be visible from further left, -1 from further right, 0 if neither is known.

        An occluder of the left part moves further left as the agent steps to the right.
        """
        if max(self.hidden_left, self.hidden_right) < OCCLUDED_SHARE:
            return 0
        return -1 if self.hidden_left > self.hidden_right else 1


def locate_in_view(mask: Mask, depth: NDArray[np.float32]) -> TargetSighting | None:
    """Estimate the target's position from its mask [H, W] and the depth; None if it is out of sight."""
    box = find_box(mask, wraps=True)
    if box is None:
        return None
    rows, columns = mask.shape
    wide = box_width(box, columns)
    left, right = _measure_occlusion(mask, depth)
    return TargetSighting(
        bearing=_wrap_angle(np.pi - 2 * np.pi * (box[0] + wide / 2) / columns),
        distance=float(np.median(depth[mask])),
        size=max(2 * np.pi * wide / columns, np.pi * (box[3] - box[1]) / rows),
        hidden_left=left,
        hidden_right=right,
    )


def _measure_occlusion(mask: Mask, depth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the shares of the mask's rows whose first, or last, pixel has something closer beside it."""
    filled = int(mask.any(axis=1).sum())
    parts = []
    for step in (1, -1):  # the pixel on the left, on the right
        beside, outside = np.roll(depth, step, axis=1), ~np.roll(mask, step, axis=1)
        nearer = (beside > 0) & (beside < depth - OCCLUDER_GAP)
        parts.append(float((mask & outside & nearer).any(axis=1).sum() / filled))
    return parts[0], parts[1]


def measure_clearance(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the free metres in 16 headings, turn by turn to the left: float64 [16], straight ahead first."""
    rows, columns = depth.shape
    pitch = np.pi / 2 - np.pi * (np.arange(rows) + 0.5) / rows
    height = CAMERA_HEIGHT + depth * np.sin(pitch)[:, None]
    blocked = (depth > 0) & (height > OBSTACLE_HEIGHTS[0]) & (height < OBSTACLE_HEIGHTS[1] + 0.3)
    away = np.where(blocked, depth * np.cos(pitch)[:, None], np.inf).min(axis=0)
    count = round(2 * np.pi / TURN)
    width = columns // count
    starts = [columns // 2 - turn * width - width for turn in range(count)]
    return np.array([away[np.arange(start, start + 2 * width) % columns].min() for start in starts])


def rank_headings(seen: TargetSighting | None, bearing: float, side: int) -> list[float]:
    """Return directions in which a better view is likely, the best first.

    Args:
        seen: the present sighting; None if the target is out of sight.
        bearing: the target's direction, or its last known one.
        side: the side on which it was passed before, 0 if on none yet.
    """
    chosen = (seen.side if seen is not None else 0) or side or 1
    towards, aside, across = bearing, bearing + chosen * DETOUR_ANGLE, bearing - chosen * DETOUR_ANGLE
    if seen is not None and (seen.side or seen.size > LARGE_TARGET):
        return [aside, towards, across]
    return [towards, aside, across]


def plan_towards(heading: float, free: NDArray[np.float64], horizon: int) -> NDArray[np.int8]:
    """Plan turns to the clear heading nearest to the wanted one, then steps as far as it is free: int8 [horizon].

    Where no step is free it turns on the spot towards the wanted heading.
    """
    wanted = round(_wrap_angle(heading) / TURN)
    count = len(free)
    turns = min(
        range(-count // 2, count // 2 + 1), key=lambda turn: (_compute_cost(turn, wanted, free), abs(turn), -turn)
    )
    steps = max(0, horizon - abs(turns))
    room = max(
        0.0, (free[turns % count] - MIN_CLEARANCE / 2) / ActionSpace().forward_m
    )  # infinite where nothing is in the way
    way = TURN_LEFT if turns > 0 or (turns == 0 and wanted >= 0) else TURN_RIGHT
    made = [way] * min(abs(turns), horizon) + [FORWARD] * int(min(steps, room))
    return np.array(made or [way], np.int8)


def _compute_cost(turn: int, wanted: int, free: NDArray[np.float64]) -> float:
    """Return the number of turns off the wanted heading; headings that are not clear come last."""
    off = abs(turn - wanted) % len(free)
    return min(off, len(free) - off) + (100.0 if free[turn % len(free)] < MIN_CLEARANCE else 0.0)


def compute_target_place(observation: Observation, seen: TargetSighting) -> NDArray[np.float64]:
    """Return the target's position [x, y] in the start frame, in metres."""
    x, y, azimuth = observation.odometry
    angle = azimuth + seen.bearing
    return np.array([x + seen.distance * np.cos(angle), y + seen.distance * np.sin(angle)])


def compute_bearing(observation: Observation, place: NDArray[np.float64]) -> float:
    """Return the direction of a place of the start frame, as seen from the agent."""
    x, y, azimuth = observation.odometry
    return _wrap_angle(float(np.arctan2(place[1] - y, place[0] - x) - azimuth))


def _wrap_angle(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
