# SPDX-License-Identifier: Apache-2.0
"""Maps of traversals: floor that is covered and floor that is not, the path, and the waypoints. No scene is opened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

PIXELS_PER_METRE = 40
MARGIN = 0.4
"""Metres around the floor."""
COVERED, BARE, WALL = (222, 234, 214), (240, 190, 170), (70, 70, 66)
"""Colours: floor within the coverage radius of a position, other floor, walls and drops."""
PAPER, WAYPOINT, START = (250, 249, 246), (200, 60, 40), (30, 30, 28)
EARLY, LATE = np.array((60, 90, 200)), np.array((230, 150, 30))
"""Colours of the path at its beginning and its end."""


def draw_traversal(
    traversal: Mapping[str, Any], paths: Sequence[NDArray[np.float64]], radius: float = 1.0
) -> NDArray[np.uint8]:
    """Draw one pass over one island.

    Args:
        traversal: as in `meta.json`: walls [S, 4] and waypoints [W, 2], x and z in metres.
        paths: float [T, 2] each: x and z of a segment's frames, in the order of the traversal.
        radius: metres, along the floor, within which it counts as covered.

    Returns:
        uint8 [H, W, 3]; x is to the right, z down.
    """
    walls = np.asarray(traversal["walls"], np.float64).reshape(-1, 2, 2)
    low = walls.min(axis=(0, 1)) - MARGIN
    width, height = np.ceil((walls.max(axis=(0, 1)) + MARGIN - low) * PIXELS_PER_METRE).astype(int)

    def pixels(points: Any) -> NDArray[np.int32]:
        return np.rint((np.asarray(points, np.float64) - low) * PIXELS_PER_METRE).astype(np.int32)

    floor = fill_floor([pixels(loop) for loop in join_loops(walls)], (int(height), int(width)))
    image = np.full((height, width, 3), PAPER, np.uint8)
    image[floor > 0] = BARE
    seeds = np.zeros_like(floor)
    for path in paths:
        seeds[tuple(np.clip(pixels(path), 0, (width - 1, height - 1)).T[::-1])] = 255
    image[grow(seeds, floor, round(radius * PIXELS_PER_METRE)) > 0] = COVERED
    for wall in walls:
        cv2.polylines(image, [pixels(wall)], False, WALL, 2, cv2.LINE_AA)
    for number, path in enumerate(paths):
        share = number / max(1, len(paths) - 1)
        color = tuple(((1 - share) * EARLY + share * LATE).round().tolist())
        cv2.polylines(image, [pixels(path)], False, color, 2, cv2.LINE_AA)
    for waypoint in traversal["waypoints"]:
        cv2.circle(image, tuple(pixels(waypoint).tolist()), 6, WAYPOINT, -1, cv2.LINE_AA)
    if paths:
        cv2.circle(image, tuple(pixels(paths[0][0]).tolist()), 9, START, 2, cv2.LINE_AA)
    return image


def join_loops(walls: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the closed polygons [P, 2] that segments [S, 2, 2] with common ends make up."""
    after: dict[tuple[float, float], list[tuple[float, float]]] = {}
    for start, end in walls.round(2).tolist():
        after.setdefault(tuple(start), []).append(tuple(end))
    loops = []
    while after:
        point = next(iter(after))
        loop = [point]
        while point in after:
            following = after[point].pop()
            if not after[point]:
                del after[point]
            point = following
            loop.append(point)
        loops.append(np.array(loop))
    return loops


def fill_floor(loops: Sequence[NDArray[np.int32]], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return uint8 [H, W], 255 inside an odd number of loops: floor, but for its holes."""
    floor = np.zeros(size, np.uint8)
    cv2.fillPoly(floor, list(loops), 255)
    return floor


def grow(seeds: NDArray[np.uint8], floor: NDArray[np.uint8], steps: int) -> NDArray[np.uint8]:
    """Return the floor within so many pixels of the seeds, along the floor; octagons stand for circles."""
    shapes = [cv2.getStructuringElement(shape, (3, 3)) for shape in (cv2.MORPH_CROSS, cv2.MORPH_RECT)]
    reached = np.asarray(cv2.bitwise_and(cv2.dilate(seeds, shapes[1]), floor))
    for step in range(steps):
        reached = np.asarray(cv2.bitwise_and(cv2.dilate(reached, shapes[step % 5 in (1, 3)]), floor))
    return reached.astype(np.uint8, copy=False)
