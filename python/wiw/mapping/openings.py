# SPDX-License-Identifier: Apache-2.0
"""Openings: doorways and passages, gaps in the walls' depth through which floor goes on under what is a wall above."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

WIDTH = (0.35, 3.0)
"""Metres between the ends, as far as they are free of obstacles."""
LEAST_WALL = 10
"""Cells that a part of the walls reaches at least from end to end; lamps under the ceiling are smaller."""
LEAST_SIDE = 4
"""Free cells that must be known on either side of an opening."""
SAME = 0.6
"""Metres within which two openings are one."""


@dataclass(frozen=True)
class Opening:
    """A gap in a wall."""

    id: int
    """From 1 on, in the order in which they were found; 0 before it is in a map."""
    edges: NDArray[np.float64]
    """float64 [2, 2]: its ends on the floor, in the frame of the start."""

    @property
    def position(self) -> NDArray[np.float64]:
        """float64 [2]: the middle."""
        return np.asarray(self.edges.mean(axis=0))

    @property
    def width(self) -> float:
        """Metres between the edges."""
        return float(np.linalg.norm(self.edges[1] - self.edges[0]))


def clean_walls(walls: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what of the cells observed right under the ceiling is walls, small gaps closed: bool [rows, columns]."""
    joined = cv2.morphologyEx(walls.view(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, parts, stats, _ = cv2.connectedComponentsWithStats(joined, connectivity=8)
    large = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) >= LEAST_WALL
    large[0] = False
    return cv2.morphologyEx(large[parts].astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)).view(bool)


def find_openings(
    free: NDArray[np.bool_], walls: NDArray[np.bool_], to_points: Callable[[NDArray[Any]], NDArray[np.float64]]
) -> list[Opening]:
    """Find the openings of a map.

    Args:
        free: cells of free floor without obstacles.
        walls: as `clean_walls` returns them; they go on above openings.
        to_points: gives the middles of cells [N, 2] in metres.
    """
    under, _ = ndimage.label(free & walls, np.ones((3, 3)))
    found = []
    for number, box in enumerate(ndimage.find_objects(under), start=1):
        cells = np.argwhere(under[box] == number) + [part.start for part in box]
        edges = to_points(_find_ends(cells))
        width = float(np.linalg.norm(edges[1] - edges[0]))
        if WIDTH[0] <= width <= WIDTH[1] and _has_two_sides(under == number, box, free & ~walls):
            found.append(Opening(0, edges))
    return found


def _find_ends(cells: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the ends of a row of cells, along its longest direction: float64 [2, 2]."""
    middle = cells.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((cells - middle).T) if len(cells) > 1 else np.eye(2))
    along = (cells - middle) @ vectors[:, 1]
    return np.stack([middle + along.min() * vectors[:, 1], middle + along.max() * vectors[:, 1]])


def _has_two_sides(part: NDArray[np.bool_], box: tuple[slice, ...], open_floor: NDArray[np.bool_]) -> bool:
    window = tuple(slice(max(0, side.start - 5), side.stop + 5) for side in box)
    near = cv2.dilate(part[window].view(np.uint8), np.ones((9, 9), np.uint8)).view(bool)
    sides, count = ndimage.label(near & open_floor[window])
    return int((np.bincount(sides.ravel(), minlength=count + 1)[1:] >= LEAST_SIDE).sum()) >= 2


def name_openings(found: Sequence[Opening], names: dict[int, NDArray[np.float64]]) -> tuple[Opening, ...]:
    """Return the openings under their ids, those of the nearest that had a name before, or new ones.

    `names` has the position of each id, and is brought up to date.
    """
    named: dict[int, Opening] = {}
    for opening in sorted(found, key=lambda each: tuple(each.position)):
        away = {name: float(np.linalg.norm(place - opening.position)) for name, place in names.items()}
        free = sorted((distance, name) for name, distance in away.items() if name not in named)
        number = free[0][1] if free and free[0][0] <= SAME else len(names) + 1
        named[number] = replace(opening, id=number)
        names[number] = opening.position
    return tuple(named[number] for number in sorted(named))
