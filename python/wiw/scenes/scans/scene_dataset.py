# SPDX-License-Identifier: Apache-2.0
"""Habitat's scene datasets: HSSD, ReplicaCAD, ProcTHOR and others that come with a `scene_dataset_config.json`.

A scene is opened by its `NAME.scene_instance.json`: a stage, objects and articulated objects that are placed in it, by
names of templates. Quaternions are in order wxyz. Which way is up in a mesh is what its configuration says, else the
dataset's default, else Y, as glTF has it.
"""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import _core
from wiw.errors import ArgumentError, Error, FileError
from wiw.json_text import parse_json
from wiw.scenes.basis import import_scan
from wiw.scenes.scans.scan import (
    Imported,
    box_to_y_up,
    import_options,
    read_text,
    require_folder,
    require_scans,
    rotation_of,
    split_cells,
)
from wiw.scenes.scans.urdf import read_visuals

ENDING = ".scene_instance.json"
CONFIG = ".scene_dataset_config.json"
_UNREADABLE = (LookupError, TypeError, ValueError, AttributeError, OverflowError)
_CONFIG_OF = {
    "stages": ".stage_config.json",
    "objects": ".object_config.json",
    "articulated_objects": ".ao_config.json",
}
_SEMANTICS, _SEMANTIC_ENDING = "semantic_scene_descriptor_instances", ".semantic_config.json"
_OWN_NAME = "%%CONFIG_NAME_AS_ASSET_FILENAME%%"
"""Stands for a scene's own name in defaults of its dataset."""
_NO_WORDS = {"frl", "apartment", "robo", "thor"}
_LEVELS = 6
"""Folders above a scene in which its dataset's configuration is looked for."""


@dataclass(frozen=True)
class Template:
    """A stage or an object that scenes place by its name."""

    file: Path
    """Its configuration, or the mesh or URDF itself."""
    attributes: Mapping[str, Any]
    """Values of its configuration, over the dataset's defaults."""

    def asset(self, *names: str) -> Path:
        """Return the file that one of these attributes names; the template's own where none does."""
        for name in names:
            if self.attributes.get(name):
                return self.file.parent / str(self.attributes[name])
        return self.file


@dataclass
class Dataset:
    """A dataset's configuration."""

    path: Path
    body: Mapping[str, Any]
    read: list[Path] = field(default_factory=list)
    absent: list[Path] = field(default_factory=list)

    @staticmethod
    def open(path: Path) -> Dataset:
        """Read a configuration.

        Raises:
            FileError: it is missing or no JSON object.
        """
        return Dataset(path, read_object(path), [path])

    def read_scene(self, file: Path) -> Mapping[str, Any]:
        """Return a scene's values, over the dataset's defaults.

        Raises:
            FileError: it is missing or no JSON object, or the defaults are none.
        """
        return {**self.defaults("scene_instances"), **read_object(file)}

    def section(self, name: str) -> Mapping[str, Any]:
        """Return a section, empty if there is none."""
        found = self.body.get(name, {})
        return found if isinstance(found, Mapping) else {}

    def defaults(self, section: str) -> Mapping[str, Any]:
        """Return a section's default attributes.

        Raises:
            FileError: what stands there is something else.
        """
        found = self.section(section).get("default_attributes", {})
        if not isinstance(found, Mapping):
            raise FileError(f"{self.path}: {section}: default_attributes: expected an object, got {found!r:.80}")
        return found

    def list_patterns(self, section: str) -> Mapping[str, list[str]]:
        """Return where a section's files are, by kind (".json", ".glb").

        Raises:
            FileError: what stands there is something else.
        """
        paths = self.section(section).get("paths", {})
        lists = paths.values() if isinstance(paths, Mapping) else [None]
        if not all(isinstance(patterns, list) and all(map(_is_pattern, patterns)) for patterns in lists):
            raise FileError(f"{self.path}: {section}: paths: expected lists of patterns by suffix, got {paths!r:.80}")
        return paths

    def find_files(self, section: str, kind: str, ending: str) -> list[Path]:
        """Return the files that a section's patterns of one kind (".json", ".glb") name, in order."""
        found: dict[Path, None] = {}
        here = Path(glob.escape(str(self.path.parent)))  # a folder's own name is no pattern
        for pattern in self.list_patterns(section).get(kind, []):
            matches = sorted(glob.glob(str(here / pattern)))  # noqa: PTH207 - may lead up, by ".."
            if not matches:
                self.absent.append(self.path.parent / pattern)
            for place in map(Path, matches):
                files = sorted(place.glob(f"*{ending}")) if place.is_dir() else [place]
                found |= {file: None for file in files if file.name.endswith(ending)}
        return list(found)

    def find_named(self, section: str, name: Any, scene: Path, kind: str, ending: str) -> Path | None:
        """Return the file of a section that a scene names, by a handle or by the file's own name; None without one."""
        if not isinstance(name, str) or not name:
            return None
        name = name.replace(_OWN_NAME, scene.name.removesuffix(ENDING))
        wanted = Path(name).name.removesuffix(ending)
        listed = [self.path.parent / str(path) for handle, path in self.section(section).items() if handle == name]
        found = [path for path in self.find_files(section, kind, ending) if path.name.removesuffix(ending) == wanted]
        self.absent += [path for path in listed if not path.is_file()]
        return next((path for path in [*listed, *found] if path.is_file()), None)

    @cached_property
    def files(self) -> dict[str, dict[str, list[Path]]]:
        """Files of templates by section and name; configurations before meshes."""
        table: dict[str, dict[str, list[Path]]] = {}
        for section, ending in _CONFIG_OF.items():
            names: dict[str, list[Path]] = {}
            others = [kind for kind in self.list_patterns(section) if kind != ".json"]
            for kind, last in [(".json", ending), *((kind, kind) for kind in others)]:
                for file in self.find_files(section, kind, last):
                    names.setdefault(file.name.removesuffix(last), []).append(file)
            table[section] = names
        return table

    def find_template(self, section: str, name: str) -> Template | None:
        """Return the template of a name such as "chair" or "objects/chair"; None if there is none."""
        ending = _CONFIG_OF[section]
        wanted = name.removesuffix(ending)
        candidates = self.files[section].get(Path(wanted).name, [])
        # a name with folders is the end of a path; without a match its last part decides
        matching = [file for file in candidates if str(file.with_name(Path(wanted).name)).endswith(f"/{wanted}")]
        file = next(iter(matching or candidates), None)
        if file is None:
            return None
        own = read_object(file) if file.name.endswith(ending) else {}
        self.read.append(file)
        return Template(file, {**self.defaults(section), **own})

    def read_class_names(self, description: Path | None) -> dict[int, str]:
        """Return names of classes by the `semantic_id` of objects, from lexicons.

        Args:
            description: what describes the scene: a lexicon, or a file that may name one.
        """
        files = [
            file
            for file in self.find_files(_SEMANTICS, ".json", ".json")
            if not file.name.endswith(_SEMANTIC_ENDING) or "lexicon" in file.name
        ]  # others are one for each scene, with its rooms
        if description is not None:
            named = {**self.defaults(_SEMANTICS), **read_object(description)}.get("semantic_descriptor_filename")
            lexicon = description.parent / str(named) if named else description
            files.append(lexicon if lexicon.is_file() else description)
            self.absent += [] if lexicon.is_file() else [lexicon]
        names: dict[int, str] = {}
        for file in dict.fromkeys(files):
            try:
                names |= {int(entry["id"]): str(entry["name"]) for entry in read_object(file).get("classes", [])}
            except _UNREADABLE as error:
                raise FileError(f"{file}: not a lexicon of classes ({type(error).__name__}: {error})") from error
            self.read.append(file)
        return names

    @cached_property
    def listed_names(self) -> dict[str, str]:
        """Categories by template, from HSSD's `semantics/objects.csv`; empty if there is no such table."""
        file = self.path.parent / "semantics" / "objects.csv"
        if not file.is_file():
            self.absent.append(file)
            return {}
        self.read.append(file)
        header, *lines = split_cells(file, read_text(file).splitlines()) or [[]]
        rows = [dict(zip(header, line, strict=False)) for line in lines]
        words = [(row.get("id", ""), row.get("main_category") or row.get("name") or "") for row in rows]
        return {name: category for name, category in words if name}


def _is_pattern(value: Any) -> bool:
    return isinstance(value, str) and "\0" not in value


def read_object(path: Path) -> Mapping[str, Any]:
    """Return a JSON file's object.

    Raises:
        FileError: it is missing, no JSON, or no object.
    """
    text = read_text(path)
    try:
        body = parse_json(text)
    except ValueError as error:
        raise FileError(f"{path}: {error}") from error
    if not isinstance(body, dict):
        raise FileError(f"{path}: expected a JSON object, got {type(body).__name__}")
    return body


def find(folder: Path, split: str) -> list[Path]:
    """Return the scenes that a dataset's configurations name; of a split, those below a folder of its name."""
    place = require_folder(folder, "")
    configs = sorted(place.glob(f"*{CONFIG}"))
    if not configs:
        raise FileError(f"{place}: holds no *{CONFIG}, which lists the dataset's scenes")
    found = {file.absolute() for config in configs for file in _scenes_of(Dataset.open(config))}
    chosen = [file for file in found if not split or split in Path(os.path.relpath(file.parent, place)).parts]
    return require_scans(chosen, place, f"*{ENDING} where the patterns of {configs[0].name} lead")


def _scenes_of(dataset: Dataset) -> list[Path]:
    return dataset.find_files("scene_instances", ".json", ENDING)


def find_dataset(file: Path) -> Dataset:
    """Return the dataset that a scene belongs to: the first configuration in the folders above that names it.

    Raises:
        FileError: there is none.
    """
    scene = file.absolute()
    for folder in list(scene.parents)[:_LEVELS]:
        for config in sorted(folder.glob(f"*{CONFIG}")):
            dataset = Dataset.open(config)
            if scene in {found.absolute() for found in _scenes_of(dataset)}:
                return dataset
    raise FileError(f"{file}: no *{CONFIG} in the folders above names this scene")


def find_navmesh(file: Path) -> Path | None:
    """Return the navigation mesh that a scene names, if the file is there."""
    dataset = find_dataset(file)
    name = dataset.read_scene(file).get("navmesh_instance")
    return dataset.find_named("navmesh_instances", name, file, ".navmesh", ".navmesh")


# ---- transforms


def _vector(values: Any, default: float) -> NDArray[np.float64]:
    vector = np.full(3, default) if values is None else np.array(values, float)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"expected three finite numbers, got {values!r:.60}")
    return vector


def _affine(linear: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = linear, translation
    return result


def _frame(attributes: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the rotation [3, 3] from a mesh's axes to Y up and -Z ahead."""
    up = _vector(attributes.get("up", (0, 1, 0)), 0)
    ahead = _vector(attributes.get("front", (0, 0, -1)), 0)
    frame = np.stack([np.cross(ahead, up), up, -ahead])
    if not np.allclose(frame @ frame.T, np.eye(3), atol=1e-3):
        raise ValueError(f"up {up.tolist()} and front {ahead.tolist()} are not at right angles, or not of length 1")
    return frame


# ---- scenes


class _Assembly:
    """Parts of a scene, gathered before anything is put together, so that all that is missing can be named."""

    def __init__(self, dataset: Dataset, description: Path | None, options: Mapping[str, Any]) -> None:
        self.dataset, self.description, self.options = dataset, description, options
        self.parts: list[_core.scene.Scene] = []
        self.indices: dict[Path, int] = {}
        self.boxes: dict[Path, NDArray[np.float64]] = {}
        self.placements: list[tuple[int, int, NDArray[np.float64]]] = []
        self.instances: list[dict[str, Any]] = []
        self.missing: list[str] = []
        self.read: list[Path] = []
        self.absent: list[Path] = []
        self.warnings: list[str] = []

    @cached_property
    def class_names(self) -> dict[int, str]:
        """Names of classes by the `semantic_id` of objects."""
        return self.dataset.read_class_names(self.description)

    def part(self, file: Path) -> int | None:
        """Return the index of a mesh, in its own axes; None, and noted, if there is no such file."""
        if file not in self.indices:
            if not file.is_file():
                self.missing.append(str(file))
                return None
            scene, read, absent = import_scan(file, **import_options(self.options, "y"))
            self.indices[file] = len(self.parts)
            self.boxes[file] = scene.bounds.astype(float)
            self.parts.append(scene)
            self.read += read
            self.absent += absent
        return self.indices[file]

    def template(self, section: str, name: Any) -> Template | None:
        """Return a template by its name; None, and noted, if there is none."""
        found = self.dataset.find_template(section, str(name))
        if found is None:
            self.missing.append(f"{section}: {name}")
        return found

    def add(self, name: str, template: Template, meshes: list[tuple[Path, NDArray[np.float64]]]) -> None:
        """Add an instance of placed meshes."""
        placed = [(self.part(file), transform) for file, transform in meshes]
        self.instances.append(self._describe(name, template))
        self.placements += [(part, len(self.instances), matrix) for part, matrix in placed if part is not None]

    def _describe(self, name: str, template: Template) -> dict[str, Any]:
        stem = re.split(r"\.(?:object|stage|ao)_config", template.file.name)[0].removesuffix(template.file.suffix)
        semantic = template.attributes.get("semantic_id")
        by_class = self.class_names.get(int(semantic)) if semantic else None
        category = by_class or self.dataset.listed_names.get(stem) or words_of(stem)
        attributes = {"template": stem} | ({"semantic_id": str(int(semantic))} if semantic else {})
        return {"name": name, "category": category.lower().replace("_", " "), "attributes": attributes}


def words_of(name: str) -> str:
    """Return the category that a template's name says: "dining table" for "Dining_Table_20_1"; "" for a digest."""
    if re.fullmatch(r"[0-9a-f]{12,}(?:_part_[0-9]+)?", name):
        return ""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
    return " ".join(word for word in words if len(word) > 1 and word not in _NO_WORDS)


def read(file: Path, options: dict[str, Any]) -> Imported:
    """Read a scene.

    Raises:
        FileError: it or its dataset is damaged, or files and templates that it names do not exist; names all of them.
        ArgumentError: a ceiling is asked for.
    """
    if options.get("ceiling") is not None:
        raise ArgumentError(f"{file}: a ceiling cannot be added to a scene dataset")
    dataset = find_dataset(file)
    body = dataset.read_scene(file)
    description = dataset.find_named(_SEMANTICS, body.get("semantic_scene_instance"), file, ".json", _SEMANTIC_ENDING)
    if description is not None and description.suffix != ".json":  # of a scan's labels, which objects do not need
        description = None
    assembly = _Assembly(dataset, description, options)
    try:
        _add_stage(body, assembly)
        for placed in body.get("object_instances", []):
            _add_object(placed, str(body.get("translation_origin", "")), assembly)
        for placed in body.get("articulated_object_instances", []):
            _add_articulated(placed, assembly)
        rooms = [] if description is None else _read_rooms(description)
    except Error:
        raise
    except _UNREADABLE as error:
        raise FileError(f"{file}: cannot be read as a scene instance ({type(error).__name__}: {error})") from error
    if assembly.missing:
        lost = list(dict.fromkeys(assembly.missing))
        listed = "\n  ".join(lost[:100]) + ("\n  ..." if len(lost) > 100 else "")
        raise FileError(f"{file}: {len(lost)} objects that it names are not in {dataset.path.parent}:\n  {listed}")
    nameless = sum(not instance["category"] for instance in assembly.instances[1:])
    if nameless:
        assembly.warnings.append(f"{nameless} of {len(assembly.instances) - 1} objects have no category")
    attributes = {
        "up": "Y (scene dataset)",
        "dataset": dataset.path.name.removesuffix(CONFIG),
        "labels": "scene dataset",
    }
    try:
        scene = _core.scene.Scene.assembled(
            assembly.parts,
            assembly.placements,
            assembly.instances,
            rooms=rooms,
            name=file.name.removesuffix(ENDING),
            attributes=attributes,
            warnings=assembly.warnings,
        )
    except ArgumentError as error:  # numbers of the file that no scene can have
        raise FileError(f"{file}: {error}") from error
    read = [*dataset.read, *assembly.read, *([] if description is None else [description])]
    return Imported(scene, [file, *dict.fromkeys(read)], [*dataset.absent, *assembly.absent])


def _add_stage(body: Mapping[str, Any], assembly: _Assembly) -> None:
    placed = body["stage_instance"]
    template = assembly.template("stages", placed["template_name"])
    if template is not None:
        turn = rotation_of(placed.get("rotation", (1, 0, 0, 0)))
        matrix = _affine(turn @ _linear(placed, template), _vector(placed.get("translation"), 0))
        assembly.add("stage", template, [(template.asset("render_asset"), matrix)])
        assembly.instances[-1]["category"] = ""


def _linear(placed: Mapping[str, Any], template: Template) -> NDArray[np.float64]:
    """Return the map [3, 3] from a mesh's axes to those of its instance, scaled."""
    scale = _vector(placed.get("non_uniform_scale"), 1) * float(placed.get("uniform_scale", 1))
    return np.diag(scale * _vector(template.attributes.get("scale"), 1)) @ _frame(template.attributes)


def _add_object(placed: Mapping[str, Any], scene_origin: str, assembly: _Assembly) -> None:
    template = assembly.template("objects", placed["template_name"])
    if template is None:
        return
    file = template.asset("render_asset")
    index = assembly.part(file)
    if index is None:
        return
    linear = _linear(placed, template)
    turn = rotation_of(placed.get("rotation", (1, 0, 0, 0)))
    origin = np.zeros(3)
    if str(placed.get("translation_origin", scene_origin)).lower() != "asset_local":
        origin = _centre(template, linear, assembly.boxes[file])
    matrix = _affine(turn @ linear, _vector(placed.get("translation"), 0) - turn @ origin)
    assembly.add(f"{Path(str(placed['template_name'])).name} {len(assembly.instances)}", template, [(file, matrix)])


def _centre(template: Template, linear: NDArray[np.float64], box: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point that a placement puts in its place: the centre of mass if it is given, else that of the box."""
    if "COM" in template.attributes:
        return _vector(template.attributes["COM"], 0)
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    turned = corners @ linear.T
    return (turned.min(axis=0) + turned.max(axis=0)) / 2


def _add_articulated(placed: Mapping[str, Any], assembly: _Assembly) -> None:
    template = assembly.template("articulated_objects", placed["template_name"])
    if template is None:
        return
    urdf = template.asset("urdf_filepath")
    if not urdf.is_file():
        assembly.missing.append(str(urdf))
        return
    assembly.read.append(urdf)
    scale = float(placed.get("uniform_scale", 1)) * float(template.attributes.get("uniform_scale", 1))
    root = _affine(scale * rotation_of(placed.get("rotation", (1, 0, 0, 0))), _vector(placed.get("translation"), 0))
    visuals = read_visuals(urdf, placed.get("initial_joint_pose", ()))
    meshes = [(visual.mesh, root @ visual.T_root_mesh) for visual in visuals]
    assembly.add(f"{Path(str(placed['template_name'])).name} {len(assembly.instances)}", template, meshes)


def _read_rooms(description: Path) -> list[dict[str, Any]]:
    """Return the rooms that a scene's semantic description has, as HSSD's does."""
    return [
        {
            "name": str(region["name"]),
            "type": str(region.get("label", "")).replace("_", " "),
            "bounds": box_to_y_up(region["min_bounds"], region["max_bounds"], "y"),
        }
        for region in read_object(description).get("region_annotations", [])
    ]
