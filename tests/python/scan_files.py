# SPDX-License-Identifier: Apache-2.0
"""Small scans in the layouts of real datasets, written by nothing that reads them: one flat in all of them.

Axis Z is up in the files. Two rooms with furniture; a picture on a wall is part of the wall's two triangles in the mesh
that is seen, and an object of its own in the labels. The labelled mesh has other triangles than the one that is seen.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from glb import Glb
from numpy.typing import NDArray

FLOOR, WALL, BED, TABLE, PICTURE, CLOSET, LAMP = range(7)
NAMES = ("floor", "wall", "bed", "dining table", "picture", "closet", "lamp")
"""By the object's id; the lamp has no surface."""
MPCAT40 = ("floor", "wall", "bed", "table", "picture", "closet", "lighting")
BEDROOM, KITCHEN = 0, 1
ROOM_OF = (BEDROOM, BEDROOM, BEDROOM, KITCHEN, KITCHEN, BEDROOM, KITCHEN)
UNLABELLED = -1


@dataclass(frozen=True)
class Quad:
    """A rectangle: corner, two edges, its object, and the picture that is painted on it."""

    corner: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    label: int
    paint: int = 0

    def part(self, u: tuple[float, float], v: tuple[float, float], label: int) -> Quad:
        """Return the part of it between shares of its edges."""
        corner = self.corner + u[0] * self.u + v[0] * self.v
        return Quad(corner, (u[1] - u[0]) * self.u, (v[1] - v[0]) * self.v, label, self.paint)


def quad(corner: tuple[float, ...], u: tuple[float, ...], v: tuple[float, ...], label: int, paint: int = 0) -> Quad:
    return Quad(np.array(corner, float), np.array(u, float), np.array(v, float), label, paint)


def box(low: tuple[float, ...], size: tuple[float, ...], label: int) -> list[Quad]:
    """Five sides of a box that stands on the floor."""
    x, y, z = low
    a, b, c = size
    return [
        quad((x, y, z + c), (a, 0, 0), (0, b, 0), label, 1),
        quad((x, y, z), (a, 0, 0), (0, 0, c), label, 1),
        quad((x, y + b, z), (a, 0, 0), (0, 0, c), label, 1),
        quad((x, y, z), (0, b, 0), (0, 0, c), label, 1),
        quad((x + a, y, z), (0, b, 0), (0, 0, c), label, 1),
    ]


EAST_WALL = quad((7, 0, 0), (0, 4, 0), (0, 0, 2.6), WALL)
PICTURE_PART = ((0.4, 0.6), (0.5, 0.8))
"""Where on the east wall the picture hangs, as shares of its edges."""


def seen() -> list[Quad]:
    """The flat as it is seen: a bedroom, x 0 to 4, and a kitchen, x 4 to 7, with a doorway between."""
    shell = [
        quad((0, 0, 0), (7, 0, 0), (0, 4, 0), FLOOR, 1),
        quad((0, 0, 2.6), (7, 0, 0), (0, 4, 0), UNLABELLED),
        quad((0, 0, 0), (7, 0, 0), (0, 0, 2.6), WALL),
        quad((0, 4, 0), (7, 0, 0), (0, 0, 2.6), WALL),
        quad((0, 0, 0), (0, 4, 0), (0, 0, 2.6), WALL),
        EAST_WALL,
        quad((4, 0, 0), (0, 2.4, 0), (0, 0, 2.6), WALL),
        quad((4, 3.4, 0), (0, 0.6, 0), (0, 0, 2.6), WALL),
    ]
    return [
        *shell,
        *box((0.2, 0.2, 0), (2, 1.5, 0.5), BED),
        *box((5.2, 1.2, 0), (0.8, 1.4, 0.75), TABLE),
        *box((0.1, 3.2, 0), (1.4, 0.6, 2.0), CLOSET),
    ]


def labelled() -> list[Quad]:
    """The flat with the picture cut out of the wall, and without the ceiling."""
    (u0, u1), (v0, v1) = PICTURE_PART
    around = [
        EAST_WALL.part((0, u0), (0, 1), WALL),
        EAST_WALL.part((u1, 1), (0, 1), WALL),
        EAST_WALL.part((u0, u1), (0, v0), WALL),
        EAST_WALL.part((u0, u1), (v1, 1), WALL),
        EAST_WALL.part((u0, u1), (v0, v1), PICTURE),
    ]
    return [*(q for q in seen() if q is not EAST_WALL and q.label != UNLABELLED), *around]


Grid = tuple[NDArray[np.float32], NDArray[np.uint32], NDArray[np.int32], NDArray[np.float32]]


def grids(quads: list[Quad], step: float = 100.0) -> Grid:
    """Vertices [V, 3], quads [F, 4], object of each quad [F], texture coordinates [V, 2]; edges up to `step`."""
    vertices, faces, labels, uvs = [], [], [], []
    first = 0
    for q in quads:
        n, m = (max(1, int(np.ceil(np.linalg.norm(edge) / step))) for edge in (q.u, q.v))
        s, t = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
        vertices.append((q.corner + s[..., None] * q.u + t[..., None] * q.v).reshape(-1, 3))
        uvs.append(np.stack([s, 1 - t], axis=-1).reshape(-1, 2))
        i, j = (index.reshape(-1) for index in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
        a = first + i * (m + 1) + j
        faces.append(np.stack([a, a + m + 1, a + m + 2, a + 1], axis=-1))
        labels.append(np.full(n * m, q.label))
        first += (n + 1) * (m + 1)
    return (
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.uint32),
        np.concatenate(labels).astype(np.int32),
        np.concatenate(uvs).astype(np.float32),
    )


def triangles_of(quads: NDArray[np.uint32]) -> NDArray[np.uint32]:
    return np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def paintings() -> list[NDArray[np.uint8]]:
    """Two pictures, each other in every direction: uint8 [H, W, 3]."""
    y, x = np.mgrid[:64, :96] / [[[63.0]], [[95.0]]]
    wall = np.stack([150 + 100 * x, 140 + 100 * y, 200 - 120 * x * y], axis=-1)
    wall[4:20, 8:24] = (255, 40, 40)  # red at the top left
    floor = np.stack([90 + 60 * y, 60 + 90 * x, 40 + 0 * x], axis=-1)
    floor[48:60, 76:92] = (40, 60, 255)  # blue at the bottom right
    return [wall.astype(np.uint8), floor.astype(np.uint8)]


def png(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))[1])


def seen_glb(images: list[bytes] | None = None, kind: str = "image/png") -> Glb:
    """The mesh that is seen, with a texture for each painting."""
    glb = Glb()
    for paint, image in enumerate(images or [png(painting) for painting in paintings()]):
        vertices, faces, _, uv = grids([q for q in seen() if q.paint == paint])
        material = glb.textured(glb.image(image, kind))
        glb.node(glb.mesh(triangles_of(faces), material, POSITION=vertices, TEXCOORD_0=uv), name=f"chunk{paint}")
    return glb


def write_ply(path: Path, step: float, colors: bool, quads: bool = False) -> None:
    """The labelled mesh, with `object_id` of each face."""
    vertices, faces, labels, _ = grids(labelled(), step)
    if not quads:
        faces, labels = triangles_of(faces), np.concatenate([labels, labels])
    corners = faces.shape[1]
    fields = [("position", "<f4", 3)] + ([("color", "u1", 3)] if colors else [])
    table = np.zeros(len(vertices), fields)
    table["position"] = vertices
    if colors:
        table["color"] = np.array([[200, 190, 170], [150, 120, 90], [90, 120, 200]])[np.arange(len(vertices)) % 3]
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", corners), ("object_id", "<i4")])
    rows["count"], rows["corners"], rows["object_id"] = corners, faces, labels
    channels = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) if colors else ""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n{channels}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty int object_id\nend_header\n"
    )
    path.write_bytes(header.encode() + table.tobytes() + rows.tobytes())


def house_text() -> str:
    """The tables of Matterport3D: two regions, a category for each object."""
    tail = " 0 0 0 0 0"
    lines = ["ASCII 1.1", f"H flat ~label 0 0 8 2 0 {len(NAMES)} {len(NAMES)} 2 0 1" + tail + " 0 0 0 7 4 2.6" + tail]
    lines.append("L 0 2 - 3 2 1 0 0 0 7 4 2.6" + tail)
    lines.append("R 0 0 0 0 b 2 2 1.3 0 0 0 4 4 2.6 2.6" + tail)
    lines.append("R 1 0 0 0 k 5.5 2 1.3 4 0 0 7 4 2.6 2.6" + tail)
    for i, (name, mpcat40) in enumerate(zip(NAMES, MPCAT40, strict=True)):
        lines.append(f"C {i} {100 + i} {name.replace(' ', '#')} {i} {mpcat40}" + tail)
    for i, room in enumerate(ROOM_OF):
        low, high = object_box(i)
        centre, half = (low + high) / 2, (high - low) / 2
        numbers = " ".join(f"{x:g}" for x in (*centre, 1, 0, 0, 0, 1, 0, *half))
        lines.append(f"O {i} {room} {i} {numbers}" + tail)
        lines.append(f"E {i} {i} {i} 1 0 0 0 0 0 0 0 0 0" + tail)
    return "\n".join(lines) + "\n"


def object_box(label: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Least and greatest corner of an object, Z up; a point for one without surface."""
    corners = [q.corner + a * q.u + b * q.v for q in labelled() if q.label == label for a in (0, 1) for b in (0, 1)]
    points = np.array(corners or [[5.0, 2.0, 2.0]])
    return points.min(axis=0), points.max(axis=0)


def write_matterport(folder: Path, name: str = "17DRP5sb8fy") -> Path:
    """A scan of Matterport3D in Habitat's layout; returns its mesh."""
    place = folder / name
    place.mkdir(parents=True)
    (place / f"{name}.glb").write_bytes(seen_glb().bytes())
    (place / f"{name}.house").write_text(house_text())
    write_ply(place / f"{name}_semantic.ply", 0.31, colors=True)
    return place / f"{name}.glb"


def write_replica(folder: Path, name: str = "room_0", objects: bool = True) -> Path:
    """A room of Replica; returns its mesh."""
    place = folder / name / "habitat"
    place.mkdir(parents=True)
    write_ply(place / "mesh_semantic.ply", 0.5, colors=True, quads=True)
    info = {"classes": [{"id": i, "name": word.replace(" ", "-")} for i, word in enumerate(NAMES)]}
    if objects:
        info["objects"] = [{"id": i, "class_id": i, "class_name": word} for i, word in enumerate(NAMES)]
    (place / "info_semantic.json").write_text(json.dumps(info))
    return place / "mesh_semantic.ply"


def read_ply_slowly(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices [V, 3], triangles [T, 3] and object of each, row by row with `struct`."""
    data = path.read_bytes()
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode().splitlines()
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    colored = any(line.endswith("red") for line in lines)
    vertices, triangles, labels = [], [], []
    at = 0
    for _ in range(counts["vertex"]):
        vertices.append(struct.unpack_from("<3f", body, at))
        at += 12 + (3 if colored else 0)
    for _ in range(counts["face"]):
        (corners,) = struct.unpack_from("B", body, at)
        *face, label = struct.unpack_from(f"<{corners + 1}i", body, at + 1)
        at += 1 + 4 * (corners + 1)
        for i in range(1, corners - 1):
            triangles.append((face[0], face[i], face[i + 1]))
            labels.append(label)
    return np.array(vertices), np.array(triangles), np.array(labels)


DATA = Path(__file__).parents[1] / "data"
BASIS = ("wall_etc1s.basis", "floor_uastc.basis")
"""The paintings in Basis Universal, rows from the bottom, as HM3D has them: encoded by alktx2, repacked as `.basis`."""


def color_of(label: int) -> int:
    """The colour of an object in HM3D's labels, 0xRRGGBB; neighbours differ by little, and order tells nothing."""
    return 0x101010 + 0x0F0501 * ((5 * label + 3) % 7)


def annotation_text(rows: list[tuple[int, int, str, int]] | None = None) -> str:
    """HM3D's table of labels: objects by id from 1, the floor last."""
    listed = rows or [
        (hm3d_id(i), color_of(i), name, room) for i, (name, room) in enumerate(zip(NAMES, ROOM_OF, strict=True))
    ]
    return "HM3D Semantic Annotations\n" + "".join(f'{i},{c:06X},"{name}",{room}\n' for i, c, name, room in listed)


def hm3d_id(label: int) -> int:
    """The id of an object in HM3D's table, where 0 is unknown."""
    return label or len(NAMES)


def basis_glb(images: list[bytes] | None = None, extension: str = "GOOGLE_texture_basis", kind: str = "") -> Glb:
    """The mesh that is seen with textures in Basis Universal alone."""
    kinds = {"GOOGLE_texture_basis": "image/x-basis", "KHR_texture_basisu": "image/ktx2"}
    glb = seen_glb(images or [(DATA / name).read_bytes() for name in BASIS], kind or kinds[extension])
    document = glb.document()
    document["textures"] = [{"extensions": {extension: {"source": i}}} for i in range(len(glb.images))]
    document["extensionsUsed"] = document["extensionsRequired"] = [extension]
    glb.document = lambda: document  # type: ignore[method-assign]
    return glb


def painted_glb(how: str = "texture") -> Glb:
    """HM3D's mesh of labels: one texture with a patch for each object, or colours of vertices."""
    glb = Glb()
    vertices, faces, labels, _ = grids(labelled(), 0.9)
    corners = faces.reshape(-1)  # every quad has vertices of its own, so that no colour is shared
    rgb = np.array([[color_of(i) >> 16 & 255, color_of(i) >> 8 & 255, color_of(i) & 255] for i in range(len(NAMES))])
    of_vertex = np.repeat(labels, 4)
    apart = triangles_of(np.arange(len(corners), dtype=np.uint32).reshape(-1, 4))
    if how == "texture":
        atlas = np.repeat(np.repeat(rgb[None].astype(np.uint8), 4, axis=0), 4, axis=1)  # 4 x 4 texels an object
        uv = np.stack([(of_vertex + 0.5) / len(NAMES), np.full(len(corners), 0.5)], axis=-1).astype(np.float32)
        mesh = glb.mesh(apart, glb.textured(glb.image(png(atlas))), POSITION=vertices[corners], TEXCOORD_0=uv)
    else:
        colors = np.concatenate([rgb, np.full((len(rgb), 1), 255)], axis=-1).astype(np.uint8)[of_vertex]
        mesh = glb.mesh(apart, POSITION=vertices[corners], COLOR_0=colors)
    glb.node(mesh)
    return glb


def write_hm3d(folder: Path, name: str = "00800-TEEsavR23oF", how: str = "texture", split: str = "val") -> Path:
    """A scan of HM3D; returns its mesh."""
    place = folder / split / name
    place.mkdir(parents=True)
    stem = name.partition("-")[2]
    (place / f"{stem}.basis.glb").write_bytes(basis_glb().bytes())
    (place / f"{stem}.semantic.glb").write_bytes(painted_glb(how).bytes())
    (place / f"{stem}.semantic.txt").write_text(annotation_text())
    return place / f"{stem}.basis.glb"


def brick(size: tuple[float, float, float], low: tuple[float, float, float] = (0, 0, 0)) -> bytes:
    """A GLB with a box, by default with its least corner at the origin."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) * size + np.array(low)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([(a, b, c) for s in sides for a, b, c in ((s[0], s[1], s[2]), (s[0], s[2], s[3]))], np.uint32)
    glb = Glb()
    glb.materials.append({"pbrMetallicRoughness": {"baseColorFactor": [0.6, 0.3, 0.2, 1]}})
    glb.node(glb.mesh(triangles, 0, POSITION=corners.astype(np.float32)))
    return glb.bytes()


SCENE_OBJECTS = [
    {"template_name": "chair", "translation": [2, 0, -1], "rotation": [0.70710678, 0, 0.70710678, 0]},
    {"template_name": "objects/sofa", "translation": [4, 0.25, -2], "non_uniform_scale": [2, 1, 1],
     "translation_origin": "COM"},
    {"template_name": "sofa_part_1", "translation": [1, 1, -3], "translation_origin": "asset_local"},
]  # fmt: skip
"""A chair turned left by 90 degrees, a sofa of twice its length, put down by its centre, and a part of another."""
DRAWER_OPEN = 0.3


def write_scene_dataset(folder: Path) -> Path:
    """A dataset in Habitat's format with one scene: a room, three objects and a chest with a drawer; Y is up."""
    for place in ("stages", "objects/decomposed/sofa", "urdf/chest", "scenes", "semantics", "navmeshes"):
        (folder / place).mkdir(parents=True, exist_ok=True)
    config = {
        "stages": {"paths": {".json": ["stages/*.stage_config.json"]}},
        "objects": {"paths": {".json": ["objects", "objects/decomposed/*"], ".glb": ["objects"]}},
        "articulated_objects": {"paths": {".urdf": ["urdf/*/"]}},
        "scene_instances": {"paths": {".json": ["scenes"]}},
        "semantic_scene_descriptor_instances": {"paths": {".json": ["semantics"]}},
        "navmesh_instances": {"home": "navmeshes/flat.navmesh"},
    }
    write_json(folder / "tiny.scene_dataset_config.json", config)
    room = [q for q in seen() if q.label in (FLOOR, WALL)]
    vertices, faces, _, uv = grids(room)
    glb = Glb()
    stage = glb.textured(glb.image(png(paintings()[0])))
    glb.node(glb.mesh(triangles_of(faces), stage, POSITION=vertices, TEXCOORD_0=uv))
    (folder / "stages/flat.glb").write_bytes(glb.bytes())
    write_json(
        folder / "stages/flat.stage_config.json", {"render_asset": "flat.glb", "up": [0, 0, 1], "front": [0, 1, 0]}
    )
    (folder / "objects/chair.glb").write_bytes(brick((0.4, 0.9, 0.6)))
    (folder / "objects/sofa_mesh.glb").write_bytes(brick((0.8, 0.5, 0.6), (1, 0, 0)))
    write_json(folder / "objects/sofa.object_config.json", {"render_asset": "sofa_mesh.glb", "semantic_id": 3})
    part = {"render_asset": "part.glb", "scale": [1, 2, 1]}
    write_json(folder / "objects/decomposed/sofa/sofa_part_1.object_config.json", part)
    (folder / "objects/decomposed/sofa/part.glb").write_bytes(brick((0.3, 0.1, 0.3)))
    write_json(folder / "semantics/tiny_lexicon.json", {"classes": [{"id": 3, "name": "Couch"}]})
    (folder / "urdf/chest/body.glb").write_bytes(brick((1, 0.8, 0.5)))
    (folder / "urdf/chest/front.glb").write_bytes(brick((0.9, 0.2, 0.05)))
    (folder / "urdf/chest/chest.urdf").write_text(
        """<robot name="chest">
        <link name="body"><visual><geometry><mesh filename="body.glb"/></geometry></visual></link>
        <link name="drawer"><visual><origin xyz="0 0.1 0"/>
        <geometry><mesh filename="front.glb" scale="1 2 1"/></geometry></visual></link>
        <joint name="slide" type="prismatic"><parent link="body"/><child link="drawer"/>
        <origin xyz="0.05 0.3 0.5"/><axis xyz="0 0 1"/></joint></robot>"""
    )
    scene = {
        "stage_instance": {"template_name": "stages/flat"},
        "translation_origin": "asset_local",
        "object_instances": SCENE_OBJECTS,
        "articulated_object_instances": [
            {"template_name": "chest", "translation": [5, 0, -1], "initial_joint_pose": {"slide": DRAWER_OPEN}}
        ],
        "navmesh_instance": "home",
    }
    write_json(folder / "scenes/home.scene_instance.json", scene)
    return folder / "scenes/home.scene_instance.json"


def write_json(path: Path, body: object) -> None:
    path.write_text(json.dumps(body))
