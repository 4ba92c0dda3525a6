# SPDX-License-Identifier: Apache-2.0
"""Scenes made of boxes, written as OBJ files that load in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

Point = tuple[float, float, float]

COLORS: Mapping[str, Point] = {
    "floor": (0.6, 0.5, 0.4),
    "wall": (0.8, 0.8, 0.75),
    "red": (0.8, 0.2, 0.2),
    "green": (0.2, 0.7, 0.3),
    "blue": (0.2, 0.3, 0.8),
}
TWO_ROOMS: Mapping[str, tuple[str, Point, Point]] = {
    "floor": ("floor", (-4, -0.1, -2), (4, 0, 2)),
    "wall_w": ("wall", (-4.1, 0, -2), (-4, 2.5, 2)),
    "wall_e": ("blue", (4, 0, -2), (4.1, 2.5, 2)),
    "wall_n": ("wall", (-4, 0, -2.1), (4, 2.5, -2)),
    "wall_s": ("green", (-4, 0, 2), (4, 2.5, 2.1)),
    "partition_a": ("wall", (-0.05, 0, -2), (0.05, 2.5, 0.6)),
    "partition_b": ("wall", (-0.05, 0, 1.6), (0.05, 2.5, 2)),
    "table": ("red", (-3, 0, -1.5), (-2.2, 0.7, -0.9)),
    "shelf": ("green", (3.4, 0, -1.8), (3.9, 1.8, -0.8)),
    "chest": ("red", (1.4, 0, -1.9), (2.2, 0.6, -1.5)),
    "picture": ("blue", (-3.99, 1.0, 0.2), (-3.97, 1.6, 1.0)),
}
"""Two furnished rooms with a door between them: material, least and greatest corner by name; metres, Y up."""


def write_boxes(path: Path, boxes: Mapping[str, tuple[str, Point, Point]], colors: Mapping[str, Point]) -> None:
    """Write boxes, each with its material and two corners in metres, and their materials beside them."""
    materials = "".join(f"newmtl {name}\nKd {r} {g} {b}\n" for name, (r, g, b) in colors.items())
    path.with_suffix(".mtl").write_text(materials)
    lines, base = [f"mtllib {path.with_suffix('.mtl').name}"], 1
    for name, (material, low, high) in boxes.items():
        lines += [f"o {name}", f"usemtl {material}"]
        lines += [
            f"v {(low, high)[x][0]} {(low, high)[y][1]} {(low, high)[z][2]}"
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        lines += ["f " + " ".join(str(base + i) for i in quad) for quad in quads]
        base += 8
    path.write_text("\n".join(lines))
