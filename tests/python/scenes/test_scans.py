# SPDX-License-Identifier: Apache-2.0
"""Scans in the layouts of real datasets: geometry, textures, labels, and what is refused."""

from __future__ import annotations

import gzip
import json
import os
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scan_files as files
import trimesh
from numpy.typing import NDArray

from wiw import scenes
from wiw.cli.app import main
from wiw.cli.parts import TaskFlags
from wiw.datasets.ar import centre_of
from wiw.datasets.worlds import navmesh_file, world
from wiw.errors import ArgumentError, DependencyError, FileError
from wiw.nav import NavMesh
from wiw.render import Renderer
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.scenes import basis
from wiw.scenes.scans import hm3d, labels
from wiw.scenes.scans.glb import Glb
from wiw.scenes.scans.scene_dataset import words_of
from wiw.studies.evaluate import evaluate
from wiw.tasks.ar import AR

EYES = ((2.6, 2.6, 1.2), (4.6, 3.2, 1.5), (6.5, 0.6, 1.0))
"""Places in both rooms, Z up."""


@pytest.fixture(autouse=True)
def coarse(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sample labels every 20 cm, which is quick, but where a test asks for `fine` ones."""
    if "fine" not in request.fixturenames:
        monkeypatch.setattr(labels, "SPACING", 0.2)


@pytest.fixture
def fine() -> None:
    """Samples labels as a user's scans are sampled."""


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reads scenes without a child, which takes a second to start, and without the cache."""
    monkeypatch.setattr("wiw.scenes.opening.load", partial(scenes.load, cache=False, isolate=False))


def load(path: Path, **options: Any) -> scenes.Scene:
    return scenes.load(path, cache=False, isolate=False, **options)


def y_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], axis=-1)


def look(scene: scenes.Scene, size: tuple[int, int] = (64, 128)) -> dict[str, NDArray[Any]]:
    """Panoramas from each of `EYES`."""
    cameras = np.tile(np.eye(4), (len(EYES), 1, 1))
    cameras[:, :3, 3] = y_up(np.array(EYES))
    return Renderer(scene, backend="cpu").panorama(cameras, size, outputs=("color", "depth", "instance"))


def rays(size: tuple[int, int]) -> NDArray[np.float64]:
    """Directions [H, W, 3] of a panorama's pixels: front is -Z, right +X."""
    rows, columns = (np.arange(n) + 0.5 for n in size)
    azimuth = (columns / size[1] - 0.5) * 2 * np.pi
    elevation = (0.5 - rows / size[0]) * np.pi
    flat = np.cos(elevation)[:, None]
    return np.stack(
        [flat * np.sin(azimuth), np.sin(elevation)[:, None] + 0 * azimuth, -flat * np.cos(azimuth)], axis=-1
    )


def cast(path: Path, size: tuple[int, int]) -> NDArray[np.int64]:
    """Objects that the labelled mesh shows to each pixel, by trimesh and Embree; -9 where nothing is hit."""
    vertices, triangles, labels = files.read_ply_slowly(path)
    mesh = trimesh.Trimesh(y_up(vertices), triangles, process=False)
    directions = rays(size).reshape(-1, 3)
    found = []
    for eye in y_up(np.array(EYES)):
        hit = mesh.ray.intersects_first(np.tile(eye, (len(directions), 1)), directions)
        found.append(np.where(hit < 0, -9, labels[hit]).reshape(size))
    return np.stack(found)


def objects_of(scene: scenes.Scene, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The dataset's ids in an instance image; -1 for unlabelled surface."""
    by_id = [-9] + [int(thing["attributes"].get("scan_id", -1)) for thing in scene.instances]
    return np.array(by_id)[ids]


def named(scene: scenes.Scene, label: int) -> dict[str, Any]:
    return next(t for t in scene.instances if t["attributes"].get("scan_id") == str(label))


def assert_labels_fit(scene: scenes.Scene, truth: NDArray[np.int64]) -> None:
    """The labels of a scene are those of its labelled mesh, but for pixels at their borders."""
    views = look(scene)
    ours = objects_of(scene, views["instance"])
    there = truth != -9  # the ceiling is not in the labelled mesh
    assert (ours[~there] == -1).mean() > 0.8  # labels reach 25 cm, and so the edge of the ceiling
    assert (ours == truth)[there].mean() > 0.97
    for label in (files.FLOOR, files.WALL, files.BED, files.TABLE, files.PICTURE, files.CLOSET):
        assert (ours == label).any() and (ours == label).sum() == pytest.approx((truth == label).sum(), rel=0.1)


class TestMatterport:
    def test_every_object_is_where_the_labels_say(self, tmp_path: Path, fine: None) -> None:
        path = files.write_matterport(tmp_path)
        scene = load(path)
        assert_labels_fit(scene, cast(path.with_name(f"{path.stem}_semantic.ply"), (64, 128)))
        assert scene.attributes["up"] == "Z (Matterport3D)" and scene.texture_count == 2
        assert scene.missing_texture_share == 0

    def test_instance_ids_are_habitats(self, tmp_path: Path, fine: None) -> None:
        scene = load(files.write_matterport(tmp_path))
        for label in (files.WALL, files.BED, files.TABLE, files.PICTURE, files.CLOSET):
            thing = scene.instances[label - 1]
            assert thing["id"] == label and thing["category"] == files.NAMES[label]
            assert thing["attributes"]["mpcat40"] == files.MPCAT40[label]
            low, high = files.object_box(label)
            corners = np.sort(y_up(np.array([low, high])), axis=0)
            assert np.abs(thing["bounds"] - corners).max() < 0.06
        assert named(scene, 0)["id"] == len(files.NAMES)  # 0 is "nothing" in an instance image
        lamp = named(scene, files.LAMP)
        assert lamp["triangle_count"] == 0 and lamp["category"] == ""
        assert scene.warnings[0] == "1 of 7 objects have no surface: 6"
        assert np.isnan(lamp["bounds"]).all()
        assert scene.instances[-1]["name"] == "unlabelled"

    def test_rooms_are_those_of_the_house(self, tmp_path: Path) -> None:
        scene = load(files.write_matterport(tmp_path))
        assert [(room["name"], room["type"]) for room in scene.rooms] == [
            ("bedroom 1", "bedroom"),
            ("kitchen 1", "kitchen"),
        ]
        assert np.allclose(scene.rooms[1]["bounds"], [[4, 0, -4], [7, 2.6, 0]])
        assert named(scene, files.BED)["attributes"]["room"] == "bedroom 1"

    def test_the_surface_is_kept_whole(self, tmp_path: Path) -> None:
        path = files.write_matterport(tmp_path)
        plain = tmp_path / "plain.glb"
        plain.write_bytes(path.read_bytes())
        bare, scan = look(load(plain, up="z")), look(load(path))
        assert np.abs(bare["depth"] - scan["depth"]).max() < 1e-4

    def test_light_is_that_of_the_textures(self, tmp_path: Path) -> None:
        color = look(load(files.write_matterport(tmp_path)))["color"].astype(int)
        red = np.abs(color - (255, 40, 40)).max(axis=-1) <= 4
        assert red.sum() > 50  # the patch of the wall's picture, on walls of four directions and the ceiling

    def test_without_labels_there_are_no_objects_and_a_warning(self, tmp_path: Path) -> None:
        path = files.write_matterport(tmp_path)
        path.with_name(f"{path.stem}_semantic.ply").unlink()
        scene = load(path)
        assert [thing["name"] for thing in scene.instances] == ["unlabelled"]
        assert scene.attributes["labels"] == "none" and "no object has a label" in scene.warnings[0]
        assert len(scene.rooms) == 2

    def test_a_scan_is_read_again_once_its_labels_are_there(self, tmp_path: Path) -> None:
        path = files.write_matterport(tmp_path)
        semantic = path.with_name(f"{path.stem}_semantic.ply")
        aside = semantic.rename(tmp_path / "aside.ply")
        assert len(scenes.load(path).instances) == 1
        aside.rename(semantic)
        first = scenes.load(path)
        assert len(first.instances) == len(files.NAMES) + 1
        assert scenes.load(path).instances[2]["name"] == first.instances[2]["name"]

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            (lambda text: text.replace("ASCII 1.1", "ASCII 2.0"), "expected 'ASCII 1.1' in the first line"),
            (lambda text: text.replace("\nO 6", "\nX 6"), "has 6 objects, but its header says 7"),
            (lambda text: text.replace("2 0 7 7 2", "2 0 ² 7 2"), "has 7 objects, but its header says"),
            (lambda text: text.replace("2 0 7 7 2", f"2 0 {'9' * 5000} 7 2"), "has 7 objects, but its header says 999"),
            (lambda text: text.replace("\nO 6", "\nO -3"), "names object -3; expected ids from 0"),
            (lambda text: text.replace("R 1 0", "R 3 0"), "line .*: not a house record 'O' .*region 1 does not exist"),
            (lambda text: text.replace("C 4 104", "C x 104"), "line .*: not a house record 'C'"),
            (lambda text: text.replace("O 2 0 2 1.2", "O 2 0 2 nan"), "line .*: not a house record 'O' .*not finite"),
            (lambda text: "ASCII 1.1\n", "has no header record"),
        ],
    )
    def test_a_damaged_house_is_named(self, tmp_path: Path, change: Callable[[str], str], message: str) -> None:
        path = files.write_matterport(tmp_path)
        house = path.with_suffix(".house")
        assert change(house.read_text()) != house.read_text()
        house.write_text(change(house.read_text()))
        with pytest.raises(FileError, match=rf"17DRP5sb8fy\.house: {message}"):
            load(path)

    def test_labels_need_their_table(self, tmp_path: Path) -> None:
        path = files.write_matterport(tmp_path)
        path.with_suffix(".house").unlink()
        with pytest.raises(FileError, match=r"\.house: no such file; expected Matterport3D's table"):
            load(path)

    def test_labels_of_another_format_are_refused(self, tmp_path: Path) -> None:
        path = files.write_matterport(tmp_path)
        semantic = path.with_name(f"{path.stem}_semantic.ply")
        semantic.write_bytes(semantic.read_bytes().replace(b"int object_id", b"int something"))
        with pytest.raises(FileError, match="faces without the property 'object_id'"):
            load(path)
        semantic.write_bytes(semantic.read_bytes()[:-5])
        with pytest.raises(FileError, match="truncated"):
            load(path)


needs_decoder = pytest.mark.skipif(not basis.has_decoder(), reason="opengl_basisu is not installed (wiw[hm3d])")


@needs_decoder
class TestHm3d:
    @pytest.mark.parametrize("how", ["texture", "vertex colours"])
    def test_every_object_is_where_the_labels_say(self, tmp_path: Path, how: str, fine: None) -> None:
        scene = load(files.write_hm3d(tmp_path, how=how))
        files.write_ply(tmp_path / "labels.ply", 0.9, colors=False)
        truth = cast(tmp_path / "labels.ply", (64, 128))
        truth[truth == 0] = files.hm3d_id(0)
        views = look(scene)
        ours = objects_of(scene, views["instance"])
        there = truth != -9
        assert (ours == truth)[there].mean() > 0.97
        for label in (files.WALL, files.BED, files.TABLE, files.PICTURE, files.CLOSET):
            assert scene.instances[label - 1]["category"] == files.NAMES[label]
            assert (views["instance"] == label).any()
        assert scene.instances[files.hm3d_id(0) - 1]["category"] == "floor"
        assert scene.attributes["up"] == "Z (HM3D)" and scene.warnings == ["1 of 7 objects have no surface"]

    def test_textures_are_decoded_and_upright(self, tmp_path: Path) -> None:
        ours, plain = load(files.write_hm3d(tmp_path)), load(files.write_matterport(tmp_path))
        assert ours.texture_count == 2 and ours.missing_texture_share == 0
        assert np.abs(look(ours)["color"].astype(int) - look(plain)["color"]).mean() < 3  # ETC1S loses a little

    @pytest.mark.parametrize("name", files.BASIS)
    def test_rows_come_from_the_top_whatever_the_file_says(self, name: str) -> None:
        data = (files.DATA / name).read_bytes()
        painting = files.paintings()[files.BASIS.index(name)].astype(int)
        assert np.abs(basis.decode(data)[..., :3] - painting).mean() < 3
        assert np.abs(basis.decode(data)[::-1, :, :3] - painting).mean() > 10

    def test_khronos_textures_are_decoded(self, tmp_path: Path) -> None:
        path = tmp_path / "a.basis.glb"
        ktx2 = (files.DATA / "wall.ktx2").read_bytes()
        path.write_bytes(files.basis_glb([ktx2, ktx2], "KHR_texture_basisu").bytes())
        scene = load(path)
        assert scene.texture_count == 2 and scene.missing_texture_share == 0

    def test_a_scan_without_labels_is_drawn_and_named(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        for name in ("TEEsavR23oF.semantic.glb", "TEEsavR23oF.semantic.txt"):
            (path.parent / name).unlink()
        scene = load(path)
        assert scene.attributes["labels"] == "none" and "no object has a label" in scene.warnings[0]
        assert [thing["name"] for thing in scene.instances] == ["unlabelled"]

    @pytest.mark.parametrize(
        ("name", "message"), [("txt", "expected the table of the labels"), ("glb", "expected the mesh with the labels")]
    )
    def test_half_of_the_labels_is_refused(self, tmp_path: Path, name: str, message: str) -> None:
        path = files.write_hm3d(tmp_path)
        (path.parent / f"TEEsavR23oF.semantic.{name}").unlink()
        with pytest.raises(FileError, match=message):
            load(path)

    def test_categories_may_hold_commas(self, tmp_path: Path) -> None:
        path = tmp_path / "a.semantic.txt"
        path.write_text(files.annotation_text([(1, 0x0A0B0C, "cup, mug", 3), (2, 0x00000F, "wall", -1)]))
        table = hm3d.read_annotations(path)
        assert table.objects[1].category == "cup, mug" and table.colors == {0x0A0B0C: 1, 0x0F: 2}

    @pytest.mark.parametrize(
        ("row", "message"),
        [
            ('x,00FF00,"bed",0', "line 2: expected id,RRGGBB"),
            ('1,GG0000,"bed",0', "line 2: expected id,RRGGBB"),
            ('1,00FF00,"bed"', "line 2: expected id,RRGGBB"),
            ('1,00FF00,"bed",0\n1,00FF01,"sofa",0', "line 3: .*already used"),
            ("1,00FF00," + "a" * 200_000 + ",0", "not a table of comma-separated values: field larger"),
        ],
    )
    def test_a_damaged_table_is_named(self, tmp_path: Path, row: str, message: str) -> None:
        path = tmp_path / "a.semantic.txt"
        path.write_text(f"HM3D Semantic Annotations\n{row}\n")
        with pytest.raises(FileError, match=rf"a\.semantic\.txt: {message}"):
            hm3d.read_annotations(path)

    def test_colours_that_no_object_has_are_counted(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        table = path.parent / "TEEsavR23oF.semantic.txt"
        table.write_text("\n".join(line for line in table.read_text().splitlines() if '"bed"' not in line))
        scene = load(path)
        assert any("has colours that the table does not have" in warning for warning in scene.warnings)
        assert "bed" not in scene.categories

    def test_a_texture_that_cannot_be_decoded_is_missing(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        whole = (files.DATA / "wall_etc1s.basis").read_bytes()
        path.write_bytes(files.basis_glb([whole, whole[:200]]).bytes())
        scene = load(path)
        assert 0.3 < scene.missing_texture_share < 0.7 and scene.texture_count == 1
        assert any("image 1 of TEEsavR23oF.basis.glb cannot be decoded" in warning for warning in scene.warnings)

    def test_a_damaged_mesh_is_a_file_error(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        whole = path.read_bytes()
        path.write_bytes(whole[:300])
        with pytest.raises(FileError, match=r"TEEsavR23oF\.basis\.glb"):
            load(path)
        path.write_bytes(whole)
        painted = path.parent / "TEEsavR23oF.semantic.glb"
        painted.write_bytes(painted.read_bytes().replace(b"bufferView", b"bufferVieW"))
        with pytest.raises(FileError, match=r"TEEsavR23oF\.semantic\.glb: cannot be read"):
            load(path)

    def test_labels_of_coordinates_in_16_bits_are_those_of_floats(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        plain = load(path)
        painted = files.painted_glb()
        (uv,) = (entry for entry in painted.accessors if entry["type"] == "VEC2")
        place = painted.views[uv["bufferView"]]
        floats = np.frombuffer(painted.binary, np.float32, 2 * uv["count"], place["byteOffset"])
        short = np.round(65535 * floats).astype(np.uint16).tobytes()
        uv |= {"bufferView": painted.view(short), "componentType": 5123, "normalized": True}
        (path.parent / "TEEsavR23oF.semantic.glb").write_bytes(painted.bytes())
        assert [(t["name"], t["triangle_count"]) for t in load(path).instances] == [
            (t["name"], t["triangle_count"]) for t in plain.instances
        ]

    def test_a_painted_mesh_that_says_nothing_is_a_file_error(self, tmp_path: Path) -> None:
        path = files.write_hm3d(tmp_path)
        corners, none = np.eye(3, dtype=np.float32), np.zeros((0, 3), np.uint32)
        one, uv, rgba = none.dtype.type([[0, 1, 2]]), np.zeros((3, 2), np.float32), np.zeros((3, 4), np.uint8)
        empty, blank, moved = files.Glb(), files.Glb(), files.Glb()
        empty.node(empty.mesh(none, POSITION=corners, COLOR_0=rgba))
        blank.node(blank.mesh(one, blank.textured(blank.image(b"")), POSITION=corners, TEXCOORD_0=uv))
        picture = moved.image(files.png(files.paintings()[0]))
        moved.node(moved.mesh(one, moved.textured(picture), POSITION=corners, TEXCOORD_0=uv))
        info = moved.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]
        info["extensions"] = {"KHR_texture_transform": {"scale": [2, 2]}}
        for glb, message in ((empty, "no triangles"), (blank, "cannot be decoded"), (moved, "KHR_texture_transform")):
            (path.parent / "TEEsavR23oF.semantic.glb").write_bytes(glb.bytes())
            with pytest.raises(FileError, match=rf"TEEsavR23oF\.semantic\.glb: .*{message}"):
                load(path)


def test_without_the_decoder_a_scan_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = files.write_hm3d(tmp_path)
    monkeypatch.setattr(basis, "has_decoder", lambda: False)
    with pytest.raises(DependencyError, match=r"pip install 'wiw\[hm3d\]'"):
        load(path)


@needs_decoder
def test_a_scene_that_was_read_without_the_decoder_is_read_again_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "a.glb"
    path.write_bytes(files.basis_glb([(files.DATA / "wall_etc1s.basis").read_bytes()]).bytes())
    os.utime(path, (1, 1))  # long ago, so that what is read is kept
    with monkeypatch.context() as patch:
        patch.setattr(basis, "has_decoder", lambda: False)
        grey = scenes.load(path, isolate=False)
    assert grey.missing_texture_share == 1 and "wiw[hm3d]" in grey.warnings[0]
    found = scenes.load(path, isolate=False)
    assert found.missing_texture_share == 0 and not found.warnings


class TestReplica:
    def test_every_face_has_its_object(self, tmp_path: Path) -> None:
        path = files.write_replica(tmp_path)
        scene = load(path)
        truth = cast(path, (64, 128))
        ours = objects_of(scene, look(scene)["instance"])
        assert (ours == truth).mean() > 0.999
        assert scene.name == "room_0" and scene.attributes["up"] == "Z (Replica)"
        assert scene.instances[files.TABLE - 1]["category"] == "dining table"
        assert (look(scene)["color"].std(axis=(0, 1, 2)) > 5).all()  # colours of vertices, not white

    def test_a_table_of_classes_alone_names_classes(self, tmp_path: Path) -> None:
        scene = load(files.write_replica(tmp_path, objects=False))
        assert scene.instances[files.BED - 1]["name"] == "bed"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("{", "not a Replica table"),
            (
                '{"classes": [{"id": 1, "name": "a"}], "objects": [{"id": 3, "class_id": 7}]}',
                "not a Replica table .*KeyError: 7",
            ),
            ('{"objects": []}', "not a Replica table .*KeyError: 'classes'"),
            ('{"classes": [{"id": 1e999, "name": "a"}]}', "not a Replica table .*OverflowError"),
        ],
    )
    def test_a_damaged_table_is_named(self, tmp_path: Path, text: str, message: str) -> None:
        path = files.write_replica(tmp_path)
        path.with_name("info_semantic.json").write_text(text)
        with pytest.raises(FileError, match=rf"info_semantic\.json: {message}"):
            load(path)

    @pytest.mark.parametrize("up", ["Y", "Z", "banana", "x", ""])
    def test_an_axis_that_is_none_is_refused(self, tmp_path: Path, up: str) -> None:
        with pytest.raises(ArgumentError, match=f"up must be 'auto', 'y' or 'z', got '{up}'"):
            load(files.write_replica(tmp_path), up=up)

    def test_the_axis_may_be_chosen(self, tmp_path: Path) -> None:
        path = files.write_replica(tmp_path)
        texts = {up: load(path, up=up).attributes["up"] for up in (None, "auto", "y", "z")}
        assert texts == {None: "Z (Replica)", "auto": "Z (Replica)", "y": "Y (Replica)", "z": "Z (Replica)"}

    def test_what_cannot_be_drawn_is_refused(self, tmp_path: Path) -> None:
        path = files.write_replica(tmp_path)
        files.write_ply(path, 0.5, colors=False)
        with pytest.raises(FileError, match="has no colours"):
            load(path)
        path.with_name("info_semantic.json").unlink()
        with pytest.raises(FileError, match="expected Replica's table"):
            load(path)


def test_specs_name_the_scans_of_a_folder(tmp_path: Path) -> None:
    houses = [files.write_matterport(tmp_path / "mp3d", name) for name in ("a", "b")]
    assert scenes.resolve(f"mp3d:{tmp_path / 'mp3d'}") == [str(house) for house in houses]
    assert scenes.resolve(f"mp3d:{houses[0].parent}") == [str(houses[0])]
    home = files.write_hm3d(tmp_path / "hm3d")
    assert scenes.resolve(f"hm3d:{tmp_path / 'hm3d'}:val") == scenes.resolve(f"hm3d:{tmp_path / 'hm3d'}") == [str(home)]
    room = files.write_replica(tmp_path / "replica")
    assert scenes.resolve(f"replica:{tmp_path / 'replica'}") == [str(room)]
    assert scenes.absolute("hm3d:there:val") == f"hm3d:{Path.cwd() / 'there'}:val"
    with pytest.raises(FileError, match=r"train: no such folder; expected a dataset of scans .*; there is val"):
        scenes.resolve(f"hm3d:{tmp_path / 'hm3d'}:train")
    with pytest.raises(FileError, match="holds no scan; expected Replica's"):
        scenes.resolve(f"replica:{tmp_path}")


@needs_decoder
def test_a_scan_without_its_textures_stops_a_run_unless_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_process: None
) -> None:
    path = files.write_hm3d(tmp_path)
    path.write_bytes(files.basis_glb([(files.DATA / "wall_etc1s.basis").read_bytes(), b"none"]).bytes())
    with pytest.raises(FileError, match=r"[0-9]+% of its surface lacks its texture .*--allow-missing-textures"):
        scenes.open_scene(str(path))
    monkeypatch.setenv(scenes.ALLOW_VARIABLE, "1")
    assert scenes.open_scene(str(path)).missing_texture_share > 0.3
    monkeypatch.setattr(basis, "has_decoder", lambda: False)
    assert load(path).missing_texture_share == 1


def test_the_flag_reaches_the_processes_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(scenes.ALLOW_VARIABLE, "0")
    TaskFlags(scenes="apartments:val:1").make_recipe("imagenav", 0)
    assert not scenes.missing_textures_allowed()
    recipe = TaskFlags(scenes="apartments:val:1", allow_missing_textures=True).make_recipe("imagenav", 0)
    assert scenes.missing_textures_allowed() and "allow_missing_textures" not in recipe.options


def by_name(scene: scenes.Scene, name: str) -> NDArray[np.float32]:
    return next(thing["bounds"] for thing in scene.instances if thing["name"] == name)


class TestSceneDataset:
    def test_everything_is_where_it_is_placed(self, tmp_path: Path) -> None:
        scene = load(files.write_scene_dataset(tmp_path))
        assert np.allclose(by_name(scene, "stage"), [[0, 0, -4], [7, 2.6, 0]], atol=1e-5)
        # x becomes -z by a left turn: [0, 0.4] along x and [0, 0.6] along z become [-0.4, 0] along z, [0, 0.6] along x
        assert np.allclose(by_name(scene, "chair 1"), [[2, 0, -1.4], [2.6, 0.9, -1]], atol=1e-5)
        assert np.allclose(by_name(scene, "sofa 2"), [[3.2, 0, -2.3], [4.8, 0.5, -1.7]], atol=1e-5)
        assert np.allclose(by_name(scene, "sofa_part_1 3"), [[1, 1, -3], [1.3, 1.2, -2.7]], atol=1e-5)
        assert np.allclose(by_name(scene, "chest 4"), [[5, 0, -1], [6, 0.8, -0.15]], atol=1e-5)
        assert [thing["category"] for thing in scene.instances] == ["", "chair", "couch", "sofa part", "chest"]
        assert scene.texture_count == 1 and scene.attributes["dataset"] == "tiny" and not scene.warnings

    def test_rays_hit_what_a_slow_placement_says(self, tmp_path: Path) -> None:
        scene = load(files.write_scene_dataset(tmp_path))
        boxes = [by_name(scene, name).astype(float) for name in ("chair 1", "sofa 2", "sofa_part_1 3")]
        views, directions = look(scene), rays((64, 128)).reshape(-1, 3)
        for eye, ids in zip(y_up(np.array(EYES)), views["instance"], strict=True):
            for number, box in enumerate(boxes, 2):
                with np.errstate(divide="ignore"):
                    low, high = (box[0] - eye) / directions, (box[1] - eye) / directions
                near, far = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
                through = (near <= far) & (far > 0)
                assert not (ids.reshape(-1) == number)[~through].any()

    def test_the_origin_may_be_chosen_for_one_object(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        body = json.loads(path.read_text()) | {"translation_origin": "COM"}
        files.write_json(path, body)
        scene = load(path)
        assert np.allclose(by_name(scene, "chair 1").mean(axis=0), [2, 0, -1], atol=1e-5)
        assert np.allclose(by_name(scene, "sofa_part_1 3")[0], [1, 1, -3], atol=1e-5)

    def test_all_that_is_missing_is_named_at_once(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        (tmp_path / "objects/chair.glb").unlink()
        (tmp_path / "objects/decomposed/sofa/part.glb").unlink()
        (tmp_path / "urdf/chest/front.glb").unlink()
        with pytest.raises(FileError) as caught:
            load(path)
        message = str(caught.value)
        assert "home.scene_instance.json: 3 objects" in message
        assert all(name in message for name in ("objects: chair", "part.glb", "front.glb"))

    def test_the_navigation_mesh_that_the_scene_names_is_used(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        assert navmesh_file(str(path)) is None
        NavMesh.build(load(path)).save(tmp_path / "navmeshes/flat.navmesh")
        assert navmesh_file(str(path)) == tmp_path / "navmeshes/flat.navmesh"

    def test_the_stage_is_placed_as_the_scene_says(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        plain = by_name(load(path), "stage")
        placed = {"translation": [10, 1, 0], "rotation": [0.70710678, 0, 0.70710678, 0], "uniform_scale": 2}
        stage = json.loads(path.read_text())["stage_instance"] | placed
        files.write_json(path, json.loads(path.read_text()) | {"stage_instance": stage})
        turned = np.stack([plain[:, 2], plain[:, 1], -plain[::-1, 0]], axis=1)  # by 90 degrees to the left
        assert np.allclose(by_name(load(path), "stage"), 2 * turned + [10, 1, 0], atol=1e-5)

    def test_no_object_gets_a_ceiling(self, tmp_path: Path) -> None:
        with pytest.raises(ArgumentError, match="a ceiling cannot be added to a scene dataset"):
            load(files.write_scene_dataset(tmp_path), ceiling=2.4)

    @pytest.mark.parametrize(
        ("name", "section", "regions"),
        [
            ("words", {"words": "semantics/tiny_lexicon.json"}, False),
            (
                "%%CONFIG_NAME_AS_ASSET_FILENAME%%.semantic_config.json",
                {
                    "default_attributes": {"semantic_descriptor_filename": "../tiny_lexicon.json"},
                    "paths": {".json": ["semantics/scenes/*"]},
                },
                True,
            ),
            ("labels", {"labels": "semantics/flat.house"}, False),
        ],
    )
    def test_classes_and_rooms_are_those_of_the_file_that_the_dataset_names(
        self, tmp_path: Path, name: str, section: dict[str, Any], regions: bool
    ) -> None:
        path = files.write_scene_dataset(tmp_path)
        config = tmp_path / "tiny.scene_dataset_config.json"
        body = json.loads(config.read_text()) | {"semantic_scene_descriptor_instances": section}
        body["scene_instances"]["default_attributes"] = {"semantic_scene_instance": name}
        files.write_json(config, body)
        (tmp_path / "semantics/scenes").mkdir()
        (tmp_path / "semantics/flat.house").write_text("ASCII 1.1")
        region = {"name": "room 1", "label": "living_room", "min_bounds": [0, 0, -4], "max_bounds": [7, 2.6, 0]}
        files.write_json(tmp_path / "semantics/scenes/home.semantic_config.json", {"region_annotations": [region]})
        scene = load(path)
        sofa = next(thing for thing in scene.instances if thing["name"] == "sofa 2")
        assert sofa["category"] == ("sofa" if name == "labels" else "couch")
        assert [room["type"] for room in scene.rooms] == ["living room"] * regions

    def test_names_that_turn_up_later_are_read(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))
        path = files.write_scene_dataset(tmp_path / "homes")
        lexicon, table = (tmp_path / "homes/semantics" / name for name in ("tiny_lexicon.json", "objects.csv"))
        config = tmp_path / "homes/tiny.scene_dataset_config.json"
        section = {"paths": {".json": ["semantics/tiny_lexicon.json"]}}
        files.write_json(config, json.loads(config.read_text()) | {"semantic_scene_descriptor_instances": section})
        words = lexicon.read_text()
        lexicon.unlink()

        def categories() -> list[str]:
            return [thing["category"] for thing in scenes.load(path, isolate=False).instances]

        assert categories() == ["", "chair", "sofa", "sofa part", "chest"]
        table.write_text("id,main_category\nchair,throne\n")
        assert categories()[1:3] == ["throne", "sofa"]
        lexicon.write_text(words)
        assert categories()[1:3] == ["throne", "couch"]

    def test_scenes_may_lie_outside_of_the_datasets_folder(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path / "homes")
        (tmp_path / "val").mkdir()
        config = tmp_path / "val/more.scene_dataset_config.json"
        files.write_json(config, {"scene_instances": {"paths": {".json": [str(path.parent)]}}})
        assert scenes.resolve(f"hssd:{tmp_path / 'val'}:scenes") == [str(path)]
        with pytest.raises(FileError, match="holds no scan"):
            scenes.resolve(f"hssd:{tmp_path / 'val'}:val")

    def test_a_folder_may_be_called_like_a_pattern(self, tmp_path: Path) -> None:
        assert load(files.write_scene_dataset(tmp_path / "homes [v2]*?")).instances

    def test_specs_name_the_scenes_of_the_dataset(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        for kind in ("hssd", "replicacad", "procthor"):
            assert scenes.resolve(f"{kind}:{tmp_path}") == [str(path)]
        with pytest.raises(FileError, match="holds no scan"):
            scenes.resolve(f"hssd:{tmp_path}:val")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"stage_instance": {}}, "cannot be read as a scene instance .*KeyError: 'template_name'"),
            ({"object_instances": [{"template_name": "chair", "rotation": [0, 0, 0, 0]}]}, "is not a quaternion"),
            ({"object_instances": [{"template_name": "chair", "translation": [1, 2]}]}, "three finite numbers"),
            ({"object_instances": [{"template_name": "chair", "translation": [0, 0, 10**400]}]}, "OverflowError"),
            ({"object_instances": 3}, "cannot be read as a scene instance"),
            ({"object_instances": [{"template_name": "chair", "uniform_scale": 1e300}]}, "vertex that is not finite"),
        ],
    )
    def test_a_damaged_scene_is_named(self, tmp_path: Path, change: dict[str, Any], message: str) -> None:
        path = files.write_scene_dataset(tmp_path)
        files.write_json(path, json.loads(path.read_text()) | change)
        with pytest.raises(FileError, match=rf"home\.scene_instance\.json: .*{message}"):
            load(path)

    @pytest.mark.parametrize("patterns", [3, ["stages"], {".json": "stages"}, {".json": [3]}, {".json": ["a\0"]}])
    def test_a_damaged_configuration_is_named(self, tmp_path: Path, patterns: Any) -> None:
        path = files.write_scene_dataset(tmp_path)
        config = tmp_path / "tiny.scene_dataset_config.json"
        body = json.loads(config.read_text())
        files.write_json(config, body | {"scene_instances": {"paths": patterns}})
        with pytest.raises(FileError, match=r"config\.json: scene_instances: paths: expected lists of patterns"):
            load(path)

    def test_a_table_of_names_with_an_endless_cell_is_refused(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        (tmp_path / "semantics/objects.csv").write_text("id,name\nchair," + "a" * 200_000)
        with pytest.raises(FileError, match=r"objects\.csv: not a table of comma-separated values: field larger"):
            load(path)

    def test_a_scene_needs_its_dataset(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        (tmp_path / "tiny.scene_dataset_config.json").unlink()
        with pytest.raises(FileError, match=r"no .*scene_dataset_config\.json in the folders above names this scene"):
            load(path)

    @pytest.mark.parametrize(
        ("name", "category"),
        [
            ("Dining_Table_20_1", "dining table"),
            ("frl_apartment_wall_cabinet_01", "wall cabinet"),
            ("RoboTHOR_floor_lamp_v", "floor lamp"),
            ("0ab13f2c7d8e9f001122_part_3", ""),
        ],
    )
    def test_categories_are_read_from_names_last(self, name: str, category: str) -> None:
        assert words_of(name) == category

    def test_a_urdf_that_is_none_is_named(self, tmp_path: Path) -> None:
        path = files.write_scene_dataset(tmp_path)
        urdf = tmp_path / "urdf/chest/chest.urdf"
        whole = urdf.read_text()
        for text, message in (
            (whole[:80], "ParseError"),
            (whole.replace('xyz="0 0 1"', 'xyz="0 0 x"'), "ValueError"),
            (whole.replace('parent link="body"', 'parent link="drawer"'), "cycle"),
        ):
            urdf.write_text(text)
            with pytest.raises(FileError, match=rf"chest\.urdf: not a readable URDF .*{message}"):
                load(path)


def test_verify_says_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files.write_matterport(tmp_path / "all", "whole")
    moved = files.write_matterport(tmp_path / "all", "moved").with_suffix(".house")
    moved.write_text(moved.read_text().replace("O 2 0 2 1.2 ", "O 2 0 2 3.2 "))
    damaged = files.write_replica(tmp_path / "all")
    damaged.with_name("info_semantic.json").write_text("{")
    assert main(["scenes", "verify", str(tmp_path / "all")]) == 1
    out = capsys.readouterr().out
    assert "3 scans, 2 with something wrong" in out and "info_semantic.json: not a Replica table" in out
    assert "1 of 6 objects are over 0.5 m from their boxes in the house file: 2" in out
    row = next(line.split() for line in out.splitlines() if line.startswith("whole"))
    assert row[2:7] == ["2", "0.0", "6", "6", "2"]
    assert main(["scenes", "verify", f"mp3d:{tmp_path / 'all' / 'whole'}"]) == 0


def test_targets_of_published_episodes_are_objects_of_the_scan(tmp_path: Path, in_process: None) -> None:
    path = files.write_matterport(tmp_path)
    item = {
        "scene_id": f"/home/authors/scene_datasets/mp3d/{path.stem}/{path.name}",
        "episode_id": 0,
        "start_position": [4.6, 0.0, -3.2],
        "start_rotation": [1.0, 0.0, 0.0, 0.0],
        "target_id": files.TABLE,
        "target_categrory": "table",
        "difficulty": 1,
    }
    episodes = tmp_path / "episodes_AR.json.gz"
    episodes.write_bytes(gzip.compress(json.dumps({"episodes": [item]}).encode()))
    task = AR(episode_file=episodes, scene_folder=tmp_path)
    episode = task.episode(0)
    assert np.allclose(episode.goal_position, [5.6, 0.375, -1.9], atol=0.05)
    mask = task.environment().begin(episode).target.mask
    columns = (np.flatnonzero(mask.any(axis=0)) + 0.5) / mask.shape[1]  # of a panorama; its middle is ahead, -Z
    assert np.allclose(columns.mean(), 0.5 + np.arctan2(1.0, -1.3) / (2 * np.pi), atol=0.02)


def test_published_questions_and_object_goals_run_on_a_scan(tmp_path: Path, in_process: None) -> None:
    pytest.importorskip("opengl_basisu", reason="needs opengl_basisu: pip install 'wiw[hm3d]'")
    path = files.write_hm3d(tmp_path, "00003-c5eTyR3Rxyh", split="train")
    start = [4.6, 0.0, -3.2]
    question = {  # one of OpenEQA's
        "question": "What is the object to the left of the bed?",
        "answer": "A radiator",
        "category": "object recognition",
        "question_id": "23fb241e-989a-4299-a3fb-8d41f7156397",
        "episode_history": "hm3d-v0/003-hm3d-c5eTyR3Rxyh",
    }
    (tmp_path / "open-eqa.json").write_text(json.dumps([question]))
    view = {"agent_state": {"position": [5.6, 0.0, -3.0], "rotation": [0.0, 0.0, 0.0, 1.0]}, "iou": 0.5}
    goal = {
        "episode_id": "0",
        "scene_id": str(path.relative_to(tmp_path)),
        "start_position": start,
        "start_rotation": [0.0, 0.0, 0.0, 1.0],
        "goals": [],
        "object_category": "table",
    }
    objects = {f"{path.name}_table": [{"object_id": files.TABLE, "view_points": [view]}]}
    (tmp_path / "objectnav.json").write_text(json.dumps({"episodes": [goal], "goals_by_category": objects}))
    for task, name, policy in (("aeqa", "open-eqa.json", "explorer"), ("imagenav", "objectnav.json", "heuristic")):
        options = {"episode_file": str(tmp_path / name), "scene_folder": str(tmp_path)}
        log = evaluate(TaskRecipe(task, options), AgentRecipe(policy), 1, out=tmp_path / task, progress=False)
        (row,) = log.episodes
        assert row["status"] == "done", row["error"]
        assert Path(row["scene"]) == path


def test_active_recognition_refuses_a_scan_without_labels(tmp_path: Path, in_process: None) -> None:
    path = files.write_matterport(tmp_path)
    semantic = path.with_name(f"{path.stem}_semantic.ply")
    assert np.allclose(centre_of(world(str(path)), files.BED, "here")[[0, 2]], [1.2, -0.95], atol=0.1)
    with pytest.raises(ArgumentError, match="here: target 6 has no surface"):
        centre_of(world(str(path)), files.LAMP, "here")
    bare = path.rename(path.with_name("bare.glb"))
    path.with_suffix(".house").rename(bare.with_suffix(".house"))
    semantic.unlink()
    with pytest.raises(ArgumentError, match=r"here: .*bare\.glb has no labels"):
        centre_of(world(str(bare)), 1, "here")


def mutate(data: bytes, rng: random.Random) -> bytes:
    """A file with some bytes changed, or cut short."""
    if rng.random() < 0.2:
        return data[: rng.randrange(len(data))]
    changed = bytearray(data)
    for _ in range(rng.choice([1, 2, 8])):
        at = rng.randrange(len(changed))
        changed[at : at + rng.choice([0, 1, 1, 4])] = rng.choice([b"\xff", b"-1", b"nan", b"[]", b"\0\0\0\0", b"9"])
    return bytes(changed)


@pytest.mark.parametrize("rounds", [16, pytest.param(5000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", ["matterport", "hm3d", "replica", "scene_dataset"])
def test_mutated_files_end_in_an_error_of_ours_or_a_scene(tmp_path: Path, kind: str, rounds: int) -> None:
    path = getattr(files, f"write_{kind}")(tmp_path)
    rng, refused = random.Random(7), 0
    parts = sorted(file for file in tmp_path.rglob("*") if file.is_file())
    for _ in range(rounds):
        part = rng.choice(parts)
        whole = part.read_bytes()
        part.write_bytes(mutate(whole, rng))
        try:
            load(path)
        except (ArgumentError, FileError):
            refused += 1
        part.write_bytes(whole)
    assert refused > 2


def test_nodes_of_a_labelled_mesh_without_scenes_count_once() -> None:
    parent = {"translation": [1, 2, 3], "children": [1], "mesh": 0}
    nodes = [parent, {"translation": [0, 0, 4], "mesh": 1}, {"mesh": 2}]
    scenes: list[dict[str, Any]] = [{"nodes": [0, 2]}]
    for document in ({"nodes": nodes}, {"nodes": nodes, "scenes": scenes, "scene": 0}):
        placed = dict(Glb(Path("x.glb"), document, b"").node_transforms)
        assert {mesh: own[:3, 3].tolist() for mesh, own in placed.items()} == {0: [1, 2, 3], 1: [1, 2, 7], 2: [0, 0, 0]}
        assert len(Glb(Path("x.glb"), document, b"").node_transforms) == 3
    assert Glb(Path("x.glb"), {"nodes": nodes, "scenes": [{"name": "empty"}]}, b"").node_transforms == []
    with pytest.raises(ValueError, match="cycle"):
        list(Glb(Path("x.glb"), {"nodes": [{"children": [1]}, {"children": [0]}]}, b"").node_transforms)
