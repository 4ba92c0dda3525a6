# SPDX-License-Identifier: Apache-2.0
"""Where to go for a better look at a boxed thing: towards it, or aside, out from behind what hides it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.perception.boxes import Mask, box_width, find_box
from wiw.types import Observation

TURN = ActionSpace().turn_rad
NEARER = 0.15
"""Metres that a neighbouring pixel must be nearer than the target to count as something before it."""
CUT = 0.25
"""Part of the target's height along which something must stand before it, for it to count as hidden on that side."""
ENOUGH = np.radians(40.0)
"""A target that is larger than this is looked at from other sides instead of from nearer."""
ASIDE = 2 * TURN
"""How far beside the target a detour heads."""
BODY = (0.15, 1.0)
"""Heights above the floor, in metres, between which things are in the way; the camera is at 1 m."""
CAMERA = 1.0
CLEAR = 0.45
"""Metres that a heading must be free for."""


@dataclass(frozen=True)
class Sight:
    """What the real observation tells of where the target is. Angles in radians, left positive."""

    bearing: float
    distance: float
    """Metres, median over what is seen of it."""
    size: float
    """The larger of width and height."""
    hidden_left: float
    """Part of its rows that end at something nearer on the left, 0 to 1."""
    hidden_right: float

    @property
    def side(self) -> int:
        """1 if more is to be seen from further left, -1 from further right, 0 if neither is known.

        What stands before its left part moves on to the left as one steps to the right.
        """
        if max(self.hidden_left, self.hidden_right) < CUT:
            return 0
        return -1 if self.hidden_left > self.hidden_right else 1


def sight(mask: Mask, depth: NDArray[np.float32]) -> Sight | None:
    """What a target's mask [H, W] and the depth there tell; None where nothing of it is seen."""
    box = find_box(mask, wraps=True)
    if box is None:
        return None
    rows, columns = mask.shape
    wide = box_width(box, columns)
    left, right = _cuts(mask, depth)
    return Sight(
        bearing=_wrapped(np.pi - 2 * np.pi * (box[0] + wide / 2) / columns),
        distance=float(np.median(depth[mask])),
        size=max(2 * np.pi * wide / columns, np.pi * (box[3] - box[1]) / rows),
        hidden_left=left,
        hidden_right=right,
    )


def _cuts(mask: Mask, depth: NDArray[np.float32]) -> tuple[float, float]:
    """Parts of the mask's rows of which the first or the last pixel has something nearer beside it."""
    filled = int(mask.any(axis=1).sum())
    parts = []
    for step in (1, -1):  # the pixel on the left, on the right
        beside, outside = np.roll(depth, step, axis=1), ~np.roll(mask, step, axis=1)
        nearer = (beside > 0) & (beside < depth - NEARER)
        parts.append(float((mask & outside & nearer).any(axis=1).sum() / filled))
    return parts[0], parts[1]


def clearance(depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Metres free of obstacles in 16 headings, turn by turn to the left: float64 [16], 0 straight ahead."""
    rows, columns = depth.shape
    pitch = np.pi / 2 - np.pi * (np.arange(rows) + 0.5) / rows
    height = CAMERA + depth * np.sin(pitch)[:, None]
    blocked = (depth > 0) & (height > BODY[0]) & (height < BODY[1] + 0.3)
    away = np.where(blocked, depth * np.cos(pitch)[:, None], np.inf).min(axis=0)
    count = round(2 * np.pi / TURN)
    width = columns // count
    starts = [columns // 2 - turn * width - width for turn in range(count)]
    return np.array([away[np.arange(start, start + 2 * width) % columns].min() for start in starts])


def headings(seen: Sight | None, bearing: float, side: int) -> list[float]:
    """Directions in which a better look may be had, the best first.

    Args:
        seen: what is seen now; None where the target is out of sight.
        bearing: where it is, or should be.
        side: on which side it was passed before, 0 if on none yet.
    """
    chosen = (seen.side if seen is not None else 0) or side or 1
    towards, aside, across = bearing, bearing + chosen * ASIDE, bearing - chosen * ASIDE
    if seen is not None and (seen.side or seen.size > ENOUGH):
        return [aside, towards, across]
    return [towards, aside, across]


def plan(heading: float, free: NDArray[np.float64], horizon: int) -> NDArray[np.int8]:
    """Turns to the clear heading that is nearest to the wanted one, then steps as far as it is free: int8 [horizon].

    Where no step is free it turns on the spot, on towards the wanted heading.
    """
    wanted = round(_wrapped(heading) / TURN)
    count = len(free)
    turns = min(range(-count // 2, count // 2 + 1), key=lambda turn: (_cost(turn, wanted, free), abs(turn), -turn))
    steps = max(0, horizon - abs(turns))
    room = max(0.0, (free[turns % count] - CLEAR / 2) / ActionSpace().forward_m)  # infinite where nothing is in the way
    way = TURN_LEFT if turns > 0 or (turns == 0 and wanted >= 0) else TURN_RIGHT
    made = [way] * min(abs(turns), horizon) + [FORWARD] * int(min(steps, room))
    return np.array(made or [way], np.int8)


def _cost(turn: int, wanted: int, free: NDArray[np.float64]) -> float:
    """Turns off the wanted heading; headings that are not clear come last."""
    return abs(turn - wanted) + (100.0 if free[turn % len(free)] < CLEAR else 0.0)


def place_of(observation: Observation, seen: Sight) -> NDArray[np.float64]:
    """Where the target is, [x, y] in the frame of the start, metres."""
    x, y, azimuth = observation.odometry
    angle = azimuth + seen.bearing
    return np.array([x + seen.distance * np.cos(angle), y + seen.distance * np.sin(angle)])


def bearing_to(observation: Observation, place: NDArray[np.float64]) -> float:
    """Direction of a place in the frame of the start, as seen from the agent."""
    x, y, azimuth = observation.odometry
    return _wrapped(float(np.arctan2(place[1] - y, place[0] - x) - azimuth))


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)
