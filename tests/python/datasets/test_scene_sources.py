# SPDX-License-Identifier: Apache-2.0
"""The digest of a scene changes with each file that it is made from, and with nothing else."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Mapping
from pathlib import Path

import pytest

from wiw.datasets.scene_sources import digest_scene, digest_scenes


def write_glb(document: object) -> bytes:
    text = json.dumps(document).encode()
    return b"glTF" + struct.pack("<III", 2, 20 + len(text), len(text)) + b"JSON" + text + b'"uri": "never.png"'


SCENES: Mapping[str, Mapping[str, bytes]] = {
    "house.obj": {
        "house.obj": b"mtllib my colours.mtl\r\nv 0 0 0\n",
        "my colours.mtl": b"newmtl a\n\tmap_Kd -s 1 1 1 wall paper.png\nmap_Bump bump.png\n",
        "wall paper.png": b"1",
        "textures/bump.png": b"2",
        "house.navmesh": b"3",
    },
    "several.obj": {"several.obj": b"mtllib a.mtl b.mtl\n", "a.mtl": b"", "b.mtl": b"map_Kd b.png\n", "b.png": b"1"},
    "old mac.obj": {
        "old mac.obj": b"# one\rmtllib a.mtl\rv 0 0 0\r",
        "a.mtl": b"newmtl a\rmap_Kd wall.png\rmap_Bump bump.png\r",
        "wall.png": b"1",
        "bump.png": b"2",
    },
    "house.gltf": {
        "house.gltf": json.dumps({"buffers": [{"uri": "a%20b.bin"}, {"uri": "data:,x"}]}).encode(),
        "a b.bin": b"1",
    },
    "house.glb": {"house.glb": write_glb({"images": [{"uri": "wall.png"}]}), "wall.png": b"1"},
    "mp3d/scan.obj": {"mp3d/scan.obj": b"v 0 0 0\n", "mp3d/scan.house": b"1", "mp3d/scan_semantic.ply": b"2"},
    "hm3d/scan.basis.glb": {
        "hm3d/scan.basis.glb": write_glb({}),
        "hm3d/scan.basis.navmesh": b"1",
        "hm3d/scan.semantic.glb": write_glb({"images": [{"uri": "labels.png"}]}),
        "hm3d/scan.semantic.txt": b"2",
        "hm3d/labels.png": b"3",
    },
    "replica/mesh_semantic.ply": {
        "replica/mesh_semantic.ply": b"ply\nend_header\n",
        "replica/info_semantic.json": b"{}",
    },
    "house.ply": {"house.ply": b"ply\ncomment TextureFile wall.png\nend_header\n", "wall.png": b"1"},
    "house.dae": {"house.dae": b"<image><init_from> file://wall.png </init_from></image>", "wall.png": b"1"},
    "worlds/a.world": {
        "worlds/a.world": b"<include><uri>model://sun</uri></include><uri>model://chair</uri>",
        "models/chair/model.config": b"<sdf>chair.sdf</sdf>",
        "models/chair/chair.sdf": b"<uri>model://chair/meshes/chair.dae</uri>",
        "models/chair/meshes/chair.dae": b"<init_from>wood.png</init_from>",
        "models/chair/materials/textures/wood.png": b"1",
    },
}


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("scene", SCENES)
def test_a_digest_depends_on_each_file_of_a_scene(scene: str, tmp_path: Path) -> None:
    folder, files = tmp_path / "here", SCENES[scene]
    write_files(folder, files)
    found = digest_scene(folder / scene)
    for name, content in files.items():
        (folder / name).write_bytes(content + b"\n")
        assert digest_scene(folder / scene) != found, name
        (folder / name).unlink()
        assert digest_scene(folder / scene) != found, name
        (folder / name).write_bytes(content)
    assert digest_scene(folder / scene) == found


@pytest.mark.parametrize("scene", SCENES)
def test_a_digest_depends_on_nothing_else(scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path / "here", SCENES[scene])
    write_files(tmp_path / "there/more", SCENES[scene])
    write_files((tmp_path / "there/more" / scene).parent, {"never.png": b"1", "other.obj": b"2"})
    found = digest_scene(tmp_path / "here" / scene)
    assert digest_scene(tmp_path / "there/more" / scene) == found
    monkeypatch.chdir(tmp_path / "there/more")
    assert digest_scene(Path(scene)) == found


def test_what_a_scene_names_besides_files_and_models_is_not_read(tmp_path: Path) -> None:
    """A device may never end, and the folder above may be a whole disk."""
    write_files(tmp_path, {"here/house.obj": b"mtllib /dev/zero\nmtllib ..\n", "there/house.obj": b""})
    os.mkfifo(tmp_path / "here/pipe.mtl")
    with (tmp_path / "here/house.obj").open("ab") as file:
        file.write(b"mtllib pipe.mtl\n")
    found = digest_scene(tmp_path / "here/house.obj")
    write_files(tmp_path, {"there/house.obj": b"v 0 0 0\n"})
    assert digest_scene(tmp_path / "here/house.obj") == found
    there = f"<uri>{tmp_path / 'there'}</uri><uri>../there</uri>".encode()
    write_files(tmp_path, {"here/in.world": b"<uri>model://box</uri>" + there, "here/box/model.sdf": b""})
    found = digest_scene(tmp_path / "here/in.world")
    write_files(tmp_path, {"there/house.obj": b""})
    assert digest_scene(tmp_path / "here/in.world") == found
    write_files(tmp_path, {"here/box/model.sdf": b"<sdf/>"})
    assert digest_scene(tmp_path / "here/in.world") != found


def test_only_files_have_digests_whatever_they_hold(tmp_path: Path) -> None:
    for name, content in {"loop.mtl": b"map_Kd loop.mtl\nmap_Kd .\nmap_Kd /\nmap_Kd \0\n", "bad.glb": b"glTF"}.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "lost.scene_instance.json").write_text("{}")
    shutil.copy(tmp_path / "bad.glb", tmp_path / "twin.glb")
    names = ("loop.mtl", "bad.glb", "twin.glb", "lost.scene_instance.json", "nowhere.obj")
    found = digest_scenes(
        {"apartments:train/0": "apartments:train/0", **{each: str(tmp_path / each) for each in names}}
    )
    assert list(found) == [*names] and len(set(found.values())) == len(names) - 1
    assert found["bad.glb"] == found["twin.glb"]
