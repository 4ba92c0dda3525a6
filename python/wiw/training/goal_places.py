# SPDX-License-Identifier: Apache-2.0
"""Training data of the navigator: places of a scene as seen, and the paths between them.

A goal view is a part of the panorama at the goal, so any two places of a scene are an example, at any heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw._core import core
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.policies.navigator.bands import BAND_ROWS, PANORAMA, WIDTH

DRAWN = (288, 512)
"""Pixels of the panoramas that are drawn, to be shrunk."""
AHEAD = 1.0
"""Metres along the shortest path at which its bearing is taken."""
TRIES = 8
"""Candidates for each place near another."""
DEPTH_ROWS = slice(12, 52)
"""Rows of a 64-row panorama whose median depth is how far one sees in a column."""
SIGHT_MARGIN = 0.3
"""Metres in front of a place where what is seen hides it no longer."""


@dataclass(frozen=True)
class PlaceRules:
    """How a scene is sampled. Lengths in metres."""

    anchors: int = 24
    """Places all over the scene."""
    neighbours: int = 3
    """Maximum number of places near each of these."""
    reach: float = 2.0
    """Greatest distance of the near ones."""


@dataclass(frozen=True)
class GoalPlaces:
    """N places of a scene, all looked at in the same direction."""

    bands: NDArray[np.uint8]
    """uint8 [N, 32, 128, 3]: the middle rows of panoramas, latitudes within 45 degrees."""
    depths: NDArray[np.float16]
    """float16 [N, 128]: median metres seen in each column."""
    distances: NDArray[np.float16]
    """float16 [N, N]: metres of the shortest path from place i to place j, inf if there is none."""
    bearings: NDArray[np.float16]
    """float16 [N, N]: azimuth at place i of the path to place j a metre on, in radians, left positive; 0 where none."""
    visible: NDArray[np.bool_]
    """bool [N, N]: whether the camera at place j would be seen from place i."""

    def __len__(self) -> int:
        return len(self.bands)


def record_goal_places(world: World, seed: int, rules: PlaceRules = PlaceRules()) -> GoalPlaces:
    """Record the places of a scene; a pure function of (scene, seed, rules)."""
    points = _choose_points(world, core.fold_key([seed, 0x4C30]), rules)
    poses = np.stack([camera_pose(point, 0.0) for point in points])
    color = world.renderer.panorama(poses, DRAWN, outputs=("color",))["color"]
    depth = world.renderer.panorama(poses, PANORAMA, outputs=("depth",))["depth"]
    return GoalPlaces(
        bands=panorama.resize(color, PANORAMA)[:, BAND_ROWS],
        depths=np.median(depth[:, DEPTH_ROWS], axis=1).astype(np.float16),
        distances=world.navmesh.distance_matrix(points).astype(np.float16),
        bearings=_measure_bearings(world, points).astype(np.float16),
        visible=_find_visible(points, depth),
    )


def _choose_points(world: World, key: int, rules: PlaceRules) -> NDArray[np.float64]:
    """Choose places all over the scene, and places near each: float64 [N, 3] on the floor that is drawn."""
    anchors = world.navmesh.sample(rules.anchors, key, world.floor).astype(np.float64)
    draws = core.uniform(core.fold_key([key, 1]), 2 * len(anchors) * TRIES).reshape(len(anchors), TRIES, 2)
    radius, angle = rules.reach * np.sqrt(draws[..., 0]), 2 * np.pi * draws[..., 1]
    offsets = np.stack([radius * np.cos(angle), np.zeros_like(radius), radius * np.sin(angle)], axis=-1)
    points = [anchors]
    for anchor, candidates in zip(anchors, anchors[:, None] + offsets, strict=True):
        usable = candidates[world.navmesh.is_navigable(candidates)]
        near = world.navmesh.geodesic_distance(usable, anchor) <= 2 * rules.reach if len(usable) else []
        points.append(usable[near][: rules.neighbours])
    return world.ground.put_down(np.concatenate(points)).astype(np.float64)


def _measure_bearings(world: World, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the azimuth of each path a metre on, or of its end where it is shorter: float64 [N, N]."""
    bearings = np.zeros((len(points), len(points)))
    reachable = np.isfinite(world.navmesh.distance_matrix(points))
    for i, j in np.argwhere(reachable & ~np.eye(len(points), dtype=bool)):
        bends = np.asarray(world.navmesh.shortest_path(points[i], points[j]), np.float64)
        walked = np.concatenate([[0.0], np.hypot(*np.diff(bends[:, [0, 2]], axis=0).T).cumsum()])
        x, z = (np.interp(AHEAD, walked, bends[:, axis]) - bends[0, axis] for axis in (0, 2))
        bearings[i, j] = np.arctan2(-x, -z)
    return bearings


def _find_visible(points: NDArray[np.float64], depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return from which places i the cameras j would be seen, by depth panoramas float32 [N, H, W]: bool [N, N]."""
    away = points[None] - points[:, None]
    metres = np.linalg.norm(away, axis=2)
    height = depth.shape[1]
    column = ((0.5 - np.arctan2(-away[..., 0], -away[..., 2]) / (2 * np.pi)) * WIDTH).astype(np.intp) % WIDTH
    horizon = depth[:, height // 2 - 1 : height // 2 + 1]
    seen = np.where(horizon > 0, horizon, np.inf).max(axis=1)
    return np.take_along_axis(seen, column, axis=1) > metres - SIGHT_MARGIN


def require_places(parts: Sequence[GoalPlaces]) -> Sequence[GoalPlaces]:
    """Return the scenes in which one can walk from a place to another.

    Raises:
        ArgumentError: there is none.
    """
    usable = [part for part in parts if np.isfinite(part.distances).sum() > len(part)]  # each is 0 m from itself
    if not usable:
        raise ArgumentError(
            "expected scenes in which an agent can walk from one place to another, got none; choose others"
        )
    return usable
