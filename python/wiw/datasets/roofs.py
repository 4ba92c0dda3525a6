# SPDX-License-Identifier: Apache-2.0
"""Roofs: islands of a navigation mesh that lie on top of a building, where no agent is meant to walk.

A mesh with ceilings or a roof has walkable surface on them, and often more of it than there is free floor inside.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.nav import NavMesh
from wiw.render import Renderer

LEAST_AREA = 1.0
"""Square metres below which an island is not examined: nothing starts on it."""
PLACES = 64
"""Places of an island that are examined."""
STOREY = 1.0
"""Metres by which floor lies at least below a roof."""
COVERED = 0.25
"""Minimum share of a roof that has floor of another island below it; furniture and walls take much of the rest."""
OPEN = 0.5
"""Minimum share of a roof that has nothing above it."""
EYE = 0.5
"""Metres above the surface from which to look up."""
UPWARD = (16, 8)
"""Size of a panorama whose first row looks straight up, to 6 degrees."""


def find_roofs(navmesh: NavMesh, renderer: Renderer) -> frozenset[int]:
    """Return the islands that have floor of another island below them and nothing above.

    An upper storey is none, as there is a roof above it; neither is a terrace that can be walked to from inside.

    Args:
        navmesh: of the scene.
        renderer: of the scene.
    """
    found = set()
    if len(navmesh.islands) > 1:
        triangles, owners = (np.asarray(each) for each in navmesh.triangles())
        triangles = triangles.astype(np.float64)
        for index, island in enumerate(navmesh.islands):
            if island.area < LEAST_AREA:
                continue
            places = np.asarray(navmesh.sample(PLACES, 0, index), np.float64)
            covering = _has_floor_below(places, triangles[owners != index])
            if covering.mean() >= COVERED and _is_open_above(places, renderer).mean() >= OPEN:
                found.add(index)
    return frozenset(found)


def _has_floor_below(places: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether triangles [T, 3, 3] lie a storey below each place [N, 3]: bool [N]."""
    a, b, c = (triangles[:, corner][:, [0, 2]] for corner in range(3))
    lowest = triangles[:, :, 1].min(axis=1)
    found = np.zeros(len(places), bool)
    for number, place in enumerate(places):
        point = place[[0, 2]]
        sides = np.stack([_cross_product(q - p, point - p) for p, q in ((a, b), (b, c), (c, a))])
        inside = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
        found[number] = (inside & (lowest < place[1] - STOREY)).any()
    return found


def _cross_product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the cross products of vectors in the plane [N, 2]."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _is_open_above(places: NDArray[np.float64], renderer: Renderer) -> NDArray[np.bool_]:
    """Return whether nothing is drawn above each place [N, 3]: bool [N]."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = np.add(places, [0.0, EYE, 0.0])
    above = renderer.panorama(poses, UPWARD, outputs=("depth",))["depth"][:, 0]
    return np.asarray((above == 0).all(axis=1))
