# SPDX-License-Identifier: Apache-2.0
"""glTF: what a file says is drawn, or named; held to plainer files and to rays cast by trimesh's Embree."""

from __future__ import annotations

import ctypes
import ctypes.util
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from cast_parts import Part, cast_parts
from glb import Glb
from locations import TESTS
from numpy.typing import NDArray

from wiw import scenes
from wiw.errors import FileError
from wiw.physics import read_surface
from wiw.render import Renderer
from wiw.scenes import basis

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


def test_a_scene_depends_on_its_buffers(tmp_path: Path) -> None:
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
    with pytest.raises(FileError, match="has 4 instances, but 2 of some of their values"):
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


def test_a_morph_target_without_data_changes_nothing(tmp_path: Path) -> None:
    glb = Glb()
    glb.node(glb.mesh(TWO, POSITION=SQUARE), name="part")
    glb.accessors.append({"componentType": 5126, "type": "VEC3", "count": 4})  # zeros, as the specification has it
    targets = [{"POSITION": 2}, {"POSITION": add_accessor(glb, np.tile(np.float32([0, 0, 4]), (4, 1)))}]
    glb.meshes[0] |= {"weights": [0.5, 0.25]}
    glb.meshes[0]["primitives"][0]["targets"] = targets
    scene = load(save(glb, tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.instances[0]["bounds"], [[0, 0, 1], [1, 1, 1]], atol=1e-5)


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


def test_a_file_that_shows_nothing_says_why(tmp_path: Path) -> None:
    """By glTF 2.0, 3.5.1, a file without scenes is a library, and nothing of it is drawn."""
    with pytest.raises(FileError, match="has nodes but no scene that says which of them to show"):
        load(save(textured_square(), tmp_path / "library.glb", scenes=[]))
    with pytest.raises(FileError, match="names a scene that is not there"):
        load(save(textured_square(), tmp_path / "other.glb", scene=3))


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


@pytest.mark.parametrize("factor", [[0, 0, 0], [1, 1, 1]])
def test_an_emissive_texture_stands_in_for_a_base_texture_where_it_shines(tmp_path: Path, factor: list[int]) -> None:
    glb = textured_square()
    glb.materials[0] = {"emissiveTexture": {"index": 0}, "emissiveFactor": factor}
    found = draw(load(save(glb, tmp_path / "a.glb")))
    assert (found[30:66, 30:66].std(axis=(0, 1)).max() > 20) == any(factor)


# ---- against rays


EYE = np.array([0.5, 0.5, 0.5])
DATA = TESTS / "data"


def assert_as_cast(scene: scenes.Scene, *parts: Part, eye: NDArray[np.float64] = EYE) -> None:
    """The scene's instances are these parts, in order and in colour, but for pixels at their edges."""
    pose = np.eye(4)
    pose[:3, 3] = eye
    seen = Renderer(scene, backend="cpu").perspective(pose[None], (96, 96), 90.0, outputs=("color", "instance"))
    color, number = cast_parts(list(parts), eye)
    same = (seen["instance"][0] == number) & (number > 0)
    assert (number > 0).mean() > 0.1 and (seen["instance"][0] == number).mean() > 0.99
    wrong = np.abs(seen["color"][0] - color).max(axis=-1) > 2
    assert (wrong & same).sum() < 0.01 * same.sum()


def unlit(glb: Glb) -> Glb:
    """The file, its materials as bright as their textures."""
    for material in glb.materials:
        material["extensions"] = {"KHR_materials_unlit": {}}
    return glb


def few_texels() -> NDArray[np.uint8]:
    """A picture of which a texel covers many pixels."""
    return np.random.default_rng(0).integers(40, 220, (5, 7, 3), dtype=np.uint8)


WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}


@pytest.mark.parametrize("nearest", [False, True])
@pytest.mark.parametrize("wrap", [("repeat", "clamp"), ("clamp", "mirror"), ("mirror", "repeat")])
def test_samplers_are_obeyed(tmp_path: Path, wrap: tuple[str, str], nearest: bool) -> None:
    image, uv = few_texels(), 4 * UV - 1.3
    glb = Glb()
    material = glb.textured(glb.image(png(image)))
    unlit(glb).node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=uv))
    sampler = {"wrapS": WRAPS[wrap[0]], "wrapT": WRAPS[wrap[1]], "magFilter": 9728 if nearest else 9729}
    entries = {"samplers": [sampler], "textures": [{"source": 0, "sampler": 0}]}
    file = save(glb, tmp_path / "a.glb", **entries)
    scene = load(file)
    assert scene.warnings == []
    assert_as_cast(scene, Part(SQUARE, TWO, uv, image, wrap, nearest))
    assert_as_cast(scenes.load(file), Part(SQUARE, TWO, uv, image, wrap, nearest))  # through the cache


def test_one_image_serves_several_samplers(tmp_path: Path) -> None:
    image, uv = few_texels(), 4 * UV - 1.3
    glb = Glb()
    glb.textured(glb.image(png(image)))
    glb.textured(1)
    unlit(glb)
    for i in (0, 1):
        glb.node(
            glb.mesh(TWO, i, POSITION=np.float32([0.5, 1, 1]) * SQUARE + np.float32([0.5 * i, 0, 0]), TEXCOORD_0=uv)
        )
    entries = {"samplers": [{"wrapS": 33071, "wrapT": 33071}], "textures": [{"source": 0}, {"source": 0, "sampler": 0}]}
    scene = load(save(glb, tmp_path / "a.glb", **entries))
    left, right = SQUARE * (0.5, 1, 1), SQUARE * (0.5, 1, 1) + (0.5, 0, 0)
    assert_as_cast(scene, Part(left, TWO, uv, image), Part(right, TWO, uv, image, ("clamp", "clamp")))


def test_links_of_robots_may_be_gltf(tmp_path: Path) -> None:
    glb = compressed_bumps()
    glb.nodes[0] |= {"scale": [2, 2, 2], "translation": [0, 0, 1]}
    glb.materials[0] = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}
    file = save_compressed(glb, tmp_path / "link.glb")
    surface = read_surface(file, scale=(1, 1, -1))
    vertices, triangles, _ = bumps()
    expected = (2 * vertices + [0, 0, 1]) * [1, 1, -1]
    np.testing.assert_allclose(np.sort(surface["positions"], axis=0), np.sort(expected, axis=0), atol=1e-5)
    assert len(surface["triangles"]) == len(triangles)
    np.testing.assert_allclose(surface["normals"], np.tile([0, 0, -1], (len(vertices), 1)), atol=0.02)
    np.testing.assert_allclose(surface["colors"], np.tile([1, 0, 0, 1], (len(vertices), 1)))
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(FileError, match=r"truncated file\) \(mesh of link 'hand'\)"):
        read_surface(file, link="hand")


def test_a_mesh_without_material_in_a_world_takes_no_other_ones(tmp_path: Path) -> None:
    model = '<model name="{0}"><pose>{1} 0 0 0 0 0</pose><link name="l"><visual name="v"><geometry><mesh><uri>{0}.glb'
    model += "</uri></mesh></geometry></visual></link></model>"
    red, plain = Glb(), Glb()
    red.materials.append({"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}})
    red.node(red.mesh(TWO, 0, POSITION=SQUARE))
    plain.node(plain.mesh(TWO, POSITION=SQUARE))
    save(red, tmp_path / "a.glb")
    save(plain, tmp_path / "b.glb")
    drawn = []
    for models in ((model.format("b", 0),), (model.format("a", 50), model.format("b", 0))):
        world = "<sdf version='1.7'><world name='w'>" + "".join(models) + "</world></sdf>"
        (tmp_path / "w.sdf").write_text(world)
        drawn.append(draw(load(tmp_path / "w.sdf")))
    assert drawn[0].std() > 0 or drawn[0].mean() > 50
    np.testing.assert_array_equal(*drawn)


@pytest.mark.parametrize(("mode", "corners"), [(5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_strips_and_fans_are_drawn(tmp_path: Path, mode: int, corners: list[int]) -> None:
    glb = Glb()
    material = glb.textured(glb.image(png(few_texels())))
    unlit(glb).node(glb.mesh(np.uint32(corners), material, POSITION=SQUARE, TEXCOORD_0=UV))
    glb.meshes[0]["primitives"][0]["mode"] = mode
    assert_as_cast(load(save(glb, tmp_path / "a.glb")), Part(SQUARE, TWO, UV, few_texels()))


@pytest.mark.parametrize("lossless", [True, False])
def test_webp_is_drawn(tmp_path: Path, lossless: bool) -> None:
    image = picture()
    webp = bytes(cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101 if lossless else 95])[1])
    glb = Glb()
    material = glb.textured(glb.image(webp, "image/webp"))
    unlit(glb).node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=UV))
    needs = {"extensionsUsed": ["EXT_texture_webp"], "extensionsRequired": ["EXT_texture_webp"]}
    textures = [{"extensions": {"EXT_texture_webp": {"source": 0}}}]
    scene = load(save(glb, tmp_path / "a.glb", textures=textures, **needs))
    decoded = cv2.imdecode(np.frombuffer(webp, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert scene.warnings == []
    assert_as_cast(scene, Part(SQUARE, TWO, UV, decoded))


@pytest.mark.skipif(not basis.has_decoder(), reason="opengl_basisu is not installed (wiw[hm3d])")
def test_ktx2_is_drawn_in_any_mesh(tmp_path: Path) -> None:
    data = (DATA / "wall.ktx2").read_bytes()
    glb = Glb()
    material = glb.textured(glb.image(data, "image/ktx2"))
    unlit(glb).node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=UV))
    textures = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    file = save(glb, tmp_path / "a.glb", textures=textures, extensionsRequired=["KHR_texture_basisu"])
    scene = scenes.load(file, cache=False)  # in a child
    assert scene.warnings == [] and scene.texture_count == 1
    assert_as_cast(scene, Part(SQUARE, TWO, UV, basis.decode(data)))


@pytest.mark.parametrize(
    ("extension", "kind"), [("EXT_texture_webp", "image/webp"), ("KHR_texture_basisu", "image/ktx2")]
)
def test_a_png_comes_before_pictures_of_extensions(tmp_path: Path, extension: str, kind: str) -> None:
    glb = unlit(textured_square())
    other = glb.image(b"RIFF....WEBPVP8 ", kind)
    textures = [{"source": 0, "extensions": {extension: {"source": other}}}]
    scene = load(save(glb, tmp_path / "a.glb", textures=textures, extensionsUsed=[extension]))
    assert scene.warnings == []
    assert_as_cast(scene, Part(SQUARE, TWO, UV, picture()))
    (warning,) = load(save(glb, tmp_path / "b.glb", textures=[{"source": other}])).warnings
    assert "image 1 of b.glb cannot be decoded as WebP" in warning


# ---- compressed meshes


def meshopt() -> ctypes.CDLL:
    """The library's encoders, which the core links with its decoders."""
    name = ctypes.util.find_library("meshoptimizer")
    if name is None:
        pytest.skip("libmeshoptimizer is not installed")
    library = ctypes.CDLL(name)
    for function in ("EncodeVertexBufferBound", "EncodeVertexBuffer", "EncodeIndexBufferBound", "EncodeIndexBuffer"):
        getattr(library, f"meshopt_e{function[1:]}").restype = ctypes.c_size_t
    for function in ("EncodeIndexSequenceBound", "EncodeIndexSequence"):
        getattr(library, f"meshopt_e{function[1:]}").restype = ctypes.c_size_t
    return library


def pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def compressed_view(glb: Glb, rows: NDArray[Any], mode: str, filter_: str = "NONE") -> int:
    """A buffer view with EXT_meshopt_compression of these rows."""
    library, size = meshopt(), ctypes.c_size_t
    rows = np.ascontiguousarray(rows)
    count, stride = len(rows), rows.itemsize * (rows.shape[1] if rows.ndim == 2 else 1)
    out = np.zeros(1 << 16, np.uint8)
    if mode == "ATTRIBUTES":
        used = library.meshopt_encodeVertexBuffer(
            pointer(out), size(len(out)), pointer(rows), size(count), size(stride)
        )
    else:
        indices = rows.astype(np.uint32)
        encode = "Buffer" if mode == "TRIANGLES" else "Sequence"
        encode_indices = getattr(library, f"meshopt_encodeIndex{encode}")
        used = encode_indices(pointer(out), size(len(out)), pointer(indices), size(count))
    assert used > 0
    plain = glb.view(out[:used].tobytes())
    settings = {"count": count, "byteStride": stride, "mode": mode, "filter": filter_}
    extension = {**glb.views[plain], **settings}
    glb.views[plain] = {"buffer": 1, "byteLength": count * stride, "extensions": {"EXT_meshopt_compression": extension}}
    if mode == "ATTRIBUTES":
        glb.views[plain]["byteStride"] = stride
    return plain


def filtered(rows: NDArray[np.float32], filter_: str, stride: int, bits: int) -> NDArray[np.int8]:
    """Rows as a filter of EXT_meshopt_compression takes them."""
    out = np.zeros((len(rows), stride), np.int8)
    encode = getattr(meshopt(), f"meshopt_encodeFilter{filter_}")
    rows = np.ascontiguousarray(rows, np.float32)
    encode(pointer(out), ctypes.c_size_t(len(rows)), ctypes.c_size_t(stride), ctypes.c_int(bits), pointer(rows))
    return out


def bumps(n: int = 9) -> tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.float32]]:
    """Vertices, triangles and texture coordinates of an uneven square."""
    y, x = np.mgrid[:n, :n] / (n - 1)
    vertices = np.stack([x, y, 0.1 * np.sin(5 * x) * np.cos(4 * y)], axis=-1).reshape(-1, 3).astype(np.float32)
    at = np.arange(n * n).reshape(n, n)
    quads = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.uint32)
    return vertices, triangles, np.stack([x, 1 - y], axis=-1).reshape(-1, 2).astype(np.float32)


def compressed_bumps(mode: str = "TRIANGLES", filter_: str = "NONE", index: str = "uint16") -> Glb:
    vertices, triangles, uv = bumps()
    glb = Glb()
    material = glb.textured(glb.image(png()))
    unlit(glb)
    rows: NDArray[Any] = vertices
    if filter_ == "EXPONENTIAL":
        rows = filtered(vertices, "Exp", 12, 20)
    position = {"bufferView": compressed_view(glb, rows, "ATTRIBUTES", filter_), "componentType": 5126}
    normals = filtered(np.tile(np.float32([0, 0, 1, 0]), (len(vertices), 1)), "Oct", 4, 8)
    normal = {"bufferView": compressed_view(glb, normals, "ATTRIBUTES", "OCTAHEDRAL"), "componentType": 5120}
    quantised = np.round(uv * 65535).astype(np.uint16)
    coordinate = {
        "bufferView": compressed_view(glb, quantised, "ATTRIBUTES"),
        "componentType": 5123,
        "normalized": True,
    }
    corners = {"bufferView": compressed_view(glb, triangles.reshape(-1).astype(index), mode)}
    count = len(vertices)
    glb.accessors += [
        {**position, "count": count, "type": "VEC3"},
        {**normal, "normalized": True, "count": count, "type": "VEC3"},
        {**coordinate, "count": count, "type": "VEC2"},
        {**corners, "componentType": CODES[index], "count": triangles.size, "type": "SCALAR"},
    ]
    attributes = {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    glb.meshes.append({"primitives": [{"attributes": attributes, "indices": 3, "material": material}]})
    glb.node(0)
    return glb


def save_compressed(glb: Glb, path: Path) -> Path:
    size = 1 << 16
    needs = ["EXT_meshopt_compression", "KHR_mesh_quantization"]
    buffers = [{"byteLength": len(glb.binary)}, {"byteLength": size}]
    return save(glb, path, buffers=buffers, extensionsUsed=needs, extensionsRequired=needs)


@pytest.mark.parametrize(
    ("mode", "filter_", "index"),
    [("TRIANGLES", "NONE", "uint16"), ("TRIANGLES", "EXPONENTIAL", "uint32"), ("INDICES", "NONE", "uint16")],
)
def test_meshopt_compression_is_undone(tmp_path: Path, mode: str, filter_: str, index: str) -> None:
    scene = load(save_compressed(compressed_bumps(mode, filter_, index), tmp_path / "a.glb"))
    assert scene.triangle_count == 128 and scene.warnings == []
    assert_as_cast(scene, Part(*bumps(), picture()))


def test_instances_may_be_compressed(tmp_path: Path) -> None:
    glb = compressed_bumps()
    quarter = np.float32([[0, 0, 0, 1], [0, 0, np.sqrt(0.5), np.sqrt(0.5)]])
    view = compressed_view(glb, filtered(quarter, "Quat", 8, 16), "ATTRIBUTES", "QUATERNION")
    glb.accessors.append({"bufferView": view, "componentType": 5122, "normalized": True, "count": 2, "type": "VEC4"})
    glb.nodes[0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"ROTATION": 4}}}
    scene = load(save_compressed(glb, tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.instances[0]["bounds"][:, :2], [[0, 0], [1, 1]], atol=1e-3)
    np.testing.assert_allclose(scene.instances[1]["bounds"][:, :2], [[-1, 0], [0, 1]], atol=1e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"byteStride": 6}, "compressed elements of 6"),
        ({"mode": "OTHER"}, "mode 'OTHER'"),
        ({"filter": "QUATERNION"}, "filter 'QUATERNION'"),
        ({"byteLength": 8}, "cannot decode"),
        ({"byteLength": 1 << 30}, "but its buffer"),
        ({"count": 1 << 62}, "compressed elements"),
        ({"count": 200_000_000, "byteStride": 256}, "cannot hold its 200000000 x 256 bytes"),
    ],
)
def test_damaged_meshopt_compression_is_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    glb = compressed_bumps()
    view = glb.accessors[0]["bufferView"]
    glb.views[view]["extensions"]["EXT_meshopt_compression"] |= change  # type: ignore[index, operator]
    if "byteStride" in change and "count" in change:
        glb.views[view] |= {"byteLength": change["count"] * change["byteStride"], "byteStride": change["byteStride"]}
    with pytest.raises(FileError, match=words):
        load(save_compressed(glb, tmp_path / "a.glb"))


def draco_glb(data: bytes) -> Glb:
    """`bumps` as DracoPy encodes it: attribute 0 is the texture coordinate, 1 the position."""
    glb = Glb()
    material = glb.textured(glb.image(png()))
    unlit(glb)
    view = glb.view(data)
    glb.accessors = [
        {"componentType": 5126, "count": 81, "type": "VEC3"},
        {"componentType": 5126, "count": 81, "type": "VEC2"},
        {"componentType": 5125, "count": 384, "type": "SCALAR"},
    ]
    compression = {"bufferView": view, "attributes": {"POSITION": 1, "TEXCOORD_0": 0}}
    primitive = {
        "attributes": {"POSITION": 0, "TEXCOORD_0": 1},
        "indices": 2,
        "material": material,
        "extensions": {"KHR_draco_mesh_compression": compression},
    }
    glb.meshes.append({"primitives": [primitive]})
    glb.node(0)
    return glb


DRACO = {name: ["KHR_draco_mesh_compression"] for name in ("extensionsUsed", "extensionsRequired")}


def test_draco_compression_is_undone(tmp_path: Path) -> None:
    scene = load(save(draco_glb((DATA / "bumps.drc").read_bytes()), tmp_path / "a.glb", **DRACO))
    assert scene.triangle_count == 128 and scene.warnings == []
    assert_as_cast(scene, Part(*bumps(), picture()))


def test_damaged_draco_compression_is_refused(tmp_path: Path) -> None:
    whole = (DATA / "bumps.drc").read_bytes()
    with pytest.raises(FileError, match=r"a\.glb: has a primitive that KHR_draco_mesh_compression cannot decode"):
        load(save(draco_glb(whole[:600]), tmp_path / "a.glb", **DRACO))
    glb = draco_glb(whole)
    glb.accessors[0]["count"] = glb.accessors[1]["count"] = 80
    with pytest.raises(FileError, match="has 81 vertices, but should have 80"):
        load(save(glb, tmp_path / "b.glb", **DRACO))
    glb = draco_glb(whole)
    glb.meshes[0]["primitives"][0]["extensions"]["KHR_draco_mesh_compression"]["attributes"]["POSITION"] = 7
    with pytest.raises(FileError, match="no attribute 7 of 3 components"):
        load(save(glb, tmp_path / "c.glb", **DRACO))


# ---- materials, and what is named


def test_specular_glossiness_and_emissive_strength_are_read(tmp_path: Path) -> None:
    glb = textured_square()
    gloss = {"diffuseFactor": [0.5, 1, 1, 1], "diffuseTexture": {"index": 0}}
    glb.materials[0] = {"extensions": {"KHR_materials_pbrSpecularGlossiness": gloss, "KHR_materials_unlit": {}}}
    tinted = picture().astype(float) * (0.5 ** (1 / 2.2), 1, 1)
    assert_as_cast(load(save(glb, tmp_path / "a.glb")), Part(SQUARE, TWO, UV, tinted.astype(np.uint8)))
    glb = textured_square()
    black = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": [0.1, 0.2, 0.3]}
    glb.materials[0] = black | {"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 3}}}
    expected = 255 * np.array([0.3, 0.6, 0.9]) ** (1 / 2.2)
    np.testing.assert_allclose(draw(load(save(glb, tmp_path / "b.glb")))[48, 48], expected, atol=2)


def test_what_cannot_be_drawn_of_a_mesh_is_named(tmp_path: Path) -> None:
    glb = textured_square()
    glb.meshes[0]["name"] = "door"
    glb.meshes[0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})
    glb.materials[0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = 3
    warnings = load(save(glb, tmp_path / "a.glb")).warnings
    assert warnings == [
        "mesh 'door' of a.glb has no TEXCOORD_3, which its texture takes; drawn without texture",
        "mesh 'door' of a.glb has points or lines, which are not drawn",
    ]


def test_extensions_that_nobody_reads_are_named(tmp_path: Path) -> None:
    used = ["KHR_node_visibility", "KHR_materials_ior"]
    (warning,) = load(save(textured_square(), tmp_path / "a.glb", extensionsUsed=used)).warnings
    assert "a.glb uses the glTF extension 'KHR_node_visibility', which is not read" in warning
    with pytest.raises(FileError, match="needs the glTF extension 'KHR_node_visibility'"):
        load(save(textured_square(), tmp_path / "b.glb", extensionsRequired=["KHR_node_visibility"]))
