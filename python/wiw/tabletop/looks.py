# SPDX-License-Identifier: Apache-2.0
"""What an articulation looks like: a painted mesh for each of its links."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import Articulation, read_surface
from wiw.tabletop.shapes import Mesh, joined, mesh_of, painted

Looks = tuple[tuple[int, Mesh], ...]
"""(link, mesh in the link's frame) of every link that is seen."""


@cache
def looks_of(robot: Articulation) -> Looks:
    """(link, mesh in the link's frame) of every link that is seen; primitives have their edges broken.

    Raises:
        FileError: a mesh file that is missing or damaged; the message names the link.
    """
    parts: dict[int, list[tuple[Mesh, NDArray[np.float64]]]] = {}
    for each in robot.visuals:
        mesh = _of_file(each, robot) if each["shape"] is None else _of_shape(each)
        parts.setdefault(each["link"], []).append((mesh, each["T_link_visual"]))
    return tuple((link, joined(meshes)) for link, meshes in parts.items())


def _of_shape(visual: dict[str, Any]) -> Mesh:
    return painted(mesh_of(visual["shape"], rounded=True), visual["color"])


def _of_file(visual: dict[str, Any], robot: Articulation) -> Mesh:
    """In the colours of the file's materials, in the description's where there are none."""
    mesh = read_surface(visual["mesh"], scale=visual["scale"], link=robot.links[visual["link"]])
    colours = mesh.pop("colors")
    return painted(mesh, np.where(colours[:, 3:] > 0, colours, visual["color"]))
