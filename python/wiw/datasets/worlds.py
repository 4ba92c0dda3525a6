# SPDX-License-Identifier: Apache-2.0
"""Scenes with renderer and navigation mesh, shared by all environments of a process."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

from wiw.datasets.roofs import find_roofs
from wiw.errors import FileError
from wiw.nav import Ground, NavMesh
from wiw.render import Renderer
from wiw.scenes import Scene, is_generated, open_scene
from wiw.scenes.scans import scene_dataset

CAPACITY = 4
"""Worlds kept: enough for the live episodes of a run that goes scene by scene (an apartment takes about 100 MB)."""

SLACK = 1.0
"""Metres that a navigation mesh may reach beyond its scene: Recast's cells and the gaps between them."""


@dataclass(frozen=True)
class World:
    """One scene with its renderer and navigation mesh."""

    name: str
    scene: Scene
    renderer: Renderer
    navmesh: NavMesh
    ground: Ground
    """Heights of the floor; the mesh lies up to 0.2 m above it."""
    backend: Literal["auto", "cpu", "gpu"] = "auto"
    """The renderer that was requested."""

    @cached_property
    def roofs(self) -> frozenset[int]:
        """Islands of the navigation mesh that are roofs."""
        return find_roofs(self.navmesh, self.renderer)

    @cached_property
    def floor(self) -> int:
        """The largest island of the navigation mesh that is not a roof: where episodes take place."""
        return next((index for index in range(len(self.navmesh.islands)) if index not in self.roofs), 0)


_worlds: OrderedDict[tuple[str, str, Path | None], World] = OrderedDict()


def world(scene: str, backend: Literal["auto", "cpu", "gpu"] = "auto") -> World:
    """Return the world of a single scene's spec, from memory where possible; the oldest unused is dropped."""
    path = navmesh_file(scene)
    key = (scene, backend, path)
    if key in _worlds:
        _worlds.move_to_end(key)
        return _worlds[key]
    loaded = open_scene(scene)
    made = World(scene, loaded, Renderer(loaded, backend=backend), open_navmesh(path, loaded), Ground(loaded), backend)
    _worlds[key] = made
    while len(_worlds) > CAPACITY:
        _worlds.popitem(last=False)
    return made


def navmesh_file(scene: str) -> Path | None:
    """Return Habitat's navigation mesh beside a scene's file, "house.navmesh" for "house.glb", if there is one.

    A scene of a scene dataset names its own.
    """
    if is_generated(scene):
        return None
    if scene.endswith(scene_dataset.ENDING):
        return scene_dataset.find_navmesh(Path(scene).expanduser())
    path = Path(scene).expanduser().with_suffix(".navmesh")
    return path if path.is_file() else None


def open_navmesh(path: Path | None, scene: Scene) -> NavMesh:
    """Return the mesh that came with the scene, else one built from it.

    Raises:
        FileError: the file is damaged, or its mesh is not where the scene is.
    """
    if path is None:
        return NavMesh.build(scene)
    navmesh = NavMesh.load(path)
    places = navmesh.triangles()[0].reshape(-1, 3)
    low, high = places.min(axis=0), places.max(axis=0)
    if (low < scene.bounds[0] - SLACK).any() or (high > scene.bounds[1] + SLACK).any():
        raise FileError(
            f"{path}: its mesh reaches from {low.round(1)} to {high.round(1)}, the scene from "
            f"{scene.bounds[0].round(1)} to {scene.bounds[1].round(1)} (metres, Y up): expected the navigation mesh of "
            "this scene; remove the file to have one built"
        )
    return navmesh
