# SPDX-License-Identifier: Apache-2.0
"""A map of explored space, built from panorama depth and odometry, and distances to its frontiers."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

CELL = 0.1
"""Metres."""
HALF, GROWTH = 160, 40
"""Cells from the start to the edge of the smallest map, and by which each side moves out at a time: 16 and 4 m."""
RANGE = 4.0
"""Metres up to which depth marks space as explored."""
MARGIN = 0.5
"""Metres beyond these that the map reaches."""
CAMERA_HEIGHT = 1.0
OBSTACLE = (0.25, 1.5)
"""Heights above the floor, in metres, between which a surface blocks the agent."""
FAR_DISTANCE = 30.0


@dataclass
class ExplorationMap:
    """A grid in the start frame: x forward (rows), y left (columns); it grows as the agent gets far from the start."""

    explored: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((2 * HALF, 2 * HALF), bool))
    occupied: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((2 * HALF, 2 * HALF), np.uint8))
    likeness: NDArray[np.float32] = field(default_factory=lambda: np.zeros((2 * HALF, 2 * HALF), np.float32))
    """Mean similarity to the goal of the views in the direction of each cell."""
    times: NDArray[np.float32] = field(default_factory=lambda: np.zeros((2 * HALF, 2 * HALF), np.float32))
    trail: list[NDArray[np.float64]] = field(default_factory=list)

    @property
    def half(self) -> int:
        """Cells from the start to the map's edge."""
        return len(self.explored) // 2

    @property
    def centres(self) -> NDArray[np.float64]:
        """Middles of the cells along each axis in metres, float64 [2 * half]."""
        return np.asarray((np.arange(2 * self.half) - self.half + 0.5) * CELL, np.float64)

    def to_cells(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Convert positions in metres to row and column, clipped to the map."""
        row, column = (np.floor(along / CELL).astype(np.intp) + self.half for along in (x, y))
        return np.clip(row, 0, 2 * self.half - 1), np.clip(column, 0, 2 * self.half - 1)

    def _grow_around(self, odometry: NDArray[np.float64]) -> None:
        """Let the map reach as far as is seen from a place."""
        needed = (np.abs(odometry[:2]).max() + RANGE + MARGIN) / CELL - self.half
        if needed > 0:
            more = GROWTH * math.ceil(needed / GROWTH)
            self.explored, self.occupied = np.pad(self.explored, more), np.pad(self.occupied, more)
            self.likeness, self.times = np.pad(self.likeness, more), np.pad(self.times, more)

    def update(self, depth: NDArray[np.float32], odometry: NDArray[np.float64], likeness: NDArray[np.float32]) -> None:
        """Add a panorama of distances float32 [H, W] at (x, y, azimuth); `likeness` [W] is the similarity of each
        column.
        """
        self._grow_around(odometry)
        rays, height = _get_rays(depth.shape)
        azimuth = odometry[2] + rays["azimuth"]
        flat = depth * rays["cos_latitude"]
        floor_height = CAMERA_HEIGHT + depth * height
        hit = (depth > 0) & (flat < RANGE)
        solid = hit & (floor_height > OBSTACLE[0]) & (floor_height < OBSTACLE[1])
        x, y = odometry[0] + flat * np.cos(azimuth), odometry[1] + flat * np.sin(azimuth)
        ground = hit & (np.abs(floor_height) < 0.12)
        self.explored[self.to_cells(x[ground], y[ground])] = True
        self._sweep(np.where(solid, flat, np.inf).min(0), azimuth, odometry, likeness)
        self.occupied[self.to_cells(x[solid], y[solid])] = 1
        self.trail.append(np.array(odometry[:2]))
        here = self.to_cells(np.array([odometry[0]]), np.array([odometry[1]]))
        self.explored[here] = True

    def _sweep(
        self,
        reach: NDArray[np.float64],
        azimuth: NDArray[np.float64],
        odometry: NDArray[np.float64],
        likeness: NDArray[np.float32],
    ) -> None:
        """Mark the space in front of each column's nearest obstacle as explored."""
        steps = np.arange(0.05, RANGE, CELL / 2)[:, None]
        inside = steps < np.minimum(reach, RANGE)[None] - CELL
        x, y = odometry[0] + steps * np.cos(azimuth), odometry[1] + steps * np.sin(azimuth)
        here = self.to_cells(x[inside], y[inside])
        self.explored[here] = True
        self.times[here] += 1
        values = np.broadcast_to(likeness, inside.shape)[inside]
        self.likeness[here] += (values - self.likeness[here]) / self.times[here]

    def mark_blocked(self, odometry: NDArray[np.float64]) -> None:
        """Mark the cell ahead as occupied if the agent has not moved since the last update: its step was refused."""
        if self.trail and np.linalg.norm(odometry[:2] - self.trail[-1]) < 1e-3:
            ahead = odometry[:2] + 2.5 * CELL * np.array([np.cos(odometry[2]), np.sin(odometry[2])])
            self.occupied[self.to_cells(ahead[:1], ahead[1:])] = 1

    def find_free_cells(self) -> NDArray[np.bool_]:
        """Return the cells where the agent may stand: explored, and further than its radius from any obstacle."""
        return self.explored & ~_dilate(self.occupied > 0)

    def look_ahead(
        self, odometry: NDArray[np.float64], headings: int, reach: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the free metres in each of `headings` directions, at most `reach`, and their end points [headings,
        2].
        """
        azimuth = odometry[2] + np.arange(headings) * 2 * np.pi / headings
        steps = np.arange(CELL / 2, reach + 1e-9, CELL / 2)
        x = odometry[0] + steps * np.cos(azimuth)[:, None]
        y = odometry[1] + steps * np.sin(azimuth)[:, None]
        clear = self.find_free_cells()[self.to_cells(x, y)]
        clear |= steps < 1.5 * CELL  # the agent stands there already
        runs = np.where(clear.all(1), reach, steps[np.argmin(clear, axis=1)] - CELL / 2)
        ends = odometry[:2] + runs[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        return runs, ends

    def sample_grid(self, values: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a grid's values at points [N, 2] in metres."""
        return values[self.to_cells(points[:, 0], points[:, 1])]

    def distance_to_trail(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the metres from points [N, 2] to the nearest place the agent has been."""
        return np.linalg.norm(points[:, None] - np.stack(self.trail)[None], axis=2).min(1)

    def distance_to_target(self, likeness: float, travel: float) -> NDArray[np.float64]:
        """Return the metres from each free cell to the best frontier; FAR_DISTANCE where none can be reached.

        A frontier's worth is `likeness` times the similarity of the views towards it, less `travel` per metre.
        """
        free = self.find_free_cells()
        here = np.zeros_like(free)
        row, column = self.to_cells(self.trail[-1][:1], self.trail[-1][1:])
        here[row, column] = free[row, column] = True
        way = compute_distance_field(free, here)
        worth = np.where(
            self._find_frontier(free) & (way < FAR_DISTANCE), likeness * self.likeness - travel * way, -np.inf
        )
        best = np.unravel_index(int(np.argmax(worth)), worth.shape)
        target = np.zeros_like(free)
        target[best] = np.isfinite(worth[best])
        return compute_distance_field(free, target)

    def _find_frontier(self, free: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return free cells beside unexplored ones, in clusters of at least three."""
        unknown = ~self.explored & ~(self.occupied > 0)
        frontier = free & _dilate(unknown)
        labels, _ = ndimage.label(frontier, np.ones((3, 3)))
        return frontier & (np.bincount(labels.ravel())[labels] >= 3)


def compute_distance_field(free: NDArray[np.bool_], sources: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the metres from each free cell to the nearest source over 8-connected free cells; FAR_DISTANCE where
    unreachable.
    """
    field_ = np.full(free.shape, FAR_DISTANCE)
    if not sources.any():
        return field_
    rows, columns = np.nonzero(free)
    top, left = rows.min(), columns.min()
    box = (slice(top, rows.max() + 1), slice(left, columns.max() + 1))
    graph, index = _build_grid_graph(free[box])
    starts = index[box_sources] if (box_sources := sources[box]).any() else np.array([], np.intp)
    distance = csgraph.dijkstra(graph, directed=False, indices=starts, min_only=True)
    inner = np.full(index.shape, FAR_DISTANCE)
    inner[free[box]] = np.minimum(distance, FAR_DISTANCE)
    field_[box] = inner
    return field_


def _build_grid_graph(free: NDArray[np.bool_]) -> tuple[sparse.csr_array, NDArray[np.intp]]:
    """Build the 8-connected graph of the free cells, weighted by metres; also return each cell's node."""
    index = np.cumsum(free.ravel()).reshape(free.shape) - 1
    heads, tails, weights = [], [], []
    height, width = free.shape
    for dr, dc in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = (slice(0, height - dr), slice(max(0, -dc), width - max(0, dc)))
        b = (slice(dr, height), slice(max(0, dc), width - max(0, -dc)))
        both = free[a] & free[b]
        heads.append(index[a][both])
        tails.append(index[b][both])
        weights.append(np.full(int(both.sum()), CELL * np.hypot(dr, dc)))
    nodes = int(free.sum())
    edges = (np.concatenate(heads), np.concatenate(tails))
    return sparse.csr_array((np.concatenate(weights), edges), shape=(nodes, nodes)), index


@cache
def _get_rays(shape: tuple[int, int]) -> tuple[dict[str, NDArray[np.float64]], NDArray[np.float64]]:
    """Return azimuth (left positive) of each column, and cosine and sine of each row's latitude."""
    height, width = shape
    azimuth = np.pi - (np.arange(width) + 0.5) / width * 2 * np.pi
    latitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    return {"azimuth": azimuth, "cos_latitude": np.cos(latitude)[:, None]}, np.sin(latitude)[:, None]


def _dilate(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Add the eight cells around each of the mask's."""
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8))).view(bool)
