# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from glb import Glb
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from wiw import _core, scenes
from wiw.errors import ArgumentError, FileError

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
FAST = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def square(folder: Path, name: str = "square.glb", **node: Any) -> Path:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), **node)
    (folder / name).write_bytes(glb.bytes())
    return folder / name


def plain(path: Path, **options: Any) -> scenes.Scene:
    return scenes.load(path, cache=False, isolate=False, **options)


def corners(scene: scenes.Scene) -> NDArray[np.float32]:
    """[T, 3, 3] world corners of every triangle."""
    vertices, triangles, _ = scene.world_triangles()
    return vertices[triangles]


def matrix(rotation_deg: float, offset: tuple[float, float, float]) -> NDArray[np.float64]:
    c, s = np.cos(np.radians(rotation_deg)), np.sin(np.radians(rotation_deg))
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = offset
    return pose


coordinates = st.floats(-100, 100, width=32)


@st.composite
def meshes(draw: st.DrawFn) -> dict[str, NDArray[Any]]:
    count = draw(st.integers(3, 12))
    positions = draw(hnp.arrays(np.float32, (count, 3), elements=coordinates))
    triangles = draw(
        hnp.arrays(np.uint32, st.tuples(st.integers(1, 8), st.just(3)), elements=st.integers(0, count - 1))
    )
    mesh: dict[str, NDArray[Any]] = {"positions": positions, "triangles": triangles}
    if draw(st.booleans()):
        mesh["uv"] = draw(hnp.arrays(np.float32, (count, 2), elements=st.floats(-2, 2, width=32)))
    if draw(st.booleans()):
        mesh["colors"] = draw(hnp.arrays(np.uint8, (count, 4)))
    return mesh


def with_area(mesh: dict[str, NDArray[Any]]) -> NDArray[np.float32]:
    p = mesh["positions"].astype(np.float64)[mesh["triangles"]]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    return mesh["positions"][mesh["triangles"]][(normal**2).sum(-1) > 0]


@FAST
@given(mesh=meshes(), offset=st.tuples(coordinates, coordinates, coordinates))
def test_a_random_glb_gives_its_geometry(
    tmp_path: Path, mesh: dict[str, NDArray[Any]], offset: tuple[float, ...]
) -> None:
    expected = with_area(mesh)
    if len(expected) == 0:
        return
    glb = Glb()
    attributes = {"POSITION": mesh["positions"]} | ({"TEXCOORD_0": mesh["uv"]} if "uv" in mesh else {})
    glb.node(glb.mesh(mesh["triangles"], **attributes), translation=list(offset))
    (tmp_path / "random.glb").write_bytes(glb.bytes())
    found = corners(plain(tmp_path / "random.glb"))
    np.testing.assert_allclose(found, expected + np.float32(offset), atol=2e-5)


@FAST
@given(parts=st.lists(meshes(), min_size=1, max_size=3), angle=st.floats(-180, 180))
def test_a_random_scene_comes_back_from_the_cache(tmp_path: Path, parts: list[dict[str, Any]], angle: float) -> None:
    texture = np.arange(2 * 3 * 4, dtype=np.uint8).reshape(2, 3, 4)
    for i, part in enumerate(parts):
        part |= {"name": f"part {i}", "category": "box", "material": 0, "T_world_instance": matrix(angle, (i, 2, 3))}
    scene = scenes.Scene.from_arrays(parts, textures=[texture], materials=[{"name": "m", "texture": 0}])
    _core.scene.write_cache(scene, tmp_path / "scene")
    back = _core.scene.map_cache(tmp_path / "scene")
    for before, after in zip(scene.world_triangles(), back.world_triangles(), strict=True):
        np.testing.assert_array_equal(before, after)
    assert back.describe() == scene.describe()
    assert back.texture_bytes == texture.size
    assert [i["name"] for i in back.instances] == [i["name"] for i in scene.instances]


def test_from_arrays_places_and_reports() -> None:
    chair = {
        "positions": SQUARE,
        "triangles": TWO,
        "category": "chair",
        "attributes": {"color": "red"},
        "T_world_instance": np.stack([matrix(0, (0, 0, 0)), matrix(90, (5, 1, 0))]),
    }
    scene = scenes.Scene.from_arrays([chair], name="two chairs")
    assert repr(scene) == "<Scene 'two chairs': 2 instances, 4 triangles, 5.0 x 2.0 x 1.0 m (x, y up, z)>"
    assert scene.mesh_count == 1
    assert scene.categories == ["chair"]
    second = scene.instances[1]
    assert (second["id"], second["category"], second["attributes"]) == (2, "chair", {"color": "red"})
    np.testing.assert_allclose(second["bounds"], [[5, 1, -1], [5, 2, 0]], atol=1e-6)
    np.testing.assert_array_equal(scene.world_triangles()[2], [1, 1, 2, 2])


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ({"positions": SQUARE[:, :2], "triangles": TWO}, "positions float32 \\[V, 3\\], got \\[4, 2\\]"),
        ({"positions": SQUARE, "triangles": TWO + 2}, "triangle with vertex 4"),
        ({"positions": SQUARE, "triangles": TWO, "uv": SQUARE[:2, :2]}, "uv has 2 entries for 4 vertices"),
        ({"positions": SQUARE * np.nan, "triangles": TWO}, "not finite"),
        ({"positions": SQUARE, "triangles": TWO, "material": 3}, "material is 3"),
        ({"positions": SQUARE, "triangles": TWO, "colour": 1}, "'colour' is no key of a mesh"),
        ({"positions": SQUARE, "triangles": TWO + 0.5}, "triangles uint32 \\[T, 3\\], got \\[2, 3\\] float64"),
        ({"positions": SQUARE, "triangles": TWO.astype(int) - 1}, "triangles uint32 .*, got numbers out of its range"),
        (
            {"positions": SQUARE, "triangles": TWO, "colors": np.full((4, 4), 0.5)},
            "colors uint8 \\[V, 4\\], got \\[4, 4\\] float64",
        ),
        (
            {"positions": SQUARE, "triangles": TWO, "colors": np.full((4, 4), 256)},
            "colors uint8 .*, got numbers out of its range",
        ),
    ],
)
def test_from_arrays_refuses_what_does_not_fit(mesh: dict[str, Any], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        scenes.Scene.from_arrays([mesh])


def test_from_arrays_takes_whole_numbers_of_any_type() -> None:
    for kind in (np.int64, np.uint8, list):
        triangles = TWO.tolist() if kind is list else TWO.astype(kind)
        scene = scenes.Scene.from_arrays([{"positions": SQUARE, "triangles": triangles}])
        np.testing.assert_array_equal(scene.world_triangles()[1], TWO)


@pytest.mark.parametrize("kind", [".png", ".jpg"])
def test_embedded_textures_and_colours_are_drawn_as_written(tmp_path: Path, kind: str) -> None:
    from wiw.render import Renderer

    image = np.zeros((64, 64, 3), np.uint8)
    image[:32, :32], image[:32, 32:], image[32:, :32], image[32:, 32:] = (
        (255, 0, 0),
        (0, 255, 0),
        (0, 0, 255),
        (255, 255, 255),
    )
    encoded = cv2.imencode(kind, image[..., ::-1])[1].tobytes()
    glb = Glb()
    material = glb.textured(glb.image(encoded, "image/png" if kind == ".png" else "image/jpeg"))
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v from the top
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=uv))
    (tmp_path / "a.glb").write_bytes(glb.bytes())
    scene = plain(tmp_path / "a.glb")
    assert (scene.texture_count, scene.texture_bytes) == (1, 64 * 64 * 4)
    camera = np.eye(4)
    camera[:3, 3] = [0.5, 0.5, 0.5]
    seen = Renderer(scene, backend="cpu").perspective(camera[None], (64, 64), 90.0, outputs=("color",))["color"][0]
    for y, x in ((16, 16), (16, 48), (48, 16), (48, 48)):  # same hue: light scales all channels alike
        wanted = image[y, x] > 128
        assert ((seen[y, x].astype(int) > seen[y, x].max() // 2) == wanted).all(), (y, x, seen[y, x])


def test_a_gltf_with_files_beside_it_is_read_and_followed(tmp_path: Path) -> None:
    glb = Glb()
    material = glb.textured(0)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=uv), scale=[2, 2, 2])
    document = glb.document()
    document["buffers"][0]["uri"] = "data.bin"
    document |= {"images": [{"uri": "my%20photo.png"}], "textures": [{"source": 0}]}
    (tmp_path / "data.bin").write_bytes(glb.binary)
    (tmp_path / "my photo.png").write_bytes(cv2.imencode(".png", np.zeros((4, 2, 3), np.uint8))[1].tobytes())
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    scene, read, _ = _core.scene.import_scene(tmp_path / "a.gltf")
    assert scene.warnings == []
    assert scene.texture_bytes == 4 * 2 * 4
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [2, 2, 0]])
    assert {path.name for path in read} == {"a.gltf", "data.bin", "my photo.png"}
    (tmp_path / "data.bin").unlink()
    with pytest.raises(FileError, match=r"a\.gltf: lacks its buffer .*data\.bin"):
        plain(tmp_path / "a.gltf")


def test_limits_are_options(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"has 2 triangles, more than the limit of 1 \(raise limits.triangles"):
        plain(square(tmp_path), limits={"triangles": 1})
    with pytest.raises(ArgumentError, match="'vertices' is no limit"):
        plain(square(tmp_path), limits={"vertices": 1})


def test_unsupported_and_missing_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(FileError, match=r"a.fbx: '.fbx' is not a supported mesh format; expected one of .glb"):
        scenes.load(tmp_path / "a.fbx")
    with pytest.raises(FileError, match="no such file"):
        scenes.load(tmp_path / "none.glb")
    with pytest.raises(ArgumentError, match="up must be"):
        scenes.load(square(tmp_path), up="x")


@pytest.mark.parametrize("read", [scenes.load, scenes.resolve, lambda path: scenes.resolve(f"hm3d:{path}:val")])
def test_a_path_that_cannot_be_looked_for_is_named(read: Any) -> None:
    with pytest.raises(ArgumentError, match=r"~nobody-here/x.glb.*: Could not determine home directory"):
        read("~nobody-here/x.glb")
    with pytest.raises(FileError, match=r"xxx.*: File name too long"):
        read("x" * 300)


def test_the_home_of_an_unknown_user_has_no_absolute_spec() -> None:
    for spec in ("~nobody-here/x.glb", "hm3d:~nobody-here/scans:val"):
        with pytest.raises(ArgumentError, match=r"~nobody-here.*: Could not determine home directory"):
            scenes.absolute(spec)


def test_a_file_may_be_called_like_the_apartments(tmp_path: Path) -> None:
    mesh = square(tmp_path, "apartments_scan.glb")
    assert scenes.resolve(mesh) == scenes.resolve(str(mesh)) == [str(mesh)]
    assert scenes.resolve("apartments:val:2") == ["apartments:val/0", "apartments:val/1"]
    with pytest.raises(ArgumentError, match="apartments:dev"):
        scenes.resolve("apartments:dev")
    with pytest.raises(FileError, match="no such file"):
        scenes.resolve("apartments")


def test_the_cache_is_used_and_follows_its_sources(tmp_path: Path, own_cache: Path) -> None:
    (tmp_path / "m.mtl").write_text("newmtl a\nmap_Kd photo.png\n")
    mesh = tmp_path / "m.obj"
    mesh.write_text("mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    built: list[Path] = []
    options: dict[str, Any] = {"up": None, "ceiling": None, "limits": {}, "texture_folders": [], "model_folders": []}

    def load() -> scenes.Scene:
        def build(out: Path) -> scenes.store.Sources:
            built.append(out)
            scene, read, absent = _core.scene.import_scene(mesh, **options)
            _core.scene.write_cache(scene, out)
            return scenes.store.Sources(tuple(read), tuple(absent))

        return scenes.store.load_imported(mesh, options, build)

    time.sleep(0.02)  # a file written while it is read is not remembered
    assert len(load().warnings) == 1
    assert load().triangle_count == 1
    assert len(built) == 1

    os.utime(mesh)  # touched, not changed
    load()
    assert len(built) == 1

    (tmp_path / "photo.png").write_bytes(cv2.imencode(".png", np.zeros((2, 2, 3), np.uint8))[1].tobytes())
    time.sleep(0.02)
    assert load().texture_count == 1  # the missing texture has turned up
    assert len(built) == 2

    mesh.write_text(mesh.read_text() + "v 1 1 0\nf 2 4 3\n")
    time.sleep(0.02)
    assert load().triangle_count == 2
    assert len(built) == 3

    options["ceiling"] = 2.0
    assert load().triangle_count == 4
    assert len(built) == 4
    assert not list((own_cache / "scenes").glob("*.tmp"))


def write_textured(folder: Path, image: str) -> Path:
    """A triangle that asks for a texture by name."""
    folder.mkdir()
    (folder / "m.mtl").write_text(f"newmtl a\nmap_Kd {image}\n")
    (folder / "m.obj").write_text("mtllib m.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return folder / "m.obj"


def write_image(path: Path, size: int) -> None:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(cv2.imencode(".png", np.zeros((size, size, 3), np.uint8))[1].tobytes())


def test_relative_folders_mean_those_of_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = write_textured(tmp_path / "mesh", "photo.png")
    for size, name in enumerate(("a", "b"), start=1):
        (tmp_path / name).mkdir()
        write_image(tmp_path / name / "textures" / "photo.png", size)
    time.sleep(0.02)
    for size, name in enumerate(("a", "b"), start=1):
        monkeypatch.chdir(tmp_path / name)
        assert scenes.load(mesh, isolate=False, texture_folders=["textures"]).texture_bytes == 4 * size * size


@pytest.mark.parametrize("kind", [str, Path, lambda path: (path,)])
def test_one_folder_may_be_given_by_itself(tmp_path: Path, kind: Any) -> None:
    mesh = write_textured(tmp_path / "mesh", "photo.png")
    write_image(tmp_path / "elsewhere" / "photo.png", 2)
    folder = kind(tmp_path / "elsewhere")
    scene = scenes.load(mesh, isolate=False, cache=False, texture_folders=folder, model_folders=folder)
    assert scene.texture_bytes == 16 and not scene.warnings


def test_a_relative_path_remembers_absolute_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = write_textured(tmp_path / "mesh", "photo.png")
    time.sleep(0.02)
    monkeypatch.chdir(mesh.parent)
    assert scenes.load("m.obj", isolate=False).texture_count == 0
    write_image(mesh.parent / "photo.png", 2)
    monkeypatch.chdir(tmp_path)
    assert scenes.load(mesh, isolate=False).texture_count == 1


def test_a_link_finds_the_textures_beside_it(tmp_path: Path) -> None:
    mesh = write_textured(tmp_path / "mesh", "photo.png")
    link = write_textured(tmp_path / "link", "photo.png")
    link.unlink()
    link.symlink_to(mesh)
    write_image(link.parent / "photo.png", 2)
    time.sleep(0.02)
    assert scenes.load(mesh, isolate=False).texture_count == 0
    assert scenes.load(link, isolate=False).texture_count == 1


def test_a_damaged_cache_is_rebuilt_with_a_warning(
    tmp_path: Path, own_cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mesh = square(tmp_path)
    time.sleep(0.02)
    scenes.load(mesh, isolate=False)
    (file,) = (own_cache / "scenes").glob("*.wiwscene")
    for damage in (file.read_bytes()[:-3], b"", b"\0" * 500):
        file.unlink()
        file.write_bytes(damage)
        with caplog.at_level(logging.WARNING, "wiw.scenes"):
            assert scenes.load(mesh, isolate=False).triangle_count == 2
        assert "rebuilt" in caplog.text
        caplog.clear()
    file.unlink()
    assert scenes.load(mesh, isolate=False).triangle_count == 2


def test_processes_and_threads_share_one_cache(tmp_path: Path, own_cache: Path) -> None:
    mesh = square(tmp_path)
    time.sleep(0.02)
    code = f"from wiw import scenes; print(scenes.load({str(mesh)!r}, isolate=False).triangle_count)"
    children = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    counts: list[int] = []
    threads = [
        threading.Thread(target=lambda: counts.append(scenes.load(mesh, isolate=False).triangle_count))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [child.communicate()[0].strip() for child in children] == ["2", "2", "2"]
    assert counts == [2, 2, 2]
    assert len(list((own_cache / "scenes").glob("*.wiwscene"))) == 1


def test_generated_scenes_are_kept_by_identity(own_cache: Path) -> None:
    made: list[int] = []

    def make() -> scenes.Scene:
        made.append(1)
        return scenes.Scene.from_arrays([{"positions": SQUARE, "triangles": TWO}])

    for identity in (["maker", 1, 7], ["maker", 1, 7], ["maker", 2, 7]):
        assert scenes.store.load_generated(identity, make).triangle_count == 2
    assert len(made) == 2
    assert not list((own_cache / "scenes").glob("*.lock"))


def flat() -> scenes.Scene:
    return scenes.Scene.from_arrays([{"positions": SQUARE, "triangles": TWO}])


MAKER = """
import sys, time
import wiw.scenes
from pathlib import Path
from wiw import _core
make = _core.scene.apartment
def slow(seed, split, edits):
    with Path(sys.argv[1]).open("a") as log:
        log.write("made\\n")
    time.sleep(0.3)
    return wiw.scenes.Scene.from_arrays([{"positions": [[0, 0, 0], [1, 0, 0], [0, 1, 0]], "triangles": [[0, 1, 2]]}])
_core.scene.apartment = slow
print(wiw.scenes.open_scene("apartments:val/3").triangle_count)
"""


def test_an_apartment_is_made_once_for_all_processes(tmp_path: Path, own_cache: Path) -> None:
    command = [sys.executable, "-c", MAKER, str(tmp_path / "log")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    children = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) for _ in range(3)]
    assert [child.communicate(timeout=60)[0].strip() for child in children] == ["1", "1", "1"]
    assert (tmp_path / "log").read_text() == "made\n"


def test_an_apartment_is_kept_by_seed_split_and_build(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[tuple[int, str]] = []
    monkeypatch.setattr(_core.scene, "apartment", lambda seed, split, edits: made.append((seed, split)) or flat())
    for _ in range(2):
        for seed, split in ((1, "val"), (2, "val"), (1, "test")):
            scenes.apartment(seed, split)
    assert made == [(1, "val"), (2, "val"), (1, "test")]
    monkeypatch.setattr(scenes.store, "build_digest", lambda: "another build")
    scenes.apartment(1, "val")
    scenes.apartment(1, "val", cache=False)
    assert len(made) == 5


def test_the_cache_forgets_what_was_not_used_for_longest(own_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes.store.load_generated(["size"], flat)
    (first,) = (own_cache / "scenes").glob("*.wiwscene")
    monkeypatch.setenv("WIW_CACHE_GB", str(3.5 * first.stat().st_size / 2**30))
    made: list[int] = []

    def ask(number: int) -> None:
        scenes.store.load_generated([number], lambda: made.append(number) or flat())
        time.sleep(0.02)

    for number in (1, 2, 1, 3, 1, 4, 1):  # 2 goes when 4 comes
        ask(number)
    assert made == [1, 2, 3, 4]
    assert len(list((own_cache / "scenes").glob("*.wiwscene"))) == 3
    ask(2)
    assert made == [1, 2, 3, 4, 2]
    monkeypatch.setenv("WIW_CACHE_GB", "much")
    with pytest.raises(ArgumentError, match=r"WIW_CACHE_GB.*much"):
        ask(5)


def test_a_scene_forgotten_by_the_cache_is_imported_again_without_a_word(
    tmp_path: Path, own_cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    mesh = square(tmp_path)
    time.sleep(0.02)
    scenes.load(mesh, isolate=False)
    (file,) = (own_cache / "scenes").glob("*.wiwscene")
    file.unlink()
    assert scenes.load(mesh, isolate=False).triangle_count == 2 and file.exists()
    assert not caplog.text


def test_drafts_of_killed_imports_are_removed(tmp_path: Path, own_cache: Path) -> None:
    place = own_cache / "scenes"
    place.mkdir(parents=True)
    old, new = place / "1.2.tmp.77-0.tmp", place / "1.3.tmp"
    old.touch()
    new.touch()
    os.utime(old, times=(0, time.time() - 25 * 3600))
    scenes.load(square(tmp_path), isolate=False)
    assert new.exists() and not old.exists()

    def end_half_way(path: Path) -> scenes.store.Sources:
        path.with_name(f"{path.name}.77-0.tmp").touch()
        raise FileError("crashed on it")

    with pytest.raises(FileError, match="crashed"):
        scenes.store.load_imported(tmp_path / "square.glb", {"other": 1}, end_half_way)
    assert list(place.glob("*.tmp")) == [new]


def test_on_a_network_file_system_scenes_of_the_last_week_are_kept(
    own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes.store, "find_network", lambda path: "nfs4")
    monkeypatch.setenv("WIW_CACHE_GB", "1e-9")

    def list_kept() -> set[Path]:
        return set((own_cache / "scenes").glob("*.wiwscene"))

    scenes.store.load_generated([1], flat)
    old = list_kept()
    scenes.store.load_generated([2], flat)
    assert len(list_kept()) == 2 and old < list_kept()
    for path in old:
        os.utime(path, (time.time() - 8 * 24 * 3600,) * 2)
    scenes.store.load_generated([3], flat)
    assert len(list_kept()) == 2 and not old & list_kept()


def test_a_scene_trimmed_by_another_process_at_once_is_used_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scenes.store, "_trim", lambda newest: newest.unlink())
    assert scenes.load(square(tmp_path), isolate=False).triangle_count == 2


def test_a_scene_that_cannot_be_kept_is_used_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(scene: scenes.Scene, path: Path) -> None:
        raise FileError(f"{path}: cannot be written (is the disk full?)")

    monkeypatch.setattr(_core.scene, "write_cache", full)
    assert scenes.store.load_generated(["full"], flat).triangle_count == 2
    assert "disk full" in caplog.text and "generated again next time" in caplog.text
    monkeypatch.undo()
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "file"))
    caplog.clear()
    assert scenes.store.load_generated(["nowhere"], flat).triangle_count == 2
    assert "cannot be cached" in caplog.text


@pytest.mark.parametrize("isolate", [False, True])
def test_an_imported_scene_needs_no_cache_that_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, isolate: bool
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "file"))
    assert scenes.load(square(tmp_path), isolate=isolate).triangle_count == 2
    assert "cannot be cached" in caplog.text

    def forbidden(self: Path, *_: object) -> None:
        raise PermissionError(13, "Read-only file system", str(self))

    monkeypatch.setenv("WIW_CACHE", str(tmp_path / "cache"))
    (tmp_path / "cache/scenes").mkdir(parents=True)
    monkeypatch.setattr(Path, "touch", forbidden)
    caplog.clear()
    assert scenes.load(square(tmp_path), isolate=isolate).triangle_count == 2
    assert "Read-only file system" in caplog.text and not list((tmp_path / "cache/scenes").iterdir())


def test_a_file_that_ends_the_importer_is_an_error_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cut.glb").write_bytes(square(tmp_path).read_bytes()[:-10])
    with pytest.raises(FileError, match=r"cut.glb: should have .* \(truncated file\)"):
        scenes.load(tmp_path / "cut.glb", cache=False)

    fake = tmp_path / "python"
    for body, message in (("kill -SEGV $$", "crashed on it with SIGSEGV"), ("sleep 9", "took more than 1 s")):
        fake.write_text(f"#!/bin/sh\n{body}\n")
        fake.chmod(0o755)
        with monkeypatch.context() as patch:
            patch.setattr(sys, "executable", str(fake))
            patch.setattr(scenes.isolated, "TIMEOUT", 1.0)
            with pytest.raises(FileError, match=message):
                scenes.load(tmp_path / "square.glb", cache=False)


def test_resolve_names_scenes(tmp_path: Path) -> None:
    assert scenes.resolve("apartments:val:3") == ["apartments:val/0", "apartments:val/1", "apartments:val/2"]
    assert scenes.resolve("apartments:test/7") == ["apartments:test/7"]
    assert scenes.resolve("apartments:test:60:62") == ["apartments:test/60", "apartments:test/61"]
    for spec in ("apartments:test:62:60", "apartments:test:7:7", "apartments:test:1:2:3", "apartments:test:-1:3"):
        with pytest.raises(ArgumentError, match="val:40:60"):
            scenes.resolve(spec)
    assert scenes.resolve("apartments:test/999999") == ["apartments:test/999999"]
    for spec in ("apartments:test/1000000", "apartments:test:1000000", f"apartments:test:{'9' * 5000}:1"):
        with pytest.raises(ArgumentError, match="expected numbers below 1000000"):
            scenes.resolve(spec)
    with pytest.raises(ArgumentError, match="expected numbers below 1000000"):
        scenes.open_scene("apartments:test/18446744073709551616")
    mesh = str(square(tmp_path))
    assert scenes.resolve(mesh) == [mesh]
    with pytest.raises(ArgumentError, match="expected apartments"):
        scenes.resolve("apartments:dev")
    with pytest.raises(FileError, match="no such file"):
        scenes.resolve(str(tmp_path / "none.world"))


def test_the_real_house_is_mapped_by_a_second_process(data_dir: Path) -> None:
    world = data_dir / "small_house/worlds/small_house.world"
    first = scenes.load(world)
    assert len(first.instances) == 87
    assert sum(i["triangle_count"] for i in first.instances if i["category"] != "ball") == 145_844 - 2
    code = f"""
import time, wiw.scenes as scenes
from wiw.scenes import isolated
isolated.import_to = None  # a second import would fail
begin = time.perf_counter()
scene = scenes.load({str(world)!r})
print(time.perf_counter() - begin, scene.triangle_count, scene.texture_bytes)
maps = open("/proc/self/maps").read()
assert ".wiwscene" in maps, maps
"""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, triangles, texture_bytes = child.stdout.split()
    assert int(triangles) == first.triangle_count
    assert int(texture_bytes) == first.texture_bytes
    print(f"mapped in {1e3 * float(seconds):.0f} ms")


def test_a_ceiling_closes_the_real_house(data_dir: Path) -> None:
    from wiw.render import Renderer

    world = data_dir / "small_house/worlds/small_house.world"
    camera = np.eye(4)
    camera[:3, 3] = [0, 1.2, 0]
    up = slice(0, 200)
    holes = []
    for ceiling in (None, 2.9):
        scene = scenes.load(world, ceiling=ceiling)
        ids = Renderer(scene, backend="cpu").panorama(camera[None], (576, 1024), outputs=("instance",))["instance"][0]
        holes.append((ids[up] == 0).mean())
    assert holes[0] > 0.5
    assert holes[1] == 0
    assert scene.instances[-1]["category"] == "ceiling"


@pytest.mark.parametrize("spec", [["apartments:val/0", "apartments:val/1"], 3, None])
def test_a_spec_is_text(spec):
    for read in (scenes.resolve, scenes.absolute):
        with pytest.raises(ArgumentError, match=r"scene spec: expected text such as .* got .*episode file"):
            read(spec)
