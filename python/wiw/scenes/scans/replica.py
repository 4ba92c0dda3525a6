# SPDX-License-Identifier: Apache-2.0
"""Replica: `ROOM/habitat/mesh_semantic.ply` with colours of vertices and an object of each face, and its table.

The table is `info_semantic.json` beside the mesh: objects with their classes, or classes alone, which labels then
name. Axis Z is up. The fine textures of Replica, in PTex, are not read: what is drawn is the colour of the vertices.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from wiw import _core
from wiw.errors import ArgumentError, FileError
from wiw.json_text import parse_json
from wiw.scenes.scans.scan import (
    Imported,
    ScanObject,
    number_objects,
    read_text,
    require_file,
    require_folder,
    require_scans,
    to_y_up,
)

MESH, TABLE = "mesh_semantic.ply", "info_semantic.json"


def is_scan(file: Path) -> bool:
    """Return whether a file is the mesh of a Replica room."""
    return file.name == MESH


def find(folder: Path, split: str) -> list[Path]:
    """Return the meshes of all rooms in a dataset's folder, or in that of one room."""
    place = require_folder(folder, split)
    found = [file for depth in ("", "habitat/", "*/habitat/") for file in place.glob(f"{depth}{MESH}")]
    return require_scans(found, place, f"Replica's ROOM/habitat/{MESH} with {TABLE} beside it")


def room_name(file: Path) -> str:
    """Return the name of the room that a mesh belongs to: "apartment_0"."""
    folder = file.absolute().parent
    return folder.parent.name if folder.name == "habitat" else folder.name


def read_objects(path: Path) -> dict[int, ScanObject]:
    """Read the table of a room; where it has classes alone, each class is one object.

    Raises:
        FileError: it is missing or not JSON, or an entry is incomplete or names a class that does not exist.
    """
    text = read_text(require_file(path, "expected Replica's table of objects beside the mesh"))
    try:
        body = parse_json(text)
        classes = {int(item["id"]): str(item["name"]) for item in body["classes"]}
        if not body.get("objects"):
            return {i: ScanObject(name, _plain(name)) for i, name in classes.items() if i >= 0}
        return dict(_object(item, classes) for item in body["objects"])
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise FileError(f"{path}: not a Replica table ({type(error).__name__}: {error})") from error


def _object(item: dict[str, Any], classes: dict[int, str]) -> tuple[int, ScanObject]:
    index, kind = int(item["id"]), int(item["class_id"])
    category = "" if kind < 0 else _plain(classes[kind])
    return index, ScanObject(f"{category or 'object'} {index}", category)


def _plain(name: str) -> str:
    return name.replace("-", " ").replace("_", " ")


def read(file: Path, options: dict[str, Any]) -> Imported:
    """Read a room."""
    up = options.get("up") or "z"
    table_file = file.with_name(TABLE)
    objects = read_objects(table_file)
    vertices, triangles, labels, colors = _core.scene.read_ply_surface(
        file, "object_id", limits=options.get("limits", {})
    )
    if colors is None:
        raise FileError(f"{file}: has no colours (red, green, blue of each vertex), so there is nothing to draw")
    if options.get("ceiling") is not None:
        raise ArgumentError(f"{file}: a ceiling cannot be added to a scan of Replica")
    mesh = {"positions": to_y_up(vertices, up), "triangles": triangles, "colors": colors, "material": 0}
    scene = _core.scene.Scene.from_arrays([mesh], name=room_name(file), materials=[{"name": "scan"}])
    table = number_objects(objects, np.unique(labels).tolist(), table_file)
    strange = sorted(set(np.unique(labels[labels >= 0]).tolist()) - set(objects))
    warnings = [f"{file.name} labels {len(strange)} objects that the table does not have"] if strange else []
    scene = scene.relabelled(
        table.instances,
        table.number(labels),
        flat=True,
        attributes={"up": f"{up.upper()} (Replica)", "dataset": "Replica", "labels": "Replica objects"},
        warnings=warnings,
    )
    return Imported(scene, [file, table_file])
