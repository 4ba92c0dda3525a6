# SPDX-License-Identifier: Apache-2.0
"""Scenes with the navigation mesh that came with them."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
import trimesh

from wiw import scenes
from wiw.datasets import imagenav
from wiw.datasets.worlds import navmesh_file, world
from wiw.errors import FileError, StoreError
from wiw.nav import NavMesh, NavMeshSettings
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, resume_run
from wiw.training.navigation_rules import NavigationRules
from wiw.training.traversal import choose_islands


@pytest.fixture
def house(two_rooms: str, tmp_path: Path) -> Path:
    """A scene in a folder of its own."""
    for name in ("two_rooms.obj", "two_rooms.mtl"):
        shutil.copy(Path(two_rooms).with_name(name), tmp_path)
    return (tmp_path / "two_rooms.obj").rename(tmp_path / "house.obj")


def test_habitats_mesh_beside_a_scene_is_used(house: Path) -> None:
    assert navmesh_file(str(house)) is None and navmesh_file("apartments:val/0") is None
    built = world(str(house)).navmesh
    NavMesh.build(scenes.load(house), NavMeshSettings(agent_radius=0.4)).save(house.with_suffix(".navmesh"))
    assert navmesh_file(str(house)) == house.with_suffix(".navmesh")
    thin = world(str(house)).navmesh
    assert thin.area == NavMesh.load(house.with_suffix(".navmesh")).area < 0.9 * built.area


def test_the_mesh_of_another_scene_is_refused(house: Path) -> None:
    floor = np.array([[20, 0, 0], [30, 0, 0], [30, 0, 10], [20, 0, 10]], np.float32)
    far = NavMesh.from_triangles(floor, np.array([[0, 2, 1], [0, 3, 2]]))
    far.save(house.with_suffix(".navmesh"))
    with pytest.raises(
        FileError, match=r"house\.navmesh: its mesh reaches from .* expected the navigation mesh of this scene"
    ):
        world(str(house))


def test_the_manifest_names_the_mesh_and_a_run_keeps_to_it(house: Path, tmp_path: Path) -> None:
    task = TaskRecipe("imagenav", {"scenes": house, "decisions": 1})
    log = evaluate(task, AgentRecipe("heuristic"), 2, out=tmp_path / "run", progress=False)
    assert log.store.info["scenes"] == {str(house): {"navmesh": "built"}}
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
    NavMesh.build(scenes.load(house)).save(house.with_suffix(".navmesh"))
    with pytest.raises(StoreError, match=r"house\.navmesh"):
        resume_run(tmp_path / "run", progress=False)
    log = evaluate(task, AgentRecipe("heuristic"), 1, out=tmp_path / "other", progress=False)
    assert log.store.info["scenes"] == {str(house): {"navmesh": str(house.with_suffix(".navmesh"))}}
    house.with_suffix(".navmesh").unlink()
    assert resume_run(tmp_path / "run", progress=False).complete


@pytest.fixture(scope="module")
def covered_house(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two rooms with a door between them, furniture, and a flat ceiling of more free surface than they have."""
    boxes = {
        "floor": ((-4, -0.1, -3), (4, 0, 3)),
        "ceiling": ((-4, 2.6, -3), (4, 2.7, 3)),
        "west": ((-4.1, 0, -3), (-4, 2.6, 3)),
        "east": ((4, 0, -3), (4.1, 2.6, 3)),
        "north": ((-4, 0, -3.1), (4, 2.6, -3)),
        "south": ((-4, 0, 3), (4, 2.6, 3.1)),
        "inner_north": ((-0.05, 0, -3), (0.05, 2.6, -0.5)),
        "inner_south": ((-0.05, 0, 0.5), (0.05, 2.6, 3)),
        "table": ((-3.5, 0, -2.5), (-2.5, 0.7, -1.5)),
        "sofa": ((2, 0, 1.5), (3.5, 0.5, 2.7)),
        "cupboard": ((2.5, 0, -2.8), (3.5, 1.8, -2.3)),
    }
    file = tmp_path_factory.mktemp("covered") / "house.glb"
    house = trimesh.Scene()
    for name, (low, high) in boxes.items():
        size, middle = np.subtract(high, low), np.add(high, low) / 2
        box = trimesh.creation.box(size, trimesh.transformations.translation_matrix(middle))
        house.add_geometry(box, node_name=name, geom_name=name)
    house.export(file)
    return str(file)


def test_nobody_walks_on_a_roof(covered_house: str) -> None:
    place = world(covered_house)
    ceiling, rooms = place.navmesh.islands[:2]
    assert ceiling.area > rooms.area and ceiling.bounds[0][1] > 2.6
    assert place.roofs == {0} and place.floor == 1
    starts = [episode.start_position[1] for episode in imagenav.generate(place, 2, seed=0)]
    assert starts == pytest.approx([0, 0], abs=0.05)
    assert choose_islands(place.navmesh, NavigationRules(), place.roofs) == [1]


def test_floors_without_a_ceiling_are_no_roofs(two_rooms: str) -> None:
    for scene in (two_rooms, "apartments:val/0"):
        assert world(scene).roofs == frozenset() and world(scene).floor == 0
