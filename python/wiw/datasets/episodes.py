# SPDX-License-Identifier: Apache-2.0
"""Episode files: JSON, one object an episode, with the goal's full pose so that goal images can be made again."""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from wiw.datasets import habitat
from wiw.errors import FileError
from wiw.scenes import absolute, is_generated
from wiw.types import Episode

VERSION = 1


def save(path: str | Path, episodes: Sequence[Episode], task: str, **about: Any) -> None:
    """Write an episode file, gzipped if its name ends in .gz; `about` (generator, seed, ...) goes into its header."""
    folder = Path(path).absolute().parent
    items = [_item(episode, folder) for episode in episodes]
    body = {"format": "wiw-episodes", "version": VERSION, "task": task, **about, "episodes": items}
    text = json.dumps(body, indent=1, allow_nan=False).encode()
    Path(path).write_bytes(gzip.compress(text, mtime=0) if str(path).endswith(".gz") else text)


def _item(episode: Episode, folder: Path) -> dict[str, Any]:
    """Return an episode as JSON; the scene's path relative to the file's folder where it lies in there."""
    scene = Path(episode.scene)
    name = str(scene.relative_to(folder)) if scene.is_relative_to(folder) else episode.scene
    geodesic = episode.geodesic if math.isfinite(episode.geodesic) else None
    return {**asdict(episode), "scene": name, "geodesic": geodesic}


def load(path: str | Path, scenes: str | Path = "") -> list[Episode]:
    """Read an episode file: one that `save` wrote, habitat-lab's navigation episodes, or World-in-World's.

    `scenes` is the folder that scene paths are relative to; if not given, the folder of a file that `save` wrote, and
    the present one for the other formats. Lengths that a file does not give are NaN until the task has measured them.

    Raises:
        FileError: missing, not JSON, of another format or version, or an episode lacks a field; names the file.
    """
    body = read_json(path)
    own = isinstance(body, Mapping) and body.get("format") == "wiw-episodes"
    folder = Path(scenes) if scenes or not own else Path(path).parent
    read = _own(body, path) if own else _foreign(body, path)
    return [replace(e, scene=absolute(e.scene if is_generated(e.scene) else folder / e.scene)) for e in read]


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
    return [_episode(item, f"{path}: episode {i}") for i, item in enumerate(body.get("episodes", []))]


def read_json(path: str | Path) -> Any:
    """Return the parsed file, gunzipped when its name ends in .gz.

    Raises:
        FileError: it cannot be read or parsed; names file and cause.
    """
    try:
        raw = Path(path).read_bytes()
        return json.loads(gzip.decompress(raw) if str(path).endswith(".gz") else raw)
    except (OSError, EOFError, ValueError) as error:
        raise FileError(f"{path}: {error}") from error


def _episode(item: Any, where: str) -> Episode:
    names = [f.name for f in fields(Episode)]
    missing = [name for name in names if name != "info" and (not isinstance(item, Mapping) or name not in item)]
    if missing:
        raise FileError(f"{where} lacks {', '.join(missing)}")
    values = {name: item[name] for name in names if name in item}
    for name in ("start_position", "goal_position"):
        point = values[name]
        if not isinstance(point, Sequence) or len(point) != 3:
            raise FileError(f"{where}: {name} must be [x, y, z] in metres, got {point!r}")
        values[name] = tuple(float(x) for x in point)
    if values["geodesic"] is None:
        values["geodesic"] = math.nan
    return Episode(**values)
