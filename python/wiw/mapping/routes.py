# SPDX-License-Identifier: Apache-2.0
"""Routes over known floor, as primitives: to a place, or along a heading.

The shortest way to the goal is measured over the cells where the agent fits; the primitives are then found by A* over
poses that primitives lead to, with that distance for a guide, so that each step of the walk is on floor that is known
to be free.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import floor
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.errors import ArgumentError
from wiw.mapping.occupancy import CELL, OccupancyGrid

_FAR = float("inf")
STEP = ActionSpace().forward_m
TURN = ActionSpace().turn_rad
HEADINGS = round(2 * np.pi / TURN)
RADIUS = 0.25
"""Metres from its target within which a route ends."""
TURN_COST = 0.05
"""Metres that a turn is worth: enough to prefer straight paths, too little for a detour."""
START_RADIUS = 0.35
"""Metres around the agent in which it may pass closer to obstacles than it fits: it stands there."""
TOP_RADIUS = 1.0
"""Metres around the agent in which it may step off what it stands on, such as a coffee table."""
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (2, -1), (1, -2))
"""Steps between cells whose lengths make up distances: sixteen directions, counted both ways."""
WEIGHT = 1.15
"""Factor of the guide: what is still to go counts a little more, so that far fewer poses are looked at."""
POSES = 20_000
"""Poses looked at before a search is given up."""
SIGHT_MARGIN = 0.35
"""Metres before a target in which what blocks the view is the target itself."""


@dataclass(frozen=True)
class Route:
    """A walk by primitives."""

    actions: NDArray[np.int8]
    """int8 [K] ids of `wiw.action`."""
    poses: NDArray[np.float64]
    """float64 [K + 1, 3]: x, y, azimuth before the first and after each action, in the frame of the start."""
    reached: bool
    """Whether the whole of it ends within the radius of its target, or at the heading."""

    @property
    def length(self) -> float:
        """Metres walked."""
        return float((self.actions == int(FORWARD)).sum() * STEP)

    def take(self, first: int) -> Route:
        """Return the first primitives, at most `first` of them."""
        whole = first >= len(self.actions)
        return self if whole else Route(self.actions[:first], self.poses[: first + 1], False)


def route(
    grid: OccupancyGrid,
    pose: NDArray[np.float64],
    target: NDArray[np.float64] | float,
    radius: float = RADIUS,
    first: int | None = None,
) -> Route:
    """Return the route to a target.

    Where the target cannot be reached over known floor, the route ends where it is nearest, and `reached` is False.

    Args:
        grid: what is known of the floor.
        pose: x, y, azimuth of the agent.
        target: a point float [2] or [3], or a heading in radians, to turn to.
        radius: the route ends within so many metres of the point, where it is in sight if there is such a place.
        first: return at most so many primitives.

    Raises:
        ArgumentError: a target that is neither.
    """
    goal = np.asarray(target, np.float64)
    if goal.shape not in ((), (2,), (3,)) or not np.isfinite(goal).all():
        raise ArgumentError(f"route: expected a finite point [2] or [3], or a heading, got {target!r}")
    if goal.ndim == 0:
        found = follow_heading(grid, pose, float(goal), 0.0)
    else:
        found = _route_to_point(grid, np.asarray(pose, np.float64), goal[:2], radius)
    return found if first is None else found.take(first)


def follow_heading(grid: OccupancyGrid, pose: NDArray[np.float64], azimuth: float, metres: float) -> Route:
    """Return the turns to the heading nearest to an azimuth, and steps ahead, up to `metres`, as far as it is free."""
    turns = round(_wrap(azimuth - float(pose[2])) / TURN)
    actions = [TURN_LEFT if turns > 0 else TURN_RIGHT] * abs(turns)
    heading = float(pose[2]) + turns * TURN
    count = int(metres / STEP + 1e-9)
    ahead = np.arange(1, 2 * count + 1)[:, None] * (STEP / 2) * [[np.cos(heading), np.sin(heading)]]
    open_ = _open_cells(grid, np.asarray(pose, np.float64))
    free = grid.lookup(open_, np.asarray(pose[:2]) + ahead).reshape(-1, 2).all(axis=1)
    clear = count if free.all() else int(free.argmin())
    return _simulate(pose, [*actions, *[FORWARD] * clear], clear == count)


def measure_distances(grid: OccupancyGrid, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the metres from the agent to each cell, over known floor where it fits: inf where it cannot go."""
    open_ = _open_cells(grid, np.asarray(pose, np.float64))
    here = np.zeros_like(open_)
    here[_find_cell(grid, np.asarray(pose))] = True
    return _distance_field(open_, here)


def _route_to_point(grid: OccupancyGrid, pose: NDArray[np.float64], point: NDArray[np.float64], radius: float) -> Route:
    if np.linalg.norm(pose[:2] - point) <= radius:
        return _simulate(pose, [], True)
    nearest = _simulate(pose, [], False)
    for squeeze in (False, True):  # between things only where there is no other way
        found = _find_route(grid, pose, point, radius, _open_cells(grid, pose, squeeze))
        if found.reached:
            return found
        if _measure_rest(found, point) < _measure_rest(nearest, point) - CELL:
            nearest = found
    return nearest


def _measure_rest(found: Route, point: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(found.poses[-1, :2] - point))


def _find_route(
    grid: OccupancyGrid,
    pose: NDArray[np.float64],
    point: NDArray[np.float64],
    radius: float,
    open_: NDArray[np.bool_],
) -> Route:
    """Return the route over the open cells, to the radius or as near as they lead."""
    _, parts = cv2.connectedComponents(open_.view(np.uint8), connectivity=8)
    cells = np.argwhere(parts == parts[_find_cell(grid, pose)])
    places = grid.to_points(cells)
    away = np.linalg.norm(places - point, axis=1)
    within = away <= radius
    chosen = np.flatnonzero(within if within.any() else away <= away.min() + CELL / 2)
    visible = _is_in_sight(grid, places[chosen], point)
    goals = np.zeros_like(open_)
    goals[tuple(cells[chosen[visible] if visible.any() else chosen].T)] = True
    actions = _search(grid, pose, goals, _distance_field(open_, goals), point, radius if within.any() else np.inf)
    found = _simulate(pose, actions, True)
    return found if _measure_rest(found, point) <= radius else replace(found, reached=False)


def _search(
    grid: OccupancyGrid,
    pose: NDArray[np.float64],
    goals: NDArray[np.bool_],
    field: NDArray[np.float64],
    point: NDArray[np.float64],
    radius: float,
) -> list[int]:
    """Find the cheapest primitives to a goal's cell among poses that primitives lead to; one pose per cell and heading.

    Positions are kept as they are, not rounded to their cells, so that the walk is the one the agent takes.
    """
    width = field.shape[1]
    ahead = field.ravel().tolist()  # plain lists are several times faster to look up one by one
    goal = goals.ravel().tolist()
    origin_x, origin_y = grid.origin
    angles = pose[2] + TURN * np.arange(HEADINGS)
    moves = [(STEP * float(np.cos(a)), STEP * float(np.sin(a))) for a in angles]
    x, y = float(pose[0]), float(pose[1])

    def cell(x: float, y: float) -> int:
        return (floor(x / CELL) - origin_x) * width + floor(y / CELL) - origin_y

    first = cell(x, y)
    best = {(first, 0): 0.0}
    came: dict[tuple[int, int], tuple[tuple[int, int], int] | None] = {(first, 0): None}
    queue: list[tuple[float, int, float, float, float, int]] = [(_guide(ahead, first), 0, 0.0, x, y, 0)]
    closed: set[tuple[int, int]] = set()
    count, nearest = 0, ((first, 0), _guide(ahead, first))
    while queue and len(closed) < POSES:
        _, _, cost, x, y, heading = heapq.heappop(queue)
        node = cell(x, y), heading
        if node in closed:
            continue
        closed.add(node)
        if goal[node[0]] and np.hypot(x - point[0], y - point[1]) <= radius:
            return _trace(came, node)
        if ahead[node[0]] < nearest[1]:
            nearest = node, ahead[node[0]]
        dx, dy = moves[heading]
        half, end = cell(x + dx / 2, y + dy / 2), cell(x + dx, y + dy)
        options = [
            (TURN_LEFT, (heading + 1) % HEADINGS, x, y, TURN_COST),
            (TURN_RIGHT, (heading - 1) % HEADINGS, x, y, TURN_COST),
        ]
        if ahead[half] < _FAR and ahead[end] < _FAR:
            options.append((FORWARD, heading, x + dx, y + dy, STEP))
        for action, turned, to_x, to_y, price in options:
            after = (end if action == FORWARD else node[0]), turned
            total = cost + price
            if after not in closed and total < best.get(after, _FAR) - 1e-9:
                best[after], came[after] = total, (node, int(action))
                count += 1
                heapq.heappush(queue, (total + _guide(ahead, after[0]), count, total, to_x, to_y, turned))
    return _trace(came, nearest[0])


def _guide(ahead: list[float], cell: int) -> float:
    """Return the metres still to go; where the agent begins off the known floor, none are known."""
    return WEIGHT * ahead[cell] if ahead[cell] < _FAR else 0.0


def _trace(came: dict[tuple[int, int], tuple[tuple[int, int], int] | None], node: tuple[int, int]) -> list[int]:
    actions: list[int] = []
    step = came[node]
    while step is not None:
        node, action = step
        actions.append(action)
        step = came[node]
    return actions[::-1]


def _simulate(pose: NDArray[np.float64], actions: list[Any], reached: bool) -> Route:
    """Return the route that primitives make from a pose."""
    ids = np.array([int(action) for action in actions], np.int8)
    turns = np.cumsum((ids == int(TURN_LEFT)).astype(int) - (ids == int(TURN_RIGHT)))
    heading = float(pose[2]) + TURN * turns
    ahead = STEP * (ids == int(FORWARD))
    poses = np.empty((len(ids) + 1, 3))
    poses[0] = pose
    poses[1:, 0] = pose[0] + np.cumsum(ahead * np.cos(heading))
    poses[1:, 1] = pose[1] + np.cumsum(ahead * np.sin(heading))
    poses[1:, 2] = (heading + np.pi) % (2 * np.pi) - np.pi
    return Route(ids, poses, reached)


def find_refused(
    pose: NDArray[np.float64], actions: Sequence[int] | NDArray[np.int8], end: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the pose at which a step forward was first refused on a walk, None if none was.

    Args:
        pose: x, y, azimuth before the walk.
        actions: primitives of the walk, the refused ones included.
        end: x, y, azimuth after the walk.
    """
    found = _simulate(pose, list(actions), True)
    if np.hypot(*(found.poses[-1] - end)[:2]) < STEP / 4:
        return None
    ids = np.asarray(actions)
    ahead = np.flatnonzero(ids == int(FORWARD))
    misses = []
    for first in ahead:
        # What refuses a step refuses those after it, until the agent turns; then all go well, or none.
        turn = first + np.argmax(np.append(ids[first:] != int(FORWARD), True))
        rest = ids[turn:]
        ends = [_simulate(pose, [*ids[:first], *later], True).poses[-1] for later in (rest, rest[rest != int(FORWARD)])]
        misses.append(min(float(np.hypot(*(each - end)[:2])) for each in ends))
    return found.poses[ahead[int(np.argmin(misses))]] if misses else None


def _open_cells(grid: OccupancyGrid, pose: NDArray[np.float64], squeeze: bool = False) -> NDArray[np.bool_]:
    """Return the cells where the agent fits, and those close around it that it may leave its place over.

    With `squeeze` those are all that are free, else only those with no obstacle right beside them.
    """
    ((row,), (column,)) = grid.to_cells(pose[None, :2])
    window = _cut_window(row, column, START_RADIUS)
    size = (1, 1) if squeeze else (3, 3)
    near = cv2.dilate(grid.occupied.view(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, size))
    open_ = grid.standable.copy()
    open_[window] |= grid.free[window] & (near[window] == 0)
    open_[row, column] = True
    if grid.occupied[row, column]:
        open_ |= _find_way_off(grid, row, column)
    return open_


def _find_way_off(grid: OccupancyGrid, row: int, column: int) -> NDArray[np.bool_]:
    """Return the cells over which an agent leaves what it stands on: the thing close around a cell, and its rim."""
    window = _cut_window(row, column, TOP_RADIUS)
    _, parts = cv2.connectedComponents((grid.occupied & ~grid.wall_cells)[window].view(np.uint8), connectivity=8)
    own = parts == parts[row - window[0].start, column - window[1].start]
    found = np.zeros_like(grid.occupied)
    found[window] = cv2.dilate(own.view(np.uint8), np.ones((5, 5), np.uint8)).view(bool)
    return np.asarray(found & grid.known & ~grid.wall_cells)


def _cut_window(row: int, column: int, radius: float) -> tuple[slice, slice]:
    """Return the rows and columns within so many metres of a cell."""
    reach = int(radius / CELL)
    return slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)


def _find_cell(grid: OccupancyGrid, pose: NDArray[np.float64]) -> tuple[int, int]:
    ((row,), (column,)) = grid.to_cells(pose[None, :2])
    return int(row), int(column)


def _is_in_sight(grid: OccupancyGrid, places: NDArray[np.float64], point: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return from which places nothing occupied is before the point."""
    steps = np.linspace(0.0, 1.0, 33)
    away = np.linalg.norm(places - point, axis=1)
    line = places[:, None] + steps[None, :, None] * (point - places)[:, None]
    blocked = grid.lookup(grid.occupied, line.reshape(-1, 2)).reshape(len(places), -1)
    return ~(blocked & (away[:, None] * (1 - steps) > SIGHT_MARGIN)).any(axis=1)


def _distance_field(open_: NDArray[np.bool_], goals: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the metres from each open cell to the nearest goal; inf if there is no path."""
    rows, columns = np.flatnonzero(open_.any(axis=1)), np.flatnonzero(open_.any(axis=0))
    box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
    inner = open_[box]
    index = np.full(inner.shape, -1, np.int32)
    index[inner] = np.arange(int(inner.sum()))
    heads, tails, lengths = [], [], []
    for dr, dc in NEIGHBOURS:
        a, b = _shift_slices(inner.shape, dr, dc)
        both = inner[a] & inner[b]
        for r, c in _between(dr, dc):  # a knight's move passes two more cells
            both &= inner[_offset(inner.shape, a, r, c)]
        heads.append(index[a][both])
        tails.append(index[b][both])
        lengths.append(np.full(len(heads[-1]), CELL * float(np.hypot(dr, dc))))
    nodes = int(inner.sum())
    edges = np.concatenate(heads), np.concatenate(tails)
    graph = sparse.csr_array((np.concatenate(lengths), edges), shape=(nodes, nodes))
    found = csgraph.dijkstra(graph, directed=False, indices=index[goals[box]], min_only=True)
    field = np.full(open_.shape, np.inf)
    field[box][inner] = found
    return field


def _shift_slices(shape: tuple[int, ...], dr: int, dc: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the slices of an array's cells that have a neighbour (dr, dc) away, and of those neighbours."""
    height, width = shape
    first = slice(0, height - dr), slice(max(0, -dc), width - max(0, dc))
    second = slice(dr, height), slice(max(0, dc), width - max(0, -dc))
    return first, second


def _between(dr: int, dc: int) -> list[tuple[int, int]]:
    """Return the cells that a knight's move passes over."""
    if abs(dr) + abs(dc) < 3:
        return []
    return [(dr // 2, int(np.sign(dc))), (1, 0)] if dr == 2 else [(0, int(np.sign(dc))), (1, int(np.sign(dc)))]


def _offset(shape: tuple[int, ...], base: tuple[slice, slice], dr: int, dc: int) -> tuple[slice, slice]:
    rows, columns = base
    return slice(rows.start + dr, rows.stop + dr), slice(columns.start + dc, columns.stop + dc)


def _wrap(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi
