# SPDX-License-Identifier: Apache-2.0
"""Edited apartments as users meet them: specs, tables, pictures; cpp/tests/apartment tests every kind of edit."""

from __future__ import annotations

import json
import pickle
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw import _core, scenes
from wiw.cli.app import main
from wiw.datasets import episodes as files
from wiw.errors import ArgumentError, FileError
from wiw.nav import NavMesh
from wiw.render import Renderer
from wiw.types import Episode

SPEC = (
    "apartments:val/3?color:sofa_1=red&color:walls_of_bedroom_1=red&state:floor_lamp_1=off&state:pendant_lamp_1=off&"
    "state:toilet_1=open"
)
EDITED = {"sofa 1", "walls of bedroom 1", "floor lamp 1", "pendant lamp 1", "toilet 1"}


@pytest.fixture(scope="module")
def plain() -> scenes.Scene:
    return scenes.apartment(3, "val")


@pytest.fixture(scope="module")
def edited() -> scenes.Scene:
    return scenes.open_scene(SPEC)


def poses_in(scene: scenes.Scene, room: str) -> Any:
    """Return a pose in the middle of a room, at the height of eyes."""
    pose = np.eye(4)
    pose[:3, 3] = next(entry["bounds"].mean(axis=0) for entry in scene.rooms if entry["name"] == room)
    return pose[None]


def rows(scene: scenes.Scene) -> dict[int, Any]:
    """Return the table of a scene in values that can be compared."""
    return {
        row["id"]: json.dumps({key: np.asarray(value).tolist() for key, value in row.items()}, sort_keys=True)
        for row in scene.instances
    }


def test_only_the_edited_entries_of_the_table_differ(plain: scenes.Scene, edited: scenes.Scene) -> None:
    before, after = rows(plain), rows(edited)
    assert before.keys() == after.keys()
    assert {json.loads(before[i])["name"] for i in before if before[i] != after[i]} == EDITED
    states = {row["name"]: row["attributes"].get("state") for row in edited.instances}
    assert (states["floor lamp 1"], states["pendant lamp 1"], states["toilet 1"]) == ("off", "off", "open")
    assert next(row for row in edited.instances if row["name"] == "sofa 1")["attributes"]["color"] == "red"
    assert edited.attributes["edits"] == SPEC.partition("?")[2]
    assert edited.name == f"apartment val 3?{edited.attributes['edits']}"


def test_pictures_differ_in_what_was_edited_and_in_its_light(plain: scenes.Scene, edited: scenes.Scene) -> None:
    def views(room: str) -> tuple[Any, Any]:
        poses = poses_in(plain, room)
        return tuple(Renderer(scene, backend="cpu").panorama(poses, (288, 576)) for scene in (plain, edited))

    before, after = views("living room")
    for key in ("instance", "depth"):
        np.testing.assert_array_equal(before[key], after[key])  # none of what is edited here changes its shape
    sofa = next(row["id"] for row in plain.instances if row["name"] == "sofa 1")
    red = after["color"][before["instance"] == sofa].mean(axis=0)
    assert red[0] > 2 * red[1] and red[0] > 2 * red[2], red
    others = before["instance"] != sofa
    assert after["color"][others].mean() < 0.85 * before["color"][others].mean()  # the lamps are out
    ceiling = next(row["id"] for row in plain.instances if row["name"] == "ceiling of living room")
    overhead = before["instance"] == ceiling
    assert after["color"][overhead].mean() < 0.8 * before["color"][overhead].mean()

    before, after = views("bathroom")  # with its own lamp, and another door between
    toilet = next(row["id"] for row in plain.instances if row["name"] == "toilet 1")
    near = (before["instance"] == toilet) | (after["instance"] == toilet)
    assert near.any()
    np.testing.assert_array_equal(before["instance"][~near], after["instance"][~near])
    inside = [row["id"] for row in plain.instances if row["attributes"]["room"] == "bathroom"]
    here = np.isin(before["instance"], inside) & ~near
    apart = np.abs(before["color"][here].astype(int) - after["color"][here])
    assert apart.mean() < 2.0, apart.mean()
    assert (before["color"][near] != after["color"][near]).any()


def test_a_recoloured_wall_bounces_its_colour(plain: scenes.Scene, edited: scenes.Scene) -> None:
    poses = poses_in(plain, "bedroom 1")
    before, after = (Renderer(scene, backend="cpu").panorama(poses, (288, 576)) for scene in (plain, edited))
    ceiling = next(row["id"] for row in plain.instances if row["name"] == "ceiling of bedroom 1")
    overhead = before["instance"] == ceiling

    def redness(picture: Any) -> float:
        color = picture["color"][overhead].astype(float).mean(axis=0)
        return float(color[0] / color[2])

    assert redness(after) > redness(before) + 0.03


def test_the_table_is_that_of_the_scene_without_its_light(plain: scenes.Scene, edited: scenes.Scene) -> None:
    for scene, edits in ((plain, []), (edited, SPEC.partition("?")[2].split("&"))):
        table = scenes.apartment_table(3, "val", edits=edits)
        assert rows(table) == rows(scene)
        assert table.attributes == scene.attributes and table.texture_count == 0
        for one, other in zip(table.world_triangles(), scene.world_triangles(), strict=True):
            np.testing.assert_array_equal(one, other)


def test_every_room_can_be_reached_whatever_is_edited() -> None:
    tried = 0
    for seed in range(4):
        mesh = NavMesh.build(scenes.apartment_table(seed, "val"))
        places = mesh.sample(400, seed=0)
        places = places[places[:, 1] < 0.3]
        main_island = places[np.isfinite(mesh.distance_matrix(places)[0])]
        for edit in _obstacles(seed):
            scene = scenes.apartment_table(seed, "val", edits=[edit])
            distances = NavMesh.build(scene).distance_matrix(main_island)
            reached = main_island[np.isfinite(distances).sum(axis=1) > 0.8 * len(main_island)]
            for room in scene.rooms:
                low, high = room["bounds"]
                inside = np.all((reached[:, [0, 2]] > low[[0, 2]]) & (reached[:, [0, 2]] < high[[0, 2]]), axis=1)
                assert inside.any(), (seed, edit, room["name"])
            tried += 1
    assert tried > 30


def _obstacles(seed: int) -> list[str]:
    """Return edits that could block a way: doors of furniture, and some things that change places on the floor."""
    edits = scenes.possible_edits(f"apartments:val/{seed}")
    floor = {
        row["name"].replace(" ", "_")
        for row in scenes.apartment_table(seed, "val").instances
        if row["bounds"][0, 1] < 0.01 and row["bounds"][1, 1] > 0.3
    }
    swaps = [edit for edit in edits if edit.startswith("swap:") and set(edit[5:].split(",")) <= floor]
    return [edit for edit in edits if edit.startswith("state:") and edit.endswith("=open")] + swaps[::4]


def test_specs_have_one_spelling() -> None:
    other = (
        "apartments:val/3?state:toilet+1=open&color:sofa_1=red&color:walls+of_bedroom_1=red&"
        "state:pendant_lamp_1=off&state:floor+lamp_1=off"
    )
    assert scenes.resolve(other) == [SPEC] == scenes.resolve(SPEC)
    assert scenes.is_generated(SPEC) and scenes.absolute(SPEC) == SPEC
    assert scenes.resolve("apartments:val/3") == ["apartments:val/3"] == scenes.resolve("apartments:val/003")
    assert scenes.resolve("apartments:val/03?remove:vase_1") == ["apartments:val/3?remove:vase_1"]
    for spec, message in (
        ("apartments:val?remove:vase_1", "single apartment"),
        ("apartments:val:2?remove:vase_1", "single apartment"),
        ("apartments:val/3?", "expected color:NAME=COLOR"),
        ("apartments:val/3?remove:vase_1&", "expected color:NAME=COLOR"),
        ("apartments:val/3?remove:vase_1&color:vase_1=red", "contradicts"),
        ("apartments:dev/3?remove:vase_1", "expected apartments"),
    ):
        with pytest.raises(ArgumentError, match=message):
            scenes.resolve(spec)


def test_what_cannot_be_is_refused_when_the_scene_is_opened() -> None:
    with pytest.raises(ArgumentError, match="has no 'sofa 8'; did you mean 'sofa 1'"):
        scenes.open_scene("apartments:val/3?color:sofa_8=red")
    with pytest.raises(ArgumentError, match="it is on already; expected 'off'"):
        scenes.apartment(3, "val", edits=["state:floor_lamp_1=on"])
    with pytest.raises(ArgumentError, match="no states"):
        scenes.apartment_table(3, "val", edits=["state:door_of_kitchen=closed"])


def test_possible_edits_are_canonical_and_can_be_done() -> None:
    edits = scenes.possible_edits("apartments:val/3")
    assert edits == scenes.possible_edits("apartments:val/3") and len(set(edits)) == len(edits)
    assert {edit.partition(":")[0] for edit in edits} == {"color", "remove", "state", "swap"}
    assert "state:toilet_1=open" in edits and "state:toilet_1=closed" not in edits
    assert not any("=green" in edit and "sofa_1" in edit for edit in edits)  # it is green
    for edit in edits[::40]:
        assert scenes.resolve(f"apartments:val/3?{edit}") == [f"apartments:val/3?{edit}"]
        scenes.apartment_table(3, "val", edits=[edit])
    assert not any("toilet_1=" in edit and edit.startswith("state") for edit in scenes.possible_edits(SPEC))
    for spec in ("apartments:val", "apartments:val:3", "house.glb"):
        with pytest.raises(ArgumentError, match="single apartment"):
            scenes.possible_edits(spec)


def test_possible_edits_can_be_added_to_those_applied() -> None:
    for scene, applied, absent, offered in (
        ("apartments:train/11", ["swap:candles_2,photo_1"], "remove:candles_2", "remove:candles_1"),
        ("apartments:val/3", ["color:sofa_1=red", "state:toilet_1=open"], "remove:sofa_1", "color:toilet_1=red"),
    ):
        edits = scenes.possible_edits(f"{scene}?{'&'.join(applied)}")
        assert absent not in edits and offered in edits
        for edit in edits:
            _core.scene.canonical_edits([*applied, edit])


def test_edited_scenes_are_kept_under_names_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plain: scenes.Scene
) -> None:
    monkeypatch.setenv("WIW_CACHE", str(tmp_path))
    made: list[list[str]] = []

    def make(seed: int, split: str, edits: list[str]) -> scenes.Scene:
        made.append(edits)
        return scenes.apartment_table(seed, split, edits=edits)

    monkeypatch.setattr(_core.scene, "apartment", make)
    scenes.open_scene("apartments:val/3")
    scenes.open_scene("apartments:val/3?remove:vase_1&color:sofa_1=red")
    again = scenes.open_scene("apartments:val/3?color:sofa+1=red&remove:vase+1")
    assert made == [[], ["color:sofa_1=red", "remove:vase_1"]]
    assert len(again.instances) == len(plain.instances) - 1
    assert len(scenes.open_scene("apartments:val/3").instances) == len(plain.instances)


def test_episodes_take_edited_scenes(tmp_path: Path) -> None:
    episode = Episode("a", SPEC, (0, 0, 0), 0, (1, 0, 0), 0, 1, {})
    assert pickle.loads(pickle.dumps(episode)) == episode
    files.save(tmp_path / "episodes.json", [episode], "imagenav")
    assert [asdict(e)["scene"] for e in files.load(tmp_path / "episodes.json")] == [SPEC]
    text = (tmp_path / "episodes.json").read_text()
    (tmp_path / "wrong.json").write_text(text.replace("color:sofa_1=red", "paint:sofa_1=red"))
    with pytest.raises(FileError, match="expected color:NAME=COLOR"):
        files.load(tmp_path / "wrong.json")


def test_the_command_line_shows_edited_scenes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], edited: scenes.Scene
) -> None:
    sheet = tmp_path / "sheet.png"
    assert main(["scenes", SPEC, "--out", str(sheet), "--views", "1", "--backend", "cpu"]) == 0
    assert "apartments:val/3?" in capsys.readouterr().out  # the rest may not fit beside the numbers
    assert sheet.stat().st_size > 10_000
    assert main(["scenes", "apartments:val/3?color:sofa_1=bleu"]) != 0
    assert "did you mean 'blue'" in " ".join(capsys.readouterr().err.split())
