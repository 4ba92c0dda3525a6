# SPDX-License-Identifier: Apache-2.0
"""Opening a scene: imported afresh, imported in a process of its own, mapped from the cache; beside trimesh.

The first two are what the first process pays, once; mapping is what every later one pays, for textures, materials and
all. A child's CPU time is not in the CPU column. trimesh, where installed, reads the same mesh without the checks, the
textures or the cache.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
from harness import measure, optional, report

from wiw import scenes


def wavy_ply(path: Path, cells: int) -> None:
    """A wavy sheet of 2 cells^2 triangles with vertex colours, as a scan would store it."""
    n = cells + 1
    y, x = np.mgrid[0:n, 0:n].astype(np.float32) / 100
    vertices = np.zeros(n * n, [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"] = np.stack([x, np.sin(x) * np.cos(y), y], -1).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)).reshape(-1)
    halves = [(corner, corner + n, corner + 1), (corner + 1, corner + n, corner + n + 1)]
    faces = np.zeros(2 * cells * cells, [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = np.concatenate([np.stack(half, -1) for half in halves])
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def compare(title: str, path: Path, with_trimesh: bool) -> None:
    scenes.load(path)  # fills the cache
    trimesh = optional("trimesh") if with_trimesh else None
    cases = {
        "mapped": lambda: scenes.load(path),
        "imported": lambda: scenes.load(path, cache=False, isolate=False),
        "imported, own process": lambda: scenes.load(path, cache=False),
    }
    if with_trimesh:
        cases["trimesh"] = (lambda: trimesh.load(path, process=False)) if trimesh else None
    timings = measure(cases, repeats=7, warmup=1)
    report(title, cases, timings, ours="mapped", target="mapped at least 20x faster than imported")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WIW_CACHE"] = folder
        ply = Path(folder) / "sheet.ply"
        wavy_ply(ply, 1000)
        compare("A scan of 2,000,000 triangles, PLY", ply, with_trimesh=True)
        data = os.environ.get("WIW_TEST_DATA")
        world = Path(data) / "small_house/worlds/small_house.world" if data else None
        if world and world.is_file():
            compare("small_house.world: 87 models, 83 textures", world, with_trimesh=False)
        else:
            print("\nsmall_house.world: not here (set WIW_TEST_DATA)")


if __name__ == "__main__":
    import logging

    logging.getLogger("wiw.scenes").setLevel(logging.ERROR)
    main()
