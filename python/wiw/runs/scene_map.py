# SPDX-License-Identifier: Apache-2.0
"""Scene maps for the report: pictures from high above, without the roof, kept in the run store.

The store keeps the picture and where world points lie in it, so that a report needs no scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.runs.pictures import choose_pictured_episodes
from wiw.runs.store import RunStore
from wiw.tasks.base import Task

HFOV_DEG = 15.0
"""So narrow that walls lean outward by little: 0.3 m at the edge of a 15 m wide scene."""
LONG_SIDE = 1100
"""Pixels."""
MARGIN = 0.4
"""Metres around the scene."""
OVERHEAD = 1.8
"""Metres; what hangs wholly above this height, such as ceilings and lamps, is taken away."""
FLOOR_COLOR, BACKGROUND = (236, 233, 226), (0, 0, 0, 0)


@dataclass(frozen=True)
class View:
    """The camera: where it is and how its pixels map to the floor."""

    T_world_camera: NDArray[np.float64]
    size: tuple[int, int]
    """Height, width."""
    world_to_pixel: NDArray[np.float64]
    """float64 [2, 3]: pixel (u, v) = A [x, z, 1] for points on the floor."""


def draw_scene_maps(store: RunStore, task: Task) -> None:
    """Draw the scenes of the episodes that have pictures, where the task has scenes to draw."""
    episodes = store.episodes()
    for index in choose_pictured_episodes(store):
        episode = episodes[index]
        if store.scene_map(episode.scene) is None:
            place = task.open_world(episode)
            if place is None:
                continue
            image, matrix = draw(place.scene, place.navmesh, episode.start_position[1], place.backend)
            store.write_scene_map(episode.scene, _encode(image), matrix)


def draw(
    scene: Any, navmesh: Any, floor: float, backend: Any = "auto"
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return a scene from above.

    Args:
        scene: a `wiw.scenes.Scene`.
        navmesh: its `wiw.nav.NavMesh`; drawn instead where a roof that cannot be taken off hides the floor.
        floor: height of the floor in metres.
        backend: of the renderer.

    Returns:
        uint8 [H, W, 4] RGBA, transparent outside, and the float64 [2, 3] matrix from world (x, z) to pixels.
    """
    from wiw.render import Renderer

    view = look_down(np.asarray(scene.bounds, np.float64), floor)
    renderer = Renderer(scene, backend=backend, samples=4)
    hidden = [item for item in scene.instances if item["bounds"][0][1] > floor + OVERHEAD]
    if hidden:
        renderer.set_poses([item["id"] for item in hidden], np.stack([_lift(item) for item in hidden]))
    seen = renderer.perspective(view.T_world_camera[None], view.size, HFOV_DEG)
    triangles, _ = navmesh.triangles()
    if _has_roof(seen["depth"][0], triangles, view, floor):
        return _flat(triangles, view), view.world_to_pixel
    opaque = np.where(seen["instance"][0] > 0, 255, 0).astype(np.uint8)
    return np.dstack([seen["color"][0], opaque]), view.world_to_pixel


def look_down(bounds: NDArray[np.float64], floor: float) -> View:
    """Return the camera over the middle of `bounds` [2, 3], with -Z up in the picture."""
    low, high = bounds[0] - MARGIN, bounds[1] + MARGIN
    width, depth = high[0] - low[0], high[2] - low[2]
    scale = LONG_SIDE / max(width, depth)
    size = (max(1, round(depth * scale)), max(1, round(width * scale)))
    above = (size[1] / scale) / 2 / np.tan(np.deg2rad(HFOV_DEG) / 2)
    center = (low + high) / 2
    pose = np.array([[1, 0, 0, center[0]], [0, 0, 1, floor + above], [0, -1, 0, center[2]], [0, 0, 0, 1.0]])
    matrix = np.array([[scale, 0, size[1] / 2 - scale * center[0]], [0, scale, size[0] / 2 - scale * center[2]]])
    return View(pose, size, matrix)


def to_pixels(world_to_pixel: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Return the pixels [N, 2] of world points [N, 3]."""
    matrix, positions = np.asarray(world_to_pixel, np.float64), np.asarray(points, np.float64)
    pixels: NDArray[np.float64] = positions[:, [0, 2]] @ matrix[:, :2].T + matrix[:, 2]
    return pixels


def _lift(item: dict[str, Any]) -> NDArray[np.float64]:
    """Return the instance's pose high above, behind the camera."""
    pose = np.array(item["T_world_instance"], np.float64)
    pose[1, 3] += 1e4
    return pose


def _has_roof(depth: NDArray[np.float32], triangles: NDArray[np.float32], view: View, floor: float) -> bool:
    """Return whether something higher than a person hides most walkable places on this floor from above."""
    centers = triangles.mean(1)
    centers = centers[np.abs(centers[:, 1] - floor) < 1]
    if len(centers) == 0:
        return True
    u, v = np.floor(to_pixels(view.world_to_pixel, centers)).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < view.size[1]) & (v < view.size[0])
    above = view.T_world_camera[1, 3] - depth[v[inside], u[inside]]
    return bool(np.mean(above > floor + OVERHEAD) > 0.5)


def _flat(triangles: NDArray[np.float32], view: View) -> NDArray[np.uint8]:
    """Draw the walkable area as a plain shape."""
    image = np.full((*view.size, 4), BACKGROUND, np.uint8)
    corners = to_pixels(view.world_to_pixel, triangles.reshape(-1, 3)).reshape(-1, 3, 2)
    cv2.fillPoly(image, list(np.round(corners).astype(np.int32)), (*FLOOR_COLOR, 255))
    return image


def _encode(image: NDArray[np.uint8]) -> bytes:
    """Return WebP bytes of an RGBA image."""
    _, data = cv2.imencode(".webp", cv2.cvtColor(image, cv2.COLOR_RGBA2BGRA), [cv2.IMWRITE_WEBP_QUALITY, 80])
    return bytes(data)
