# SPDX-License-Identifier: Apache-2.0
"""Check that the scans of a dataset can be used, and are what the dataset's own files say."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from wiw.datasets.worlds import navmesh_file, open_navmesh
from wiw.errors import Error
from wiw.scenes import MOST_MISSING, Scene, load
from wiw.scenes.scans.formats import compare_tables


@dataclass
class ScanCheck:
    """Findings about one scan."""

    file: Path
    problems: list[str] = field(default_factory=list)
    """Faults, one sentence each; a scan with none can be used."""
    remarks: list[str] = field(default_factory=list)
    """Sentences on things left out or uncertain."""
    triangles: int = 0
    textures: int = 0
    missing: float = 0.0
    """Share of the surface, 0 to 1, whose texture could not be had."""
    objects: int = 0
    """Objects with surface."""
    categories: int = 0
    rooms: int = 0
    area: float = 0.0
    """Navigable square metres."""
    islands: int = 0
    navmesh: str = ""
    """"file", or "built" where none came with the scan."""
    seconds: float = 0.0


def check_scan(file: Path) -> ScanCheck:
    """Open a scan with its navigation mesh, and compare it with what its dataset's files say.

    Errors of the scan become problems.
    """
    check, started = ScanCheck(file), time.perf_counter()
    try:
        scene = load(file)
        _count(scene, check)
        check.problems += compare_tables(file, scene)
        path = navmesh_file(str(file))
        check.navmesh = "built" if path is None else "file"
        navmesh = open_navmesh(path, scene)
        check.area, check.islands = navmesh.area, len(navmesh.islands)
        if not check.area > 0:
            check.problems.append("no walkable place")
    except Error as error:
        check.problems.append(str(error).removeprefix(f"{file}: "))
    check.seconds = time.perf_counter() - started
    return check


def _count(scene: Scene, check: ScanCheck) -> None:
    check.remarks += scene.warnings
    check.triangles, check.textures, check.rooms = scene.triangle_count, scene.texture_count, len(scene.rooms)
    check.missing = scene.missing_texture_share
    things = [thing for thing in scene.instances if thing["triangle_count"] and thing["category"]]
    check.objects, check.categories = len(things), len({thing["category"] for thing in things})
    if check.missing > MOST_MISSING:
        check.problems.append(f"{check.missing:.0%} of the surface lacks its texture")
    if scene.attributes.get("labels", "none") == "none":
        check.remarks.append("no labels: usable for Image-Goal Navigation, but not for Active Recognition")
    elif not things:
        check.problems.append("no object has both a surface and a category")
