# SPDX-License-Identifier: Apache-2.0
"""Basis Universal images of mesh files, decoded by `opengl_basisu` (extra `wiw[hm3d]`) for the core's importer."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import _core
from wiw.errors import DependencyError


def has_decoder() -> bool:
    """Return whether the decoder is installed."""
    return find_spec("opengl_basisu") is not None


def decode(data: bytes) -> NDArray[np.uint8]:
    """Return a `.basis` or KTX2 file's largest image, uint8 [H, W, 4], row 0 at the top of the picture.

    Raises:
        ValueError: it is damaged, or in a codec without 8-bit colours.
    """
    import opengl_basisu

    texture = opengl_basisu.open(data)
    image = np.asarray(texture.transcode(opengl_basisu.Target.RGBA8).data, np.uint8)
    image = image.reshape(texture.height, texture.width, 4)
    return image[::-1] if texture.y_flipped else image  # the flag says how rows are stored; no decoder undoes it


def import_mesh(file: Path, **options: Any) -> tuple[_core.scene.Scene, list[Path], list[Path]]:
    """Import a mesh or a Gazebo world, images in Basis Universal included where their decoder is installed.

    Returns:
        The scene, files read, and files looked for in vain.

    Raises:
        FileError: it is missing, damaged, unsupported or above the limits.
    """
    return _import_with(decode if has_decoder() else None, file, options)


def import_scan(file: Path, allow_missing: bool, **options: Any) -> tuple[_core.scene.Scene, list[Path], list[Path]]:
    """Import the mesh of a scan as `import_mesh` does, where textures may only be missing if `allow_missing`.

    Raises:
        FileError: it is missing, damaged, unsupported or above the limits.
        DependencyError: its images are in Basis Universal, and the decoder is not installed.
    """
    if allow_missing or has_decoder():
        return import_mesh(file, **options)
    needed = False

    def record_need(data: bytes) -> NDArray[np.uint8]:
        nonlocal needed
        needed = True
        raise ValueError("the decoder is not installed")

    imported = _import_with(record_need, file, options)
    if needed:
        raise DependencyError(
            f"{file}: its textures are in Basis Universal, which needs opengl_basisu: pip install 'wiw[hm3d]' (or give "
            "--allow-missing-textures to draw the scan grey)"
        )
    return imported


def _import_with(
    decoder: Callable[[bytes], NDArray[np.uint8]] | None, file: Path, options: dict[str, Any]
) -> tuple[_core.scene.Scene, list[Path], list[Path]]:
    scene, read, absent = _core.scene.import_scene(file, decode_basis=decoder, **options)
    return scene, list(dict.fromkeys([file, *read])), list(absent)
