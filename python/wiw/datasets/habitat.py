# SPDX-License-Identifier: Apache-2.0
"""Episode files of others: Habitat's PointNav-v1 (also its ImageNav) and ObjectNav-v1, World-in-World's ImageNav.

Positions are metres, Y up, in all of them; the order of a quaternion is part of each format and never guessed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wiw._core import core
from wiw.datasets.fields import integer, length, name_of, number, point, positive, text
from wiw.errors import FileError
from wiw.types import Episode

Order = Literal["xyzw", "wxyz"]
PUBLISHED = "world-in-world"
"""Source of episodes that the paper's authors have published, as `Episode.info` names it."""
_UNREADABLE = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError)
"""Exceptions raised for an item of another shape."""


def yaw_of(quaternion: Sequence[float], order: Order, where: str) -> float:
    """Return the heading in radians, left positive, of a rotation about the vertical.

    Raises:
        FileError: not four numbers, not of unit length, or tilted by more than 5 degrees; names `where`.
    """
    values = np.asarray(quaternion, float)
    if values.shape != (4,) or not abs(np.linalg.norm(values) - 1) <= 1e-2:
        raise FileError(f"{where}: expected a unit quaternion in order {order}, got {quaternion!r:.80}")
    x, y, z, w = values if order == "xyzw" else np.roll(values, -1)
    if np.hypot(x, z) > np.sin(np.radians(2.5)):
        raise FileError(
            f"{where}: rotation {quaternion!r:.80} ({order}) is not about the vertical; is the order right?"
        )
    return float(2 * np.arctan2(y, w))


def is_habitat(body: Any) -> bool:
    """Return whether a parsed file has the layout of habitat-lab's navigation episodes."""
    return "start_rotation" in _first(body, "episodes")


def _first(body: Any, name: str) -> Mapping[str, Any]:
    """Return the first object of a list in a parsed file; an empty one if there is no such list."""
    items = body.get(name) if isinstance(body, Mapping) else None
    return items[0] if isinstance(items, list) and items and isinstance(items[0], Mapping) else {}


def read_habitat(body: Mapping[str, Any], path: str) -> list[Episode]:
    """Read episodes of habitat-lab (`start_rotation` in order xyzw); scenes are relative to its scene folder.

    Habitat derives an ImageNav goal's heading from a hash that differs between processes. Here it is the heading of
    `goals[0].rotation` where the file has one, else a function of the episode's id.

    An ObjectNav episode becomes an image goal: the view point that shows most of an object, which is that of its
    category with the view point nearest to the start. Other objects of the category do not count, and the shortest path
    is measured anew.
    """
    objects = body.get("goals_by_category")
    return [_habitat(item, objects, f"{path}: episode {i}") for i, item in enumerate(body["episodes"])]


def _habitat(item: Mapping[str, Any], objects: Any, where: str) -> Episode:
    try:
        goal, found = (item["goals"][0], {}) if item["goals"] else _find_view_point(item, objects)
        name = name_of(item["episode_id"], "episode_id")
        rotation = goal.get("rotation")
        yaw = yaw_of(rotation, "xyzw", where) if rotation is not None else heading_of(name)
        return Episode(
            episode_id=name,
            scene=text(item["scene_id"], "scene_id").removeprefix("data/scene_datasets/"),
            start_position=point(item["start_position"], "start_position"),
            start_yaw=yaw_of(item["start_rotation"], "xyzw", where),
            goal_position=point(goal["position"], "goals[0].position"),
            goal_yaw=yaw,
            geodesic=float("nan") if found else _read_geodesic(item),
            info={"source": "habitat", "goal_heading": "file" if rotation is not None else "episode id", **found},
        )
    except _UNREADABLE as error:
        raise FileError(
            f"{where}: not a navigation episode of habitat-lab ({type(error).__name__}: {error})"
        ) from error


def _read_geodesic(item: Mapping[str, Any]) -> float:
    """Return the length of an episode's shortest path; NaN where habitat-lab has left it, or all of `info`, out."""
    given = (item.get("info") or {}).get("geodesic_distance")
    return float("nan") if given is None else length(given, "info.geodesic_distance")


def _find_view_point(item: Mapping[str, Any], objects: Any) -> tuple[Mapping[str, Any], dict[str, str]]:
    """Return the position and rotation from which an ObjectNav episode's object is seen best, and what object it is."""
    category = text(item["object_category"], "object_category")
    start = np.array(point(item["start_position"], "start_position"))
    goals = [goal for goal in objects[f"{Path(item['scene_id']).name}_{category}"] if goal["view_points"]]
    places = [[point(view["agent_state"]["position"], "position") for view in goal["view_points"]] for goal in goals]
    nearest = int(np.argmin([np.linalg.norm(np.array(own) - start, axis=1).min() for own in places]))
    best = max(goals[nearest]["view_points"], key=lambda view: number(view["iou"], "iou"))
    state = {"position": best["agent_state"]["position"], "rotation": best["agent_state"]["rotation"]}
    return state, {"category": category, "object": name_of(goals[nearest]["object_id"], "object_id")}


def is_world_in_world(body: Any) -> bool:
    """Return whether a parsed file has the layout of World-in-World's published ImageNav episodes."""
    return "goal_image_relpath" in _first(body, "data")


def read_world_in_world(body: Mapping[str, Any], path: str) -> list[Episode]:
    """Episodes of the published ImageNav file (quaternions in order wxyz); scenes are relative to its scene folder.

    Each brings the radius of its goal and the number of primitives that its SPL is measured against, and the picture of
    its goal where that lies beside the file.
    """
    folder = Path(path).parent
    return [_world_in_world(item, f"{path}: item {i}", folder) for i, item in enumerate(body["data"])]


def _world_in_world(item: Mapping[str, Any], where: str, folder: Path) -> Episode:
    try:
        steps = item.get("step_to_goal")
        picture = _find_picture(folder, text(item["goal_image_relpath"], "goal_image_relpath"))
        return Episode(
            episode_id=name_of(item["episode_id"], "episode_id"),
            scene=text(item["scene_relpath"], "scene_relpath"),
            start_position=point(item["start_position"], "start_position"),
            start_yaw=yaw_of(item["start_rotation"], "wxyz", where),
            goal_position=point(item["goal_position"], "goal_position"),
            goal_yaw=yaw_of(item["goal_rotation"], "wxyz", where),
            geodesic=float("nan"),
            info={
                "source": PUBLISHED,
                "radius": positive(item["goal_radius"], "goal_radius"),
                **({} if steps is None else {"ideal_primitives": integer(steps, "step_to_goal")}),
                **({} if picture is None else {"goal_image": picture}),
            },
        )
    except _UNREADABLE as error:
        raise FileError(f"{where}: not a World-in-World ImageNav item ({type(error).__name__}: {error})") from error


def _find_picture(folder: Path, relative: str) -> str | None:
    """Return the whole path of a picture within a folder; None if it does not exist."""
    path = (folder / relative).resolve()
    return str(path) if path.is_relative_to(folder.resolve()) and path.is_file() else None


def is_active_recognition(body: Any) -> bool:
    """Return whether a parsed file has the layout of World-in-World's published Active Recognition episodes."""
    return "target_id" in _first(body, "episodes")


def read_active_recognition(body: Mapping[str, Any], path: str) -> list[Episode]:
    """Read episodes of the published AR file (`start_rotation` in order wxyz, the category's key misspelt).

    Scene paths are those of the authors' disk, so that only folder and file name are kept, relative to the scene
    folder. The place of a target is known by its instance alone; until the scene is open, the goal's position is NaN.
    """
    return [_active_recognition(item, f"{path}: episode {i}") for i, item in enumerate(body["episodes"])]


def _active_recognition(item: Mapping[str, Any], where: str) -> Episode:
    try:
        return Episode(
            episode_id=name_of(item["episode_id"], "episode_id"),
            scene="/".join(text(item["scene_id"], "scene_id").split("/")[-2:]),
            start_position=point(item["start_position"], "start_position"),
            start_yaw=yaw_of(item["start_rotation"], "wxyz", where),
            goal_position=(float("nan"),) * 3,
            goal_yaw=0.0,
            geodesic=float("nan"),
            info={
                "source": PUBLISHED,
                "target": integer(item["target_id"], "target_id"),
                "category": text(item["target_categrory"], "target_categrory"),
                "difficulty": integer(item["difficulty"], "difficulty"),
            },
        )
    except _UNREADABLE as error:
        raise FileError(
            f"{where}: not a World-in-World Active Recognition episode ({type(error).__name__}: {error})"
        ) from error


def heading_of(name: str) -> float:
    """Derive a heading in [0, 2 pi) from an episode's id, the same on every machine and in every process."""
    return float(2 * np.pi * core.uniform(core.fold_key(list(name.encode())), 1)[0])
