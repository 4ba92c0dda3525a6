# SPDX-License-Identifier: Apache-2.0
"""Read a robot description, a URDF file and its meshes, in a child process.

urdfdom and the readers of meshes trust their input, as those of scenes do; the child hands back plain data.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from wiw.physics import Articulation
from wiw.scenes.isolated import read_in_child
from wiw.tabletop.link_meshes import LinkMeshes, build_link_meshes
from wiw.tabletop.shapes import Mesh


@dataclass(frozen=True)
class Description:
    """A robot, and its link meshes."""

    articulation: Articulation
    link_meshes: LinkMeshes


def read_description(path: Path) -> Description:
    """Read a URDF file and all meshes it names.

    Raises:
        FileError: the file or a mesh is missing or damaged; the message names it, and the link of a mesh.
        ArgumentError: impossible numbers, or joints of kinds that are not supported.
    """
    with TemporaryDirectory(prefix="wiw-robot-") as folder:
        out = Path(folder) / "looks.npz"
        reply = read_in_child("wiw.tabletop.description_worker", {"path": str(path), "out": str(out)})
        with np.load(out, allow_pickle=False) as arrays:
            link_meshes = tuple((link, _read_mesh(arrays, i)) for i, link in enumerate(reply["links"]))
    return Description(Articulation.from_parts(reply["robot"]), link_meshes)


def write_description(job: dict[str, Any]) -> dict[str, Any]:
    """Do the child's part of `read_description`."""
    articulation = Articulation(job["path"])
    link_meshes = build_link_meshes(articulation)
    arrays: dict[str, Any] = {
        f"{i}/{name}": array for i, (_, mesh) in enumerate(link_meshes) for name, array in mesh.items()
    }
    np.savez(job["out"], **arrays)
    return {"robot": articulation.to_parts(), "links": [link for link, _ in link_meshes]}


def _read_mesh(arrays: Any, index: int) -> Mesh:
    start = f"{index}/"
    return {name.removeprefix(start): arrays[name] for name in arrays.files if name.startswith(start)}
