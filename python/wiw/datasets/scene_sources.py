# SPDX-License-Identifier: Apache-2.0
"""Which files a scene's pictures and paths come from, without opening it, and a digest of what is in them.

The scene, its navigation mesh, the files that label a scan, and the materials, textures and models that these files
name, and those name in turn. Not followed: what a Habitat scene dataset places by the names of templates, which only
opening the scene finds.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from hashlib import blake2b
from pathlib import Path
from urllib.parse import unquote

from wiw.datasets.worlds import navmesh_file
from wiw.errors import Error
from wiw.scenes import is_generated
from wiw.scenes.scans import replica

_URI = re.compile(rb'"uri"\s*:\s*"(?!data:)([^"]+)"')
_ELEMENT = re.compile(rb"<(?:uri|init_from|ref)>\s*([^<]+?)\s*</")
_NAMES = {
    ".obj": re.compile(rb"\n[ \t]*mtllib[ \t]+(.+?)[ \t]*$", re.MULTILINE),
    ".mtl": re.compile(rb"\n[ \t]*(?:map_\w+|bump|disp|decal|norm|refl)[ \t]+(.+?)[ \t]*$", re.MULTILINE | re.I),
    ".ply": re.compile(rb"^comment TextureFile[ \t]+(.+?)[ \t\r]*$", re.MULTILINE),
    ".gltf": _URI,
    ".glb": _URI,
    ".dae": _ELEMENT,
    ".sdf": _ELEMENT,
    ".world": _ELEMENT,
}
"""How files of each kind name others."""
_LINE_ENDS = bytes.maketrans(b"\r\f\0", b"\n\n\n")
"""Makes line feeds of the other characters that end a line of a Wavefront file."""
_SCHEME = re.compile(r"^[a-z]+://")
_TEXTURES = ("", "textures", "../textures", "materials/textures", "../materials/textures")
"""Folders, seen from a file's own, where a texture that is not at its path is looked for by its name alone."""
_PLY_HEADER = 1 << 16
_ABSENT = b"absent"
"""Stands for a file that is named and cannot be read: the scene is another one when it turns up."""


def digest_scenes(specs: Mapping[str, str]) -> dict[str, str]:
    """Return the digest of each single scene that is a file, by name; a generated one is determined by its name."""
    return {name: digest_scene(Path(spec)) for name, spec in specs.items() if not is_generated(spec)}


def digest_scene(path: Path) -> str:
    """Return a digest of what is in a scene's files, the same wherever they lie and whatever the scene is called."""
    state = blake2b(digest_size=16)
    for file in _list_sources(path.expanduser()):
        state.update(_digest_file(file))
    return state.hexdigest()


def _digest_file(path: Path | None) -> bytes:
    state = blake2b(digest_size=16)
    try:
        if path is not None:
            with path.open("rb") as stream:
                while block := stream.read(1 << 20):
                    state.update(block)
            return state.digest()
    except OSError:
        pass
    return _ABSENT


def _list_sources(path: Path) -> list[Path | None]:
    """Return a scene's navigation mesh and files, each once, in an order that only their content determines.

    None stands for one that is not there.
    """
    folder = path.absolute().parent
    is_world = path.suffix.lower() in (".sdf", ".world")
    models = (folder.parent / "models", folder / "models", folder, folder.parent) if is_world else ()
    found: list[Path | None] = [_find_navmesh(path)]
    waiting: list[Path | None] = [path, *_find_labels(path)]
    while waiting:
        file = waiting.pop(0)
        if file is None or file not in found:
            found.append(file)
            waiting += [] if file is None else _list_named(file, models)
    return found


def _find_navmesh(path: Path) -> Path | None:
    try:
        return navmesh_file(str(path))
    except (Error, OSError):  # opening the scene says what is wrong
        return None


def _find_labels(path: Path) -> list[Path]:
    """Return the files beside a scan that label it, in the layouts of docs/real-scans.md."""
    names = []
    if path.suffix.lower() in (".glb", ".obj"):
        names = [f"{path.stem}.house", f"{path.stem}_semantic.ply"]
    if path.suffix == ".glb":
        scan = path.stem.removesuffix(".basis")
        names += [f"{scan}.semantic.glb", f"{scan}.semantic.txt"]
    if path.name == replica.MESH:
        names = [replica.TABLE]
    return [file for name in names if (file := path.with_name(name)).is_file()]


def _list_named(file: Path, models: Sequence[Path]) -> Iterator[Path | None]:
    """Yield the files that a file names, in order."""
    pattern = _NAMES.get(file.suffix.lower())
    if pattern is None:
        return
    try:
        content = _read_naming_part(file)
    except OSError:
        return
    for match in pattern.finditer(content):
        yield from _find_named(match[1].decode(errors="surrogateescape"), file.parent, models)


def _read_naming_part(file: Path) -> bytes:
    """Return what of a file may name others; of a Wavefront file with a line feed before each line."""
    kind = file.suffix.lower()
    with file.open("rb") as stream:
        if kind == ".glb":  # the JSON of a binary glTF is its first chunk
            length = int.from_bytes(stream.read(20)[12:16], "little")
            return stream.read(min(length, file.stat().st_size))
        if kind == ".ply":
            return stream.read(_PLY_HEADER)
        content = stream.read()
    return b"\n" + content.translate(_LINE_ENDS) if kind in (".obj", ".mtl") else content


def _find_named(name: str, folder: Path, models: Sequence[Path]) -> list[Path | None]:
    """Return the files that a name in a file of `folder` stands for; in place of a folder, such as a model, its files.

    A line of a Wavefront file may have options before the name, and several names.
    """
    plain = unquote(_SCHEME.sub("", name)).replace("\\", "/")
    words = plain.split()
    tails = [" ".join(words[at:]) for at in range(1, len(words))]
    for texts in ([plain], [*words, *tails]):
        found = [place for text in texts if (place := _locate(text, folder, models)) is not None]
        if found:
            return [file for place in found for file in _list_files(place)]
    return [None]


def _locate(name: str, folder: Path, models: Sequence[Path]) -> Path | None:
    """Return the first place where a name leads to a file, or to a model's folder; None if none does, as for a device.

    A folder is read whole: only where worlds look for models is one taken, and none that lies above or elsewhere.
    """
    if Path(name).name in ("", ".."):
        return None
    may_be_folder = bool(models) and not Path(name).is_absolute() and ".." not in Path(name).parts
    places = [
        folder / name,
        *(folder / each / Path(name).name for each in _TEXTURES),
        *(each / name for each in models),
    ]
    try:
        return next((place for place in places if place.is_file() or (may_be_folder and place.is_dir())), None)
    except (OSError, ValueError):  # no path, such as one with a null byte
        return None


def _list_files(place: Path) -> list[Path]:
    if not place.is_dir():
        return [place]
    return sorted(file for file in place.rglob("*") if file.is_file())
