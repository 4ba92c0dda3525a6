# SPDX-License-Identifier: Apache-2.0
"""Procedural textured apartment for the rendering benchmark: the same arrays for every renderer.

Twenty rooms with doorways and some 40 objects each, every surface a grid of quads whose fineness sets the triangle
count. One atlas texture, one lightmap. Y up, metres, both faces of every triangle count.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROOM, HEIGHT, ROOMS_X, ROOMS_Z = 4.0, 2.7, 5, 4
CELLS = 8  # the atlas has CELLS x CELLS swatches
ATLAS_SIDE, LIGHTMAP_SIDE = 2048, 1024


@dataclass
class Arrays:
    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    light_uv: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    vertex_start: NDArray[np.int64]
    """[objects + 1]: vertices of object i are vertex_start[i]:vertex_start[i + 1]."""
    triangle_start: NDArray[np.int64]
    atlas: NDArray[np.uint8]
    lightmap: NDArray[np.uint8]
    views: NDArray[np.float64]
    """[8, 4, 4] T_world_camera."""


class _Mesh:
    """Grids of quads gathered into objects."""

    def __init__(self, fineness: float, rng: np.random.Generator) -> None:
        self.fineness, self.rng = fineness, rng
        self.parts: list[tuple[NDArray, ...]] = []
        self.objects: list[tuple[int, int]] = []
        self.vertices = self.triangles = 0

    def finish_object(self) -> None:
        self.objects.append((self.vertices, self.triangles))

    def grid(self, points: NDArray, normals: NDArray) -> None:
        """points, normals [n, m, 3]: one smooth sheet with its own swatch and patch of light."""
        n, m = points.shape[:2]
        s, t = np.meshgrid(np.linspace(0.02, 0.98, n), np.linspace(0.02, 0.98, m), indexing="ij")
        st = np.stack([s, t], -1).reshape(-1, 2)
        uv = (self.rng.integers(0, CELLS, 2) + st) / CELLS
        light_uv = (self.rng.integers(0, 32, 2) + st) / 32
        i = np.arange(n * m).reshape(n, m)
        a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
        faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]) + self.vertices
        self.parts.append((points.reshape(-1, 3), normals.reshape(-1, 3), uv, light_uv, faces))
        self.vertices += n * m
        self.triangles += len(faces)

    def steps(self, extent: float) -> int:
        return 1 + max(1, round(self.fineness * extent))

    def panel(self, corner: NDArray, across: NDArray, along: NDArray) -> None:
        s = np.linspace(0, 1, self.steps(float(np.linalg.norm(across))))[:, None, None]
        t = np.linspace(0, 1, self.steps(float(np.linalg.norm(along))))[None, :, None]
        points = corner + s * across + t * along
        normal = np.cross(across, along)
        self.grid(points, np.broadcast_to(normal / np.linalg.norm(normal), points.shape))

    def box(self, center: NDArray, size: NDArray) -> None:
        x, y, z = np.diag(np.asarray(size, float))
        low = np.asarray(center) - (x + y + z) / 2
        for corner, across, along in ((low, z, y), (low + x, y, z), (low, x, z), (low + y, z, x), (low, y, x),
                                      (low + z, x, y)):  # fmt: skip
            self.panel(corner, across, along)

    def turned(self, base: NDArray, profile: NDArray) -> None:
        """Surface of revolution; profile [k, 2] of radius and height."""
        turns = self.steps(2.5 * 2 * np.pi * float(profile[:, 0].max())) + 3
        levels = self.steps(2.5 * float(np.linalg.norm(np.diff(profile, axis=0), axis=1).sum())) + 1
        at = np.linspace(0, len(profile) - 1, levels)
        radius = np.interp(at, np.arange(len(profile)), profile[:, 0])[None, :]
        height = np.interp(at, np.arange(len(profile)), profile[:, 1])[None, :]
        angle = np.linspace(0, 2 * np.pi, turns)[:, None]
        points = np.stack([radius * np.cos(angle), height + 0 * angle, radius * np.sin(angle)], -1) + base
        normals = np.stack([np.cos(angle) + 0 * radius, 0.2 + 0 * radius * angle, np.sin(angle) + 0 * radius], -1)
        self.grid(points, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _room_shell(mesh: _Mesh, x0: float, z0: float) -> None:
    x, y, z = np.eye(3)
    origin = np.array([x0, 0.0, z0])
    mesh.panel(origin, ROOM * z, ROOM * x)
    mesh.finish_object()
    mesh.panel(origin + HEIGHT * y, ROOM * x, ROOM * z)
    mesh.finish_object()
    for along, out in ((x, z), (z, x)):  # a wall with a doorway of 1 x 2.1 m in its middle, 12 cm thick
        for offset, length, low, high in ((0.0, 1.5, 0.0, HEIGHT), (2.5, 1.5, 0.0, HEIGHT), (1.5, 1.0, 2.1, HEIGHT)):
            center = origin + (offset + length / 2) * along + (low + high) / 2 * y
            mesh.box(center, np.abs(length * along + (high - low) * y + 0.12 * out))
        mesh.finish_object()


def _furnish(mesh: _Mesh, x0: float, z0: float) -> None:
    rng = mesh.rng
    for _ in range(6):  # tables, beds, shelves: a top, legs, things on top
        center = np.array([x0 + rng.uniform(0.6, 3.4), 0, z0 + rng.uniform(0.6, 3.4)])
        size = np.array([rng.uniform(0.5, 1.3), rng.uniform(0.35, 1.1), rng.uniform(0.4, 0.9)])
        mesh.box(center + size * [0, 1, 0], np.array([size[0], 0.05, size[2]]))
        for sx in (-0.45, 0.45):
            for sz in (-0.45, 0.45):
                mesh.box(center + size * [sx, 0.5, sz], np.array([0.05, size[1], 0.05]))
        mesh.finish_object()
        for _ in range(4):
            base = center + size * [rng.uniform(-0.4, 0.4), 1 + 0.025 / size[1], rng.uniform(-0.4, 0.4)]
            heights = np.linspace(0, rng.uniform(0.1, 0.35), 6)
            mesh.turned(base, np.stack([rng.uniform(0.02, 0.09, 6), heights], -1))
            mesh.finish_object()
    for _ in range(8):  # books and cushions
        center = np.array([x0, 0, z0]) + rng.uniform([0.3, 0.05, 0.3], [3.7, 1.6, 3.7])
        mesh.box(center, rng.uniform(0.05, 0.3, 3))
        mesh.finish_object()


def _build(fineness: float, seed: int) -> _Mesh:
    mesh = _Mesh(fineness, np.random.default_rng(seed))
    for i in range(ROOMS_X):
        for k in range(ROOMS_Z):
            _room_shell(mesh, i * ROOM, k * ROOM)
            _furnish(mesh, i * ROOM, k * ROOM)
    x, y, z = np.eye(3)  # the outer walls that rooms leave open
    mesh.panel(ROOMS_X * ROOM * x, ROOMS_Z * ROOM * z, HEIGHT * y)
    mesh.panel(ROOMS_Z * ROOM * z, ROOMS_X * ROOM * x, HEIGHT * y)
    mesh.finish_object()
    return mesh


def _textures(rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    cell = ATLAS_SIDE // CELLS
    atlas = np.empty((ATLAS_SIDE, ATLAS_SIDE, 3))
    y, x = np.mgrid[:cell, :cell] / cell
    for i in range(CELLS):
        for j in range(CELLS):
            stripes = 0.5 + 0.5 * np.sin(2 * np.pi * (rng.integers(0, 20) * x + rng.integers(0, 20) * y))
            grain = rng.normal(0, 0.06, (cell, cell))
            pattern = (stripes * rng.uniform(0, 0.4) + 0.6 + grain)[..., None]
            atlas[i * cell : (i + 1) * cell, j * cell : (j + 1) * cell] = pattern * rng.uniform(0.3, 1.0, 3)
    y, x = np.mgrid[:LIGHTMAP_SIDE, :LIGHTMAP_SIDE] / LIGHTMAP_SIDE
    light = 0.42 + 0.1 * np.sin(40 * x + 3 * y) * np.cos(33 * y)
    return ((255 * np.clip(image, 0, 1)).astype(np.uint8) for image in (atlas, np.repeat(light[..., None], 3, -1)))


def _views(rng: np.random.Generator, count: int = 8) -> NDArray[np.float64]:
    """Eye height 1.0 m in doorways and room corners, where furniture does not swallow the camera."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose in poses:
        room = rng.integers(0, [ROOMS_X - 1, ROOMS_Z - 1])
        yaw = rng.uniform(0, 2 * np.pi)
        pose[:3, 3] = [
            ROOM * room[0] + 2.0 + rng.uniform(-0.3, 0.3),
            1.0,
            ROOM * (room[1] + 1) + rng.uniform(-0.3, 0.3),
        ]
        pose[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    return poses


def make(triangles: int, seed: int = 7) -> Arrays:
    """About `triangles` triangles (within 3 %)."""
    low, high = 0.05, 200.0
    for _ in range(40):
        middle = (low * high) ** 0.5
        count = _build(middle, seed).triangles
        if abs(count / triangles - 1) < 0.03:
            break
        low, high = (middle, high) if count < triangles else (low, middle)
    mesh = _build(middle, seed)
    positions, normals, uv, light_uv, faces = (np.concatenate(column) for column in zip(*mesh.parts, strict=True))
    rng = np.random.default_rng(seed)
    atlas, lightmap = _textures(rng)
    starts = np.array([(0, 0), *mesh.objects])
    return Arrays(
        positions.astype(np.float32), normals.astype(np.float32), uv.astype(np.float32), light_uv.astype(np.float32),
        faces.astype(np.uint32), starts[:, 0], starts[:, 1], atlas, lightmap, _views(rng),
    )  # fmt: skip


def unordered(arrays: Arrays) -> Arrays:
    """One object whose triangles come in random order, as those of many scans do."""
    order = np.random.default_rng(0).permutation(len(arrays.triangles))
    ends = [np.array([0, count]) for count in (len(arrays.positions), len(arrays.triangles))]
    return replace(arrays, triangles=arrays.triangles[order], vertex_start=ends[0], triangle_start=ends[1])


def perspective_rays(size: tuple[int, int], hfov_deg: float) -> NDArray[np.float32]:
    """[H, W, 3] in the camera frame, planar depth 1."""
    height, width = size
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    x, y = (np.arange(width) + 0.5 - width / 2) / focal, (height / 2 - np.arange(height) - 0.5) / focal
    x, y = np.meshgrid(x, y)
    return np.stack([x, y, -np.ones_like(x)], -1).astype(np.float32)


def panorama_rays(size: tuple[int, int]) -> NDArray[np.float32]:
    """[H, W, 3] unit vectors in the camera frame."""
    height, width = size
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
    cos = np.cos(latitude)
    rays = (np.sin(longitude) * cos, np.sin(latitude) + 0 * longitude, -np.cos(longitude) * cos)
    return np.stack(rays, -1).astype(np.float32)


def save(arrays: Arrays, path: Path) -> None:
    np.savez(path, **{field.name: getattr(arrays, field.name) for field in fields(arrays)})


def load(path: Path) -> Arrays:
    with np.load(path) as file:
        return Arrays(**{field.name: file[field.name] for field in fields(Arrays)})


def to_scene(arrays: Arrays):
    """The same arrays as a `wiw` scene, one instance an object."""
    from wiw.scenes import Scene

    def rgba(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.concatenate([image, np.full((*image.shape[:2], 1), 255, np.uint8)], -1)

    meshes = []
    for i in range(len(arrays.vertex_start) - 1):
        vertices = slice(arrays.vertex_start[i], arrays.vertex_start[i + 1])
        faces = arrays.triangles[arrays.triangle_start[i] : arrays.triangle_start[i + 1]] - arrays.vertex_start[i]
        meshes.append({
            "positions": arrays.positions[vertices], "uv": arrays.uv[vertices],
            "lightmap_uv": arrays.light_uv[vertices], "triangles": faces.astype(np.uint32),
            "material": 0, "lightmap": 1, "name": f"object {i + 1}", "category": "object",
        })  # fmt: skip
    return Scene.from_arrays(
        meshes, name="benchmark", textures=[rgba(arrays.atlas), rgba(arrays.lightmap)],
        materials=[{"name": "atlas", "texture": 0}],
    )  # fmt: skip
