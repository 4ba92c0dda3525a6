# SPDX-License-Identifier: Apache-2.0
"""Write what the compiled readers' fuzz targets begin with: fuzz_seeds.py FOLDER.

FOLDER/TARGET gets small whole files, FOLDER/TARGET.dict the words in them.
"""

from __future__ import annotations

import re
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS), str(TESTS / "python")]

from locations import ROOM_FOLDERS  # noqa: E402

sys.path.extend(ROOM_FOLDERS)

from fuzz_files import DATA, write_all  # noqa: E402
from readers import READERS, make_stl  # noqa: E402
from test_damaged_files import DAE, MTL, OBJ, OWN, PLY, SQUARE, URDF, binary_ply  # noqa: E402

TARGETS = {"glb": ".glb", "gltf": ".gltf", "obj": ".obj", "ply": ".ply", "dae": ".dae", "sdf": ".sdf"}
"""Targets that read the files which `scripts/fuzz` damages, by extension."""
SHAPES = ('<box size="1 1 1"/>', '<mesh filename="part.obj" scale="1 1 2"/>', '<sphere radius="1"/>')
WORLD = b"""<sdf version="1.7"><world name="w"><include><uri>model://part</uri><pose>1 2 0 0 0 1</pose></include>
<model name="m"><static>true</static><link name="l"><pose relative_to="f">0 0 1 0 0 0</pose><visual name="v"><geometry>
<mesh><uri>part.obj</uri><scale>1 2 1</scale></mesh></geometry><material><diffuse>1 0 0 1</diffuse></material></visual>
<visual name="c"><geometry><cylinder><radius>1</radius><length>2</length></cylinder></geometry></visual></link>
<frame name="f"><pose>0 0 1 0 0 0</pose></frame></model></world></sdf>"""


def own_library(obj: bytes) -> bytes:
    """Return an OBJ file that is its own material library."""
    return MTL + obj.replace(b"m.mtl", b"m.obj")


def labelled_ply() -> bytes:
    """Return a binary PLY file whose faces say what object they belong to."""
    head = PLY[: PLY.index(b"end_header")].replace(b"ascii", b"binary_little_endian")
    head = head.replace(b"element face", b"property uchar red\nproperty uchar green\nproperty uchar blue\nelement face")
    vertices = b"".join(row.tobytes() + b"\1\2\3" for row in SQUARE)
    faces = b"".join(struct.pack("<B3iH", 3, *corners, 7) for corners in ((0, 1, 2), (0, 2, 3)))
    return head + b"property ushort object_id\nend_header\n" + vertices + faces


def make_images() -> Iterator[bytes]:
    picture = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    for extension in (".png", ".jpg", ".bmp", ".webp"):
        yield bytes(cv2.imencode(extension, picture)[1])
    yield bytes(cv2.imencode(".png", picture[..., 0])[1])
    yield bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
    for kind, pixels in (
        (2, picture.tobytes()),
        (10, b"\x87\1\2\3" * 8),
    ):  # TGA: plain, and one run of eight pixels a row
        yield struct.pack("<3B9x2H2B", 0, 0, kind, 8, 8, 24, 0) + pixels
    yield (DATA / "wall.ktx2").read_bytes()
    yield (DATA / "wall_etc1s.basis").read_bytes()


def make_robots() -> Iterator[bytes]:
    yield OWN.encode()
    for shape in SHAPES:
        yield URDF.format(shape=shape, material="").encode()


def make_seeds(folder: Path) -> dict[str, list[bytes]]:
    """Return whole files for each target; `folder` is for what readers write on the way."""
    seeds: dict[str, list[bytes]] = {target: [] for target in TARGETS}
    files = folder / "files"
    files.mkdir()
    write_all(files)
    for target, extension in TARGETS.items():
        seeds[target] += [file.read_bytes() for file in sorted(files.iterdir()) if file.suffix == extension]
    seeds["obj"].append(own_library(OBJ))
    seeds["sdf"].append(WORLD)
    seeds["image"] = list(make_images())
    seeds["surface"] = [labelled_ply()]
    seeds["cache"] = [READERS["scene cache"].make_sample(folder)]
    seeds["navmesh"] = [READERS["navmesh"].make_sample(folder)]
    seeds["urdf"] = list(make_robots())
    seeds["link"] = [make_stl(folder), DAE, PLY, binary_ply()]
    return seeds


def find_words(contents: list[bytes]) -> set[bytes]:
    """Return the words of the files, of five letters and more, which few compressed ones have by chance."""
    return {word for content in contents for word in re.findall(rb"[A-Za-z_][A-Za-z_0-9]{4,40}", content)}


def write_seeds(folder: Path) -> None:
    with TemporaryDirectory() as own:
        for target, contents in make_seeds(Path(own)).items():
            (folder / target).mkdir(parents=True, exist_ok=True)
            for number, content in enumerate(contents):
                (folder / target / f"seed-{number}").write_bytes(content)
            words = sorted(find_words(contents))
            if words:  # libFuzzer refuses an empty dictionary
                (folder / f"{target}.dict").write_text("".join(f'"{word.decode()}"\n' for word in words))


if __name__ == "__main__":
    write_seeds(Path(sys.argv[1]))
