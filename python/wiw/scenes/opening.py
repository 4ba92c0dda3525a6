# SPDX-License-Identifier: Apache-2.0
"""Opening scenes: from files, or by the names that specs stand for."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from wiw import _core
from wiw.errors import ArgumentError, FileError
from wiw.scenes import basis, isolated, store
from wiw.scenes.apartments import apartment, apartment_table
from wiw.scenes.scans import formats
from wiw.scenes.specs import blame_path, is_generated, parse_single

Scene = _core.scene.Scene
Folders = str | PathLike[str] | Sequence[str | PathLike[str]]
"""One folder, or several."""
UP_AXES = (None, "auto", "y", "z")

MOST_MISSING = 0.05
"""Largest share of a scan's surface whose texture may be missing."""
ALLOW_VARIABLE = "WIW_ALLOW_MISSING_TEXTURES"
"""Environment variable that allows more, also for processes that a run starts."""

_log = logging.getLogger("wiw.scenes")


def load(
    path: str | PathLike[str],
    up: str | None = None,
    ceiling: float | None = None,
    cache: bool = True,
    *,
    isolate: bool = True,
    limits: dict[str, int] | None = None,
    texture_folders: Folders = (),
    model_folders: Folders = (),
) -> Scene:
    """Read a GLB, glTF, OBJ, PLY or DAE mesh, a Gazebo `.world` or `.sdf` file, or a real scan.

    A scan is opened by its mesh, and recognised by the files next to it (`docs/real-scans.md`).

    Args:
        path: the file; `~` is expanded.
        up: "y", "z", or None and "auto": by the file (COLLADA header; Y for glTF, OBJ and PLY; Z for scans and for
            names in HM3D's layout). The rule that was used is `scene.attributes["up"]`.
        ceiling: height in metres above the floor at which to close a scene that is open above. Rooms of Replica and
            scenes of scene datasets take none.
        cache: cache the imported scene on disk (`$WIW_CACHE` or `~/.cache/wiw`), to be mapped the next time.
        isolate: import in a separate process, so that a file that crashes the reader raises FileError here.
        limits: raises or lowers the import limits: file_bytes, triangles, nodes, texture_pixels, texture_bytes.
        texture_folders: one or several folders searched for textures by base name, after the places next to the file.
        model_folders: one or several folders searched for a world's `model://`, before the places next to the file.

    Whatever had to be left out, such as a missing texture, is logged and listed in `scene.warnings`.

    Raises:
        FileError: naming file and cause: missing, damaged, unsupported or above the limits.
        ArgumentError: an option is out of its range.
        DependencyError: a scan's textures need a decoder that is not installed.
    """
    with blame_path(path):
        file = Path(path).expanduser().absolute()  # the cache is shared by processes with other working folders
        if not file.is_file():
            raise FileError(f"{file}: no such file; expected a mesh or a Gazebo world")
    if up not in UP_AXES:  # here, as scans have readers of their own
        raise ArgumentError(f"up must be 'auto', 'y' or 'z', got {up!r}")
    options = {
        "up": None if up == "auto" else up,
        "ceiling": ceiling,
        "limits": limits or {},
        "texture_folders": _list_folders(texture_folders),
        "model_folders": _list_folders(model_folders),
    }
    if not basis.has_decoder():  # what is imported without it is another scene, and must not outlive its installation
        options["basis_decoder"] = False
    reader = formats.find_reader(file)
    if reader is not None:
        options |= {"scan": reader, "allow_missing_textures": missing_textures_allowed()}
    scene = _load(file, options, cache, isolate)
    for warning in scene.warnings:
        _log.warning("%s: %s", scene.name, warning)
    return scene


def _list_folders(folders: Folders) -> list[str]:
    several = [folders] if isinstance(folders, str | PathLike) else folders
    return [str(Path(folder).expanduser().absolute()) for folder in several]


def _load(file: Path, options: dict[str, Any], cache: bool, isolate: bool) -> Scene:
    def build(out: Path) -> store.Sources:
        if isolate:
            return isolated.import_to(file, options, out)
        imported = formats.read_scene(file, options)
        _core.scene.write_cache(imported.scene, out)
        return store.Sources(tuple(imported.read), tuple(imported.absent))

    if cache:
        return store.load_imported(file, options, build)
    if not isolate:
        return formats.read_scene(file, options).scene
    return store.temporary(build)


def open_scene(name: str) -> Scene:
    """Load one scene of `resolve`.

    Raises:
        FileError: it cannot be read; or it is a scan, more than `MOST_MISSING` of its surface lacks its texture, and
            `$WIW_ALLOW_MISSING_TEXTURES` is not set.
    """
    if is_generated(name):
        seed, split, edits = parse_single(name)
        return apartment(seed, split, edits=edits)
    scene = load(name)
    is_grey = "dataset" in scene.attributes and scene.missing_texture_share > MOST_MISSING
    if is_grey and not missing_textures_allowed():
        cause = next((warning for warning in scene.warnings if "texture" in warning or "image" in warning), "")
        raise FileError(
            f"{name}: {scene.missing_texture_share:.0%} of its surface lacks its texture and would be drawn grey "
            f"({cause}); at most {MOST_MISSING:.0%} is allowed. Put the textures where the file expects them, or allow "
            f"it with --allow-missing-textures ({ALLOW_VARIABLE}=1)"
        )
    return scene


def allow_missing_textures() -> None:
    """Allow this process and those that it starts to use scans that lack more than `MOST_MISSING` of their textures."""
    os.environ[ALLOW_VARIABLE] = "1"


def missing_textures_allowed() -> bool:
    """Return whether scans may be used that lack more than `MOST_MISSING` of their textures."""
    return os.environ.get(ALLOW_VARIABLE, "") not in ("", "0")


def open_outline(name: str) -> Scene:
    """Load one scene of `resolve`, an apartment without its textures and light (`apartment_table`)."""
    if is_generated(name):
        seed, split, edits = parse_single(name)
        return apartment_table(seed, split, edits=edits)
    return open_scene(name)
