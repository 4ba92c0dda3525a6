# SPDX-License-Identifier: Apache-2.0
"""Scenes: generated apartments, and meshes, Gazebo worlds and real scans from files.

World frame: metres, Y up, right-handed. See `Scene` for a scene's attributes.
"""

from __future__ import annotations

import difflib
import logging
import os
import re
import time
from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

from wiw import _core
from wiw.errors import ArgumentError, FileError
from wiw.scenes import isolated, scans, store
from wiw.suggestions import did_you_mean

Scene = _core.scene.Scene

__all__ = [
    "ALLOW_VARIABLE",
    "COLORS",
    "MOST_MISSING",
    "Scene",
    "absolute",
    "allow_missing_textures",
    "apartment",
    "apartment_table",
    "is_generated",
    "load",
    "missing_textures_allowed",
    "open_outline",
    "open_scene",
    "possible_edits",
    "resolve",
    "strip_edits",
]

COLORS = (
    "white", "grey", "black", "brown", "beige", "red", "orange", "yellow", "green", "turquoise", "blue", "purple",
    "pink",
)  # fmt: skip
"""Colour words of apartments. Weights count classes by their order."""

MOST_MISSING = 0.05
"""Largest share of a scan's surface whose texture may be missing."""
ALLOW_VARIABLE = "WIW_ALLOW_MISSING_TEXTURES"
"""Environment variable that allows more, also for processes that a run starts."""

_log = logging.getLogger("wiw.scenes")


def load(
    path: str | PathLike[str],
    up: str | None = None,
    ceiling: float | None = None,
    cache: bool = True,
    *,
    isolate: bool = True,
    limits: dict[str, int] | None = None,
    texture_folders: Sequence[str | PathLike[str]] = (),
    model_folders: Sequence[str | PathLike[str]] = (),
) -> Scene:
    """Read a GLB, glTF, OBJ, PLY or DAE mesh, a Gazebo `.world` or `.sdf` file, or a real scan.

    A scan is opened by its mesh, and recognised by the files next to it (`docs/real-scans.md`).

    Args:
        path: the file; `~` is expanded.
        up: "y", "z" or None: by the file (COLLADA header; Y for glTF, OBJ and PLY; Z for scans and for names in HM3D's
            layout). The rule that was used is `scene.attributes["up"]`.
        ceiling: height in metres above the floor at which to close a scene that is open above.
        cache: cache the imported scene on disk (`$WIW_CACHE` or `~/.cache/wiw`), to be mapped the next time.
        isolate: import in a separate process, so that a file that crashes the reader raises FileError here.
        limits: raises or lowers the import limits: file_bytes, triangles, nodes, texture_pixels, texture_bytes.
        texture_folders: folders searched for textures by base name, after the places next to the file.
        model_folders: folders searched for a world's `model://`, before the places next to the file.

    Whatever had to be left out, such as a missing texture, is logged and listed in `scene.warnings`.

    Raises:
        FileError: naming file and cause: missing, damaged, unsupported or above the limits.
        ArgumentError: an option is out of its range.
        DependencyError: a scan's textures need a decoder that is not installed.
    """
    file = Path(path).expanduser().absolute()  # the cache is shared by processes with other working folders
    if not file.is_file():
        raise FileError(f"{file}: no such file; expected a mesh or a Gazebo world")
    options = {
        "up": up,
        "ceiling": ceiling,
        "limits": limits or {},
        "texture_folders": [str(Path(folder).expanduser().absolute()) for folder in texture_folders],
        "model_folders": [str(Path(folder).expanduser().absolute()) for folder in model_folders],
    }
    reader = scans.find_reader(file)
    if reader is not None:
        options |= {"scan": reader, "allow_missing_textures": missing_textures_allowed()}
    scene = _load(file, options, cache, isolate)
    for warning in scene.warnings:
        _log.warning("%s: %s", scene.name, warning)
    return scene


def _load(file: Path, options: dict[str, Any], cache: bool, isolate: bool) -> Scene:
    def build(out: Path) -> store.Sources:
        if isolate:
            return isolated.import_to(file, options, out)
        imported = scans.read_scene(file, options)
        _core.scene.write_cache(imported.scene, out)
        return store.Sources(tuple(imported.read), tuple(imported.absent))

    if cache:
        return store.load_imported(file, options, build)
    if not isolate:
        return scans.read_scene(file, options).scene
    return store.temporary(build)


def apartment(seed: int, split: str = "val", cache: bool = True, *, edits: Sequence[str] = ()) -> Scene:
    """Generate a furnished apartment, the same for the same seed and split; splits share neither layouts nor palettes.

    With `cache` it is generated once, in seconds, and then mapped from disk like imported scenes, until the compiled
    core changes. An edit changes one thing and leaves everything else unchanged, with light baked for the edited
    apartment: "color:sofa_1=blue", "state:floor_lamp_1=off", "remove:vase_1" or "swap:plant_1,floor_lamp_2". Names are
    those of instances, with "_" or "+" for a space; if several doors or windows share a name, ".2" is the second.

    Raises:
        ArgumentError: `split` is not "train", "val" or "test"; or an edit cannot be done, with what is possible.
    """
    edits = _core.scene.canonical_edits(list(edits))

    def make() -> Scene:
        started = time.perf_counter()
        scene = _core.scene.apartment(seed, split, edits)
        _log.info("%s built in %.1f s", scene.name, time.perf_counter() - started)
        return scene

    identity: list[str | int] = ["apartment", store.build_digest(), split, int(seed), *edits]
    return store.load_generated(identity, make) if cache else make()


def apartment_table(seed: int, split: str = "val", *, edits: Sequence[str] = ()) -> Scene:
    """Return rooms and instances of an apartment without its textures and light, in a fraction of the time.

    `instances`, `rooms`, `attributes` and all triangles are those of `apartment`, so it is suitable for questions and
    navigation meshes; renderings of it show plain colours.
    """
    return _core.scene.apartment_outline(seed, split, _core.scene.canonical_edits(list(edits)))


def possible_edits(spec: str) -> list[str]:
    """Return the edits that can be added to a single apartment's spec, without baking it.

    Raises:
        ArgumentError: the spec does not name a single apartment.
    """
    seed, split, edits = _parse_single(spec)
    return _core.scene.possible_edits(seed, split, edits)


SPLIT_SIZE = 1000
"""Number of apartments in a spec without a number."""
APARTMENTS = r"apartments:(train|val|test)(?:(?::([0-9]+))?:([1-9][0-9]*)|/([0-9]+))?"
"""Split, first, end, and number of a single one. A single one may be followed by "?" and edits, joined by "&"."""
_FORMS = (
    "apartments:{train,val,test}, apartments:val:40, apartments:val:40:60, apartments:val/7 or "
    "apartments:val/7?state:floor_lamp_1=off&color:sofa_1=blue"
)


def is_generated(spec: str) -> bool:
    """Return whether a scene spec names generated apartments rather than a file."""
    return spec.startswith("apartments:")


def strip_edits(spec: str) -> str:
    """Return the apartment that an edited one is a copy of: "apartments:val/7" for "apartments:val/7?remove:tv_1"."""
    return spec.partition("?")[0] if is_generated(spec) else spec


def absolute(spec: str | PathLike[str]) -> str:
    """Return the spec, made absolute if it is a path, so that it means the same in any folder."""
    spec = fspath(spec)
    scan = scans.parse_spec(spec)
    if scan is not None:
        kind, folder, split = scan
        return ":".join(filter(None, [kind, str(folder.expanduser().absolute()), split]))
    return spec if is_generated(spec) or _resembles_generated(spec) else str(Path(spec).expanduser().absolute())


def resolve(spec: str | PathLike[str]) -> list[str]:
    """Return the single scenes that a scene spec names, in order, without loading them.

    "apartments:val" and "apartments:val:40" are the first 1000 or 40 apartments of a split, "apartments:val:40:60" are
    numbers 40 to 59, each named "apartments:val/7"; "hm3d:DIR:val" is each scan of a dataset's split, by its file (see
    `wiw.scenes.scans.KINDS`); anything else is the path of a mesh or a Gazebo world. The edits of
    "apartments:val/7?state:floor_lamp_1=off&color:sofa_1=blue" are put into canonical order and spelling, so that equal
    scenes have equal names; whether the apartment allows them is checked when it is opened.

    Raises:
        ArgumentError: the split, the count or an edit is invalid.
        FileError: the file does not exist, or the folder has no scan.
    """
    spec = fspath(spec)
    scan = scans.parse_spec(spec)
    if scan is not None:
        return [str(file) for file in scans.find_scans(*scan)]
    if not is_generated(spec):
        if not Path(spec).expanduser().is_file():
            raise FileError(
                f"{spec}: no such file; expected a mesh, a Gazebo world, apartments:{{train,val,test}}[:N], or scans "
                f"such as hm3d:DIR:val ({', '.join(scans.KINDS)}).{_did_you_mean(spec)}"
            )
        return [spec]
    base, mark, edits = spec.partition("?")
    match = re.fullmatch(APARTMENTS, base)
    if match is None or int(match[2] or 0) >= int(match[3] or SPLIT_SIZE):
        raise ArgumentError(f"scene spec '{spec}': expected {_FORMS}.{_did_you_mean(base)}")
    split, first, end, index = match.groups()
    if index is not None:
        return [base + mark + "&".join(_parse_edits(spec, edits))] if mark else [spec]
    if mark:
        raise ArgumentError(f"scene spec '{spec}': edits belong to a single apartment; expected {_FORMS}.")
    return [f"apartments:{split}/{i}" for i in range(int(first or 0), int(end or SPLIT_SIZE))]


def _resembles_generated(spec: str) -> bool:
    """Return whether a spec is not a file and looks like a misspelt `apartments:`, to be refused as typed."""
    kind, colon, _ = spec.partition(":")
    return bool(colon and did_you_mean(kind, ["apartments"])) and not Path(spec).expanduser().exists()


def _parse_edits(spec: str, edits: str) -> list[str]:
    """Return the edits of a spec in their canonical order."""
    try:
        return _core.scene.canonical_edits(edits.split("&"))
    except ArgumentError as error:
        raise ArgumentError(f"scene spec '{spec}': {error}") from None


def _parse_single(spec: str) -> tuple[int, str, list[str]]:
    """Return seed, split and edits of a single apartment's spec."""
    base, mark, edits = spec.partition("?")
    match = re.fullmatch(APARTMENTS, base)
    if match is None or match[4] is None:
        raise ArgumentError(f"scene spec '{spec}': expected a single apartment, such as apartments:val/7.")
    return int(match[4]), match[1], _parse_edits(spec, edits) if mark else []


def _did_you_mean(spec: str) -> str:
    """Return a hint at a split, or at a similar file next to the missing one."""
    path = Path(spec).expanduser()
    kind, colon, rest = spec.partition(":")
    if did_you_mean(kind, ["apartments"]):
        split = re.split("[:/]", rest)[0]
        near = difflib.get_close_matches(split, ["train", "val", "test"], 1, 0.5) or ["val"]
        meant = f"apartments:{near[0]}{rest[len(split) :]}"
        return did_you_mean(spec, [meant]) if re.fullmatch(APARTMENTS, meant) else ""
    if colon or not path.parent.is_dir():
        return ""
    return did_you_mean(path.name, [file.name for file in path.parent.iterdir()])


def open_scene(name: str) -> Scene:
    """Load one scene of `resolve`.

    Raises:
        FileError: it cannot be read; or it is a scan, more than `MOST_MISSING` of its surface lacks its texture, and
            `$WIW_ALLOW_MISSING_TEXTURES` is not set.
    """
    if is_generated(name):
        seed, split, edits = _parse_single(name)
        return apartment(seed, split, edits=edits)
    scene = load(name)
    is_grey = "dataset" in scene.attributes and scene.missing_texture_share > MOST_MISSING
    if is_grey and not missing_textures_allowed():
        cause = next((warning for warning in scene.warnings if "texture" in warning or "image" in warning), "")
        raise FileError(
            f"{name}: {scene.missing_texture_share:.0%} of its surface lacks its texture and would be drawn grey "
            f"({cause}); at most {MOST_MISSING:.0%} is allowed. Put the textures where the file expects them, or allow "
            f"it with --allow-missing-textures ({ALLOW_VARIABLE}=1)"
        )
    return scene


def allow_missing_textures() -> None:
    """Allow this process and those that it starts to use scans that lack more than `MOST_MISSING` of their textures."""
    os.environ[ALLOW_VARIABLE] = "1"


def missing_textures_allowed() -> bool:
    """Return whether scans may be used that lack more than `MOST_MISSING` of their textures."""
    return os.environ.get(ALLOW_VARIABLE, "") not in ("", "0")


def open_outline(name: str) -> Scene:
    """Load one scene of `resolve`, an apartment without its textures and light (`apartment_table`)."""
    if is_generated(name):
        seed, split, edits = _parse_single(name)
        return apartment_table(seed, split, edits=edits)
    return open_scene(name)
