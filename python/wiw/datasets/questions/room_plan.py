# SPDX-License-Identifier: Apache-2.0
"""Rooms of a scene that defines none: what walls keep apart, named by the furniture that gives rooms away.

A gap between the ends of two walls in one line, up to a few metres wide, is a doorway. Floor that walls and doorways
close off is one room if it has signs of one room in it, such as a bed. With signs of several, as in an open plan, it is
of the room whose sign is clearly nearest on foot. Other floor, and whatever stands there, is in no room: nobody could
say in which.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from wiw.datasets.cameras import camera_pose
from wiw.datasets.questions.facts import Room, Thing
from wiw.datasets.worlds import World

SIGNS: Mapping[str, str] = {
    "bed": "bedroom",
    "bunk bed": "bedroom",
    "toilet": "bathroom",
    "bathtub": "bathroom",
    "shower": "bathroom",
    "stove": "kitchen",
    "refrigerator": "kitchen",
    "kitchen cabinet": "kitchen",
    "kitchen counter": "kitchen",
    "kitchen sink": "kitchen",
    "sofa": "living room",
    "fitness equipment": "gym",
    "treadmill": "gym",
    "dining table": "dining room",
}
"""Kind of room that a category gives away; a dining table near a kitchen is of the kitchen."""
BARRIERS = frozenset({"wall", "door", "window", "curtain", "door frame"})
"""Categories that close a room."""
BAND = (0.9, 1.8)
"""Metres above the floor between which walls are looked for: above tables, below lintels."""
CELL = 0.1
"""Metres."""
DOORWAY = 3.6
"""Metres of the widest gap in a line of walls that is taken for a doorway; folding doors leave wide ones."""
WALL = 0.5
"""Metres of wall that show which way it runs."""
NEARER = 0.6
"""Walk to the nearest sign of a room, relative to that of any other room, from which on it is clearly the nearest."""
TOGETHER = 5.0
"""Metres to walk within which two signs of one kind are of one room."""
BESIDE = 0.5
"""Metres around a thing in which the floor says what room it is in."""
CLEAR = 0.8
"""Share of this floor that must be of one room."""
PANORAMA = (144, 256)
CAMERA = 1.0
_BATCH = 64


@dataclass(frozen=True, eq=False)
class RoomPlan:
    """The rooms of a floor, in cells of 0.1 m: rows along z, columns along x."""

    origin: NDArray[np.float64]
    """float64 [2]: x and z where the first column and row begin."""
    labels: NDArray[np.int32]
    """int32 [rows, columns]: number of the room, from 1 on; 0 if there is none, or nobody could say which."""
    kinds: tuple[str, ...]
    """Kind of each room, by number - 1."""

    def name_room(self, number: int) -> str:
        """Return e.g. "bedroom 2"."""
        return f"{self.kinds[number - 1]} {number}"

    def find(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the room of each place [N, 3]; 0 where it is in none."""
        cells = np.floor((points[:, [0, 2]] - self.origin) / CELL).astype(np.intp)
        inside = ((cells >= 0) & (cells < self.labels.shape[::-1])).all(axis=1)
        found = np.zeros(len(points), np.int32)
        found[inside] = self.labels[cells[inside, 1], cells[inside, 0]]
        return found

    def find_thing(self, low: NDArray[np.float64], high: NDArray[np.float64], floor: NDArray[np.bool_]) -> int:
        """Return the room of what fills these bounds; 0 if not clearly in one. `floor` has the cells of any floor."""
        first, last = (np.floor((edge[[0, 2]] - self.origin) / CELL).astype(int) for edge in (low, high))
        reach = round(BESIDE / CELL)
        window = tuple(slice(max(0, first[axis] - reach), last[axis] + reach + 1) for axis in (1, 0))
        near = self.labels[window][floor[window]]
        if not len(near):
            return 0
        counts = np.bincount(near)
        best = int(counts.argmax())
        return best if counts[best] >= CLEAR * len(near) else 0


@dataclass(frozen=True, eq=False)
class PlannedRoom(Room):
    """A room of a plan; its bounds are those of its floor."""

    plan: RoomPlan
    number: int

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether places [N, 3] are on its floor."""
        return np.asarray(self.plan.find(points) == self.number)


@dataclass(frozen=True, eq=False)
class Floor:
    """The floor between walls, furnished or not."""

    origin: NDArray[np.float64]
    open: NDArray[np.bool_]
    doorways: NDArray[np.bool_]
    """Cells between the ends of walls."""


def survey_floor(world: World, things: Sequence[Thing], points: NDArray[np.float64]) -> Floor:
    """Return the floor that is seen from some places: all between them and the walls around."""
    barriers = np.array([thing.id for thing in things if thing.category in BARRIERS])
    bounds = np.asarray(world.scene.bounds, np.float64)[:, [0, 2]]
    origin = bounds[0] - 5 * CELL
    width, height = np.ceil((bounds[1] - origin) / CELL).astype(int) + 5
    walls, swept = np.zeros((2, height, width), bool)
    for start in range(0, len(points), _BATCH):
        places = points[start : start + _BATCH]
        poses = np.stack([camera_pose(point, 0.0) for point in places])
        seen = world.renderer.panorama(poses, PANORAMA, outputs=("instance", "depth"))
        for place, ids, depth in zip(places, seen["instance"], seen["depth"], strict=True):
            _add_walls(walls, swept, place[[0, 2]] - origin, np.isin(ids, barriers), depth)
    closed = cv2.morphologyEx(walls.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).astype(bool)
    return Floor(origin, swept & ~closed, _find_doorways(closed))


def _find_doorways(walls: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the gaps between walls in one line, along rows or columns."""
    found = np.zeros(walls.shape, bool)
    layer = np.pad(walls.astype(np.uint8), round(DOORWAY / CELL))
    for axis in (0, 1):
        run, gap = (np.ones(np.roll((1, round(metres / CELL)), axis), np.uint8) for metres in (WALL, DOORWAY))
        along = cv2.morphologyEx(layer, cv2.MORPH_OPEN, run)
        bridged = cv2.morphologyEx(along, cv2.MORPH_CLOSE, gap)
        margin = round(DOORWAY / CELL)
        found |= bridged[margin:-margin, margin:-margin].astype(bool)
    return found & ~walls


def _add_walls(
    walls: NDArray[np.bool_],
    swept: NDArray[np.bool_],
    place: NDArray[np.float64],
    barrier: NDArray[np.bool_],
    depth: NDArray[np.float32],
) -> None:
    """Add the walls that a panorama shows, and the floor before the nearest one of each column."""
    rows, columns = PANORAMA
    pitch = np.pi / 2 - (np.arange(rows) + 0.5) * np.pi / rows
    azimuth = (np.arange(columns) + 0.5) * 2 * np.pi / columns - np.pi
    flat, level = depth * np.cos(pitch)[:, None], CAMERA + depth * np.sin(pitch)[:, None]
    away = np.where(barrier & (depth > 0) & (level > BAND[0]) & (level < BAND[1]), flat, np.inf)
    row, column = np.nonzero(np.isfinite(away))
    heading = np.stack([np.sin(azimuth), -np.cos(azimuth)], axis=1)
    _mark(walls, place + away[row, column, None] * heading[column])
    nearest = away.min(axis=0)
    known = np.isfinite(nearest)
    steps = np.arange(0.0, float(nearest[known].max(initial=0.0)), CELL / 2)
    column, step = np.nonzero(steps < (np.where(known, nearest, 0.0) - CELL)[:, None])
    _mark(swept, place + steps[step, None] * heading[column])


def _mark(layer: NDArray[np.bool_], points: NDArray[np.float64]) -> None:
    cells = np.floor(points / CELL).astype(np.intp)
    inside = ((cells >= 0) & (cells < layer.shape[::-1])).all(axis=1)
    layer[cells[inside, 1], cells[inside, 0]] = True


def plan_rooms(floor: Floor, things: Sequence[Thing]) -> RoomPlan:
    """Return the rooms that signs among the things mark on a floor."""
    parts, _ = ndimage.label(floor.open & ~floor.doorways, np.ones((3, 3)))
    labels = np.zeros(parts.shape, np.int32)
    kinds: list[str] = []
    found = [(SIGNS[thing.category], _find_cells(floor, thing)) for thing in things if thing.category in SIGNS]
    for part in range(1, int(parts.max(initial=0)) + 1):
        inside = parts == part
        signs = [(kind, own) for kind, cells in found if len(own := cells[inside[cells[:, 0], cells[:, 1]]])]
        if signs:
            numbers = _divide(inside, signs, kinds)
            labels[inside] = numbers[inside]
    return RoomPlan(floor.origin, labels, tuple(kinds))


def _divide(
    inside: NDArray[np.bool_], signs: Sequence[tuple[str, NDArray[np.intp]]], kinds: list[str]
) -> NDArray[np.int32]:
    """Return the room of each cell of a part of the floor; append the kinds of its rooms to `kinds`."""
    walks = _measure_walks(inside, [cells for _, cells in signs])
    apart = np.array([[walk[cells[:, 0], cells[:, 1]].min() for _, cells in signs] for walk in walks])
    names = _join_kitchens([kind for kind, _ in signs], apart)
    groups = _group(names, apart)
    by_group = np.stack([walks[group].min(axis=0) for group in groups])
    on_foot, nearest = np.sort(by_group, axis=0), by_group.argmin(axis=0)
    clearly = on_foot[0] <= NEARER * on_foot[1] if len(groups) > 1 else inside
    numbers = np.where(clearly & inside, len(kinds) + 1 + nearest, 0).astype(np.int32)
    kinds += [names[group[0]] for group in groups]
    return numbers


def list_rooms(plan: RoomPlan) -> tuple[Room, ...]:
    """Return the rooms of a plan, named by their kinds."""
    rooms = []
    for number, kind in enumerate(plan.kinds, start=1):
        cells = np.argwhere(plan.labels == number)
        if not len(cells):
            continue
        low, high = plan.origin + cells.min(axis=0)[::-1] * CELL, plan.origin + (cells.max(axis=0)[::-1] + 1) * CELL
        ends = (np.array([low[0], 0.0, low[1]]), np.array([high[0], 0.0, high[1]]))
        rooms.append(PlannedRoom(plan.name_room(number), kind, *ends, plan, number))
    return tuple(rooms)


def _find_cells(floor: Floor, thing: Thing) -> NDArray[np.intp]:
    """Return the cells of floor below and right beside a thing, [N, 2]."""
    first, last = (np.floor((edge[[0, 2]] - floor.origin) / CELL).astype(int) for edge in (thing.low, thing.high))
    window = np.zeros(floor.open.shape, bool)
    window[max(0, first[1] - 2) : last[1] + 3, max(0, first[0] - 2) : last[0] + 3] = True
    return np.argwhere(window & floor.open)


def _measure_walks(free: NDArray[np.bool_], sources: Sequence[NDArray[np.intp]]) -> NDArray[np.float64]:
    """Return the metres to walk to each cell from each of some groups of cells, float64 [groups, rows, columns]."""
    index = np.full(free.shape, -1)
    index[free] = np.arange(int(free.sum()))
    edges = []
    for shift, metres in (((0, 1), 1.0), ((1, 0), 1.0), ((1, 1), np.sqrt(2)), ((1, -1), np.sqrt(2))):
        moved = np.roll(index, (-shift[0], -shift[1]), axis=(0, 1))  # no cell at the rim is free
        both = (index >= 0) & (moved >= 0)
        edges.append((index[both], moved[both], np.full(int(both.sum()), metres * CELL)))
    one, other, lengths = (np.concatenate(column) for column in zip(*edges, strict=True))
    graph = sparse.csr_matrix((lengths, (one, other)), shape=(int(free.sum()),) * 2)
    walks = np.full((len(sources), *free.shape), np.inf)
    for number, cells in enumerate(sources):
        start = index[cells[:, 0], cells[:, 1]]
        walks[number][free] = csgraph.dijkstra(graph, directed=False, indices=start, min_only=True)
    return walks


def _join_kitchens(kinds: Sequence[str], apart: NDArray[np.float64]) -> list[str]:
    """Return the kinds with a dining table that is near a kitchen taken for a part of it."""
    kitchens = [index for index, kind in enumerate(kinds) if kind == "kitchen"]
    joined = [
        kind == "dining room" and bool((row[kitchens] <= TOGETHER).any())
        for kind, row in zip(kinds, apart, strict=True)
    ]
    return ["kitchen" if join else kind for kind, join in zip(kinds, joined, strict=True)]


def _group(kinds: Sequence[str], apart: NDArray[np.float64]) -> list[list[int]]:
    """Return the signs of each room: those of one kind that are near each other, directly or by way of others."""
    alike = np.array([[one == other for other in kinds] for one in kinds])
    near = sparse.csr_matrix(alike & (apart <= TOGETHER))
    _, groups = csgraph.connected_components(near, directed=False)
    return [np.flatnonzero(groups == group).tolist() for group in range(int(groups.max()) + 1)]
