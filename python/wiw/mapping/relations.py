# SPDX-License-Identifier: Apache-2.0
"""Spatial relations of mapped objects: on, above, beside, around, in one room.

Boxes are along the axes of the frame of the start, which need not be those of the walls; what touches is therefore
measured between voxels wherever an oblique box would mislead.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
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


def share_room(one: MapObject, other: MapObject, grid: OccupancyGrid) -> bool:
    """Return whether two objects are in the same room, as far as it is known."""
    room = grid.find_room(one.points)
    return room != 0 and room == grid.find_room(other.points)
