# SPDX-License-Identifier: Apache-2.0
"""The published questions of OpenEQA: the lists of 184 and 557 that A-EQA is asked with, and those with start poses.

Their answers are free text. Scenes are HM3D's, which the user has; a scene is found by its name in the scene folder, in
HM3D's layout (00824-Dd4bFSTQ8gi/Dd4bFSTQ8gi.basis.glb) or as a mesh of that name.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from wiw._core import core
from wiw.datasets.episodes import read_json
from wiw.datasets.fields import name_of, number, point, text, to_position
from wiw.datasets.habitat import heading_of, yaw_of
from wiw.datasets.questions.question import CATEGORIES, Question
from wiw.datasets.questions.survey import choose_places
from wiw.datasets.worlds import World
from wiw.errors import FileError
from wiw.types import Episode

SOURCE = "open-eqa"
"""`Episode.info["source"]` of such episodes."""
PATH_LENGTHS = "gt_path_length.json"
"""Name of the published file of metres by question id, each the length of a recorded tour of the scene."""
ENDINGS = (".glb", ".basis.glb", ".gltf", ".obj", ".ply", ".dae")
"""Suffixes of a scene's file, in order of preference."""
NEAR = 0.5
"""Metres from a start to the navigation mesh beyond which it is off it."""
_PLACES = 64


def load(path: str | Path, scenes: str | Path = "", path_lengths: str | Path | None = None) -> list[Episode]:
    """Return one episode for each question of a published list, in its order.

    Starts are those of the file, else NaN: `locate_start` gives such an episode one, once its scene is open. Lengths
    are those of `path_lengths`, else of `gt_path_length.json` beside the list, else NaN.

    Args:
        path: the list, `open-eqa-184.json` or like it.
        scenes: folder of the scenes. Without it episodes name scenes as the list does: enough to read, not to run.
        path_lengths: file of metres by question id.

    Raises:
        FileError: a file is missing or damaged; an item lacks a field, or has an empty answer, an unknown category, an
            id that another one has, a number that is none, or a scene that is not in the folder. Names file, index and
            field.
    """
    body = read_json(path)
    if not isinstance(body, list) or not body:
        raise FileError(f"{path}: expected OpenEQA's list of questions, got {type(body).__name__} {body!r:.60}")
    lengths = _read_lengths(path, path_lengths)
    found: list[Episode] = []
    first: dict[str, int] = {}
    for i, item in enumerate(body):
        where = f"{path}: item {i}"
        episode = _episode(item, where, lengths)
        other = first.setdefault(episode.episode_id, i)
        if other != i:
            raise FileError(
                f"{where}: question_id '{episode.episode_id}' is also that of item {other}; expected a unique one"
            )
        found.append(episode)
    if not scenes:
        return found
    files = _index_scenes(Path(scenes).expanduser().absolute())
    return [
        replace(each, scene=_find_scene(each.scene, files, scenes, f"{path}: item {i}")) for i, each in enumerate(found)
    ]


def _episode(item: Any, where: str, lengths: Mapping[str, float]) -> Episode:
    if not isinstance(item, Mapping):
        raise FileError(f"{where}: expected an object with question, answer, category, got {item!r:.60}")
    missing = [
        name for name in ("question", "answer", "category", "question_id", "episode_history") if name not in item
    ]
    if missing:
        raise FileError(f"{where}: lacks {', '.join(missing)}")
    try:
        name = _words(name_of(item["question_id"], "question_id"), "question_id")
        question = _question(item)
        start = next((item[key] for key in ("start_position", "position") if item.get(key) is not None), None)
        turn = next((item[key] for key in ("start_rotation", "rotation") if item.get(key) is not None), None)
        if (start is None) != (turn is None):
            raise ValueError("start: expected both a position and a rotation, or none of them")
        return Episode(
            episode_id=name,
            scene=_words(text(item["episode_history"], "episode_history"), "episode_history").split("/")[-1],
            start_position=(math.nan,) * 3 if start is None else point(start, "position"),
            start_yaw=heading_of(name) if turn is None else yaw_of(turn, "wxyz", f"{where}: rotation"),
            goal_position=(math.nan,) * 3,
            goal_yaw=0.0,
            geodesic=lengths.get(name, math.nan),
            info={"question": question.to_info(), "source": SOURCE},
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise FileError(f"{where}: {error}") from error


def _question(item: Mapping[str, Any]) -> Question:
    answer = _words(text(item["answer"], "answer"), "answer")
    extra = item.get("extra_answers") or []
    if not isinstance(extra, list):
        raise ValueError(f"extra_answers: expected a list of texts, got {extra!r:.60}")
    category = text(item["category"], "category")
    if category not in CATEGORIES:
        raise ValueError(f"category: expected one of {', '.join(CATEGORIES)}, got '{category}'")
    return Question(
        text=_words(text(item["question"], "question"), "question"),
        answer=answer,
        category=category,
        answer_type=_type_of(answer),
        extra_answers=tuple(_words(text(each, "extra_answers"), "extra_answers") for each in extra),
    )


def _type_of(answer: str) -> str:
    """Return the kind of a free answer, where rules can decide it."""
    plain = answer.lower().strip(" .!")
    return "yes_no" if plain in ("yes", "no") else "count" if plain.isdecimal() else "text"


def _words(value: str, name: str) -> str:
    if not value.strip():
        raise ValueError(f"{name}: expected words, got {value!r}")
    return value


def _read_lengths(path: str | Path, path_lengths: str | Path | None) -> dict[str, float]:
    beside = Path(path).parent / PATH_LENGTHS
    file = Path(path_lengths) if path_lengths is not None else beside
    if path_lengths is None and not beside.is_file():
        return {}
    body = read_json(file)
    if not isinstance(body, Mapping):
        raise FileError(f"{file}: expected an object of metres by question id, got {type(body).__name__}")
    try:
        lengths = {name: number(length, f"'{name}'") for name, length in body.items()}
    except ValueError as error:
        raise FileError(f"{file}: {error}") from error
    short = next((name for name, length in lengths.items() if length <= 0), None)
    if short is not None:
        raise FileError(f"{file}: '{short}': expected a length above 0 metres, got {lengths[short]}")
    return lengths


def _find_scene(history: str, files: Mapping[str, str], folder: str | Path, where: str) -> str:
    """Return the path of a history's scene: "000-hm3d-BFRyYbPCCPE" and "00824-Dd4bFSTQ8gi" end in its name."""
    name = history.rsplit("-", 1)[-1]
    for ending in ENDINGS:
        if f"{name}{ending}".lower() in files:
            return files[f"{name}{ending}".lower()]
    raise FileError(
        f"{where}: episode_history '{history}': {folder} has no scene {name}; expected {name}.glb or HM3D's "
        f"*-{name}/{name}.basis.glb in it or in one of its folders"
    )


def _index_scenes(folder: Path) -> dict[str, str]:
    """Return the files of scenes by name, from a folder and the two levels below it that HM3D has."""
    files = [file for depth in ("*", "*/*", "*/*/*") for file in sorted(folder.glob(depth))]
    found: dict[str, str] = {}
    for file in files:
        if file.name.lower().endswith(ENDINGS):
            found.setdefault(file.name.lower(), str(file))
    return found


def locate_start(world: World, episode: Episode) -> Episode:
    """Return an episode whose start is on the floor of its scene.

    A start that the list does not give is drawn on the scene's largest island, the same for the same question.

    Raises:
        FileError: the start of the list is not on the navigation mesh; names the episode and the nearest place.
    """
    start = np.asarray(episode.start_position, np.float64)
    if np.isnan(start).any():
        key = core.fold_key([0x0E0A, *episode.episode_id.encode()])
        places = choose_places(world, _PLACES, key)
        return replace(episode, start_position=to_position(places[0]))
    nearest = np.asarray(world.navmesh.snap(start), np.float64)
    away = float(np.linalg.norm(nearest - start))
    if not away <= NEAR:
        raise FileError(
            f"episode {episode.episode_id}: start_position {to_position(start)} is not on the navigation mesh of "
            f"{world.name}; the nearest place, {to_position(nearest)}, is {away:.2f} m away, expected at most {NEAR} "
            "m: is this the right scene?"
        )
    return replace(episode, start_position=to_position(nearest))
