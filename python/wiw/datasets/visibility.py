# SPDX-License-Identifier: Apache-2.0
"""Visibility of objects from a place, by rendering instance ids with and without occluders."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World

Size = tuple[int, int]

SIZE: Size = (288, 512)
"""Pixels of the panoramas that are counted."""
COARSE: Size = (108, 192)
"""The same where it is enough to know what is worth a closer look."""
LIFT = 100.0
"""Metres above the scene where an instance is looked at alone."""


def measure_sizes(world: World, points: NDArray[np.float64], size: Size = SIZE) -> NDArray[np.float64]:
    """Return the steradians that each instance fills from N places on the floor: float64 [N, 1 + instances] by id."""
    counted = np.zeros((len(points), len(world.scene.instances) + 1))
    for row, ids in enumerate(_panoramas(world, points, size)):
        counted[row] = np.bincount(ids.ravel(), _weights(size).ravel(), counted.shape[1])
    return counted


def measure_unoccluded_sizes(world: World, points: NDArray[np.float64], instance: int) -> NDArray[np.float64]:
    """Return the steradians that an instance would fill without occluders, from N places: float64 [N]."""
    if not len(points):
        return np.zeros(0)
    with _lift(world, instance):
        ids = _panoramas(world, np.add(points, [0.0, LIFT, 0.0]), SIZE)
    return ((ids == instance) * _weights(SIZE)).sum(axis=(1, 2))


def visible_fraction(world: World, point: NDArray[np.float64], instance: int) -> float:
    """Return the visible fraction of an instance from a place: 1 without occlusion."""
    places = np.asarray(point, np.float64)[None]
    whole = float(measure_unoccluded_sizes(world, places, instance)[0])
    return min(1.0, float(measure_sizes(world, places)[0, instance]) / whole) if whole else 0.0


def _panoramas(world: World, points: NDArray[np.float64], size: Size) -> NDArray[np.uint32]:
    poses = np.stack([camera_pose(point, 0.0) for point in points])
    return world.renderer.panorama(poses, size, outputs=("instance",))["instance"]


def _weights(size: Size) -> NDArray[np.float64]:
    """Return the steradians of each pixel, float64 [H, W]."""
    edges = np.sin(np.linspace(np.pi / 2, -np.pi / 2, size[0] + 1))
    return np.repeat(-np.diff(edges)[:, None] * 2 * np.pi / size[1], size[1], axis=1)


@contextmanager
def _lift(world: World, instance: int) -> Iterator[None]:
    """Move the instance high above the scene, where nothing occludes it."""
    home = np.asarray(world.scene.instances[instance - 1]["T_world_instance"], np.float64)
    away = home.copy()
    away[1, 3] += LIFT
    world.renderer.set_poses([instance], away[None])
    try:
        yield
    finally:
        world.renderer.set_poses([instance], home[None])
