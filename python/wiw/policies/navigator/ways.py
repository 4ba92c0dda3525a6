# SPDX-License-Identifier: Apache-2.0
"""Ways over a map whose unknown parts are taken for floor: how long they are, and in which direction they begin."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.distance import cdist

from wiw.mapping.occupancy import CELL as FINE
from wiw.mapping.occupancy import OccupancyGrid
from wiw.policies.navigator.way_cells import CELL, WayCells

RAYS, RAY_STEP = 256, 0.1
"""Directions in which sight is measured, and metres between the points along each."""
UNKNOWN_COST = 1.3
"""Metres that one of unknown floor counts."""
CLOSE = 1.0
"""Metres within which the floor around the agent is seen."""
OCTILE = 0.96
"""Length of a way over its length by steps to eight neighbours, on average."""


@dataclass(frozen=True)
class Ways:
    """The shortest paths from N places to all cells."""

    metres: NDArray[np.float64]
    """float64 [N, cells]; inf if there is none."""
    azimuths: NDArray[np.float64]
    """float64 [N, cells]: direction in which it begins, straight to its first bend, in the frame of the start."""
    before: NDArray[np.int32]
    """int32 [N, cells]: the cell before each, itself if there is none."""
    cells: WayCells

    def take(self, rows: slice) -> Ways:
        """Return some of the N places."""
        return Ways(self.metres[rows], self.azimuths[rows], self.before[rows], self.cells)


class WayMap:
    """Knowledge of the floor in the cells of a way map."""

    def __init__(self, grid: OccupancyGrid, cells: WayCells) -> None:
        self.cells = cells
        blocked = find_blocked(grid)
        standable, occupied, known = (_coarsen(grid, layer, cells) for layer in (grid.standable, blocked, grid.known))
        self.open = standable.any(axis=-1)
        """bool [rows, columns]: where the agent is known to fit."""
        self.unknown = ~self.open & ~occupied.any(axis=-1) & ~known.all(axis=-1)
        """bool [rows, columns]: what may be floor."""

    def measure_ways(self, places: NDArray[np.float64]) -> Ways:
        """Measure the shortest paths from places [N, 2], which must be on the map, to all cells."""
        sources = self.cells.find(places)
        metres, before = csgraph.dijkstra(
            self._build_graph(sources), directed=True, indices=sources, return_predecessors=True
        )
        own = np.arange(self.cells.count, dtype=np.int32)
        before = np.where(before < 0, own, before)
        away = self.cells.centres - places[:, None]
        straight, azimuths = np.hypot(*np.moveaxis(away, -1, 0)), np.arctan2(away[..., 1], away[..., 0])
        visible = straight < self._measure_sight(places, azimuths) + CELL
        bend = np.where(visible, own, before) + np.arange(len(places))[:, None] * self.cells.count  # of all rows
        for _ in range(8):  # each doubles how far back along its way a cell looks for one in sight
            bend = bend.take(bend)
        return Ways(metres * OCTILE, azimuths.take(bend), before, self.cells)

    def _measure_sight(self, places: NDArray[np.float64], azimuths: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far one could go straight ahead from places [N, 2] at azimuths [N, cells]: float64 [N, cells]."""
        angles = (np.arange(RAYS) + 0.5) * 2 * np.pi / RAYS - np.pi
        steps = np.arange(CELL, max(self.cells.shape) * CELL / np.sqrt(2), RAY_STEP)
        points = steps[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        free = (self.open | self.unknown).ravel()
        sight = np.empty(azimuths.shape)
        for row, place in enumerate(places):
            blocked = ~free[self.cells.find(place + points)]
            reach = np.where(blocked.any(axis=0), steps[blocked.argmax(axis=0)], np.inf)
            sight[row] = reach[((azimuths[row] + np.pi) / (2 * np.pi) * RAYS).astype(np.intp) % RAYS]
        return sight

    def trace(self, ways: Ways, row: int, cell: int) -> NDArray[np.intp]:
        """Return the cells of the way from a place to a cell, both included."""
        found = [cell]
        while ways.before[row, found[-1]] != found[-1]:
            found.append(int(ways.before[row, found[-1]]))
        return np.array(found[::-1])

    def _build_graph(self, sources: NDArray[np.intp]) -> sparse.csr_array:
        """Build the graph of steps to eight neighbours; places stand where they are, whatever the map says."""
        passable: NDArray[np.bool_] = np.asarray(self.open | self.unknown)
        passable.ravel()[sources] = True
        cost = np.where(self.unknown, UNKNOWN_COST, 1.0)
        rows, columns = self.cells.shape
        index = np.arange(self.cells.count, dtype=np.int32).reshape(rows, columns)
        heads, tails, lengths = [], [], []
        for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
            a = slice(0, rows - dr), slice(max(0, -dc), columns - max(0, dc))
            b = slice(dr, rows), slice(max(0, dc), columns - max(0, -dc))
            free = passable[a] & passable[b]
            if dr and dc:  # no step between two cells that touch at a corner
                free &= passable[a[0], b[1]] & passable[b[0], a[1]]
            length = CELL * np.hypot(dr, dc) * (cost[a] + cost[b])[free] / 2
            heads += [index[a][free], index[b][free]]
            tails += [index[b][free], index[a][free]]
            lengths += [length, length]
        edges = np.concatenate(heads), np.concatenate(tails)
        return sparse.csr_array((np.concatenate(lengths), edges), shape=(self.cells.count, self.cells.count))


def find_blocked(grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Return the cells of a map, bool [rows, columns], that are occupied, or must be for all that is known.

    From close by the floor is seen unless something is in the way: where known floor ends there, the way does, too.
    """
    edge = ~grid.known & cv2.dilate(grid.free.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
    cells = np.argwhere(edge)
    if not len(cells):
        return grid.occupied
    near = cdist(grid.to_points(cells), np.array(grid.visits).reshape(-1, 2)).min(axis=1, initial=np.inf) < CLOSE
    blocked = grid.occupied.copy()
    blocked[tuple(cells[near].T)] = True
    return blocked


def _coarsen(grid: OccupancyGrid, layer: NDArray[np.bool_], cells: WayCells) -> NDArray[np.bool_]:
    """Return a layer's values in each cell of the way map: bool [rows, columns, 4]; False outside of the grid."""
    factor = round(CELL / FINE)
    rows, columns = cells.shape
    first = cells.low[0] * factor, cells.low[1] * factor
    fine = crop_layer(grid, layer, first, (rows * factor, columns * factor))
    return fine.reshape(rows, factor, columns, factor).transpose(0, 2, 1, 3).reshape(rows, columns, -1)


def crop_layer(
    grid: OccupancyGrid, layer: NDArray[np.bool_], first: tuple[int, int], shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Return a part of a grid's layer, bool of a shape, from row and column `first` on; False outside of the grid.

    Rows and columns are counted from the start's.
    """
    cropped = np.zeros(shape, bool)
    shift = np.array(grid.origin) - first
    low, high = np.maximum(shift, 0), np.minimum(shift + layer.shape, shape)
    if (low < high).all():
        own = tuple(slice(a - s, b - s) for a, b, s in zip(low, high, shift, strict=True))
        cropped[low[0] : high[0], low[1] : high[1]] = layer[own]
    return cropped
