# SPDX-License-Identifier: Apache-2.0
"""Write small files that use what the scene readers know, for `scripts/fuzz` to damage: fuzz_files.py FOLDER."""

from __future__ import annotations

import base64
import json
import sys
from pathlib import Path

import cv2
from glb import Glb
from locations import ROOM_FOLDERS

sys.path.extend(ROOM_FOLDERS)

from test_damaged_files import DAE, OBJ, PLY, SDF, binary_ply, posed_glb, textured_glb
from test_gltf import (
    DRACO,
    SQUARE,
    TWO,
    UV,
    compressed_bumps,
    draco_glb,
    picture,
    save,
    save_compressed,
    textured_square,
)

DATA = Path(__file__).parents[1] / "data"


def write_all(folder: Path) -> None:
    plain = {"ascii.ply": PLY, "binary.ply": binary_ply(), "part.dae": DAE, "box.sdf": SDF}
    plain["part.obj"] = OBJ.replace(b"m.mtl", b"sample.mtl")
    for name, content in plain.items():
        (folder / name).write_bytes(content)
    (folder / "textured.glb").write_bytes(textured_glb())
    (folder / "posed.glb").write_bytes(posed_glb())
    for index, mode in (("uint16", "TRIANGLES"), ("uint32", "INDICES")):
        save_compressed(compressed_bumps(mode, "EXPONENTIAL", index), folder / f"meshopt_{index}.glb")
    save(draco_glb((DATA / "bumps.drc").read_bytes()), folder / "draco.glb", **DRACO)
    webp = bytes(cv2.imencode(".webp", picture(), [cv2.IMWRITE_WEBP_QUALITY, 90])[1])
    write_textured(folder / "webp.glb", webp, "EXT_texture_webp")
    write_textured(folder / "ktx2.glb", (DATA / "wall.ktx2").read_bytes(), "KHR_texture_basisu")
    write_inline(folder / "inline.gltf")


def write_textured(path: Path, image: bytes, extension: str) -> None:
    glb = Glb()
    material = glb.textured(glb.image(image, "image/webp"))
    glb.node(glb.mesh(TWO, material, POSITION=SQUARE, TEXCOORD_0=UV))
    save(glb, path, textures=[{"extensions": {extension: {"source": 0}}}], extensionsRequired=[extension])


def write_inline(path: Path) -> None:
    """A glTF file with its buffer in a data URI."""
    glb = textured_square()
    document = glb.document()
    document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(glb.binary).decode()
    path.write_text(json.dumps(document))


if __name__ == "__main__":
    write_all(Path(sys.argv[1]))
