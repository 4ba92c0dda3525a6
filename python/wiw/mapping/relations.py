# SPDX-License-Identifier: Apache-2.0
"""How mapped objects stand to each other: on, above, beside, around, nearest, in one room.

Boxes are along the axes of the frame of the start, which need not be those of the walls; what touches is therefore
measured between voxels wherever an oblique box would mislead.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from wiw.mapping.object_map import MapObject
from wiw.mapping.occupancy import OccupancyGrid

UNDER = 0.2
"""Metres under the lowest voxel of a thing in which what it stands on is looked for."""
ASIDE = 0.15
"""Metres around the footprint of a thing that count as under it."""
HANGS = 0.25
"""Metres that a thing above another may reach below its top, as a picture behind a sofa's back does."""
AROUND = 0.6
BESIDE = 0.7
NEAREST = 1.2


def measure_gap(one: MapObject, other: MapObject) -> float:
    """Return the horizontal metres between two objects' nearest voxels, 0 where one is over the other."""
    few, many = sorted((one, other), key=lambda thing: len(thing.voxels))
    points = few.points[:: -(-len(few.points) // 400), :2]
    distance, _ = cKDTree(np.unique(many.points[:, :2], axis=0)).query(points)
    nearest = float(distance.min())
    return 0.0 if nearest < 0.08 else nearest


def rests_on(thing: MapObject, support: MapObject) -> bool:
    """Return whether an object stands on another, or in it, as a vase in a bookshelf does."""
    if thing.id == support.id or thing.bounds[0, 2] < 0.0:
        return False
    low, high = support.bounds
    bottom = float(thing.bounds[0, 2])
    if not low[2] - 0.05 <= bottom <= high[2] + 0.1 or thing.extent[:2].max() > support.extent[:2].max() + 0.1:
        return False
    if bottom >= high[2] - 0.1:  # its top may not have been seen
        inside = ((thing.points[:, :2] >= low[:2] - 0.05) & (thing.points[:, :2] <= high[:2] + 0.05)).all(axis=1)
        if inside.mean() >= 0.8:
            return True
    points = support.points
    near = (points[:, 2] <= bottom + 0.08) & (points[:, 2] >= bottom - UNDER)
    if not near.any():
        return False
    distance, _ = cKDTree(points[near, :2]).query(thing.points[:, :2])
    return bool((distance <= ASIDE).mean() >= 0.5)


def find_support(thing: MapObject, candidates: Iterable[MapObject]) -> MapObject | None:
    """Return what an object stands on: of several, the one whose top is nearest to its bottom."""
    under = [other for other in candidates if rests_on(thing, other)]
    bottom = float(thing.bounds[0, 2])
    return min(under, key=lambda other: (_measure_step(other, thing, bottom), other.id), default=None)


def _measure_step(support: MapObject, thing: MapObject, bottom: float) -> float:
    """Return how far below an object the nearest voxel of its support is, sideways steps included."""
    bottom_points = thing.points[thing.points[:, 2] <= bottom + 0.1]
    distance, _ = support.tree.query(bottom_points)
    return float(np.median(distance))


def find_things_on(support: MapObject, things: Iterable[MapObject], supports: Sequence[MapObject]) -> list[MapObject]:
    """Return those of some things that stand on an object, and on none of the other supports rather."""
    return [
        thing for thing in things if (found := find_support(thing, supports)) is not None and found.id == support.id
    ]


def hangs_above(thing: MapObject, anchor: MapObject) -> bool:
    """Return whether an object is over another, off the floor, most of it higher than the other's top."""
    if thing.id == anchor.id or thing.bounds[0, 2] < 0.3 or rests_on(thing, anchor):
        return False
    higher = thing.bounds[0, 2] >= anchor.bounds[1, 2] - HANGS and thing.center[2] > anchor.center[2]
    if not higher:
        return False
    distance, _ = cKDTree(anchor.points[:, :2]).query(thing.center[:2])
    return bool(distance <= 0.35)


def is_beside(thing: MapObject, anchor: MapObject, reach: float = BESIDE) -> bool:
    """Return whether two objects stand next to each other: near, and at heights that overlap."""
    overlap = min(thing.bounds[1, 2], anchor.bounds[1, 2]) - max(thing.bounds[0, 2], anchor.bounds[0, 2])
    return bool(
        thing.id != anchor.id and overlap > 0 and measure_gap(thing, anchor) <= reach and not rests_on(thing, anchor)
    )


def find_around(things: Iterable[MapObject], anchor: MapObject, reach: float = AROUND) -> list[MapObject]:
    """Return those of some things that are within reach of an object, by id."""
    return [thing for thing in things if thing.id != anchor.id and measure_gap(thing, anchor) <= reach]


def find_nearest(
    thing: MapObject, candidates: Iterable[MapObject], reach: float = NEAREST
) -> tuple[MapObject, float] | None:
    """Return the candidate nearest to an object, and the metres between them; None where none is within reach."""
    near = [(measure_gap(thing, other), other.id, other) for other in candidates if other.id != thing.id]
    near = [entry for entry in near if entry[0] <= reach]
    if not near:
        return None
    gap, _, found = min(near, key=lambda entry: entry[:2])
    return found, gap


def find_side(anchor: MapObject, thing: MapObject, viewer: NDArray[np.float64]) -> str:
    """Return "left" or "right": the side of an anchor that an object is on for someone at `viewer` who faces it."""
    ahead, across = anchor.center[:2] - viewer[:2], thing.center[:2] - viewer[:2]
    return "left" if ahead[0] * across[1] - ahead[1] * across[0] > 0 else "right"


def find_front(anchor: MapObject, grid: OccupancyGrid, reach: float = 1.0) -> NDArray[np.float64]:
    """Return the place, float64 [2], in the middle of the free floor before an object: where one who faces it stands.

    Furniture stands with its back to a wall, so that the floor around it is free in front.
    """
    cells = np.argwhere(grid.free & ~grid.occupied)
    points = grid.to_points(cells)
    low, high = anchor.box[0, :2] - reach, anchor.box[1, :2] + reach
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    if not len(points):
        return np.asarray(anchor.center[:2])
    distance, _ = cKDTree(anchor.points[:, :2]).query(points)
    room = grid.find_room(anchor.points)
    close = points[(distance <= reach) & (distance > 0.1)]
    inside = close[[room in (0, grid.find_room(point[None])) for point in close]] if len(close) else close
    return np.asarray(inside.mean(axis=0)) if len(inside) else np.asarray(anchor.center[:2])


def group_by_room(things: Iterable[MapObject], grid: OccupancyGrid) -> dict[int, list[MapObject]]:
    """Return objects by the room of the grid that they are in, 0 for none; rooms in ascending order."""
    groups: dict[int, list[MapObject]] = {}
    for thing in things:
        groups.setdefault(grid.find_room(thing.points), []).append(thing)
    return dict(sorted(groups.items()))


def share_room(one: MapObject, other: MapObject, grid: OccupancyGrid) -> bool:
    """Return whether two objects are in the same room, as far as it is known."""
    room = grid.find_room(one.points)
    return room != 0 and room == grid.find_room(other.points)
