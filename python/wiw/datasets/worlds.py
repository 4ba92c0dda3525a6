# SPDX-License-Identifier: Apache-2.0
"""Scenes with renderer and navigation mesh, shared by all environments of a process."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Literal

from wiw.nav import Ground, NavMesh
from wiw.render import Renderer
from wiw.scenes import Scene, open_scene

CAPACITY = 4
"""Worlds kept: enough for the live episodes of a run that goes scene by scene (an apartment takes about 100 MB)."""


@dataclass(frozen=True)
class World:
    """One scene, ready to be seen and walked in."""

    name: str
    scene: Scene
    renderer: Renderer
    navmesh: NavMesh
    ground: Ground
    """Heights of the floor; the mesh lies up to 0.2 m above it."""


_worlds: OrderedDict[tuple[str, str], World] = OrderedDict()


def world(scene: str, backend: Literal["auto", "cpu", "gpu"] = "auto") -> World:
    """The world of a scene spec that names one scene, from memory where possible; the oldest unused is dropped."""
    key = (scene, backend)
    if key in _worlds:
        _worlds.move_to_end(key)
        return _worlds[key]
    loaded = open_scene(scene)
    made = World(scene, loaded, Renderer(loaded, backend=backend), NavMesh.build(loaded), Ground(loaded))
    _worlds[key] = made
    while len(_worlds) > CAPACITY:
        _worlds.popitem(last=False)
    return made
