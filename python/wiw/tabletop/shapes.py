# SPDX-License-Identifier: Apache-2.0
"""Meshes of simple shapes, as `Scene.from_arrays` takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.physics import Box, Capsule, ConvexHull, Cylinder, Sphere

AROUND = 48
"""Sides of a circle."""

Mesh = dict[str, NDArray[Any]]
"""positions float32 [V, 3], normals float32 [V, 3], triangles uint32 [T, 3]."""


def mesh_of(shape: Any) -> Mesh:
    """The surface of a shape of `wiw.physics`, with normals that show curves as curves and edges as edges.

    Raises:
        ArgumentError: another kind of thing.
    """
    if isinstance(shape, Box):
        return _box(np.asarray(shape.size))
    if isinstance(shape, Sphere):
        return _turned(*_arc(shape.radius, 0.0, 0.0))
    if isinstance(shape, Capsule):
        return _turned(*_arc(shape.radius, shape.length / 2, -shape.length / 2))
    if isinstance(shape, Cylinder):
        return _cylinder(shape.radius, shape.length / 2)
    if isinstance(shape, ConvexHull):
        return _hull(np.asarray(shape.points))
    raise ArgumentError(f"mesh_of: expected a shape of wiw.physics, got {type(shape).__name__}")


def joined(parts: list[tuple[Mesh, NDArray[np.float64]]]) -> Mesh:
    """One mesh of several, each with its pose [4, 4]."""
    positions, normals, triangles, count = [], [], [], 0
    for mesh, pose in parts:
        positions.append(mesh["positions"] @ pose[:3, :3].T + pose[:3, 3])
        normals.append(mesh["normals"] @ pose[:3, :3].T)
        triangles.append(mesh["triangles"] + np.uint32(count))
        count += len(mesh["positions"])
    return _mesh(np.concatenate(positions), np.concatenate(normals), np.concatenate(triangles))


def _mesh(positions: NDArray[Any], normals: NDArray[Any], triangles: NDArray[Any]) -> Mesh:
    return {
        "positions": np.ascontiguousarray(positions, np.float32),
        "normals": np.ascontiguousarray(normals, np.float32),
        "triangles": np.ascontiguousarray(triangles, np.uint32),
    }


def _box(size: NDArray[np.float64]) -> Mesh:
    """Six sides of four corners."""
    positions, normals = [], []
    for axis in range(3):
        for sign in (-1, 1):
            normal = sign * np.eye(3)[axis]
            along = np.eye(3)[(axis + 1) % 3]
            across = np.cross(normal, along)
            positions += [normal + u * along + v * across for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [normal] * 4
    first = 4 * np.arange(6)[:, None, None]
    halves = np.array([[0, 1, 2], [0, 2, 3]])
    return _mesh(np.array(positions) * size / 2, np.array(normals), (first + halves).reshape(-1, 3))


def _arc(radius: float, top: float, bottom: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Half a circle from the top down, drawn apart at the equator: points and normals [N, 2], (outward, up)."""
    angles = np.linspace(0, np.pi / 2, AROUND // 4 + 1)
    upper = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    normals = np.concatenate([upper, upper[::-1] * (1, -1)])
    lift = np.repeat([top, bottom], len(upper))
    return radius * normals + lift[:, None] * (0, 1), normals


def _turned(profile: NDArray[Any], normals: NDArray[Any]) -> Mesh:
    """A profile (distance from the axis, height), from the top down, turned about z."""
    angles = np.linspace(0, 2 * np.pi, AROUND + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    positions, outward = (
        np.concatenate(
            [values[:, None, :1] * circle, np.broadcast_to(values[:, None, 1:], (len(values), AROUND + 1, 1))], axis=-1
        )
        for values in (profile, normals)
    )
    row, column = np.mgrid[: len(profile) - 1, :AROUND]
    a = row * (AROUND + 1) + column
    b, c, d = a + 1, a + AROUND + 1, a + AROUND + 2
    triangles = np.stack([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)], axis=2).reshape(-1, 3)
    return _mesh(positions.reshape(-1, 3), outward.reshape(-1, 3), triangles)


def _cylinder(radius: float, half: float) -> Mesh:
    """Mantle and two lids, each with normals of its own."""
    lid = _turned(np.array([[0, half], [radius, half]]), np.array([[0.0, 1], [0, 1]]))
    mantle = _turned(np.array([[radius, half], [radius, -half]]), np.array([[1.0, 0], [1, 0]]))
    floor = _turned(np.array([[radius, -half], [0, -half]]), np.array([[0.0, -1], [0, -1]]))
    return joined([(part, np.eye(4)) for part in (lid, mantle, floor)])


def _hull(points: NDArray[np.float64]) -> Mesh:
    """Flat triangles."""
    from scipy.spatial import ConvexHull as Hull

    found = Hull(points)
    corners, normals = points[found.simplices], found.equations[:, None, :3].repeat(3, axis=1)
    inward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * normals[:, 0]).sum(-1) < 0
    corners[inward] = corners[inward, ::-1]
    return _mesh(corners.reshape(-1, 3), normals.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
