# SPDX-License-Identifier: Apache-2.0
"""From commands to primitives: a route to a landmark over floor that depth has shown, or a turn and a walk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.mapping.landmarks import Landmark
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.routes import TURN, route
from wiw.mapping.views import VIEW_YAWS_DEG

HALF_TURN = round(np.pi / TURN)
"""Primitives of the longest turn, which counts as one action."""
LOOK = 3
"""Primitives of a plan that only takes a second look after an answer."""
LOOK_AROUND = 4
"""Left turns where a command leads nowhere: a quarter turn."""


def find_route(grid: OccupancyGrid, pose: NDArray[np.float64], landmark: Landmark) -> NDArray[np.int8]:
    """Return the route to a landmark, or the way towards it where the agent is there."""
    found = route(grid, pose, landmark.destination, landmark.radius).actions
    return found if len(found) else route(grid, pose, measure_bearing(pose, landmark)).actions


def measure_bearing(pose: NDArray[np.float64], landmark: Landmark) -> float:
    """Return the azimuth at which a landmark lies."""
    away = landmark.position[:2] - pose[:2]
    return float(np.arctan2(away[1], away[0]))


def walk_in_view(view: int, walk: NDArray[np.int8], horizon: int) -> NDArray[np.int8]:
    """Return the turn to a view and a walk from there."""
    return cut_plan(np.concatenate([turn_to_view(view), walk]), horizon)


def turn_to_view(view: int) -> NDArray[np.int8]:
    """Return the turn to a view, the left one where both are as long."""
    return _turn_by(float(np.radians(VIEW_YAWS_DEG[view])))


def turn_to_landmark(pose: NDArray[np.float64], landmark: Landmark) -> NDArray[np.int8]:
    """Return the shorter turn towards a landmark, to the nearest heading that turns lead to."""
    angle = measure_bearing(pose, landmark) - pose[2]
    return _turn_by(float(np.arctan2(np.sin(angle), np.cos(angle))))


def go_straight(turn: NDArray[np.int8], horizon: int) -> NDArray[np.int8]:
    """Return a turn, and then as many steps forward as a plan of L actions has after its turn."""
    steps = np.full(max(1, horizon - HALF_TURN), FORWARD, np.int8)
    return np.concatenate([turn, steps])[:horizon]


def _turn_by(angle: float) -> NDArray[np.int8]:
    turns = round(angle / TURN)
    return np.full(abs(turns), TURN_LEFT if turns > 0 else TURN_RIGHT, np.int8)


def cut_plan(actions: NDArray[np.int8], horizon: int) -> NDArray[np.int8]:
    """Return the plan cut to L actions, of which the turn that it begins with is one; a look around where it is empty.

    `horizon` is L with the longest turn counted out, as the task gives it: L - 1 + 8 primitives.
    """
    if not len(actions):
        return np.full(min(LOOK_AROUND, horizon), TURN_LEFT, np.int8)
    turns = count_leading_turns(actions)
    most = max(1, horizon - HALF_TURN) + max(1, turns)
    return actions[: min(most, horizon)].astype(np.int8)


def count_leading_turns(actions: NDArray[np.int8]) -> int:
    """Return how many primitives at the beginning turn the same way."""
    if actions[0] == int(FORWARD):
        return 0
    other = np.flatnonzero(actions != actions[0])
    return int(other[0]) if len(other) else len(actions)
