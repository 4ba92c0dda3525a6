# SPDX-License-Identifier: Apache-2.0
"""Habitat-Matterport 3D: `SCAN.basis.glb`, and for scans with labels `SCAN.semantic.glb` and `SCAN.semantic.txt`.

Axis Z is up. The picture of the labels is painted on a separate mesh: each colour is one object of the table. A line of
the table is `id,RRGGBB,"category",region`; id 0 is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import FileError
from wiw.scenes.basis import import_scan
from wiw.scenes.scans import labels as transfer
from wiw.scenes.scans.glb import UNREADABLE, Glb
from wiw.scenes.scans.scan import (
    Imported,
    ScanObject,
    import_options,
    number_objects,
    read_text,
    require_file,
    require_folder,
    require_scans,
    split_cells,
    to_y_up,
)

HEADER = "HM3D Semantic Annotations"


@dataclass(frozen=True)
class Annotations:
    """The table of a scan's labels."""

    objects: dict[int, ScanObject]
    colors: dict[int, int]
    """Object ids by colour, 0xRRGGBB."""


def is_scan(file: Path) -> bool:
    """Return whether a mesh file is named as in HM3D, or has HM3D's labels beside it."""
    if file.suffix != ".glb" or file.name.endswith(".semantic.glb"):
        return False
    return file.name.endswith(".basis.glb") or any(path.is_file() for path in _labels(file))


def find(folder: Path, split: str) -> list[Path]:
    """Return the meshes of all scans in a dataset's or a split's folder, or in that of one scan."""
    place = require_folder(folder, split)
    found = [file for depth in ("", "*/", "*/*/") for file in place.glob(f"{depth}*.basis.glb")]
    return require_scans(found, place, "HM3D's 00800-SCAN/SCAN.basis.glb in it")


def _name(file: Path) -> str:
    return file.name.removesuffix(".glb").removesuffix(".basis")


def _labels(file: Path) -> tuple[Path, Path]:
    """Return where the labels of a scan lie: the painted mesh and the table."""
    return file.with_name(f"{_name(file)}.semantic.glb"), file.with_name(f"{_name(file)}.semantic.txt")


def read_annotations(path: Path) -> Annotations:
    """Read a `.semantic.txt` file.

    Raises:
        FileError: it is missing or no such table, or a line is damaged or repeats an id or a colour; names the line.
    """
    lines = read_text(path).splitlines()
    if not lines or HEADER not in lines[0]:
        raise FileError(f"{path}: expected '{HEADER}' in the first line, got {lines[0] if lines else ''!r:.60}")
    table = Annotations({}, {})
    for number, row in enumerate(split_cells(path, lines[1:]), 2):
        if not row:
            continue
        try:
            index, color, category, region = int(row[0]), int(row[1], 16), row[2].strip(), int(row[3])
            if index in table.objects or color in table.colors or not 0 <= color <= 0xFFFFFF:
                raise ValueError("its id or colour is invalid or already used")
        except (ValueError, IndexError) as error:
            raise FileError(
                f'{path}: line {number}: expected id,RRGGBB,"category",region, got {",".join(row)!r:.80} ({error})'
            ) from error
        if index > 0:  # 0 is unknown
            table.objects[index] = ScanObject(f"{category} {index}", category, {"region": str(region)})
            table.colors[color] = index
    return table


def read(file: Path, options: dict[str, Any]) -> Imported:
    """Read a scan; one without labels, as most are, has no instances of objects, and a warning."""
    up = options.get("up") or "z"
    scene, read, absent = import_scan(file, **import_options(options, up))
    warnings: list[str] = []
    painted, listed = _labels(file)
    surface = transfer.Surface(*scene.world_triangles()[:2])
    about = {"up": f"{up.upper()} (HM3D)", "dataset": "HM3D"}
    if not painted.is_file() and not listed.is_file():
        scene = scene.relabelled(
            number_objects({}, (), listed).instances,
            np.ones(len(surface.triangles), np.uint32),
            name=_name(file),
            flat=True,
            attributes={**about, "labels": "none"},
            warnings=[*warnings, f"{painted.name} does not exist: no object has a label"],
        )
        return Imported(scene, read, [*absent, painted, listed])
    table = read_annotations(require_file(listed, "expected the table of the labels next to their mesh"))
    require_file(painted, "expected the mesh with the labels next to their table")
    source, strange = read_painted(painted, table, up)
    pieces = transfer.transfer_labels(surface, source, file)
    instances = number_objects(table.objects, set(np.unique(pieces.labels).tolist()), listed)
    shown = len(set(pieces.labels.tolist()) & set(table.objects)) if len(pieces.labels) else 0
    if strange > 0.001:
        warnings.append(f"{100 * strange:.1f} % of {painted.name} has colours that the table does not have")
    if shown < len(table.objects):
        warnings.append(f"{len(table.objects) - shown} of {len(table.objects)} objects have no surface")
    unlabelled = transfer.unlabelled_share(surface, pieces)
    if unlabelled > 0.2:
        warnings.append(f"{100 * unlabelled:.0f} % of the surface has no label")
    scene = scene.relabelled(
        instances.instances,
        instances.number(pieces.labels),
        triangles=pieces.triangles,
        corners=pieces.corners,
        name=_name(file),
        flat=True,
        attributes={**about, "labels": "HM3D objects"},
        warnings=warnings,
    )
    return Imported(scene, [*read, painted, listed], absent)


def read_painted(path: Path, table: Annotations, up: str) -> tuple[transfer.LabelledSurface, float]:
    """Read the labels of a `.semantic.glb`, from its textures (version 0.2) or vertex colours (0.1).

    Returns:
        The labelled surface, and the share of its samples, 0 to 1, whose colour is not in the table.

    Raises:
        FileError: it is damaged, or has no colours at all.
    """
    glb = Glb.read(path)
    try:
        meshes = [_placed_primitive(glb, *placed, up) for placed in _primitives(glb)]
    except UNREADABLE as error:
        raise FileError(f"{path}: cannot be read: {error} (damaged file?)") from error
    if not any(len(mesh.surface.triangles) for mesh in meshes):
        raise FileError(f"{path}: holds no triangles")
    offsets = np.cumsum([0, *(len(mesh.surface.vertices) for mesh in meshes[:-1])])
    surface = transfer.Surface(
        np.concatenate([mesh.surface.vertices for mesh in meshes]),
        np.concatenate([m.surface.triangles + np.uint32(o) for m, o in zip(meshes, offsets, strict=True)]),
    )
    samples = transfer.sample(surface, path)
    first = np.cumsum([0, *(len(mesh.surface.triangles) for mesh in meshes)])
    which = np.searchsorted(first, samples.triangles, side="right") - 1
    colors = np.zeros(len(samples.triangles), np.int64)
    for number, mesh in enumerate(meshes):
        mine = which == number
        colors[mine] = mesh.colors_at(samples.triangles[mine] - first[number], samples.weights[mine])
    lookup = np.full(1 << 24, -1, np.int32)
    lookup[list(table.colors)] = list(table.colors.values())
    ids = lookup[colors].astype(np.int64)
    strange = float(((ids < 0) & (colors != 0)).mean())
    return transfer.LabelledSurface(surface, samples, ids), strange


@dataclass(frozen=True)
class PaintedMesh:
    """One part of a painted mesh, in the world."""

    surface: transfer.Surface
    uv: NDArray[np.float32] | None
    """float32 [V, 2], v downwards."""
    picture: NDArray[np.uint8] | None
    """uint8 [H, W, 3]."""
    colors: NDArray[np.uint8] | None
    """uint8 [V, 3], of vertices."""

    def colors_at(self, triangles: NDArray[np.int64], weights: NDArray[np.float32]) -> NDArray[np.int64]:
        """Return the colours 0xRRGGBB, int64 [N], at points of triangles; never mixed of two."""
        corners = self.surface.triangles[triangles]
        if self.picture is not None and self.uv is not None:
            height, width = self.picture.shape[:2]
            uv = np.einsum("nc,ncx->nx", weights, self.uv[corners])
            texels = np.floor(uv * (width, height)).astype(np.int64) % (width, height)
            rgb = self.picture[texels[:, 1], texels[:, 0]]
        elif self.colors is not None:
            nearest = np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]
            rgb = self.colors[nearest]
        else:
            rgb = np.zeros((len(triangles), 3), np.uint8)
        return rgb.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])


def _primitives(glb: Glb) -> list[tuple[dict[str, Any], NDArray[np.float64]]]:
    return [
        (primitive, transform)
        for mesh, transform in glb.node_transforms
        for primitive in glb.items("meshes")[mesh]["primitives"]
        if primitive.get("mode", 4) == 4
    ]


def _placed_primitive(glb: Glb, primitive: dict[str, Any], transform: NDArray[np.float64], up: str) -> PaintedMesh:
    attributes = primitive["attributes"]
    positions = glb.fractions(attributes["POSITION"]).astype(np.float64)
    vertices = to_y_up(positions @ transform[:3, :3].T + transform[:3, 3], up).astype(np.float32)
    if "indices" in primitive:
        corners = glb.values(primitive["indices"]).astype(np.uint32).reshape(-1, 3)
    else:
        corners = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    if (corners.size and corners.max() >= len(vertices)) or not np.isfinite(vertices).all():
        raise ValueError("a triangle refers to a vertex that does not exist or is not finite")
    uv = glb.fractions(attributes["TEXCOORD_0"]).astype(np.float32) if "TEXCOORD_0" in attributes else None
    colors = _vertex_colors(glb.values(attributes["COLOR_0"])) if "COLOR_0" in attributes else None
    picture = _picture(glb, primitive) if uv is not None else None
    if picture is None and colors is None:
        raise ValueError("a part of it has neither a texture nor colours, so that nothing is labelled")
    for values in (uv, colors):
        if values is not None and len(values) != len(vertices):
            raise ValueError("its attributes differ in length")
    if uv is not None and not np.isfinite(uv).all():
        raise ValueError("a texture coordinate is not finite")
    return PaintedMesh(transfer.Surface(vertices, corners), uv, picture, colors)


def _vertex_colors(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours as the bytes that were stored; floats are bytes over 255."""
    if values.dtype == np.uint16:
        values = values / np.float32(65535)
    if values.dtype.kind == "f":
        values = np.round(np.nan_to_num(values).clip(0, 1) * 255)
    return values[:, :3].astype(np.uint8)


def _picture(glb: Glb, primitive: dict[str, Any]) -> NDArray[np.uint8] | None:
    """Return the texture of a part, uint8 [H, W, 3]; None if it has none."""
    if "material" not in primitive:
        return None
    material = glb.items("materials")[primitive["material"]]
    info = material.get("pbrMetallicRoughness", {}).get("baseColorTexture") or material.get("emissiveTexture")
    if not info:
        return None
    if "KHR_texture_transform" in info.get("extensions", {}):
        raise ValueError("a label image is placed by KHR_texture_transform, which is not supported")
    image = glb.items("images")[glb.items("textures")[info["index"]]["source"]]
    data = np.frombuffer(glb.view(image["bufferView"]), np.uint8)
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if decoded is None:
        raise ValueError("a label image cannot be decoded")
    return np.ascontiguousarray(decoded[..., ::-1])
