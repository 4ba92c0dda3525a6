# SPDX-License-Identifier: Apache-2.0
"""Scenes with the navigation mesh that came with them."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import wiw
from wiw import scenes
from wiw.datasets import imagenav, scene_sources
from wiw.datasets.scene_sources import digest_scene
from wiw.datasets.worlds import navmesh_file, world
from wiw.errors import FileError, StoreError
from wiw.nav import NavMesh, NavMeshSettings
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, resume_run
from wiw.tasks.imagenav import ImageNav
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
    plain = digest_scene(house)
    assert log.store.info["scenes"] == {str(house): {"navmesh": "built", "content": plain}}
    with sqlite3.connect(store_path(tmp_path / "run")) as store:
        store.execute("DELETE FROM outcome WHERE episode = 1")
    NavMesh.build(scenes.load(house)).save(house.with_suffix(".navmesh"))
    with pytest.raises(StoreError, match=r"house\.navmesh"):
        resume_run(tmp_path / "run", progress=False)
    log = evaluate(task, AgentRecipe("heuristic"), 1, out=tmp_path / "other", progress=False)
    navmesh, content = str(house.with_suffix(".navmesh")), digest_scene(house)
    assert log.store.info["scenes"] == {str(house): {"navmesh": navmesh, "content": content}} and content != plain
    house.with_suffix(".navmesh").unlink()
    assert resume_run(tmp_path / "run", progress=False).complete


TASK_OPTIONS: dict[str, Any] = {"decisions": 1, "backend": "cpu"}


def begin(house: Path, out: Path, **settings: Any) -> None:
    task = TaskRecipe("imagenav", {"scenes": house, **TASK_OPTIONS})
    evaluate(task, AgentRecipe("matcher", "copy"), 3, out=out, progress=False, **settings).close()


def forget_an_episode(run: Path) -> None:
    with sqlite3.connect(store_path(run)) as store:
        assert store.execute("DELETE FROM outcome WHERE episode = 1").rowcount == 1


def write_again(house: Path, more: str = "") -> None:
    """Replace a scene's file by a copy, with more in it."""
    text = house.read_text()
    house.unlink()
    house.write_text(text + more)


COMMANDS: Mapping[str, Callable[[Path, Path], Any]] = {
    "resume": lambda run, house: resume_run(run, progress=False),
    "run --resume": lambda run, house: begin(house, run, resume=True),
    "verify": lambda run, house: wiw.verify(run),
    "blame": lambda run, house: wiw.blame(run, progress=False),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("file", ["house.obj", "two_rooms.mtl"])
def test_a_run_is_not_mixed_with_another_version_of_its_scene(
    command: str, file: str, house: Path, tmp_path: Path
) -> None:
    run, changed = tmp_path / "run", house.with_name(file)
    begin(house, run)
    forget_an_episode(run)
    before = changed.read_text()
    write_again(changed, "# one more line\n")
    with pytest.raises(StoreError, match=r"the files of \S+/house\.obj have changed .* put back the files"):
        COMMANDS[command](run, house)
    assert len(wiw.load_run(run).episodes) == 2 and not (run / "blame").exists()
    changed.write_text(before)
    COMMANDS[command](run, house)


def test_a_run_without_digests_is_read_and_resumed(house: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    begin(house, run)
    forget_an_episode(run)
    with sqlite3.connect(store_path(run)) as store:
        place = f'$.scenes."{house}".content'
        store.execute("UPDATE run SET info = json_remove(info, ?)", (place,))
    write_again(house, "# one more line\n")
    assert wiw.load_run(run).store.info["scenes"] == {str(house): {"navmesh": "built"}}
    assert wiw.verify(run).same and resume_run(run, progress=False).complete


def test_shards_are_merged_that_had_the_same_scene(house: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    _, copy = (Path(shutil.copy(house.with_name(name), elsewhere)) for name in ("two_rooms.mtl", "house.obj"))
    for number, more in ((1, ""), (2, ""), (3, "# one more line\n")):
        write_again(house, more)
        begin(house, tmp_path / str(number), shard=f"{min(number, 2)}/2", salt="s")
    begin(copy, tmp_path / "4", shard="2/2", salt="s")
    assert wiw.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged").complete
    assert wiw.merge([tmp_path / "1", tmp_path / "4"], tmp_path / "of two places").complete
    with pytest.raises(StoreError, match=r"scenes\.house\.obj\.content: "):
        wiw.merge([tmp_path / "1", tmp_path / "3"], tmp_path / "other")
    assert not (tmp_path / "other").exists()
    forget_an_episode(tmp_path / "merged")
    with pytest.raises(StoreError, match=r"the files of \S+/house\.obj have changed"):
        resume_run(tmp_path / "merged", progress=False)


def test_a_scene_is_digested_once_a_command_and_a_generated_one_never(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digested = list[Path]()

    def count(path: Path) -> str:
        digested.append(path)
        return digest_scene(path)

    monkeypatch.setattr(scene_sources, "digest_scene", count)
    begin(house, tmp_path / "run", workers=1)
    assert digested == [house]
    forget_an_episode(tmp_path / "run")
    resume_run(tmp_path / "run", progress=False)
    assert digested == [house, house]
    task = ImageNav(scenes="apartments:val/0", **TASK_OPTIONS)
    assert task.require(task.episodes(1)) == {"apartments:val/0": {"navmesh": "built"}}
    assert digested == [house, house]


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
