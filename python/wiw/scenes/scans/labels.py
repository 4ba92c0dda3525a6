# SPDX-License-Identifier: Apache-2.0
"""Carry labels from one mesh of a place over to another.

Datasets keep the mesh that is seen and the mesh that is labelled apart, with other triangles. Each triangle of the
former is sampled every few centimetres, and each sample has the label of the nearest labelled surface that faces the
same way or its opposite. A triangle whose samples disagree is cut into four, and so on down to a single sample.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import FileError

SPACING = 0.05
"""Most metres between samples; half of it is about how far a label may reach beyond its border."""
REACH = 0.25
"""Metres beyond which a surface has no label."""
TILT = 0.1
"""Metres that a right angle between two surfaces counts for, by the square root of two."""
FARTHEST = 1e7
"""Metres from the origin; beyond, a file is damaged."""
MOST_SAMPLES = 50_000_000
_MOST_PARTS = 400
"""Along the edge of one triangle: 20 m. Longer ones, which no room has, are sampled once and never cut."""
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Surface:
    """Triangles in the world, metres, Y up."""

    vertices: NDArray[np.float32]
    """float32 [V, 3]."""
    triangles: NDArray[np.uint32]
    """uint32 [T, 3]."""

    def corners(self) -> NDArray[np.float32]:
        """Return the corners of each triangle, float32 [T, 3, 3]."""
        return self.vertices[self.triangles]

    def normals(self) -> NDArray[np.float32]:
        """Return unit normals, float32 [T, 3]; zero for triangles without area."""
        corners = self.corners()
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True)
class Samples:
    """Points on a surface."""

    triangles: NDArray[np.int64]
    """int64 [N], the triangle of each."""
    weights: NDArray[np.float32]
    """float32 [N, 3], barycentric coordinates in it."""


@dataclass(frozen=True)
class Pieces:
    """A surface cut by its labels, as `Scene.relabelled` takes it."""

    triangles: NDArray[np.uint32]
    """uint32 [P]."""
    corners: NDArray[np.float32]
    """float32 [P, 3, 3], barycentric."""
    labels: NDArray[np.int64]
    """int64 [P]; -1 where no labelled surface is near."""


@cache
def _parts(count: int) -> NDArray[np.float32]:
    """Return the corners, float32 [count * count, 3, 3], of congruent parts of a triangle, `count` along an edge."""
    i, j = np.divmod(np.arange(count * count), count)
    upright = i + j < count
    i, j = np.where(upright, i, count - i), np.where(upright, j, count - 1 - j)
    steps = np.array([[[0, 0], [1, 0], [0, 1]], [[0, 0], [0, 1], [-1, 1]]])[np.where(upright, 0, 1)]
    corners = (np.stack([i, j], axis=-1)[:, None] + steps) / count
    return np.concatenate([1 - corners.sum(axis=-1, keepdims=True), corners], axis=-1).astype(np.float32)


def _count_parts(corners: NDArray[np.float32], path: object) -> NDArray[np.int64]:
    """Return into how many parts, int64 [T], the edges of triangles [T, 3, 3] are cut."""
    edges = (corners - np.roll(corners, 1, axis=1)).astype(np.float64)
    longest = np.linalg.norm(edges, axis=-1).max(axis=1)
    parts = np.ceil(longest / SPACING)
    counts = np.where(parts > _MOST_PARTS, 1, parts.clip(1, _MOST_PARTS)).astype(np.int64)
    if (counts**2).sum() > MOST_SAMPLES:
        raise FileError(
            f"{path}: its surface is too large to be labelled: {longest.max():.0f} m along an edge (damaged?)"
        )
    return counts


def _groups(counts: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield triangles that are cut in the same way, some at a time."""
    for count in np.unique(counts):
        members = np.flatnonzero(counts == count)
        size = max(1, _CHUNK // int(count) ** 2)
        for start in range(0, len(members), size):
            yield int(count), members[start : start + size]


def sample(surface: Surface, path: object) -> Samples:
    """Return points on a surface: centres of parts of its triangles, none longer than `SPACING`.

    Raises:
        FileError: the surface is too large; names `path`.
    """
    if not (np.abs(surface.vertices) <= FARTHEST).all():
        raise FileError(f"{path}: a vertex lies more than {FARTHEST:.0f} m from the origin (damaged file?)")
    triangles, weights = [], []
    for count, members in _groups(_count_parts(surface.corners(), path)):
        triangles.append(np.repeat(members, count**2))
        weights.append(np.tile(_parts(count).mean(axis=1), (len(members), 1)))
    return Samples(np.concatenate(triangles), np.concatenate(weights))


def _features(points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.floating[Any]]:
    """Return coordinates in which distances also count the angle between surfaces, whichever side they show."""
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    products = [TILT * np.sqrt(1.0 if i == j else 2.0) * normals[:, i] * normals[:, j] for i, j in pairs]
    return np.concatenate([points, np.stack(products, axis=-1)], axis=-1)


class LabelledSurface:
    """Labels in space: those of the nearest sample of a labelled mesh."""

    def __init__(self, surface: Surface, samples: Samples, labels: NDArray[np.int64]) -> None:
        """Keep `labels` int64 [N], one for each of the samples of `surface`."""
        from scipy.spatial import cKDTree

        self._points = np.einsum("nc,ncx->nx", samples.weights, surface.corners()[samples.triangles])
        self._tree = cKDTree(_features(self._points, surface.normals()[samples.triangles]))
        self._labels = labels

    def find(self, points: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the labels int64 [N] at points [N, 3] of surfaces with unit normals [N, 3]; -1 beyond `REACH`."""
        reach = float(np.hypot(REACH, np.sqrt(2) * TILT))
        _, nearest = self._tree.query(_features(points, normals), distance_upper_bound=reach, workers=-1)
        found = nearest < len(self._labels)
        nearest = np.where(found, nearest, 0)
        found &= ((self._points[nearest] - points) ** 2).sum(axis=1) <= REACH**2
        return np.where(found, self._labels[nearest], -1)


def transfer_labels(surface: Surface, labelled: LabelledSurface, path: object) -> Pieces:
    """Cut a surface so that each piece has the label of the labelled surface where it lies.

    Raises:
        FileError: the surface is too large; names `path`.
    """
    triangles = np.arange(len(surface.triangles), dtype=np.uint32)
    corners = np.tile(np.eye(3, dtype=np.float32), (len(triangles), 1, 1))
    normals = surface.normals()
    done: list[Pieces] = []
    while len(triangles):
        places = np.einsum("pij,pjx->pix", corners, surface.corners()[triangles])
        labels, agreed = np.empty(len(triangles), np.int64), np.empty(len(triangles), bool)
        for count, members in _groups(_count_parts(places, path)):
            points = np.einsum("pc,tcx->tpx", _parts(count).mean(axis=1), places[members])
            facing = np.repeat(normals[triangles[members]], count**2, axis=0)
            found = labelled.find(points.reshape(-1, 3), facing).reshape(len(members), -1)
            labels[members], agreed[members] = found[:, 0], (found == found[:, :1]).all(axis=1)
        done.append(Pieces(triangles[agreed], corners[agreed], labels[agreed]))
        quarters = np.einsum("qij,pjk->pqik", _parts(2), corners[~agreed])
        triangles, corners = np.repeat(triangles[~agreed], 4), quarters.reshape(-1, 3, 3)
    return Pieces(
        np.concatenate([pieces.triangles for pieces in done]),
        np.concatenate([pieces.corners for pieces in done]),
        np.concatenate([pieces.labels for pieces in done]),
    )


def unlabelled_share(surface: Surface, pieces: Pieces) -> float:
    """Return the share of a surface, 0 to 1, that has no label."""
    corners = np.einsum("pij,pjx->pix", pieces.corners, surface.corners()[pieces.triangles])
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return float(areas[pieces.labels < 0].sum() / max(areas.sum(), 1e-12))
