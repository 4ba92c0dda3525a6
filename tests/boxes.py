# SPDX-License-Identifier: Apache-2.0
"""Scenes made of boxes, written as OBJ files that load in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

Point = tuple[float, float, float]


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
