# SPDX-License-Identifier: Apache-2.0
"""glTF: what assimp would drop or draw wrong is drawn as it should be, or named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from glb import Glb
from numpy.typing import NDArray

from wiw import scenes
from wiw.errors import FileError
from wiw.render import Renderer

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
CODES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}


def add_accessor(glb: Glb, array: NDArray[Any], normalized: bool = False, **view: int) -> int:
    """An accessor of any numbers, its rows padded to four bytes."""
    rows = np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
    step = rows.shape[1] + -rows.shape[1] % 4
    padded = np.zeros((len(array), step), np.uint8)
    padded[:, : rows.shape[1]] = rows
    glb.accessors.append(
        {
            "bufferView": glb.view(padded.tobytes()),
            "componentType": CODES[str(array.dtype)],
            "count": len(array),
            "type": {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[array.shape[1]],
            "normalized": normalized,
        }
    )
    if array.shape[1] < 16:
        glb.views[-1]["byteStride"] = step
    glb.views[-1] |= view
    return len(glb.accessors) - 1


def picture() -> NDArray[np.uint8]:
    """Smooth, and other in every direction."""
    y, x = np.mgrid[:64, :64] / 63
    image = np.stack([255 * x, 255 * y, 255 * (1 - x) * (1 - y)], axis=-1).astype(np.uint8)
    image[8:24, 40:56] = 255
    return image


def png(image: NDArray[np.uint8] | None = None) -> bytes:
    return bytes(cv2.imencode(".png", (picture() if image is None else image)[..., ::-1])[1].tobytes())


def textured_square(uv: NDArray[np.float32] = UV) -> Glb:
    """A square with a picture."""
    glb = Glb()
    glb.node(glb.mesh(TWO, glb.textured(glb.image(png())), POSITION=SQUARE, TEXCOORD_0=uv), name="part")
    return glb


def save(glb: Glb, path: Path, **entries: Any) -> Path:
    """The file, with these entries in its JSON."""
    document = glb.document() | entries
    glb.document = lambda: document  # type: ignore[method-assign]
    path.write_bytes(glb.bytes())
    return path


def load(path: Path, **options: Any) -> scenes.Scene:
    return scenes.load(path, cache=False, isolate=False, **options)


def draw(scene: scenes.Scene) -> NDArray[np.int64]:
    """The unit square from the front."""
    camera = np.eye(4)
    camera[:3, 3] = [0.5, 0.5, 0.5]
    renderer = Renderer(scene, backend="cpu")
    return renderer.perspective(camera[None], (96, 96), 90.0, outputs=("color",))["color"][0].astype(int)


def assert_alike(a: NDArray[np.int64], b: NDArray[np.int64]) -> None:
    assert np.abs(a - b).mean() < 0.5 and b.std() > 20


@pytest.mark.parametrize(
    ("offset", "scale", "rotation"),
    [
        ((0.3, 0.1), (0.5, 0.25), 0.0),
        ((0, 0), (1, 1), 0.6),
        ((0.2, 0.7), (0.4, -0.3), -1.1),
        ((0, 1), (0.5, 0.5), np.pi / 2),
    ],
)
def test_texture_transforms_are_carried_out(
    tmp_path: Path, offset: tuple[float, float], scale: tuple[float, float], rotation: float
) -> None:
    glb = textured_square()
    transform = {"offset": list(offset), "scale": list(scale), "rotation": rotation}
    info = glb.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]
    info["extensions"] = {"KHR_texture_transform": transform}
    file = save(glb, tmp_path / "a.glb", extensionsUsed=["KHR_texture_transform"])
    c, s = np.cos(rotation), np.sin(rotation)
    uv = np.array(offset) + (UV * scale) @ np.array([[c, s], [-s, c]]).T
    expected = load(save(textured_square(uv.astype(np.float32)), tmp_path / "b.glb"))
    assert_alike(draw(load(file)), draw(expected))


@pytest.mark.parametrize("how", ["transform", "texture"])
def test_the_set_of_texture_coordinates_is_the_one_named(tmp_path: Path, how: str) -> None:
    glb = Glb()
    material = glb.textured(glb.image(png()))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=0 * UV, TEXCOORD_1=UV))
    info = glb.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]
    info |= {"texCoord": 1} if how == "texture" else {"extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    file = save(glb, tmp_path / "a.glb", extensionsUsed=["KHR_texture_transform"])
    assert_alike(draw(load(file)), draw(load(save(textured_square(), tmp_path / "b.glb"))))


@pytest.mark.parametrize("kind", ["uint8", "uint16"])
def test_texture_coordinates_may_be_normalised_integers(tmp_path: Path, kind: str) -> None:
    glb = Glb()
    material = glb.textured(glb.image(png()))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE))
    most = np.iinfo(kind).max
    glb.meshes[0]["primitives"][0]["attributes"]["TEXCOORD_0"] = add_accessor(
        glb, (UV * most).astype(kind), normalized=True
    )
    assert_alike(draw(load(save(glb, tmp_path / "a.glb"))), draw(load(save(textured_square(), tmp_path / "b.glb"))))


@pytest.mark.parametrize(("kind", "normalized"), [("int8", True), ("int16", True), ("uint16", False), ("int8", False)])
def test_quantised_meshes_are_read(tmp_path: Path, kind: str, normalized: bool) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), scale=[2, 2, 2], translation=[1, 0, 0])
    most = np.iinfo(kind).max if normalized else 100
    attributes = {"POSITION": add_accessor(glb, (SQUARE * most).astype(kind), normalized)}
    attributes["NORMAL"] = add_accessor(glb, np.tile(np.int8([0, 0, 127]), (4, 1)), normalized=True)
    glb.meshes[0]["primitives"][0]["attributes"] = attributes
    needs = {"extensionsUsed": ["KHR_mesh_quantization"], "extensionsRequired": ["KHR_mesh_quantization"]}
    scene = load(save(glb, tmp_path / "a.glb", **needs))
    size = 2 if normalized else 200
    np.testing.assert_allclose(scene.bounds, [[1, 0, 0], [1 + size, size, 0]], atol=1e-5)
    assert scene.warnings == []


def test_interleaved_values_may_end_with_the_last_row(tmp_path: Path) -> None:
    glb = Glb()
    material = glb.textured(glb.image(png()))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=UV))
    rows = np.concatenate([SQUARE, UV, np.zeros((4, 1), np.float32)], axis=1)  # 24 bytes, the last 4 of them unused
    view = glb.view(rows.tobytes()[:-4])
    glb.views[view]["byteStride"] = 24
    attributes = glb.meshes[0]["primitives"][0]["attributes"]
    glb.accessors[attributes["POSITION"]] |= {"bufferView": view, "byteOffset": 0}
    glb.accessors[attributes["TEXCOORD_0"]] |= {"bufferView": view, "byteOffset": 12}
    assert_alike(draw(load(save(glb, tmp_path / "a.glb"))), draw(load(save(textured_square(), tmp_path / "b.glb"))))


def separate(glb: Glb, folder: Path, uri: str, name: str) -> Path:
    """A .gltf file whose buffer is a file of its own."""
    document = glb.document()
    document["buffers"][0]["uri"] = uri
    (folder / name).write_bytes(glb.binary)
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def test_names_of_buffers_may_be_percent_encoded(tmp_path: Path) -> None:
    file = separate(textured_square(), tmp_path, "my%20d%C3%A4ta%251.bin", "my däta%1.bin")
    assert load(file).triangle_count == 2
    assert scenes.load(file).texture_count == 1  # in a child, with the buffer among the sources of the cache
    (tmp_path / "my däta%1.bin").unlink()
    with pytest.raises(FileError, match=r"my däta%1\.bin"):
        load(file)


def test_a_rewritten_file_still_depends_on_its_buffers(tmp_path: Path) -> None:
    glb = textured_square()
    glb.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] = {
        "KHR_texture_transform": {"scale": [0.5, 0.5]}
    }
    file = separate(glb, tmp_path, "data.bin", "data.bin")
    scene, read, _ = scenes._core.scene.import_scene(file)
    assert scene.triangle_count == 2 and {path.name for path in read} == {"a.gltf", "data.bin"}


def test_instances_are_drawn_each(tmp_path: Path) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), name="chair", translation=[0, 0, 5])
    places = np.float32([[0, 0, 0], [3, 0, 0], [0, 7, 0]])
    half = np.int16([[0, 0, 0, 32767], [0, 0, 0, 32767], [0, 0, 32767, 0]])  # the last is turned by 180 degrees about z
    attributes = {
        "TRANSLATION": add_accessor(glb, places),
        "ROTATION": add_accessor(glb, half, normalized=True),
        "SCALE": add_accessor(glb, np.float32([[1, 1, 1], [2, 2, 2], [1, 1, 1]])),
    }
    glb.nodes[0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    needs = {"extensionsUsed": ["EXT_mesh_gpu_instancing"], "extensionsRequired": ["EXT_mesh_gpu_instancing"]}
    file = save(glb, tmp_path / "a.glb", **needs)
    scene = load(file)
    assert [each["category"] for each in scene.instances] == ["chair"] * 3 and scene.warnings == []
    boxes = [each["bounds"] for each in scene.instances]
    np.testing.assert_allclose(boxes[0], [[0, 0, 5], [1, 1, 5]], atol=1e-4)
    np.testing.assert_allclose(boxes[1], [[3, 0, 5], [5, 2, 5]], atol=1e-4)
    np.testing.assert_allclose(boxes[2], [[-1, 6, 5], [0, 7, 5]], atol=1e-4)
    with pytest.raises(FileError, match=r"limits\.nodes"):
        load(file, limits={"nodes": 2})


def test_instances_of_unlike_count_are_refused(tmp_path: Path) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE))
    attributes = {"TRANSLATION": add_accessor(glb, SQUARE), "SCALE": add_accessor(glb, SQUARE[:2])}
    glb.nodes[0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    with pytest.raises(FileError, match="SCALE does not fit the others"):
        load(save(glb, tmp_path / "a.glb"))


@pytest.mark.parametrize("where", ["mesh", "node"])
def test_morph_weights_hold_at_rest(tmp_path: Path, where: str) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), name="part")
    glb.node(0, name="other", translation=[0, 0, 9]) if where == "node" else None
    targets = [
        {"POSITION": add_accessor(glb, np.tile(np.float32([0, 0, 4]), (4, 1)))},
        {"POSITION": add_accessor(glb, 8 * SQUARE)},
    ]
    glb.meshes[0]["primitives"][0]["targets"] = targets
    (glb.meshes if where == "mesh" else glb.nodes)[0]["weights"] = [0.5, 0.25]
    scene = load(save(glb, tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.instances[0]["bounds"], [[0, 0, 2], [3, 3, 2]], atol=1e-5)
    if where == "node":  # the same mesh elsewhere is as it was
        np.testing.assert_allclose(scene.instances[1]["bounds"], [[0, 0, 9], [1, 1, 9]], atol=1e-5)


def test_skins_are_drawn_in_the_pose_of_the_file(tmp_path: Path) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), name="figure", skin=0, translation=[50, 50, 50])
    glb.nodes += [{"translation": [0, 10, 0], "children": [2]}, {"translation": [3, 0, 0]}]
    bind = np.tile(np.eye(4, dtype=np.float32).ravel(), (2, 1))
    bind[1, 12:15] = [-1, 0, 0]  # columns first: bound one metre to the right
    attributes = glb.meshes[0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = add_accessor(glb, np.uint8([[0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]]))
    weights = np.float32([[1, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0]])
    attributes["WEIGHTS_0"] = add_accessor(glb, weights)
    entries = {
        "scenes": [{"nodes": [0, 1]}],
        "skins": [{"joints": [1, 2], "inverseBindMatrices": add_accessor(glb, bind)}],
    }
    scene = load(save(glb, tmp_path / "a.glb", **entries))
    (figure,) = scene.instances
    assert figure["name"] == "figure"
    vertices = scene.world_triangles()[0]
    expected = [[0, 10, 0], [3, 10, 0], [3, 11, 0], [1, 11, 0]]
    assert {tuple(np.round(vertex, 4)) for vertex in vertices.tolist()} == set(
        map(tuple, np.float64(expected).tolist())
    )

    broken = glb.document()
    broken["skins"] = [{"joints": [1, 99]}]
    with pytest.raises(FileError, match="names a joint that is not there"):
        load(save(glb, tmp_path / "b.glb", skins=broken["skins"]))


@pytest.mark.parametrize("with_texture", [False, True])
def test_emissive_only_surfaces_are_drawn(tmp_path: Path, with_texture: bool) -> None:
    glb = textured_square()
    glb.materials[0] = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": [1.0, 0.25, 1.0]}
    if with_texture:
        glb.materials[0] |= {"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}
    found = draw(load(save(glb, tmp_path / "a.glb")))
    if with_texture:
        middle = picture()[::-1][::-1][20:44, 20:44].astype(int)
        assert np.abs(found[30:66, 30:66].mean((0, 1)) - middle.mean((0, 1))).max() < 6
    else:
        np.testing.assert_allclose(found[48, 48], [255, 255 * 0.25 ** (1 / 2.2), 255], atol=2)


@pytest.mark.parametrize(("mode", "word"), [(33071, "clamped"), (33648, "mirrored"), (10497, "")])
def test_textures_that_do_not_repeat_are_named_where_it_shows(tmp_path: Path, mode: int, word: str) -> None:
    for uv, shows in ((UV, False), (2 * UV, bool(word))):
        glb = textured_square(uv)
        glb.materials[0]["name"] = "wall paper"
        entries = {"samplers": [{"wrapS": mode}], "textures": [{"source": 0, "sampler": 0}]}
        warnings = load(save(glb, tmp_path / "a.glb", **entries)).warnings
        assert len(warnings) == shows
        assert not shows or f"'wall paper' of a.glb should be {word} beyond its edges" in warnings[0]


@pytest.mark.parametrize(
    ("extension", "kind", "name"),
    [("EXT_texture_webp", "image/webp", "WebP"), ("KHR_texture_basisu", "image/ktx2", "Basis Universal")],
)
def test_a_png_stands_in_for_pictures_that_cannot_be_decoded(
    tmp_path: Path, extension: str, kind: str, name: str
) -> None:
    for has_png in (True, False):
        glb = textured_square()
        other = glb.image(b"RIFF....WEBPVP8 ", kind)
        texture: dict[str, Any] = {"extensions": {extension: {"source": other}}} | ({"source": 0} if has_png else {})
        file = save(glb, tmp_path / "a.glb", textures=[texture], extensionsUsed=[extension])
        scene = load(file)
        assert scene.texture_count == has_png
        assert [f"stored as {name} alone" in warning for warning in scene.warnings] == [True] * (not has_png)


def test_extensions_that_nobody_reads_are_named(tmp_path: Path) -> None:
    used = ["KHR_node_visibility", "KHR_materials_ior"]
    (warning,) = load(save(textured_square(), tmp_path / "a.glb", extensionsUsed=used)).warnings
    assert "a.glb uses the glTF extension 'KHR_node_visibility', which is not read" in warning
    with pytest.raises(FileError, match="needs the glTF extension 'EXT_meshopt_compression'"):
        load(save(textured_square(), tmp_path / "b.glb", extensionsRequired=["EXT_meshopt_compression"]))
