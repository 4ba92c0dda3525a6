# SPDX-License-Identifier: Apache-2.0
"""Episode files: JSON, one object an episode, with the goal's full pose so that goal images can be made again."""

from __future__ import annotations

import gzip
import json
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from wiw.datasets import habitat
from wiw.datasets.fields import integer, length, number, point, positive, text
from wiw.errors import ArgumentError, FileError
from wiw.files import atomic_file
from wiw.json_text import parse_json
from wiw.scenes import absolute, is_generated, resolve
from wiw.types import Episode

VERSION = 1
MOST_BYTES = 256 << 20
"""Maximum size of an episode file in bytes, unpacked; 100,000 episodes take about 50 MB."""


def save(path: str | Path, episodes: Sequence[Episode], task: str, **about: Any) -> None:
    """Write an episode file, gzipped if its name ends in .gz; `about` (generator, seed, ...) goes into its header.

    Raises:
        ArgumentError: an episode has no start yet, or a number in its `info` is not finite.
        FileError: it cannot be written; a file that was there is as it was.
    """
    folder = Path(path).absolute().parent
    items = [_item(episode, folder) for episode in episodes]
    body = {"format": "wiw-episodes", "version": VERSION, "task": task, **about, "episodes": items}
    try:
        text = json.dumps(body, indent=1, allow_nan=False).encode()
    except ValueError as error:
        raise ArgumentError(
            f"{path}: expected episodes with starts, and with finite numbers in info: {error}"
        ) from error
    with atomic_file(Path(path)) as draft:
        draft.write_bytes(gzip.compress(text, mtime=0) if str(path).endswith(".gz") else text)


def _item(episode: Episode, folder: Path) -> dict[str, Any]:
    """Return an episode as JSON: the scene's path relative to the file's folder where it lies in there; NaN as null."""
    scene = Path(episode.scene)
    name = str(scene.relative_to(folder)) if scene.is_relative_to(folder) else episode.scene
    geodesic = episode.geodesic if math.isfinite(episode.geodesic) else None
    goal = episode.goal_position if all(map(math.isfinite, episode.goal_position)) else None
    return {**asdict(episode), "scene": name, "goal_position": goal, "geodesic": geodesic}


def load(path: str | Path, scenes: str | Path = "") -> list[Episode]:
    """Read an episode file: one written by `save`, or habitat-lab's or World-in-World's.

    `scenes` is the folder that scene paths are relative to; if not given, the folder of a file that `save` wrote, and
    the present one for the other formats. Lengths, and goals of recognition and of questions, that a file does not give
    are NaN until the task has measured them.

    Raises:
        FileError: missing, not JSON, of another format or version, or an episode lacks a field; names the file.
    """
    body = read_json(path)
    own = isinstance(body, Mapping) and body.get("format") == "wiw-episodes"
    folder = Path(scenes) if scenes or not own else Path(path).parent
    read = _own(body, path) if own else _foreign(body, path)
    return [replace(e, scene=_scene(e.scene, folder, f"{path}: episode {i}")) for i, e in enumerate(read)]


def _scene(name: str, folder: Path, where: str) -> str:
    """Return the spec of one scene, from its name in a file whose paths are relative to `folder`."""
    try:
        if not is_generated(name):
            return absolute(folder / name)
        named = resolve(name)
        if len(named) != 1 or "/" not in name:
            raise ValueError("expected a single one, such as apartments:val/3")
        return named[0]
    except (ArgumentError, ValueError) as error:
        raise FileError(f"{where}: scene '{name}': {error}") from error


def _foreign(body: Any, path: str | Path) -> list[Episode]:
    if habitat.is_active_recognition(body):
        return habitat.read_active_recognition(body, str(path))
    if habitat.is_habitat(body):
        return habitat.read_habitat(body, str(path))
    if habitat.is_world_in_world(body):
        return habitat.read_world_in_world(body, str(path))
    raise FileError(
        f"{path}: expected an episode file of wiw ('format': 'wiw-episodes'), habitat-lab or World-in-World"
    )


def _own(body: Mapping[str, Any], path: str | Path) -> list[Episode]:
    if body.get("version") != VERSION:
        raise FileError(f"{path}: version {body.get('version')}, this release reads version {VERSION}")
    items = body.get("episodes")
    if not isinstance(items, list):
        raise FileError(f"{path}: episodes: expected a list, got {type(items).__name__}")
    return [_episode(item, f"{path}: episode {i}") for i, item in enumerate(items)]


def read_json(path: str | Path) -> Any:
    """Return the parsed file, gunzipped when its name ends in .gz.

    Raises:
        FileError: it cannot be read or parsed, or is larger than `MOST_BYTES` once unpacked; names file and cause.
    """
    try:
        with (gzip.open if str(path).endswith(".gz") else open)(path, "rb") as file:
            raw = file.read(MOST_BYTES + 1)
        if len(raw) > MOST_BYTES:
            raise ValueError(
                f"expected an episode file of at most {MOST_BYTES} bytes when unpacked, but it is larger; split it"
            )
    except (OSError, EOFError, ValueError, zlib.error) as error:
        cause = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)  # strerror: no path again
        raise FileError(f"{path}: {cause}") from error
    try:
        return parse_json(raw)
    except ValueError as error:
        raise FileError(
            f"{path}: expected an episode file, which is JSON, gzipped if its name ends in .gz; {error}"
        ) from error


def _episode(item: Any, where: str) -> Episode:
    missing = [name for name in _FIELDS if not isinstance(item, Mapping) or name not in item]
    if missing:
        raise FileError(f"{where} lacks {', '.join(missing)}")
    try:
        values = {name: read(item[name], name) for name, read in _FIELDS.items()}
        info = _info(item.get("info", {}))
        if item["goal_position"] is None and not info.keys() & {"target", "question"}:
            raise ValueError("goal_position: expected a point, as info has no target and no question, got None")
        return Episode(**values, info=info)
    except (ValueError, ArithmeticError) as error:
        raise FileError(f"{where}: {error}") from error


def _info(info: Any) -> dict[str, Any]:
    if not isinstance(info, dict):
        raise ValueError(f"info: expected an object, got {info!r:.80}")
    json.dumps(info, allow_nan=False)
    return info | {name: read(info[name], f"info.{name}") for name, read in _INFO.items() if name in info}


def _goal(value: Any, name: str) -> tuple[float, float, float]:
    return (math.nan,) * 3 if value is None else point(value, name)


def _length(value: Any, name: str) -> float:
    return math.nan if value is None else length(value, name)


_FIELDS: Mapping[str, Callable[[Any, str], Any]] = {
    "episode_id": text,
    "scene": text,
    "start_position": point,
    "start_yaw": number,
    "goal_position": _goal,
    "goal_yaw": number,
    "geodesic": _length,
}
_INFO: Mapping[str, Callable[[Any, str], Any]] = {
    "ideal_primitives": integer,
    "radius": positive,
    "goal_image": text,
    "best_position": point,
}
"""Fields that tasks compute with."""
