# SPDX-License-Identifier: Apache-2.0
"""Matterport3D: `SCAN.glb` or `SCAN.obj`, and beside it the tables `SCAN.house` and the labels `SCAN_semantic.ply`.

The formats are described in Matterport's `data_organization.md`; axis Z is up. Labels are numbers of objects in the
house file, as in Habitat.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import _core
from wiw.errors import FileError
from wiw.scenes.basis import import_scan
from wiw.scenes.scans import labels as transfer
from wiw.scenes.scans.scan import (
    Imported,
    ScanObject,
    box_to_y_up,
    import_options,
    number_objects,
    read_text,
    require_file,
    require_folder,
    require_scans,
    to_y_up,
)

ROOMS = {
    "a": "bathroom", "b": "bedroom", "c": "closet", "d": "dining room", "e": "entryway", "f": "family room",
    "g": "garage", "h": "hallway", "i": "library", "j": "laundry room", "k": "kitchen", "l": "living room",
    "m": "meeting room", "n": "lounge", "o": "office", "p": "porch", "r": "rec room", "s": "stairs", "t": "toilet",
    "u": "utility room", "v": "tv room", "w": "gym", "x": "outdoor", "y": "balcony", "z": "other room", "B": "bar",
    "C": "classroom", "D": "dining booth", "S": "spa", "Z": "junk", "-": "no label",
}  # fmt: skip
"""Types of rooms by the letters of a house file."""


@dataclass(frozen=True)
class Category:
    """A category of a house file."""

    name: str
    """As the annotators wrote it: "coffee table"."""
    mpcat40: str
    """One of 40: "table"."""


@dataclass(frozen=True)
class HouseObject:
    """An object of a house file, in the file's axes."""

    region: int
    """Index of its region, -1 for none."""
    category: Category
    centre: NDArray[np.float64]
    """float64 [3], metres."""
    axes: NDArray[np.float64]
    """float64 [3, 3], unit vectors as rows."""
    radii: NDArray[np.float64]
    """float64 [3], half sizes along the axes."""


@dataclass(frozen=True)
class Region:
    """A room of a house file, in the file's axes."""

    label: str
    """Its letter in `ROOMS`."""
    low: Sequence[float]
    high: Sequence[float]


@dataclass(frozen=True)
class House:
    """Objects and regions of a house file, by their indices."""

    objects: dict[int, HouseObject]
    regions: dict[int, Region]


def read_house(path: Path) -> House:
    """Read a `.house` file.

    Raises:
        FileError: it is missing, of another version, or a record is damaged or lacks what it refers to; names the line.
    """
    lines = read_text(path).splitlines()
    if not lines or lines[0].strip() != "ASCII 1.1":
        raise FileError(f"{path}: expected 'ASCII 1.1' in the first line, got {lines[0] if lines else ''!r:.40}")
    records: dict[str, list[tuple[int, list[str]]]] = defaultdict(list)
    for number, line in enumerate(lines[1:], 2):
        words = line.split()
        if words:
            records[words[0]].append((number, words))
    categories: dict[int, Category] = {}
    house = House({}, {})
    for kind, read in (("C", _add_category), ("R", _add_region), ("O", _add_object)):
        for number, words in records[kind]:
            try:
                read(words, categories, house)
            except (ValueError, IndexError, KeyError) as error:
                raise FileError(
                    f"{path}: line {number}: not a house record '{kind}' ({type(error).__name__}: {error})"
                ) from error
    _check_counts(path, records, house)
    return house


def _numbers(words: Sequence[str]) -> NDArray[np.float64]:
    numbers = np.array([float(word) for word in words])
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    return numbers


def _clean_word(word: str) -> str:
    return word.replace("#", " ").strip()


def _add_category(words: list[str], categories: dict[int, Category], house: House) -> None:
    categories[int(words[1])] = Category(_clean_word(words[3]), _clean_word(words[5]))


def _add_region(words: list[str], categories: dict[int, Category], house: House) -> None:
    box = _numbers(words[9:15])
    if len(box) < 6:
        raise ValueError("expected a box of six numbers")
    house.regions[int(words[1])] = Region(words[5], box[:3].tolist(), box[3:].tolist())


def _add_object(words: list[str], categories: dict[int, Category], house: House) -> None:
    index, region, category = (int(word) for word in words[1:4])
    box = _numbers(words[4:16])
    if len(box) < 12:
        raise ValueError("expected a centre, two axes and half sizes, twelve numbers")
    if region >= 0 and region not in house.regions:
        raise ValueError(f"its region {region} does not exist")
    nothing = Category("", "")
    kind = nothing if category < 0 else categories[category]
    axes = np.stack([box[3:6], box[6:9], np.cross(box[3:6], box[6:9])])
    house.objects[index] = HouseObject(region, kind, box[:3], axes, box[9:12])


def _check_counts(path: Path, records: dict[str, list[tuple[int, list[str]]]], house: House) -> None:
    """Compare the tables with the counts in the header; a truncated file has fewer."""
    if not records["H"]:
        raise FileError(f"{path}: has no header record 'H' (truncated file)")
    words = records["H"][0][1]
    for name, there, column in (("objects", house.objects, 8), ("regions", house.regions, 10)):
        said = words[column] if len(words) > column else None
        if said != str(len(there)):
            raise FileError(f"{path}: has {len(there)} {name}, but its header says {said} (truncated or damaged file)")


def is_scan(file: Path) -> bool:
    """Return whether a mesh file has Matterport3D's tables or labels beside it."""
    return file.suffix.lower() in (".glb", ".obj") and (
        _find_house_file(file).is_file() or _find_semantic_file(file).is_file()
    )


def find(folder: Path, split: str) -> list[Path]:
    """Return the meshes of all scans in a dataset's folder, or in that of one scan."""
    place = require_folder(folder, split)
    houses = [*place.glob("*.house"), *place.glob("*/*.house")]
    meshes = [(house.with_suffix(".glb"), house.with_suffix(".obj")) for house in houses]
    found = [next((mesh for mesh in pair if mesh.is_file()), pair[0]) for pair in meshes]
    return require_scans(found, place, "Matterport3D's SCAN/SCAN.glb with SCAN.house and SCAN_semantic.ply beside it")


def _find_house_file(file: Path) -> Path:
    return file.with_suffix(".house")


def _find_semantic_file(file: Path) -> Path:
    return file.with_name(f"{file.stem}_semantic.ply")


def read(file: Path, options: dict[str, Any]) -> Imported:
    """Read a scan; without its `_semantic.ply` it has no instances of objects, and a warning."""
    up = options.get("up") or "z"
    scene, read, absent = import_scan(file, **import_options(options, up))
    house_file = require_file(_find_house_file(file), "expected Matterport3D's table of objects beside the mesh")
    house = read_house(house_file)
    rooms = name_rooms(house, up)
    about = {"up": f"{up.upper()} (Matterport3D)", "dataset": "Matterport3D"}
    listed = [dict(room) for room in rooms.values()]
    semantic = _find_semantic_file(file)
    files = [*read, house_file]
    surface = transfer.Surface(*scene.world_triangles()[:2])
    if not semantic.is_file():
        table = number_objects({}, (), house_file)
        scene = scene.relabelled(
            table.instances,
            np.ones(len(surface.triangles), np.uint32),
            rooms=listed,
            flat=True,
            attributes={**about, "labels": "none"},
            warnings=[f"{semantic.name} does not exist: no object has a label"],
        )
        return Imported(scene, files, [*absent, semantic])
    vertices, triangles, object_ids, _ = _core.scene.read_ply_surface(
        semantic, "object_id", limits=options.get("limits", {})
    )
    labelled = transfer.Surface(to_y_up(vertices, up), triangles)
    samples = transfer.sample(labelled, semantic)
    source = transfer.LabelledSurface(labelled, samples, object_ids[samples.triangles])
    pieces = transfer.transfer_labels(surface, source, file)
    shown = set(np.unique(pieces.labels).tolist())
    objects = {i: _scan_object(i, thing, rooms) for i, thing in house.objects.items()}
    table = number_objects(objects, shown, house_file)
    scene = scene.relabelled(
        table.instances,
        table.number(pieces.labels),
        triangles=pieces.triangles,
        corners=pieces.corners,
        rooms=listed,
        flat=True,
        attributes={**about, "labels": "Matterport3D objects"},
        warnings=_warnings(
            semantic, shown, set(objects), np.unique(object_ids), transfer.unlabelled_share(surface, pieces)
        ),
    )
    return Imported(scene, [*files, semantic], list(absent))


def name_rooms(house: House, up: str) -> dict[int, dict[str, Any]]:
    """Return a room for each region: name ("bedroom 2"), type and bounds float32 [2, 3] in the world."""
    counts: Counter[str] = Counter()
    rooms = {}
    for index, region in sorted(house.regions.items()):
        kind = ROOMS.get(region.label, "no label")
        counts[kind] += 1
        bounds = box_to_y_up(region.low, region.high, up)
        rooms[index] = {"name": f"{kind} {counts[kind]}", "type": kind, "bounds": bounds}
    return rooms


def _scan_object(index: int, thing: HouseObject, rooms: dict[int, dict[str, Any]]) -> ScanObject:
    room = rooms.get(thing.region)
    attributes = {"mpcat40": thing.category.mpcat40} | ({"room": room["name"]} if room else {})
    return ScanObject(f"{thing.category.name or 'object'} {index}", thing.category.name, attributes)


def _warnings(
    semantic: Path, shown: set[int], known: set[int], labelled: NDArray[np.int64], unlabelled: float
) -> list[str]:
    """Say what of the labels does not fit the table and the mesh."""
    strange = sorted(set(labelled[labelled >= 0].tolist()) - known)
    lost = sorted(known - shown)
    warnings = []
    if strange:
        warnings.append(
            f"{semantic.name} labels {len(strange)} objects that the house file does not have: {_list_some(strange)}"
        )
    if lost:
        warnings.append(f"{len(lost)} of {len(known)} objects have no surface: {_list_some(lost)}")
    if unlabelled > 0.01:
        warnings.append(f"{100 * unlabelled:.0f} % of the surface is further than {transfer.REACH} m from any label")
    return warnings


FAR = 0.5
"""Metres between the middle of an object's surface and that of its box in the house file that are worth a word."""


def compare_boxes(file: Path, scene: _core.scene.Scene) -> list[str]:
    """Return where the objects of a scan are not where its house file has their boxes, one sentence each."""
    up = scene.attributes["up"][0].lower()
    shown = [thing for thing in scene.instances if thing["triangle_count"] and "scan_id" in thing["attributes"]]
    things = {thing["attributes"]["scan_id"]: thing for thing in shown}
    far = []
    for index, thing in read_house(_find_house_file(file)).objects.items():
        if str(index) in things:
            low, high = things[str(index)]["bounds"]
            distance = np.linalg.norm((low + high) / 2 - to_y_up(thing.centre, up))
            far.extend([index] * bool(distance > FAR))
    if not far:
        return []
    return [
        f"{len(far)} of {len(things)} objects are over {FAR} m from their boxes in the house file: {_list_some(far)}"
    ]


def _list_some(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers[:8])) + (", ..." if len(numbers) > 8 else "")
