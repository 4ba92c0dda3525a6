# SPDX-License-Identifier: Apache-2.0
"""Floor that a place does not see, and the ways on to it: where a look round a corner decides which way to go.

The floor around a place is cut into cells of 0.1 m that an agent can stand on. A cell is in view if the camera of an
agent that stands there is, along a level ray of a depth panorama. The floor that is not in view falls into parts that
touch each other only by way of floor in view. Each part that begins at floor in view and is large enough is a way on.
Nothing here depends on a policy or a model.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from wiw.datasets.cameras import camera_pose, is_in_view
from wiw.datasets.worlds import World

CELL = 0.1
"""Metres."""
PANORAMA = (256, 512)
MARGIN = 0.05
"""Metres by which a cell may lie behind what the ray of its direction hits."""
LEAST_AREA = 2.0
"""Square metres of unseen floor that make a way on; shadows of furniture are smaller."""
APART = 1.5
"""Metres to walk between the beginnings of two ways on, at least, for them to be different ways."""
AROUND = 1.0
"""Metres to walk from the goal within which nothing is in view."""
PAST = 1.0
"""Metres after the shortest path has left the view by which the goal has come into view: five steps of 0.2 m."""
_NEIGHBOURS = np.ones((3, 3), np.int8)

SEEN_AROUND, NO_FORK, TWO_CORNERS = (
    f"the floor within {AROUND:g} m of the goal out of view",
    f"another way on, {APART:g} m apart",
    f"the goal in view {PAST:g} m round the first corner",
)
"""Rules of the tier `beyond`, in the order in which they are checked."""


@dataclass(frozen=True, eq=False)
class FloorView:
    """The floor around a place, in cells: rows along z, columns along x."""

    origin: NDArray[np.float64]
    """float64 [3]: the middle of the first cell, at the height of the place."""
    free: NDArray[np.bool_]
    """bool [rows, columns]: an agent can stand there, and walk there from the place."""
    seen: NDArray[np.bool_]
    """bool [rows, columns]: free, and in view of the place."""

    def locate(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return row and column of places [N, 3], those outside clipped to the rim: intp [N, 2]."""
        cells = np.rint((points - self.origin)[:, [2, 0]] / CELL).astype(np.intp)
        return np.clip(cells, 0, np.array(self.free.shape) - 1)

    def list_points(self, cells: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the middles of the cells of a mask in metres: float64 [N, 3]."""
        rows, columns = np.nonzero(cells)
        return self.origin + np.stack([columns * CELL, np.zeros(len(rows)), rows * CELL], axis=1)


@dataclass(frozen=True, eq=False)
class WayOn:
    """A part of the floor that is not in view, and where it begins."""

    cells: NDArray[np.bool_]
    """bool [rows, columns]."""
    beginning: NDArray[np.float64]
    """float64 [3]: its cell beside floor in view that is the shortest walk away."""

    @property
    def area(self) -> float:
        """Square metres."""
        return float(self.cells.sum()) * CELL**2


def survey_view(world: World, place: NDArray[np.float64]) -> FloorView:
    """Return which of the floor around a place on it can be walked to, and which is in view of an agent's camera."""
    low, high = np.asarray(world.scene.bounds, np.float64)
    shape = tuple(np.ceil((high - low)[[2, 0]] / CELL).astype(int))
    origin = np.array([low[0] + CELL / 2, place[1], low[2] + CELL / 2])
    everywhere = FloorView(origin, np.ones(shape, bool), np.zeros(shape, bool))
    points = everywhere.list_points(everywhere.free)
    own = world.navmesh.island_of(place[None])
    free = np.asarray(world.navmesh.is_navigable(points)) & (np.asarray(world.navmesh.island_of(points)) == own)
    seen = free.copy()
    seen[free] = _are_in_view(world, place, points[free])
    return FloorView(origin, free.reshape(shape), seen.reshape(shape))


def _are_in_view(world: World, place: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the cameras of agents at places of the same height are in view of the camera here: bool [N]."""
    depth = world.renderer.panorama(camera_pose(place, 0.0)[None], PANORAMA, outputs=("depth",))["depth"][0]
    rows, columns = PANORAMA
    level = np.where(depth == 0, np.inf, depth)[rows // 2 - 1 : rows // 2 + 1].max(axis=0)
    level = np.max([np.roll(level, shift) for shift in (-1, 0, 1)], axis=0)
    away = points - place
    column = ((0.5 + np.arctan2(away[:, 0], -away[:, 2]) / (2 * np.pi)) * columns).astype(np.intp) % columns
    return np.asarray(level[column] > np.hypot(away[:, 0], away[:, 2]) - MARGIN)


def find_ways_on(world: World, place: NDArray[np.float64], view: FloorView) -> list[WayOn]:
    """Return the ways on from a place, by the area of what lies there, the largest first."""
    parts, count = ndimage.label(view.free & ~view.seen, _NEIGHBOURS)
    rim = ndimage.binary_dilation(_find_own_part(view, place), _NEIGHBOURS)
    found = []
    for cells in (parts == number for number in range(1, count + 1)):
        beginnings = view.list_points(cells & rim)
        if len(beginnings) and cells.sum() * CELL**2 >= LEAST_AREA:
            walks = np.asarray(world.navmesh.geodesic_distance(beginnings, place))
            found.append(WayOn(cells, beginnings[int(walks.argmin())]))
    return sorted(found, key=lambda way: -way.area)


def _find_own_part(view: FloorView, place: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the floor in view that a place is joined to by floor in view."""
    parts, _ = ndimage.label(view.seen, _NEIGHBOURS)
    return np.asarray(parts == parts[_find_nearest(view, view.seen, place)])


def _find_nearest(view: FloorView, cells: NDArray[np.bool_], place: NDArray[np.float64]) -> tuple[int, int]:
    """Return row and column of the cell of a mask that is nearest to a place."""
    there = np.argwhere(cells)
    row, column = there[np.linalg.norm(there - view.locate(place[None]), axis=1).argmin()]
    return int(row), int(column)


def find_broken_rule(world: World, start: NDArray[np.float64], goal: NDArray[np.float64]) -> str | None:
    """Return the first rule of the tier `beyond` that a start and a goal break; None if they break none.

    The goal itself is taken to be out of sight already.
    """
    view = survey_view(world, start)
    if _sees_goal_area(world, view, goal):
        return SEEN_AROUND
    ways = find_ways_on(world, start, view)
    at = _find_nearest(view, view.free, goal)
    own = [way for way in ways if way.cells[at]]
    if not own or not any(_are_apart(world, own[0], way) for way in ways if way is not own[0]):
        return NO_FORK
    return None if is_in_view(world, _turn_corner(world, view, start, goal), goal) else TWO_CORNERS


def _sees_goal_area(world: World, view: FloorView, goal: NDArray[np.float64]) -> bool:
    """Return whether any floor that is a short walk from the goal is in view, or the goal is not on this floor."""
    points = view.list_points(view.free)
    close = np.linalg.norm(points[:, [0, 2]] - goal[[0, 2]], axis=1) <= AROUND
    near = close.copy()
    near[close] = np.asarray(world.navmesh.geodesic_distance(points[close], goal)) <= AROUND
    return not near.any() or bool(view.seen[view.free][near].any())


def _are_apart(world: World, one: WayOn, other: WayOn) -> bool:
    return float(world.navmesh.geodesic_distance(one.beginning, other.beginning)) >= APART


def _turn_corner(
    world: World, view: FloorView, start: NDArray[np.float64], goal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the place on the shortest path that is `PAST` metres beyond where it first leaves the view."""
    path = np.asarray(world.navmesh.shortest_path(start, goal), np.float64)
    ends = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path[:, [0, 2]], axis=0), axis=1))])
    along = np.arange(0.0, ends[-1], CELL / 2)
    points = np.stack([np.interp(along, ends, path[:, axis]) for axis in range(3)], axis=1)
    cells = view.locate(points)
    hidden = view.free[cells[:, 0], cells[:, 1]] & ~view.seen[cells[:, 0], cells[:, 1]]
    last = round(PAST / (CELL / 2)) + int(hidden.argmax())
    return np.asarray(world.ground.put_down(points[min(last, len(points) - 1)]), np.float64)
