# SPDX-License-Identifier: Apache-2.0
"""Names of scenes in datasets, and their splits: which of them evaluation uses, so that nothing is trained on them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from os import PathLike, fspath
from os.path import normpath
from pathlib import Path

from wiw.errors import ArgumentError
from wiw.scenes import is_generated, strip_edits
from wiw.scenes.scans import replica, scene_dataset

FOLDERS = ("val", "test", "minival", "validation")
"""Names of folders that hold scenes of evaluation, as in HM3D's "hm3d/val/00800-TEEsavR23oF"."""
ARCHIVE = re.compile(r"hm3d[-_](minival|val|test)(?:[-_](?:habitat|glb|obj|semantic|v[0-9]).*)?")
"""Lower-case names of folders that HM3D's archives of evaluation are unpacked to, as "hm3d-val-habitat-v0.2"."""
NUMBERED = re.compile(r"([0-9]{5})-([0-9A-Za-z]{11})")
"""Folder of a scan of HM3D: its number and its name, which its files have too."""
NUMBERS = {"val": range(800, 900), "test": range(900, 1000)}
"""Numbers of the scans of HM3D that are for evaluation; those below are its train split."""
MATTERPORT = {
    "val": (
        "2azQ1b91cZZ", "8194nk5LbLH", "EU6Fwq7SyZv", "oLBMNvg9in8", "QUCTc6BB5sX", "TbHJrupSAjP", "X7HyMhZNoso",
        "pLe4wQe7qrG", "x8F5xyUWy9e", "Z6MFQCViBuw", "zsNo4HB9uLZ",
    ),
    "test": (
        "2t7WUuJeko7", "5ZKStnWn8Zo", "ARNzJeq3xxb", "fzynW3qQPVF", "jtcxE69GiFV", "pa4otMbVnkk", "q9vSo1VnCiC",
        "rqfALeAoiTq", "UwV83HsGsw3", "wc2JMjhGNzB", "WYY7iVyf5p8", "YFuZgdQ5vWj", "yqstnuAEVhm", "YVUC4YcDtcY",
        "gxdoqLR6rwA", "gYvKGZ5eRqb", "RPmz2sHmrrY", "Vt2qJdWjCF2",
    ),
}  # fmt: skip
"""Matterport3D's own splits (its benchmark, `scenes_val.txt` and `scenes_test.txt`): its scenes are in one folder."""


def name_scene(spec: str | PathLike[str]) -> str:
    """Return the name of a single scene in a dataset: a generated one's spec, else the file's name up to a dot.

    Rooms of Replica, whose files all have one name, are called as their folders are.
    """
    spec = fspath(spec)
    if is_generated(spec):
        return spec
    return replica.room_name(Path(spec)) if replica.is_scan(Path(spec)) else Path(spec).name.partition(".")[0]


def name_scenes(specs: Iterable[str]) -> dict[str, str]:
    """Return single scenes by the names that they have in one dataset, in their order.

    A name is that of `name_scene` unless several of the scenes have it. Those have the shortest ends of their paths
    that tell them apart: "house.v1" and "house.v2", or "a/mesh" and "b/mesh".

    Raises:
        ArgumentError: a file is given twice, or two differ in nothing but the ending of their names.
    """
    listed = list(specs)
    groups: dict[str, list[str]] = {}
    for spec in listed:
        groups.setdefault(name_scene(spec), []).append(spec)
    names = {spec: end for name, group in groups.items() for spec, end in _tell_apart(name, group).items()}
    found: dict[str, str] = {}
    for spec in listed:
        twin = found.setdefault(names[spec], spec)
        if twin != spec:
            raise _build_twin_error(names[spec], twin, spec)
    return found


def _tell_apart(name: str, specs: Sequence[str]) -> dict[str, str]:
    """Return different names of scenes that have one name alone, by spec."""
    if len(specs) == 1:
        return {specs[0]: name}
    choices, seen = [_list_ends(spec) for spec in specs], dict[str, int]()
    for number, (spec, ends) in enumerate(zip(specs, choices, strict=True)):
        file = spec if is_generated(spec) else _resolve(spec)
        for key in (file, ends[-1]):
            if (first := seen.setdefault(key, number)) != number:
                raise _build_twin_error(name, specs[first], spec)
    levels = ([ends[min(level, len(ends) - 1)] for ends in choices] for level in range(max(map(len, choices))))
    return dict(zip(specs, next(found for found in levels if len(set(found)) == len(found)), strict=True))


def _build_twin_error(name: str, one: str, other: str) -> ArgumentError:
    """Return the error that two scenes cannot have different names."""
    return ArgumentError(
        f"scenes: expected each once and of another name, got {name} twice ({one}, {other}): leave one out; where only "
        "the ending tells two scenes apart (house.glb, house.obj), rename one"
    )


def _list_ends(spec: str) -> list[str]:
    """Return the ends of a scene's path without the ending of its name, the shortest first: "mesh", "a/mesh"."""
    if is_generated(spec):
        return [spec]
    path = Path(normpath(Path(spec).expanduser().absolute()))
    if replica.is_scan(path):
        parts = path.parts[1 : -2 if path.parent.name == "habitat" else -1]
    else:
        parts = (*path.parts[1:-1], Path(path.name.removesuffix(scene_dataset.ENDING)).stem.removesuffix(".basis"))
    return ["/".join(parts[-count:]) for count in range(1, len(parts) + 1)]


def find_shared_scene(specs: Iterable[str], names: Iterable[str]) -> str | None:
    """Return the first of some single scenes that may be one of a dataset, whatever its edits; None if none may.

    Args:
        specs: of single scenes.
        names: of the dataset's scenes, without their edits.
    """
    known = set(names)
    return next((spec for spec in specs if not known.isdisjoint(_list_possible_names(spec))), None)


def _list_possible_names(spec: str) -> list[str]:
    """Return all names that a scene has in some dataset: there, other scenes may share its file's name or not.

    A link has its own names and those of what it leads to.
    """
    places = [spec] if is_generated(spec) else [spec, _resolve(spec)]
    return [strip_edits(name) for place in places for name in (name_scene(place), *_list_ends(place))]


def _resolve(spec: str) -> str:
    """Return the path of a scene's file, whatever links and ".." lead there."""
    return str(Path(spec).expanduser().resolve())


def match_names(names: Iterable[str], others: Iterable[str]) -> list[tuple[str, str]]:
    """Return the pairs of names from two datasets that may be of one scene, sorted.

    Those are equal, or one of them is a shorter name of the other's scene: "mesh" and "a/mesh".

    Args:
        names: of the scenes of one dataset, without their edits.
        others: likewise, of the other one.
    """
    first, second = set(names), set(others)
    pairs = {(short, name) for name in second for short in _shorten(name) if short in first}
    return sorted(pairs | {(name, short) for name in first for short in _shorten(name) if short in second})


def shorten_name(name: str) -> str:
    """Return the shortest name that a scene has in any dataset, of its name in one: "mesh" for "a/mesh"."""
    return _shorten(name)[-1]


def _shorten(name: str) -> list[str]:
    """Return a name and all shorter ones that its scene has in other datasets."""
    if is_generated(name):
        return [name]
    parts = name.split("/")
    return ["/".join(parts[at:]) for at in range(len(parts))] + [parts[-1].partition(".")[0]]


def find_evaluation_split(spec: str | PathLike[str]) -> str | None:
    """Return the split of a single scene that is for evaluation: "val", "test" or alike; None for any other scene.

    Generated apartments and Matterport3D's scenes are known by name, scans of HM3D by the numbers of their folders,
    files of other datasets by the names of the folders above them, both where a link is and where it leads.
    """
    spec = fspath(spec)
    if is_generated(spec):
        return find_named_split(spec)
    places = (normpath(Path(spec).expanduser().absolute()), _resolve(spec))
    return next((split for place in places if (split := _find_place_split(Path(place))) is not None), None)


def _find_place_split(path: Path) -> str | None:
    """Return the split for evaluation that an absolute path tells of; None if it tells of none."""
    named = (find_named_split(part.partition(".")[0]) for part in path.parts)
    folders = (_find_folder_split(part.lower()) for part in path.parent.parts)
    return next((split for split in (*named, _find_numbered_split(path), *folders) if split is not None), None)


def _find_folder_split(name: str) -> str | None:
    """Return the split for evaluation that a folder of such a name, in lower case, holds; None if none is known."""
    archive = ARCHIVE.fullmatch(name)
    return archive[1] if archive else name if name in FOLDERS else None


def _find_numbered_split(path: Path) -> str | None:
    """Return the split for evaluation of a file in HM3D's layout, "00800-TEEsavR23oF/TEEsavR23oF.basis.glb"."""
    folder = NUMBERED.fullmatch(path.parent.name)
    if folder is None or path.name.partition(".")[0] != folder[2]:
        return None
    return next((split for split, numbers in NUMBERS.items() if int(folder[1]) in numbers), None)


def list_evaluation_scenes(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the scenes of a dataset that are for evaluation, each once with its split, sorted by name."""
    found = ((name, find_named_split(name)) for name in sorted(set(names)))
    return [(name, split) for name, split in found if split is not None]


def find_named_split(name: str) -> str | None:
    """Return the split of a scene that is for evaluation, by its name in a dataset alone; None if none is known."""
    if is_generated(name):
        split = strip_edits(name).partition(":")[2].partition("/")[0].partition(":")[0]
        return None if split == "train" else split
    parts = name.split("/")
    return next((split for split, names in MATTERPORT.items() if not set(names).isdisjoint(parts)), None)
