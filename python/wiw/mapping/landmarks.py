# SPDX-License-Identifier: Apache-2.0
"""Landmarks: objects and openings within sight that an agent may choose to go to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.object_map import ObjectMap
from wiw.mapping.openings import Opening
from wiw.mapping.views import VIEW_NAMES, VIEW_YAWS_DEG, Views

VISITED = 1.2
"""Metres within which the agent has visited a landmark."""
NEVER_VISITED = frozenset({"opening", "door", "passage", "stairs"})
"""Categories that stay landmarks, however close the agent has been: they lead on."""
OPENING_HEIGHT = (0.05, 1.9)
"""Metres above the floor between which an opening is marked."""
LEAST_SHARE = 0.002
"""Share of a view that a landmark fills at least, in one of them."""
OPENING_IDS = 1_000_000
"""Landmarks' ids above this are those of openings."""
BESIDE = 0.8
"""Metres from the edge of an object within which the agent is beside it: less than `VISITED`, whichever side it is."""
BEHIND = 0.6
"""Metres behind an opening to which a way through it leads."""
_SLACK = 0.15


@dataclass(frozen=True)
class Landmark:
    """Something within sight."""

    id: int
    """Id of the object in the map; of an opening, its number plus `OPENING_IDS`."""
    category: str
    position: NDArray[np.float64]
    """float64 [3] in the frame of the start."""
    masks: Mapping[int, NDArray[np.bool_]]
    """Its pixels, bool [H, W], by number of the view; only views that show it."""
    distance: float
    """Horizontal metres from the agent to its nearest point."""
    radius: float = 0.25
    """Metres around `destination` within which a way to it ends."""
    behind: NDArray[np.float64] | None = None
    """float64 [2]: a place on the other side of an opening; None for objects."""

    @property
    def destination(self) -> NDArray[np.float64]:
        """float64 [2]: where a way to it leads, up to an object or through an opening."""
        return self.position[:2] if self.behind is None else self.behind

    @property
    def view(self) -> int:
        """Number of the view that shows most of it."""
        return max(sorted(self.masks), key=lambda view: int(self.masks[view].sum()))


@dataclass
class LandmarkFinder:
    """Finds the landmarks of each observation, and remembers those that were visited."""

    visited: set[int] = field(default_factory=set)

    def find(
        self, views: Views, owners: NDArray[np.int32], objects: ObjectMap, openings: Sequence[Opening]
    ) -> tuple[Landmark, ...]:
        """Return the landmarks within sight that were not visited, by id.

        Args:
            views: of the observation.
            owners: the object of each pixel, as `objects.add(views, ...)` has returned it.
            objects: the map.
            openings: those of the grid.
        """
        found = [*_find_objects(views, owners, objects), *_find_openings(views, openings)]
        self.visited |= {mark.id for mark in found if mark.distance <= VISITED and mark.category not in NEVER_VISITED}
        return tuple(mark for mark in found if mark.id not in self.visited)


def _find_objects(views: Views, owners: NDArray[np.int32], objects: ObjectMap) -> list[Landmark]:
    least = LEAST_SHARE * views.size[0] * views.size[1]
    counts = np.stack([np.bincount(view.ravel(), minlength=int(owners.max()) + 1) for view in owners])
    found = []
    for number in np.flatnonzero((counts >= least).any(axis=0)).tolist():
        if number == 0 or number not in objects:
            continue
        thing = objects[number]
        masks = {view: owners[view] == number for view in range(len(VIEW_NAMES)) if counts[view, number]}
        away = float(np.linalg.norm(thing.points[:, :2] - views.odometry[:2], axis=1).min())
        radius = float(thing.extent[:2].min()) / 2 + BESIDE
        found.append(Landmark(number, thing.category, thing.center, masks, away, radius))
    return found


def _find_openings(views: Views, openings: Sequence[Opening]) -> list[Landmark]:
    least = LEAST_SHARE * views.size[0] * views.size[1]
    found = []
    for opening in openings:
        masks = {}
        for view in range(len(VIEW_NAMES)):
            mask = draw_opening(views, view, opening)
            if int(mask.sum()) >= least:
                masks[view] = mask
        if masks:
            position = np.array([*opening.position, sum(OPENING_HEIGHT) / 2])
            away = float(np.linalg.norm(opening.position - views.odometry[:2]))
            behind = find_place_behind(opening, views.odometry)
            found.append(Landmark(OPENING_IDS + opening.id, "opening", position, masks, away, behind=behind))
    return found


def find_place_behind(opening: Opening, odometry: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the place `BEHIND` metres from the middle of an opening, on the side where the agent is not."""
    along = opening.edges[1] - opening.edges[0]
    normal = np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    away = opening.position - odometry[:2]
    if abs(float(normal @ away)) < _SLACK:  # the agent stands in it: the way that it is heading
        away = np.array([np.cos(odometry[2]), np.sin(odometry[2])])
    return np.asarray(opening.position + np.copysign(BEHIND, normal @ away) * normal)


def draw_opening(views: Views, view: int, opening: Opening) -> NDArray[np.bool_]:
    """Return the pixels of a view whose rays go through an opening, with nothing before it: bool [H, W]."""
    height, width = views.size
    heading = views.odometry[2] + np.radians(VIEW_YAWS_DEG[view])
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    ends = opening.edges - views.odometry[:2]
    forward, side = ends @ ahead, ends @ left
    slope = -(np.arange(width) + 0.5 - width / 2.0) / views.focal  # metres to the left per metre ahead
    rise = (height / 2.0 - np.arange(height) - 0.5) / views.focal
    along = (side[1] - side[0]) - slope * (forward[1] - forward[0])
    share = (slope * forward[0] - side[0]) / np.where(np.abs(along) < 1e-9, np.inf, along)
    depth = forward[0] + share * (forward[1] - forward[0])
    through = (np.abs(along) >= 1e-9) & (share >= 0) & (share <= 1) & (depth > 0.05)
    level = views.T_start_camera[view, 2, 3] + rise[:, None] * depth
    inside = (level > OPENING_HEIGHT[0]) & (level < OPENING_HEIGHT[1])
    return through & inside & (views.depth[view] > depth - _SLACK)
