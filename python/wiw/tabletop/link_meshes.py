# SPDX-License-Identifier: Apache-2.0
"""The visible surface of an articulation: a coloured mesh for each of its links."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import Articulation, read_surface
from wiw.tabletop.shapes import Mesh, build_mesh, merge_meshes, paint_mesh

LinkMeshes = tuple[tuple[int, Mesh], ...]
"""(link, mesh in the link's frame) of every visible link."""
CACHED_ROBOTS = 64
"""Articulations whose meshes are kept, those used last."""


@lru_cache(CACHED_ROBOTS)
def build_link_meshes(robot: Articulation) -> LinkMeshes:
    """Return (link, mesh in the link's frame) for every visible link; primitives get rounded edges.

    Raises:
        FileError: a mesh file is missing or damaged; the message names the link.
    """
    parts: dict[int, list[tuple[Mesh, NDArray[np.float64]]]] = {}
    for each in robot.visuals:
        mesh = _mesh_from_file(each, robot) if each["shape"] is None else _mesh_from_shape(each)
        parts.setdefault(each["link"], []).append((mesh, each["T_link_visual"]))
    return tuple((link, merge_meshes(meshes)) for link, meshes in parts.items())


def _mesh_from_shape(visual: dict[str, Any]) -> Mesh:
    return paint_mesh(build_mesh(visual["shape"], rounded=True), visual["color"])


def _mesh_from_file(visual: dict[str, Any], robot: Articulation) -> Mesh:
    """Read a mesh file; vertices without a material's colour get the description's."""
    mesh = read_surface(visual["mesh"], scale=visual["scale"], link=robot.links[visual["link"]])
    colours = mesh.pop("colors")
    return paint_mesh(mesh, np.where(colours[:, 3:] > 0, colours, visual["color"]))
