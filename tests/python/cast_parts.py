# SPDX-License-Identifier: Apache-2.0
"""Looks of textured parts, by trimesh's Embree and NumPy alone: an oracle for readers and renderers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

SIZE, HFOV = (96, 96), np.pi / 2


@dataclass
class Part:
    """Triangles in the world with a texture on them, as bright as it is."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    uv: NDArray[np.float64]
    image: NDArray[np.uint8]
    wrap: tuple[str, str] = ("repeat", "repeat")
    nearest: bool = False


def cast_parts(parts: list[Part], eye: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return colour [H, W, 3] and part [H, W] that a camera at `eye` sees along -z.

    Parts count from 1; 0 is where nothing is. Textures are read bilinearly, or at the nearest texel, from their largest
    level.
    """
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    scale = 2 * np.tan(HFOV / 2) / SIZE[1]
    rays = np.stack([(x - SIZE[1] / 2) * scale, (SIZE[0] / 2 - y) * scale, -np.ones_like(x)], axis=-1).reshape(-1, 3)
    first = np.cumsum([0] + [len(part.vertices) for part in parts])
    number = np.concatenate([np.full(len(part.triangles), i) for i, part in enumerate(parts)])
    triangles = np.concatenate([part.triangles + first[i] for i, part in enumerate(parts)])
    mesh = trimesh.Trimesh(np.concatenate([part.vertices for part in parts]), triangles, process=False)
    points, ray, face = mesh.ray.intersects_location(np.tile(eye, (len(rays), 1)), rays, multiple_hits=False)
    color, seen = np.zeros((len(rays), 3)), np.zeros(len(rays), np.int64)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[face], points)
    uv = np.einsum("nc,ncx->nx", weights, np.concatenate([part.uv for part in parts])[triangles[face]])
    for i, part in enumerate(parts):
        mine = number[face] == i
        seen[ray[mine]] = i + 1
        color[ray[mine]] = sample(part, uv[mine])
    return color.reshape(*SIZE, 3), seen.reshape(SIZE)


def sample(part: Part, uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colours [N, 3] of a part's texture."""
    height, width = part.image.shape[:2]
    place = uv * (width, height) - 0.5
    if part.nearest:
        place = np.round(place)
    low = np.floor(place).astype(int)
    share = place - low
    color = np.zeros((len(uv), 3))
    for dx in (0, 1):
        for dy in (0, 1):
            column = wrapped(low[:, 0] + dx, width, part.wrap[0])
            row = wrapped(low[:, 1] + dy, height, part.wrap[1])
            weight = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1])
            color += weight[:, None] * part.image[row, column, :3]
    return color


def wrapped(texel: NDArray[np.int64], size: int, how: str) -> NDArray[np.int64]:
    """Return the texels of an endless row that stand in for those beyond a texture's edges."""
    if how == "clamp":
        return texel.clip(0, size - 1)
    inside = texel % (2 * size if how == "mirror" else size)
    return np.minimum(inside, 2 * size - 1 - inside) if how == "mirror" else inside
