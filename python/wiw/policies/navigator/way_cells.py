# SPDX-License-Identifier: Apache-2.0
"""Cells of the navigator's way map: a rectangle around the start that grows with the places that must lie on it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import floor

import numpy as np
from numpy.typing import NDArray

CELL = 0.2
"""Metres."""
HALF = 45
"""Cells between the start and each side of the smallest map: 9 m."""
GROWTH = 20
"""Cells by which a side moves out at a time, and that lie beyond the places for which it does: 4 m."""


@dataclass(frozen=True)
class WayCells:
    """Cells of 0.2 m in the frame of the start, rows along x and columns along y; known by their flat index."""

    low: tuple[int, int] = (-HALF, -HALF)
    """First row and column, counted from the start's."""
    high: tuple[int, int] = (HALF, HALF)
    """Row and column after the last."""

    @classmethod
    def around(cls, places: NDArray[np.float64]) -> WayCells:
        """Return the cells within 9 m of the start, and 4 to 8 m more around places [N, 2] that lie beyond."""
        cells = np.floor(places / CELL).astype(np.intp)
        low, high = zip(*(_grow_axis(int(own.min()), int(own.max()) + 1) for own in cells.T), strict=True)
        return cls(low, high)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    @property
    def count(self) -> int:
        """Number of cells."""
        return self.shape[0] * self.shape[1]

    @cached_property
    def centres(self) -> NDArray[np.float64]:
        """float64 [cells, 2]: the middles of all cells in metres."""
        along = [(np.arange(low, high) + 0.5) * CELL for low, high in zip(self.low, self.high, strict=True)]
        return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 2)

    def contain(self, places: NDArray[np.float64]) -> bool:
        """Return whether all of places [N, 2] lie on the map."""
        cells = np.floor(places / CELL)
        return bool(((cells >= self.low) & (cells < self.high)).all())

    def find(self, points: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the cell that each of points [..., 2] is in, or the nearest one of the map: intp [...]."""
        rows, columns = (self._find_along(axis, points[..., axis]) for axis in (0, 1))
        rows *= self.shape[1]
        rows += columns
        return rows

    def find_near(self, point: NDArray[np.float64], radius: float) -> NDArray[np.intp]:
        """Return the cells whose middles are within `radius` metres of a point [2]."""
        row, column = (
            min(max(floor(at / CELL) - low, 0), count - 1)
            for at, low, count in zip(point.tolist(), self.low, self.shape, strict=True)
        )
        reach = int(radius / CELL) + 1
        rows = np.arange(max(0, row - reach), min(self.shape[0], row + reach + 1))
        columns = np.arange(max(0, column - reach), min(self.shape[1], column + reach + 1))
        cells = (rows[:, None] * self.shape[1] + columns).ravel()
        away = self.centres[cells] - point
        return cells[(away**2).sum(axis=1) < radius**2]

    def _find_along(self, axis: int, metres: NDArray[np.float64]) -> NDArray[np.intp]:
        """Return the row (axis 0) or column (1) of each coordinate, counted from the map's first, of the same shape."""
        cells = np.floor(metres / CELL).astype(np.intp)
        cells -= self.low[axis]
        return np.clip(cells, 0, self.shape[axis] - 1, out=cells)


def _grow_axis(low: int, high: int) -> tuple[int, int]:
    """Return the ends of one axis of the map: moved out, where cells from `low` to below `high` do not fit in."""
    return -HALF - _measure_growth(-HALF - low), HALF + _measure_growth(high - HALF)


def _measure_growth(excess: int) -> int:
    """Return the cells by which a side moves out for places so many cells beyond it."""
    return (-(-excess // GROWTH) + 1) * GROWTH if excess > 0 else 0
