# SPDX-License-Identifier: Apache-2.0
"""A map of floor space from depth panoramas: free, occupied, unknown; frontiers, rooms, and what a look would add."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from wiw.mapping.openings import Opening, clean_walls, find_openings, name_openings
from wiw.mapping.views import check_panorama, measure_camera_height

CELL = 0.1
"""Metres."""
OBSTACLE = (0.1, 1.75)
"""Heights above the floor, in metres, between which a surface is in the agent's way. Its body is 1.5 m high; navigation
meshes lie, and are rounded, up to 0.2 m higher, so that a lamp that hangs down to 1.7 m stops it."""
FLOOR = 0.08
"""Metres that floor may seem to lie above or below zero."""
DROP = 0.2
"""Metres below the floor from which on a surface shows that the floor has ended."""
RANGE = 8.0
"""Metres up to which depth is used."""
FLOOR_GAP = 0.3
"""Metres beyond the farthest visible floor that are taken for floor, where nothing is in the way."""
STRIDE = 2
"""Rows and columns of the panorama between the pixels that are used."""
MARGIN = 8
"""Cells around what is known by which the map grows."""
LEAST_UNKNOWN = 8
"""Unknown parts of fewer cells among known ones do not make a frontier."""
LEAST_FRONTIER = 3
"""Cells that a frontier has at least."""
CEILING_BAND = (0.35, 0.08)
"""Metres below the ceiling, from and to: what stands there is a wall, or the lintel above a door, not furniture."""
CEILING = 2.5
"""Metres, where no ceiling is observed."""
LEAST_ROOM = 1.0
"""Square metres of a room."""

Cells = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class Frontier:
    """A row of free cells beside unknown ones."""

    position: NDArray[np.float64]
    """float64 [2]: the middle of the cell nearest to their mean."""
    cells: int
    """How many there are; each is 0.1 m wide."""


@dataclass
class OccupancyGrid:
    """Cells of 0.1 m in the frame of the start: rows along x (forward), columns along y (left). It grows as needed."""

    origin: tuple[int, int] = (-64, -64)
    """Index of the first row and column, where (0, 0) begins at the start's position."""
    free: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((128, 128), bool))
    """Observed to be floor with nothing on it."""
    occupied: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((128, 128), bool))
    """Something is in the agent's way."""
    walls: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((128, 128), bool))
    """Something is right under the ceiling: a wall, or a lintel."""
    ceiling: float = CEILING
    openings: tuple[Opening, ...] = ()
    """Doorways and passages, by id."""
    visits: list[NDArray[np.float64]] = field(default_factory=list)
    """float64 [2] each: where the agent has observed."""
    _opening_places: dict[int, NDArray[np.float64]] = field(default_factory=dict)

    def add(self, depth: NDArray[np.float32], odometry: NDArray[np.float64]) -> int:
        """Add a panorama of distances along the ray, float32 [H, W]; return how many cells were unknown before.

        Raises:
            ArgumentError: arrays of other shapes.
        """
        check_panorama(depth, odometry)
        rays = _get_rays(depth.shape[0], depth.shape[1])
        picture = depth[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        above = measure_camera_height(depth)
        flat, height = picture * rays.cosine, above + picture * rays.sine
        azimuth = odometry[2] + rays.azimuth
        usable = (picture > 0) & (flat < RANGE)
        solid = usable & (height > OBSTACLE[0]) & (height < OBSTACLE[1])
        ground = usable & (np.abs(height) < FLOOR)
        before = int(self.known.sum())
        self._grow(np.asarray(odometry[:2]), float(flat[usable].max(initial=0.0)))
        self._observe_ceiling(height[usable])
        upright = np.abs(np.diff(height, axis=0, append=0)) > np.abs(np.diff(flat, axis=0, append=0))
        high = upright & usable & (height > self.ceiling - CEILING_BAND[0]) & (height < self.ceiling - CEILING_BAND[1])
        for mask, layer in ((solid, self.occupied), (ground, self.free), (high, self.walls)):
            rows, columns = np.nonzero(mask)
            layer[self._place(odometry, flat[rows, columns], azimuth[columns])] = True
        self._sweep(flat, height, above, usable, solid, ground, azimuth, odometry)
        self.visits.append(np.array(odometry[:2]))
        _forget(self)
        found = find_openings(self.free & ~self.occupied, self.wall_cells, self.to_points)
        self.openings = name_openings(found, self._opening_places)
        return int(self.known.sum()) - before

    def _sweep(
        self,
        flat: NDArray[np.float32],
        height: NDArray[np.float32],
        above: float,
        usable: NDArray[np.bool_],
        solid: NDArray[np.bool_],
        ground: NDArray[np.bool_],
        azimuth: NDArray[np.float64],
        odometry: NDArray[np.float64],
    ) -> None:
        """Mark the floor of each column as free, up to the first thing in the way or the end of visible floor.

        The camera is `above` the floor.
        """
        nearest = np.where(solid, flat, np.inf).min(axis=0)
        drop = usable & (height < -DROP)
        crossing = flat * (above / np.maximum(above - height, 1e-3))
        nearest = np.minimum(nearest, np.where(drop, crossing, np.inf).min(axis=0))
        before = ground & (flat < nearest)
        farthest = np.where(before, flat, 0.0).max(axis=0) + FLOOR_GAP
        reach = np.minimum(np.minimum(nearest - CELL / 2, farthest), RANGE)
        steps = np.arange(CELL / 4, RANGE, CELL / 2)
        columns, rows = np.nonzero(steps < reach[:, None])
        self.free[self._place(odometry, steps[rows], azimuth[columns])] = True
        self.free[self.to_cells(np.asarray(odometry[None, :2]))] = True

    def _observe_ceiling(self, heights: NDArray[np.float32]) -> None:
        """Take the level most often seen overhead for the ceiling."""
        above = heights[(heights > 2.0) & (heights < 4.5)]
        if len(above) < 1000:
            return
        counts = np.bincount(((above - 2.0) / 0.05).astype(np.intp), minlength=50)
        level = 2.0 + 0.05 * (int(counts.argmax()) + 0.5)
        self.ceiling = level if not self.visits else max(self.ceiling, level) if level < 3.5 else self.ceiling

    def _grow(self, center: NDArray[np.float64], reach: float) -> None:
        """Make room for points within `reach` metres of a place."""
        low = np.floor((center - reach) / CELL).astype(int) - MARGIN - self.origin
        high = np.floor((center + reach) / CELL).astype(int) + MARGIN + 1 - self.origin - self.free.shape
        if (low >= 0).all() and (high <= 0).all():
            return
        pad = [(max(0, -int(a)), max(0, int(b))) for a, b in zip(low, high, strict=True)]
        self.free, self.occupied, self.walls = (np.pad(array, pad) for array in (self.free, self.occupied, self.walls))
        self.origin = (self.origin[0] - pad[0][0], self.origin[1] - pad[1][0])

    def _place(self, odometry: NDArray[np.float64], flat: NDArray[Any], azimuth: NDArray[np.float64]) -> Cells:
        x, y = odometry[0] + flat * np.cos(azimuth), odometry[1] + flat * np.sin(azimuth)
        return np.floor(x / CELL).astype(np.intp) - self.origin[0], np.floor(y / CELL).astype(np.intp) - self.origin[1]

    def mark_blocked(self, pose: NDArray[np.float64], step: float) -> None:
        """Mark the place that a refused step would have led to as occupied, unless the agent itself stands in it."""
        ahead = np.asarray(pose[:2]) + step * np.array([np.cos(pose[2]), np.sin(pose[2])])
        self._grow(np.asarray(pose[:2]), step)
        cell, here = (tuple(int(c[0]) for c in self.to_cells(point[None])) for point in (ahead, np.asarray(pose)[:2]))
        if cell != here:
            self.occupied[cell] = True
            _forget(self)

    # -- what is known -------------------------------------------------------------------------------------------------

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that are free or occupied."""
        return self.free | self.occupied

    @cached_property
    def standable(self) -> NDArray[np.bool_]:
        """Cells where the agent fits: free, and no occupied cell within its radius."""
        kernel = np.ones((3, 3), np.uint8)
        return self.free & ~cv2.dilate(self.occupied.view(np.uint8), kernel).view(bool)

    @cached_property
    def frontiers(self) -> tuple[Frontier, ...]:
        """Edges at which floor goes on into the unknown, the longest first."""
        parts, count = ndimage.label(~self.known)
        small = np.bincount(parts.ravel(), minlength=count + 1) < LEAST_UNKNOWN
        unknown = (parts > 0) & ~small[parts]
        edge = self.standable & cv2.dilate(unknown.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
        clusters, count = ndimage.label(edge, np.ones((3, 3)))
        found = []
        for number, box in enumerate(ndimage.find_objects(clusters), start=1):
            cells = np.argwhere(clusters[box] == number) + [part.start for part in box]
            if len(cells) >= LEAST_FRONTIER:
                middle = cells[np.square(cells - cells.mean(axis=0)).sum(axis=1).argmin()]
                found.append(Frontier(self.to_points(middle), len(cells)))
        return tuple(sorted(found, key=lambda frontier: (-frontier.cells, *frontier.position.tolist())))

    @cached_property
    def wall_cells(self) -> NDArray[np.bool_]:
        """Cells of walls, those above doorways included."""
        return clean_walls(self.walls)

    @cached_property
    def rooms(self) -> NDArray[np.int32]:
        """int32 [rows, columns]: room of each known cell, from 1 on, 0 in walls, doorways and the unknown.

        Rooms are what walls and lintels, right under the ceiling, keep apart.
        """
        cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        barrier = cv2.dilate(self.wall_cells.view(np.uint8), cross).view(bool)
        parts, count = ndimage.label(self.known & ~barrier)
        large = np.bincount(parts.ravel(), minlength=count + 1) * CELL**2 >= LEAST_ROOM
        large[0] = False
        names = np.where(large, np.cumsum(large), 0)
        return names[parts].astype(np.int32)

    def find_room(self, points: NDArray[np.float64], reach: float = 0.6) -> int:
        """Return the room that most of N points [N, 2 or 3] are in, or within `reach` metres of; 0 where in none."""
        found = self.list_rooms(points, reach)
        return int(np.bincount(found[found > 0]).argmax()) if found.any() else 0

    def list_rooms(self, points: NDArray[np.float64], reach: float = 0.6) -> NDArray[np.int32]:
        """Return the room that each of N points is in, or within `reach` metres of, int32 [N]; 0 where in none."""
        rooms = self.rooms
        rows, columns = self.to_cells(points)
        inside = (rows >= 0) & (rows < rooms.shape[0]) & (columns >= 0) & (columns < rooms.shape[1])
        away, (near_rows, near_columns) = self._nearest_room
        rows, columns = rows[inside], columns[inside]
        found = np.zeros(len(inside), np.int32)
        near = rooms[near_rows[rows, columns], near_columns[rows, columns]]
        found[inside] = np.where(away[rows, columns] * CELL <= reach, near, 0)
        return found

    @cached_property
    def _nearest_room(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        distance, nearest = ndimage.distance_transform_edt(self.rooms == 0, return_indices=True)
        return distance, nearest

    @property
    def area(self) -> float:
        """Free floor in square metres."""
        return float(self.free.sum() * CELL**2)

    def measure_gain(
        self,
        position: NDArray[np.float64],
        azimuth: float = 0.0,
        hfov_deg: float = 360.0,
        reach: float = 4.0,
    ) -> float:
        """Return the square metres of unknown floor that a look from a place could show.

        What is unknown is taken for empty: rays end at occupied cells and after `reach` metres.
        """
        count = max(8, round(2 * np.pi * reach / CELL * hfov_deg / 360.0))
        spread = np.radians(hfov_deg) * ((np.arange(count) + 0.5) / count - 0.5)
        steps = np.arange(CELL / 2, reach, CELL * 0.7)
        points = (
            np.asarray(position)[:2]
            + steps[None, :, None] * np.stack([np.cos(azimuth + spread), np.sin(azimuth + spread)], axis=1)[:, None]
        )
        rows, columns = self.to_cells(points.reshape(-1, 2))
        height, width = self.free.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        index = np.where(inside, rows * width + columns, 0)
        blocked = (self.occupied.ravel()[index] & inside).reshape(count, len(steps))
        visible = ~np.logical_or.accumulate(blocked, axis=1).ravel()
        new = visible & ~(self.known.ravel()[index] & inside)
        return float(len(np.unique(np.stack([rows[new], columns[new]]), axis=1).T) * CELL**2)

    # -- cells and points ----------------------------------------------------------------------------------------------

    def to_cells(self, points: NDArray[np.float64]) -> Cells:
        """Return row and column of N points [N, 2 or 3]; they may lie outside of the map."""
        cells = np.floor(np.asarray(points, np.float64)[:, :2] / CELL).astype(np.intp) - self.origin
        return cells[:, 0], cells[:, 1]

    def to_points(self, cells: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the middles of cells [..., 2] in metres."""
        return np.asarray((np.asarray(cells) + self.origin + 0.5) * CELL)

    def lookup(self, layer: NDArray[np.bool_], points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return a layer's values at N points, False outside of the map."""
        rows, columns = self.to_cells(points)
        inside = (rows >= 0) & (rows < layer.shape[0]) & (columns >= 0) & (columns < layer.shape[1])
        values = np.zeros(len(rows), bool)
        values[inside] = layer[rows[inside], columns[inside]]
        return values


def _forget(grid: OccupancyGrid) -> None:
    """Drop what was computed of a map that has changed."""
    for name in ("standable", "frontiers", "wall_cells", "rooms", "_nearest_room"):
        grid.__dict__.pop(name, None)


@dataclass(frozen=True)
class _Rays:
    azimuth: NDArray[np.float64]
    """Azimuth of each column that is used, left positive."""
    cosine: NDArray[np.float32]
    sine: NDArray[np.float32]


@cache
def _get_rays(height: int, width: int) -> _Rays:
    azimuth = np.pi - (np.arange(width) + 0.5) / width * 2 * np.pi
    latitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    rows = latitude[STRIDE // 2 :: STRIDE, None]
    return _Rays(azimuth[STRIDE // 2 :: STRIDE], np.cos(rows).astype(np.float32), np.sin(rows).astype(np.float32))
