# SPDX-License-Identifier: Apache-2.0
"""Scenes: meshes and Gazebo worlds from files.

World frame: metres, Y up, right-handed. See `Scene` for what a scene tells about itself.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

from wiw import _core

Scene = _core.scene.Scene

__all__ = ["Scene", "load"]

_log = logging.getLogger("wiw.scenes")


def load(
    path: str | PathLike[str],
    up: str | None = None,
    ceiling: float | None = None,
    *,
    smooth_normals: bool = False,
    limits: dict[str, int] | None = None,
    texture_folders: Sequence[str | PathLike[str]] = (),
    model_folders: Sequence[str | PathLike[str]] = (),
) -> Scene:
    """Reads a GLB, glTF, OBJ, PLY or DAE mesh, or a Gazebo `.world` or `.sdf` file.

    `up` is "y", "z" or None: by the file (COLLADA header; Y for glTF, OBJ and PLY; Z for names in HM3D's layout). The
    rule that was used is `scene.attributes["up"]`. `ceiling` closes a scene that is open above, in metres above its
    floor. `smooth_normals` makes normals where a file has none. `limits` raises or lowers the import limits
    (file_bytes, triangles, nodes, texture_pixels, texture_bytes). `texture_folders` are searched for textures by base
    name, `model_folders` for `model://` of a world, before the places beside the file.

    What had to be left out, such as a texture that is missing, is logged and listed in `scene.warnings`. Raises
    FileError, naming file and cause, for a file that is missing, damaged, unsupported or above the limits.
    """
    scene, _, _ = _core.scene.import_scene(
        Path(path).expanduser(),
        up=up,
        ceiling=ceiling,
        smooth_normals=smooth_normals,
        limits=limits or {},
        texture_folders=[Path(folder).expanduser() for folder in texture_folders],
        model_folders=[Path(folder).expanduser() for folder in model_folders],
    )
    for warning in scene.warnings:
        _log.warning("%s: %s", scene.name, warning)
    return scene
