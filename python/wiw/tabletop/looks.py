# SPDX-License-Identifier: Apache-2.0
"""What an articulation looks like: a painted mesh for each of its links."""

from __future__ import annotations

from functools import cache

import numpy as np

from wiw.physics import Articulation
from wiw.tabletop.shapes import Mesh, joined, mesh_of, painted


@cache
def looks_of(robot: Articulation) -> tuple[tuple[int, Mesh], ...]:
    """(link, mesh in the link's frame) of every link that is seen; primitives have their edges broken."""
    parts: dict[int, list[tuple[Mesh, np.ndarray]]] = {}
    for each in robot.visuals:
        mesh = painted(mesh_of(each["shape"], rounded=True), each["color"])
        parts.setdefault(each["link"], []).append((mesh, each["T_link_visual"]))
    return tuple((link, joined(meshes)) for link, meshes in parts.items())
