# SPDX-License-Identifier: Apache-2.0
"""Views of a scene's instances from many places, measured once for all its questions in coarse panoramas of ids."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.datasets.cameras import camera_pose
from wiw.datasets.questions.answers import Sight
from wiw.datasets.questions.facts import SceneTable
from wiw.datasets.worlds import World
from wiw.scenes import is_generated

HFOV = 105.0
"""Degrees of the views that a viewpoint is judged by, as those that an agent is shown."""
VIEW = (480, 560)
"""Their height and width; only the ratio matters here."""
YAWS = 16
"""Headings at each place."""
PANORAMA = (144, 256)
"""Pixels of the panoramas that are counted."""
_BATCH = 64


@dataclass(frozen=True, eq=False)
class Survey:
    """How large each instance looks from each of N places of one scene, and how far these are from each other."""

    points: NDArray[np.float64]
    """float64 [N, 3], on the floor of the agent's island."""
    shares: NDArray[np.float32]
    """float32 [N, YAWS, 1 + instances]: part of the view that each instance fills."""
    distances: NDArray[np.float64]
    """float64 [N, N] metres to walk."""

    @property
    def headings(self) -> NDArray[np.float64]:
        """Headings of the views in radians, float64 [YAWS]."""
        return _headings()

    def find_viewpoints(
        self, table: SceneTable, sight: Sight, share: float, counted: float, reach: float
    ) -> NDArray[np.bool_]:
        """Return from which places, with which headings, a sight is to be had: bool [N, YAWS].

        All things of the sight fill at least `share` of one view, and the first is within `reach` metres. Where things
        may lie around, each need fill no more than `counted` of some view, and the first fills `share` of this one, or
        as much of it as it can.
        """
        things = list(sight.things)
        if sight.around:
            best = self.shares[:, :, things].max(axis=1)
            toward = self.shares[:, :, things[0]]
            fit = (best >= counted).all(axis=1)[:, None] & (toward >= toward.max(axis=1, keepdims=True))
        else:
            fit = (self.shares[:, :, things] >= share).all(axis=2)
        if sight.room:
            room = next(room for room in table.rooms if room.name == sight.room)
            fit = fit & room.contains(self.points)[:, None]
        return fit & (self._distances_to(table, sight.things[0]) <= reach)[:, None]

    def _distances_to(self, table: SceneTable, instance: int) -> NDArray[np.float64]:
        """Return how far each place is from the bounds of an instance, straight and horizontally."""
        thing = next(each for each in table.things if each.id == instance)  # a table may lack instances
        gaps = np.maximum(0.0, np.maximum(thing.low - self.points, self.points - thing.high))
        return np.hypot(gaps[:, 0], gaps[:, 2])


def choose_places(world: World, count: int, key: int) -> NDArray[np.float64]:
    """Return about `count` places on the floor from which one can walk to most others, float64 [n, 3]."""
    points = world.ground.put_down(world.navmesh.sample(count, key, world.floor)).astype(np.float64)
    reached = np.isfinite(world.navmesh.distance_matrix(points))
    return points[reached[int(reached.sum(axis=1).argmax())]]


def survey(world: World, points: NDArray[np.float64]) -> Survey:
    """Return what is in view from some places."""
    distances = np.asarray(world.navmesh.distance_matrix(points), np.float64)
    shares = np.zeros((len(points), YAWS, len(world.scene.instances) + 1), np.float32)
    for start in range(0, len(points), _BATCH):
        poses = np.stack([camera_pose(point, 0.0) for point in points[start : start + _BATCH]])
        panoramas = world.renderer.panorama(poses, PANORAMA, outputs=("instance",))["instance"]
        for row, ids in enumerate(panoramas.reshape(len(poses), -1)):
            for yaw, (pixels, parts) in enumerate(_views()):
                shares[start + row, yaw] = np.bincount(ids[pixels], parts, shares.shape[2])
    return Survey(points, shares, distances)


def place_key(seed: int, scene: str) -> int:
    """Return the key that places of a scene are drawn with; of a file, whatever folder it is in."""
    name = scene if is_generated(scene) else Path(scene).name
    return core.fold_key([seed, 0xAE0A, *name.encode()])


def _headings() -> NDArray[np.float64]:
    return 2 * np.pi * np.arange(YAWS) / YAWS


@cache
def _views() -> tuple[tuple[NDArray[np.intp], NDArray[np.float64]], ...]:
    """Return for each heading the panorama's pixels that a view shows, and the part of the view each of them fills."""
    height, width = PANORAMA
    pitch = np.pi / 2 - (np.arange(height) + 0.5) * np.pi / height
    right = (np.arange(width) + 0.5) * 2 * np.pi / width - np.pi
    edges = np.sin(np.linspace(np.pi / 2, -np.pi / 2, height + 1))
    solid = -np.diff(edges)[:, None] * 2 * np.pi / width
    reach = np.tan(np.radians(HFOV / 2))
    tall = reach * VIEW[0] / VIEW[1]
    views = []
    for heading in _headings():
        turned = right[None] + heading
        ahead = np.cos(pitch)[:, None] * np.cos(turned)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.cos(pitch)[:, None] * np.sin(turned) / ahead
            y = np.sin(pitch)[:, None] / ahead
        inside = (ahead > 0) & (np.abs(x) <= reach) & (np.abs(y) <= tall)
        pixels = np.flatnonzero(inside)
        views.append((pixels, (solid / np.maximum(ahead, 1e-9) ** 3).ravel()[pixels] / (4 * reach * tall)))
    return tuple(views)
