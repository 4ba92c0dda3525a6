# SPDX-License-Identifier: Apache-2.0
"""Meshes of simple shapes, as input of `Scene.from_arrays`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError
from wiw.physics import Box, Capsule, ConvexHull, Cylinder, Sphere

CIRCLE_SEGMENTS = 32
"""Segments of a circle."""
EDGE_SEGMENTS = 2
"""Segments of a rounded edge."""

Mesh = dict[str, NDArray[Any]]
"""positions float32 [V, 3], normals float32 [V, 3], triangles uint32 [T, 3], and colors uint8 [V, 4] where coloured."""


def build_mesh(shape: Any, rounded: bool = False) -> Mesh:
    """Build the surface of a shape of `wiw.physics`, with smooth normals on curves and sharp ones at edges.

    Args:
        shape: a box, sphere, cylinder, capsule or convex hull.
        rounded: rounds the edges of boxes and cylinders, like those of moulded parts: by a sixth of the smallest
            dimension, a centimetre at most.

    Raises:
        ArgumentError: another type of object.
    """
    if isinstance(shape, Box):
        size = np.asarray(shape.size)
        return _build_rounded_box(size, _edge_radius(size.min())) if rounded else _build_box(size)
    if isinstance(shape, Sphere):
        return _revolve(*_build_arc(shape.radius, 0.0, 0.0))
    if isinstance(shape, Capsule):
        return _revolve(*_build_arc(shape.radius, shape.length / 2, -shape.length / 2))
    if isinstance(shape, Cylinder):
        edge = _edge_radius(min(2 * shape.radius, shape.length)) if rounded else 0.0
        return _build_cylinder(shape.radius, shape.length / 2, edge)
    if isinstance(shape, ConvexHull):
        return _build_hull(np.asarray(shape.points))
    raise ArgumentError(f"build_mesh: expected a shape of wiw.physics, got {type(shape).__name__}")


def paint_mesh(mesh: Mesh, colour: ArrayLike) -> Mesh:
    """Return the mesh with one colour, or one for each vertex: RGB or RGBA from 0 to 1, drawn opaque."""
    colors = np.full((len(mesh["positions"]), 4), 255, np.uint8)
    colors[:, :3] = np.clip(np.round(255 * np.asarray(colour, np.float64)[..., :3]), 0, 255)
    return {**mesh, "colors": colors}


def merge_meshes(parts: Sequence[tuple[Mesh, NDArray[np.float64]]]) -> Mesh:
    """Merge several meshes, each with its pose [4, 4]; either all of them have colours, or none."""
    positions, normals, triangles, count = [], [], [], 0
    for mesh, pose in parts:
        positions.append(mesh["positions"] @ pose[:3, :3].T + pose[:3, 3])
        normals.append(mesh["normals"] @ pose[:3, :3].T)
        triangles.append(mesh["triangles"] + np.uint32(count))
        count += len(mesh["positions"])
    whole = _pack_mesh(np.concatenate(positions), np.concatenate(normals), np.concatenate(triangles))
    if "colors" in parts[0][0]:
        whole["colors"] = np.concatenate([mesh["colors"] for mesh, _ in parts])
    return whole


def _pack_mesh(positions: NDArray[Any], normals: NDArray[Any], triangles: NDArray[Any]) -> Mesh:
    return {
        "positions": np.ascontiguousarray(positions, np.float32),
        "normals": np.ascontiguousarray(normals, np.float32),
        "triangles": np.ascontiguousarray(triangles, np.uint32),
    }


def _build_box(size: NDArray[np.float64]) -> Mesh:
    """Build six sides of four corners."""
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
    return _pack_mesh(np.array(positions) * size / 2, np.array(normals), (first + halves).reshape(-1, 3))


def _edge_radius(least: float) -> float:
    """Return the edge radius of a shape whose smallest dimension is `least` metres."""
    return min(0.01, least / 6)


def _build_rounded_box(size: NDArray[np.float64], edge: float) -> Mesh:
    """Build six sides whose outer strips bend around the edges, like a sphere with its octants pulled apart."""
    bend = np.tan(np.linspace(0, np.pi / 4, EDGE_SEGMENTS + 1))
    line, side = np.concatenate([-bend[::-1], bend]), np.repeat([-1.0, 1.0], EDGE_SEGMENTS + 1)
    row, column = np.mgrid[: len(line) - 1, : len(line) - 1]
    a = row * len(line) + column
    b, c, d = a + 1, a + len(line), a + len(line) + 1
    quads = np.stack([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)], axis=2).reshape(-1, 3)
    faces = []
    for axis in range(3):
        for sign in (-1, 1):
            outward, octant = np.full((2, len(line), len(line), 3), float(sign))
            for way, values in ((outward, line), (octant, side)):
                way[..., (axis + 1) % 3], way[..., (axis + 2) % 3] = values[:, None], sign * values
            normals = (outward / np.linalg.norm(outward, axis=-1, keepdims=True)).reshape(-1, 3)
            faces.append(_pack_mesh(octant.reshape(-1, 3) * (size / 2 - edge) + edge * normals, normals, quads))
    return merge_meshes([(face, np.eye(4)) for face in faces])


def _build_arc(radius: float, top: float, bottom: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a half circle from the top down, pulled apart at the equator: points and normals [N, 2], (outward, up)."""
    angles = np.linspace(0, np.pi / 2, CIRCLE_SEGMENTS // 4 + 1)
    upper = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    normals = np.concatenate([upper, upper[::-1] * (1, -1)])
    lift = np.repeat([top, bottom], len(upper))
    return radius * normals + lift[:, None] * (0, 1), normals


def _revolve(profile: NDArray[Any], normals: NDArray[Any]) -> Mesh:
    """Revolve a profile (distance from the axis, height), given from the top down, about z."""
    angles = np.linspace(0, 2 * np.pi, CIRCLE_SEGMENTS + 1)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    positions, outward = (
        np.concatenate(
            [values[:, None, :1] * circle, np.broadcast_to(values[:, None, 1:], (len(values), CIRCLE_SEGMENTS + 1, 1))],
            axis=-1,
        )
        for values in (profile, normals)
    )
    row, column = np.mgrid[: len(profile) - 1, :CIRCLE_SEGMENTS]
    a = row * (CIRCLE_SEGMENTS + 1) + column
    b, c, d = a + 1, a + CIRCLE_SEGMENTS + 1, a + CIRCLE_SEGMENTS + 2
    triangles = np.stack([np.stack([a, c, b], axis=-1), np.stack([b, c, d], axis=-1)], axis=2).reshape(-1, 3)
    return _pack_mesh(positions.reshape(-1, 3), outward.reshape(-1, 3), triangles)


def _build_cylinder(radius: float, half: float, edge: float = 0.0) -> Mesh:
    """Build mantle and two lids, each with its own normals, and rounded edges between them."""
    inner, low = radius - edge, half - edge
    lid = _revolve(np.array([[0, half], [inner, half]]), np.array([[0.0, 1], [0, 1]]))
    mantle = _revolve(np.array([[radius, low], [radius, -low]]), np.array([[1.0, 0], [1, 0]]))
    floor = _revolve(np.array([[inner, -half], [0, -half]]), np.array([[0.0, -1], [0, -1]]))
    parts = [lid, mantle, floor]
    if edge:
        angles = np.linspace(0, np.pi / 2, EDGE_SEGMENTS + 1)
        upper = np.stack([np.sin(angles), np.cos(angles)], axis=1)
        lower = upper[::-1] * (1, -1)
        parts += [_revolve((inner, low) + edge * upper, upper), _revolve((inner, -low) + edge * lower, lower)]
    return merge_meshes([(part, np.eye(4)) for part in parts])


def _build_hull(points: NDArray[np.float64]) -> Mesh:
    """Build the flat triangles of a convex hull."""
    from scipy.spatial import ConvexHull as Hull

    found = Hull(points)
    corners, normals = points[found.simplices], found.equations[:, None, :3].repeat(3, axis=1)
    inward = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * normals[:, 0]).sum(-1) < 0
    corners[inward] = corners[inward, ::-1]
    return _pack_mesh(corners.reshape(-1, 3), normals.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
