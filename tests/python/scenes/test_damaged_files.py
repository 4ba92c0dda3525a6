# SPDX-License-Identifier: Apache-2.0
"""Untrusted files: whatever bytes they hold, what comes out is a scene, a robot, or an error that names the file."""

from __future__ import annotations

import ctypes
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
from glb import Glb
from locations import PYTHON_TESTS
from test_gltf import DATA, DRACO, compressed_bumps, draco_glb, save, save_compressed

import wiw
from wiw import _core, process_limits, scenes
from wiw.errors import ArgumentError, Error, FileError, InfrastructureError
from wiw.physics import Articulation, read_surface
from wiw.scenes import isolated
from wiw.tabletop.robot import load_robot

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
OWN = (Path(wiw.__file__).parent / "configs/robots/panda.urdf").read_text()
LATIN = "tür".encode("latin-1")
PLY = b"""ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
1 1 0
3 0 1 2
3 1 3 2
"""
DAE = b"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>
<library_geometries><geometry id="g" name="part"><mesh><source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0
</float_array><technique_common><accessor source="#a" count="3" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="1">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="part" name="part"><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
SDF = b"""<?xml version="1.0"?><sdf version="1.7"><world name="w"><model name="part"><link name="l"><visual name="v">
<geometry><box><size>1 1 1</size></box></geometry></visual></link></model></world></sdf>"""
OBJ = b"mtllib m.mtl\no part\nusemtl part\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
MTL = b"newmtl part\nKd 1 0 0\nmap_Kd part.png\n"
M_PERTURB = -6
"""The option of glibc's mallopt that fills new memory with a byte, which is given inverted."""
URDF = """<robot name="r"><link name="a"><visual><geometry>{shape}</geometry>{material}</visual></link></robot>"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))


def plain(path: Path, **options: Any) -> scenes.Scene:
    return scenes.load(path, cache=False, isolate=False, **options)


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def png() -> bytes:
    return bytes(cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(4, 4, 3))[1].tobytes())


def binary_ply() -> bytes:
    head = PLY[: PLY.index(b"end_header") + len(b"end_header\n")].replace(b"ascii", b"binary_little_endian")
    faces = b"".join(struct.pack("<B3i", 3, *face) for face in TWO)
    return head + SQUARE.tobytes() + faces


def textured_glb() -> bytes:
    glb = Glb()
    material = glb.textured(glb.image(png()))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=UV), name="part")
    return glb.bytes()


def posed_glb() -> bytes:
    """Quantised, instanced, morphed, skinned, with a transform of its texture: all that is rewritten."""
    glb = Glb()
    material = glb.textured(glb.image(png()))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=(UV * 65535).astype(np.uint16)), name="part", skin=0)
    primitive = glb.meshes[0]["primitives"][0]
    glb.accessors[primitive["attributes"]["TEXCOORD_0"]]["normalized"] = True
    primitive["attributes"]["JOINTS_0"] = glb.accessor(np.zeros((4, 4), np.uint8))
    primitive["attributes"]["WEIGHTS_0"] = glb.accessor(np.full((4, 4), 0.25, np.float32))
    primitive["targets"] = [{"POSITION": glb.accessor(SQUARE)}]
    glb.meshes[0]["weights"] = [0.5]
    transform = {"KHR_texture_transform": {"offset": [0.5, 0], "scale": [0.5, 0.5], "rotation": 1}}
    glb.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = transform
    instances = {"attributes": {"TRANSLATION": glb.accessor(SQUARE)}}
    glb.node(0, translation=[3, 0, 0], extensions={"EXT_mesh_gpu_instancing": instances})
    document = glb.document() | {"skins": [{"joints": [1]}]}
    glb.document = lambda: document  # type: ignore[method-assign]
    return glb.bytes()


# ---- text


@pytest.mark.parametrize("name", ["m.obj", "m.dae", "m.sdf"])
def test_names_in_latin_1_are_read_as_such(tmp_path: Path, name: str) -> None:
    content = {"m.obj": OBJ, "m.dae": DAE, "m.sdf": SDF}[name].replace(b"part", LATIN)
    write(tmp_path / "m.mtl", MTL.replace(b"part", LATIN))
    scene = plain(write(tmp_path / name, content))
    assert "tür" in scene.instances[0]["name"]
    assert "\N{REPLACEMENT CHARACTER}" not in scene.describe() + repr(scene.instances)
    assert scenes.load(tmp_path / name).triangle_count == scene.triangle_count  # in a child, through the cache


def test_a_texture_named_in_latin_1_is_found_by_its_name_in_utf_8(tmp_path: Path) -> None:
    write(tmp_path / "m.mtl", MTL.replace(b"part.png", LATIN + b".png"))
    mesh = write(tmp_path / "m.obj", OBJ)
    (warning,) = plain(mesh).warnings
    assert "tür.png" in warning and "was not found" in warning
    write(tmp_path / "tür.png", png())
    assert plain(mesh).texture_count == 1


@pytest.mark.parametrize(
    ("obj", "mtl", "words"),
    [
        (OBJ, b"#\fmap_Kd a\n", "m.mtl: line 2 has 'map_Kd'"),
        (OBJ, b"#\0map_Kd a\n", "m.mtl: line 2 has 'map_Kd'"),
        (OBJ, b"#\r\n# two\r\nmap_Kd a\r\n", "m.mtl: line 3 has 'map_Kd'"),
        (OBJ, b"# one\n \tmap_Kd a\n", "m.mtl: line 2 has 'map_Kd'"),
        (OBJ, b"\xef\xbb\xbfmap_Kd a\n", "m.mtl: line 1 has 'map_Kd'"),
        (OBJ, "\ufeffmap_Kd a\n".encode("utf-16-be"), "m.mtl: is text in UTF-16"),
        (OBJ, "\ufeffmap_Kd a\n".encode("utf-16-le"), "m.mtl: is text in UTF-16"),
        (b"#\r" + OBJ, b"map_Kd a\n", "m.mtl: line 1 has 'map_Kd'"),
        (b"#\f" + OBJ, b"map_Kd a\n", "m.mtl: line 1 has 'map_Kd'"),
        (OBJ.replace(b"mtllib ", b"mtllib \\\n"), b"map_Kd a\n", "m.mtl: line 1 has 'map_Kd'"),
        (b"mtllib m.obj\rmap_Kd a\n" + OBJ, MTL, "m.obj: line 1 has 'mtllib'"),
        (b"mtllib x file://\n" + OBJ, MTL, "expected the name of a file beside it, not an address"),
    ],
)
def test_a_texture_of_no_material_is_found_however_lines_end(
    tmp_path: Path, obj: bytes, mtl: bytes, words: str
) -> None:
    """Assimp, which follows it into nowhere, ends lines at more than line feeds, and knows the marks of Unicode."""
    write(tmp_path / "m.mtl", mtl)
    path = str(write(tmp_path / "m.obj", obj))
    code = f"""
from wiw import scenes
from wiw.errors import FileError
try:
    scenes.load({path!r}, cache=False, isolate=False)
except FileError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert words in done.stdout


@pytest.mark.parametrize(
    ("old", "new"),
    [(b"\n", b"\r\n"), (b"\n", b"\r"), (b"1 2 3\n", b"1 \\\n2 \\\r\n3\n"), (b"1 2 3\n", b"1 2 3\nv 1 \\"), (b"", b"")],
)
def test_an_obj_is_the_same_however_lines_end_and_go_on(tmp_path: Path, old: bytes, new: bytes) -> None:
    write(tmp_path / "part.png", png())
    write(tmp_path / "m.mtl", b"\xef\xbb\xbf" + MTL.replace(b"\n", new if old == b"\n" else b"\n"))
    scene = plain(write(tmp_path / "m.obj", b"\xef\xbb\xbf" + OBJ.replace(old, new) if old else OBJ))
    assert scene.triangle_count == 1 and not scene.warnings
    assert [entry["name"] for entry in scene.instances] == ["part"]


def test_an_error_that_quotes_bytes_of_a_file_is_an_error_of_the_file(tmp_path: Path) -> None:
    for isolate in (False, True):
        mesh = write(tmp_path / "m.ply", PLY.replace(b"property float y", LATIN + b" float y"))
        with pytest.raises(FileError, match=r"m\.ply: has a header line that begins with 'tür'"):
            scenes.load(mesh, cache=False, isolate=isolate)


def test_a_damaged_picture_costs_the_picture_alone(tmp_path: Path) -> None:
    whole = png()
    for bit in range(8):
        damaged = bytearray(whole)
        damaged[12] ^= 1 << bit  # the first letter of the chunk's name, IHDR
        write(tmp_path / "part.png", bytes(damaged))
        write(tmp_path / "m.mtl", MTL)
        (warning,) = plain(write(tmp_path / "m.obj", OBJ)).warnings
        assert "part.png" in warning and "cannot be decoded" in warning


def without_segments(jpeg: bytes, marker: int) -> bytes:
    """Return a JPEG file without its segments of a kind."""
    kept, at = jpeg[:2], 2
    while jpeg[at + 1] != 0xDA:  # the scan, which goes on to the end
        end = at + 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        kept += jpeg[at:end] if jpeg[at + 1] != marker else b""
        at = end
    return kept + jpeg[at:]


def test_a_chunk_of_a_picture_is_no_longer_than_its_file(tmp_path: Path) -> None:
    """It is refused before memory is taken for it."""
    damaged = bytearray(png())
    at = damaged.index(b"IDAT")
    damaged[at - 4 : at] = struct.pack(">I", 1 << 29)
    write(tmp_path / "part.png", bytes(damaged))
    write(tmp_path / "m.mtl", MTL)
    (warning,) = plain(write(tmp_path / "m.obj", OBJ)).warnings
    assert "part.png" in warning and "cannot be decoded as PNG (damaged or truncated)" in warning


def test_a_picture_of_few_pixels_does_not_inflate_to_many(tmp_path: Path) -> None:
    whole = png()
    at = whole.index(b"IDAT")
    end = at + 4 + int.from_bytes(whole[at - 4 : at], "big")
    for kilobytes, refused in ((64, False), (64 << 10, True)):
        pixels = zlib.compress(zlib.decompress(whole[at + 4 : end]) + bytes(kilobytes << 10))
        chunk = struct.pack(">I", len(pixels)) + b"IDAT" + pixels + struct.pack(">I", zlib.crc32(b"IDAT" + pixels))
        write(tmp_path / "part.png", whole[: at - 4] + chunk + whole[end + 4 :])
        write(tmp_path / "m.mtl", MTL)
        warnings = plain(write(tmp_path / "m.obj", OBJ)).warnings
        assert ["cannot be decoded" in warning for warning in warnings] == [True] * refused


def test_a_picture_without_its_tables_is_not_made_of_what_is_in_memory(tmp_path: Path) -> None:
    jpeg = bytes(cv2.imencode(".jpg", np.arange(192, dtype=np.uint8).reshape(8, 8, 3))[1])
    write(tmp_path / "part.png", without_segments(jpeg, 0xC4))
    write(tmp_path / "m.mtl", MTL)
    write(tmp_path / "m.obj", OBJ)
    caches = []
    try:
        for fill in (3, 1):
            ctypes.CDLL(None).mallopt(M_PERTURB, ~fill & 0xFF)
            _core.scene.write_cache(plain(tmp_path / "m.obj"), tmp_path / "cache")
            caches.append((tmp_path / "cache").read_bytes())
    finally:
        ctypes.CDLL(None).mallopt(M_PERTURB, 0)
    assert caches[0] == caches[1]


@pytest.mark.parametrize("count", [b"11336627045591300324", b"-1", b"4", b"3.5"])
def test_a_face_has_the_corners_that_it_announces(tmp_path: Path, count: bytes) -> None:
    """What is announced is refused before memory is taken for it."""
    mesh = write(tmp_path / "m.ply", PLY.replace(b"3 1 3 2", count + b" 1 3 2"))
    with pytest.raises(FileError, match=r"m\.ply: face 1 has fewer entries than it says"):
        plain(mesh)


@pytest.mark.parametrize(
    ("part", "damaged", "words"),
    [
        (b'offset="0"', b'offset="07777777777777777777"', "<triangles> element announces 3"),
        (b'triangles count="1"', b'triangles count="99999999"', "<triangles> element announces 299999997"),
        (b'count="9"', b'count="99999999"', "<float_array> element announces 99999999"),
    ],
)
def test_a_collada_file_has_the_numbers_that_it_announces(
    tmp_path: Path, part: bytes, damaged: bytes, words: str
) -> None:
    with pytest.raises(FileError, match=rf"m\.dae: a {words} values or points, but has at most"):
        plain(write(tmp_path / "m.dae", DAE.replace(part, damaged)))


def test_a_mesh_of_a_world_that_is_a_folder_is_left_out(tmp_path: Path) -> None:
    mesh = b"</geometry></visual><visual name='w'><geometry><mesh/></geometry></visual>"
    (warning,) = plain(write(tmp_path / "m.sdf", SDF.replace(b"</geometry></visual>", mesh))).warnings
    assert "mesh '' was not found" in warning


def test_geometries_in_geometries_of_a_collada_file_are_refused(tmp_path: Path) -> None:
    """assimp finds them by some of its paths and not by others, and reads arrays beyond their ends."""
    inner = DAE[DAE.index(b"<geometry ") : DAE.index(b"</library_geometries>")]
    mesh = write(tmp_path / "m.dae", DAE.replace(b"</mesh></geometry>", b"</mesh>" + inner + b"</geometry>"))
    with pytest.raises(FileError, match=r"m\.dae: a <geometry> element lies in another one"):
        plain(mesh)


def test_two_arrays_of_a_collada_file_with_one_name_are_taken_for_the_shorter(tmp_path: Path) -> None:
    source = DAE[DAE.index(b"<source ") : DAE.index(b"<technique_common>")] + b"</source>"
    other = source.replace(b'id="p"', b'id="q"').replace(b'count="9"', b'count="8"')
    with pytest.raises(FileError, match=r"m\.dae: an <accessor> reads 3 x 3 values of '#a', which has 8"):
        plain(write(tmp_path / "m.dae", DAE.replace(b"<source ", other + b"<source ", 1)))


@pytest.mark.parametrize("end", [b"\0", b"\f", b"\r"])
def test_rows_of_a_text_end_where_lines_do(tmp_path: Path, end: bytes) -> None:
    with pytest.raises(FileError, match=r"m\.ply: has bytes that no text has"):
        plain(write(tmp_path / "m.ply", PLY.replace(b"1 0 0", b"1 0 0" + end + b"5")))
    assert plain(write(tmp_path / "m.ply", PLY.replace(b"\n", b"\r\n"))).triangle_count == 2


def test_lists_are_counted_in_whole_numbers(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"m\.ply: has a property of unknown type"):
        plain(write(tmp_path / "m.ply", PLY.replace(b"list uchar", b"list float")))


@pytest.mark.parametrize(("row", "name"), [("vertex 0", "red"), ("face 1", "object_id")])
def test_labels_and_colours_that_are_no_numbers_are_refused(tmp_path: Path, row: str, name: str) -> None:
    head = PLY[: PLY.index(b"element face")].replace(b"ascii", b"binary_little_endian")
    colours = b"".join(b"property float %s\n" % channel for channel in (b"red", b"green", b"blue"))
    list_line = b"element face 2\nproperty list uchar int vertex_indices\nproperty double object_id\nend_header\n"
    corners = np.concatenate([SQUARE, np.full((4, 3), np.nan if name == "red" else 1)], 1, dtype=np.float32)
    label = np.nan if name == "object_id" else 2
    faces = b"".join(struct.pack("<B3id", 3, *face, value) for face, value in zip(TWO, (1, label), strict=True))
    mesh = write(tmp_path / "m.ply", head + colours + list_line + corners.tobytes() + faces)
    with pytest.raises(FileError, match=rf"m\.ply: {row} has a '{name}' that is not a number"):
        _core.scene.read_ply_surface(mesh, "object_id")


# ---- robots


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ('<cylinder radius="%p %p %p" length="1"/>', r'link \'a\' has radius="%p %p %p"; expected a finite number'),
        ('<cylinder radius="%s%n%s%n" length="1"/>', r'radius="%s%n%s%n"'),
        ('<box size="1 %n 1"/>', "expected 3 finite numbers"),
        ('<box size="1 1"/>', "expected 3 finite numbers"),
        ('<sphere radius="1e999"/>', "expected a finite number"),
    ],
)
def test_numbers_of_a_robot_are_checked_before_they_are_printed(shape: str, words: str) -> None:
    with pytest.raises(FileError, match=words):
        Articulation.from_text(URDF.format(shape=shape, material=""))


def test_percent_signs_are_text_wherever_they_stand() -> None:
    code = f"""
from wiw.physics import Articulation
from wiw.errors import FileError
for material in ('<material name="%s%n%s%n"/>', '<material name="%n"><color rgba="1 1 1 1"/></material>'):
    text = {URDF!r}.replace('name="a"', 'name="a%n"').format(shape='<box size="1 1 1"/>', material=material)
    print(Articulation.from_text(text).links)
try:
    Articulation.from_text('<robot name="%n"><link name="%s%n"/><link name="%s%n"/></robot>')
except FileError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("['a%n']") == 2 and "%s%n" in done.stdout.splitlines()[2]


def test_numbers_may_be_apart_by_any_space() -> None:
    robot = Articulation.from_text(URDF.format(shape='<box size="1\t2 \n 3"/>', material=""))
    assert robot.visuals[0]["shape"].size.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("link.obj", OBJ, r"m\.mtl: line 1 has 'map_Kd' before any 'newmtl'"),
        ("link.ply", PLY.replace(b"3 1 3 2", b"0"), "face 1 has no corners"),
    ],
)
def test_a_link_mesh_that_ends_its_reader_is_refused_by_name(
    tmp_path: Path, name: str, content: bytes, words: str
) -> None:
    write(tmp_path / "m.mtl", b"map_Kd a.png\n" + MTL)
    code = f"""
from wiw.physics import read_surface
from wiw.errors import FileError
try:
    read_surface({str(write(tmp_path / name, content))!r}, link="hand")
except FileError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with pytest.raises(FileError, match=rf"{name}: .*{words}.*mesh of link 'hand'"):
        raise FileError(done.stdout)


def test_a_robot_that_ends_its_reader_is_an_error_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = tmp_path / "robot.urdf"
    robot.write_text(OWN)
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\nkill -SEGV $$\n")
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    with pytest.raises(FileError, match=r"robot\.urdf: the importer crashed on it with SIGSEGV"):
        load_robot(robot)


def test_a_robot_from_another_process_is_the_same_to_the_last_bit(tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1))
        + "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    )
    robot = tmp_path / "robot.urdf"
    text = OWN.replace('<box size="0.056 0.204 0.05"/>', '<mesh filename="cube.obj" scale="1 2 0.3"/>')
    end = "</joint>\n</robot>"
    mimic = '<mimic joint="panda_finger_joint1" multiplier="0.9" offset="0.001"/>'
    robot.write_text(text.strip().removesuffix(end) + mimic + end)
    here, there = Articulation(robot), load_robot(robot).description
    assert here.to_parts() == there.to_parts() == json.loads(json.dumps(here.to_parts()))
    assert "panda_finger_joint1" in [joint["mimics"] for joint in there.tree]
    assert list(map(str, there.meshes)) == [str(tmp_path / "cube.obj")]
    q = np.linspace(-0.1, 0.04, here.dof)
    np.testing.assert_array_equal(here.forward_kinematics(q), there.forward_kinematics(q))
    with pytest.raises(Error, match="make no tree"):
        Articulation.from_parts({**here.to_parts(), "joints": []})
    for missing in ({}, {**here.to_parts(), "limits": []}, {**here.to_parts(), "links": [{}]}):
        with pytest.raises(ArgumentError, match="expected what `to_parts` gives; "):
            Articulation.from_parts(missing)
    for other in ({**here.to_parts(), "links": [3]}, {**here.to_parts(), "name": []}):
        with pytest.raises(ArgumentError, match="expected what `to_parts` gives; "):
            Articulation.from_parts(other)


# ---- the importer's process


def worker(folder: Path, body: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module whose `work(job)` is the child's."""
    text = "import os, resource, signal, time\nfrom pathlib import Path\nfrom wiw.scenes.child import answer_job\n"
    (folder / "worker_of_test.py").write_text(f"{text}def work(job):\n{body}\nanswer_job(work)\n")
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return "worker_of_test"


def test_the_importer_has_limits_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = """
    limits = [resource.getrlimit(kind)[0] for kind in (resource.RLIMIT_CPU, resource.RLIMIT_DATA, resource.RLIMIT_CORE)]
    print("noise of a library")
    os.write(1, b"more of it")
    return {"limits": limits, "alarm": signal.alarm(0)}"""
    monkeypatch.setattr(isolated, "TIMEOUT", 500.0)
    found = isolated.read_in_child(worker(tmp_path, body, monkeypatch), {"path": "a"})
    cpu, memory, core = found["limits"]
    assert cpu == 500 * (os.cpu_count() or 1) and core == 0 and 400 < found["alarm"] <= 500
    assert 0 < memory <= os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 3 // 4


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        ("    raise ValueError('tür')", FileError, "a.glb: cannot be read: ValueError: tür"),
        ("    bytearray(1 << 62)", FileError, "a.glb: importing it takes more than .* GB of memory"),
        ("    os._exit(3)", InfrastructureError, r"exit code 3"),
        ("    os.kill(os.getpid(), signal.SIGABRT)", FileError, "a.glb: the importer crashed on it with SIGABRT"),
        ("    os.kill(os.getpid(), signal.SIGXCPU)", FileError, "a.glb: importing took more than"),
        ("    os.write(2, bytes([255, 10]))\n    os._exit(1)", InfrastructureError, "exit code 1"),
    ],
)
def test_what_ends_the_importer_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        isolated.read_in_child(worker(tmp_path, body, monkeypatch), {"path": "a.glb"})


def test_the_importer_ends_with_its_parent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = worker(tmp_path, "    Path(job['pid']).write_text(str(os.getpid()))\n    time.sleep(600)", monkeypatch)
    note = tmp_path / "pid"
    code = f"from wiw.scenes import isolated; isolated.read_in_child({module!r}, {{'path': 'a', 'pid': {str(note)!r}}})"
    parent = subprocess.Popen([sys.executable, "-c", code])
    until(lambda: note.exists() and note.read_text() != "")
    importer = int(note.read_text())
    parent.kill()
    parent.wait()
    until(lambda: not is_running(importer))


def test_an_importer_without_its_parent_does_not_begin() -> None:
    code = "from wiw.process_limits import end_with_parent; end_with_parent(1 << 22); print('begun')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == ""


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A root folder for the system's files, of a machine with 1 GB."""
    monkeypatch.setattr(process_limits, "_ROOT", tmp_path)
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PAGE_SIZE": 1 << 12, "SC_PHYS_PAGES": 1 << 18}[name])
    (tmp_path / "proc/self").mkdir(parents=True)
    return tmp_path


def set_limits(folder: Path, name: str, limits: dict[str, str]) -> None:
    for group, text in limits.items():
        (folder / group).mkdir(parents=True, exist_ok=True)
        (folder / group / name).write_text(f"{text}\n")


JOB = "system.slice/slurmstepd.scope/job_7/step_0/user/task_0"
MOUNTED = {
    "v2": "31 23 0:28 / /sys/fs/cgroup rw,relatime shared:4 - cgroup2 cgroup2 rw,nsdelegate",
    "v1": "34 31 0:30 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n"
    "35 31 0:31 {root} /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory",
}


@pytest.mark.parametrize("mounted", [MOUNTED["v2"], ""])
def test_the_least_limit_of_all_groups_above_holds(system: Path, mounted: str) -> None:
    (system / "proc/self/cgroup").write_text(f"0::/{JOB}\n")
    (system / "proc/self/mountinfo").write_text(mounted)
    place, above = system / "sys/fs/cgroup", JOB.rpartition("/step_0")[0]
    set_limits(place, "memory.max", {JOB: "max", f"{above}/step_0": f"{1 << 28}", above: f"{1 << 27}"})
    assert process_limits.find_memory_limit() == 3 << 25
    set_limits(place, "memory.max", {above: "max"})
    assert process_limits.find_memory_limit() == 3 << 26


@pytest.mark.parametrize("root", ["/", "/slurm", "/elsewhere"])
def test_a_group_of_the_memory_controller_alone_has_the_limit(system: Path, root: str) -> None:
    """The last root is that of a container that does not show its own group: what is mounted then is its own."""
    (system / "proc/self/cgroup").write_text("9:cpu:/slurm\n4:memory:/slurm/uid_1/job_7/step_0\n0::/\n")
    (system / "proc/self/mountinfo").write_text(MOUNTED["v1"].format(root=root))
    job = {"/": "slurm/uid_1/job_7", "/slurm": "uid_1/job_7", "/elsewhere": "."}[root]
    limits = {job: f"{1 << 28}", f"{job}/step_0": f"{(1 << 63) - (1 << 12)}"}
    set_limits(system / "sys/fs/cgroup/memory", "memory.limit_in_bytes", limits)
    assert process_limits.find_memory_limit() == 3 << 26


def test_without_groups_the_machine_s_memory_is_the_limit(system: Path) -> None:
    assert process_limits.find_memory_limit() == 3 << 28
    (system / "proc/self/cgroup").write_text("0::/../other\nnonsense\n")
    (system / "proc/self/mountinfo").write_text("nonsense\n")
    assert process_limits.find_memory_limit() == 3 << 28
    set_limits(system / "sys/fs/cgroup", "memory.max", {".": f"{1 << 28}"})
    assert process_limits.find_memory_limit() == 3 << 26


def test_a_container_s_memory_is_the_limit(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _, pair: limits.append(pair))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    set_limits(system / "sys/fs/cgroup", "memory.max", {".": f"{1 << 28}"})
    assert process_limits.limit_memory() == 3 << 26
    assert [pair[0] for pair in limits] == [3 << 26]


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


# ---- files that grow


def shared_nodes(levels: int) -> bytes:
    """Nodes that each show the next one twice."""
    glb = Glb()
    mesh = glb.mesh(TWO, POSITION=SQUARE)
    for level in range(levels):
        glb.nodes.append({"children": [level + 1, level + 1]})
    glb.node(mesh)
    document = glb.document()
    document["scenes"] = [{"nodes": [0]}]
    glb.document = lambda: document  # type: ignore[method-assign]
    return glb.bytes()


def test_nodes_that_share_nodes_are_counted_before_they_are_copied(tmp_path: Path) -> None:
    assert len(plain(write(tmp_path / "few.glb", shared_nodes(5))).instances) == 32
    with pytest.raises(FileError, match=r"many\.glb: has \d+ nodes, more than the limit of 1000000"):
        plain(write(tmp_path / "many.glb", shared_nodes(40)))
    with pytest.raises(FileError, match=r"limits\.nodes"):
        plain(tmp_path / "few.glb", limits={"nodes": 62})
    assert plain(tmp_path / "few.glb", limits={"nodes": 64}).triangle_count == 64


def test_cyclic_and_very_deep_nodes_are_refused(tmp_path: Path) -> None:
    def chain(count: int, last: dict[str, Any]) -> bytes:
        glb = Glb()
        mesh = glb.mesh(TWO, POSITION=SQUARE)
        glb.nodes = [{"children": [i + 1]} for i in range(count)] + [{"mesh": mesh, **last}]
        document = glb.document() | {"scenes": [{"nodes": [0]}]}
        glb.document = lambda: document  # type: ignore[method-assign]
        return glb.bytes()

    assert plain(write(tmp_path / "deep.glb", chain(900, {}))).triangle_count == 2
    with pytest.raises(FileError, match="nested more than 1000 deep"):
        plain(write(tmp_path / "deeper.glb", chain(1100, {})))
    with pytest.raises(FileError, match="node 0 is among its own descendants"):
        plain(write(tmp_path / "ring.glb", chain(3, {"children": [0]})))
    with pytest.raises(FileError, match="a node that is not there"):
        plain(write(tmp_path / "gone.glb", chain(3, {"children": [9]})))


def test_meshes_that_share_vertices_are_counted_before_they_are_copied(tmp_path: Path) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=np.tile(SQUARE, (500, 1))))
    glb.meshes *= 1000
    file = write(tmp_path / "a.glb", glb.bytes())
    with pytest.raises(FileError, match=r"vertices and corners of all meshes, more than .* limits\.triangles"):
        plain(file, limits={"triangles": 100_000})
    assert plain(file).triangle_count == 2


# ---- mutations


def mutate(content: bytes, draw: random.Random) -> bytes:
    damaged = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 4))):
        at = draw.randrange(len(damaged))
        kind = draw.randrange(4)
        if kind == 0:
            damaged[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            damaged[at] = draw.randrange(256)
        elif kind == 2:
            del damaged[at : at + draw.randrange(1, 6)]
        else:
            damaged[at:at] = bytes(draw.randrange(256) for _ in range(draw.randrange(1, 5)))
    return bytes(damaged) or b"x"


MUTATIONS = """
import sys
from pathlib import Path
sys.path[:0] = {here!r}
from test_damaged_files import read_mutations
read_mutations({kinds!r}, Path({folder!r}), {begin}, {count})
"""


MOST_MEMORY = 2 << 30
MOST_SECONDS = 10


def compressed_glb(kind: str) -> bytes:
    """The bytes of a file with a compressed mesh."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "m.glb"
        if kind == "draco glb":
            return save(draco_glb((DATA / "bumps.drc").read_bytes()), file, **DRACO).read_bytes()
        return save_compressed(compressed_bumps(), file).read_bytes()


def subject(kind: str) -> tuple[str, bytes, Callable[[Path], Any]]:
    """A file's name, its content, and what reads it."""
    formats: dict[str, tuple[str, bytes]] = {
        "ply": ("m.ply", PLY),
        "binary ply": ("m.ply", binary_ply()),
        "glb": ("m.glb", textured_glb()),
        "posed glb": ("m.glb", posed_glb()),
        "dae": ("m.dae", DAE),
        "sdf": ("m.sdf", SDF),
        "obj": ("m.obj", OBJ),
        "mtl": ("m.mtl", MTL),
        "png": ("part.png", png()),
    }
    if kind in ("draco glb", "meshopt glb"):
        formats[kind] = ("m.glb", compressed_glb(kind))
    if kind in formats:
        name, content = formats[kind]
        read = name if name not in ("m.mtl", "part.png") else "m.obj"
        return name, content, lambda folder: plain(folder / read).describe()
    if kind == "urdf":
        return "r.urdf", OWN.encode(), lambda folder: Articulation(folder / "r.urdf")
    name, content = formats[kind.removeprefix("link ")]
    read = name if name != "m.mtl" else "m.obj"
    return name, content, lambda folder: read_surface(folder / read, link="hand")


def read_mutations(kinds: Sequence[str], folder: Path, begin: int, count: int) -> None:
    """Read mutations of files, of the first kind from `begin` on, and print what came of each.

    A crash ends this process, and the last line says where; so does a file that takes too long. One that takes too much
    memory is refused.
    """
    subjects = [subject(kind) for kind in kinds]
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_MEMORY, MOST_MEMORY))
    for kind, (name, content, read) in zip(kinds, subjects, strict=True):
        for index in range(begin, count):
            (folder / kind / name).write_bytes(mutate(content, random.Random(f"{kind} {index}")))
            print(kind, index, "", sep="\t", end="", flush=True)
            signal.alarm(MOST_SECONDS)
            try:
                read(folder / kind)
                print("read")
            except Error as error:
                print(type(error).__name__)
            except MemoryError:
                print("FileError")  # as the importing process says it
            signal.alarm(0)
        begin = 0


KINDS = (
    "ply", "binary ply", "glb", "posed glb", "meshopt glb", "draco glb", "dae", "sdf", "obj", "mtl", "png", "urdf",
    "link ply", "link obj", "link mtl",
)  # fmt: skip


def test_mutations_end_in_errors_of_wiw(tmp_path: Path) -> None:
    """Readers may crash on what nobody foresaw, in a process of their own; any other error than wiw's is a defect."""
    check_mutations(tmp_path, KINDS, 30)


@pytest.mark.nightly
@pytest.mark.parametrize("kind", [*KINDS, "link glb", "link dae", "link binary ply"])
def test_many_mutations_end_in_errors_of_wiw(tmp_path: Path, kind: str) -> None:
    check_mutations(tmp_path, [kind], 20_000)


def check_mutations(tmp_path: Path, kinds: Sequence[str], count: int) -> None:
    for kind in kinds:
        (tmp_path / kind).mkdir()
        name, content, read = subject(kind)
        for file, whole in (("m.obj", OBJ), ("m.mtl", MTL), ("part.png", png()), (name, content)):
            write(tmp_path / kind / file, whole)
        read(tmp_path / kind)  # whole files are read
    here = [str(folder) for folder in (Path(__file__).parent, PYTHON_TESTS, PYTHON_TESTS.parent)]
    refused, crashes, left, begin = set(), [], list(kinds), 0
    while left:
        code = MUTATIONS.format(here=here, kinds=left, folder=str(tmp_path), begin=begin, count=count)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        lines = [line.split("\t") for line in done.stdout.splitlines()]
        ended = lines if done.returncode == 0 else lines[:-1]
        assert {outcome for *_, outcome in ended} <= {"read", "FileError", "ArgumentError"}, ended
        refused |= {kind for kind, _, outcome in ended if outcome != "read"}
        if done.returncode == 0:
            break
        assert done.returncode < 0, f"{lines[-1:]}: {done.stderr[-2000:]}"  # a traceback would be 1
        kind, index = lines[-1][0], int(lines[-1][1])
        crashes.append((kind, index, signal.Signals(-done.returncode).name))
        left, begin = left[left.index(kind) :], index + 1
    assert refused >= {*kinds} - {"mtl", "png", "link mtl"}  # a scene may do without its pictures
    assert crashes == []
