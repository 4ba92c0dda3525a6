# SPDX-License-Identifier: Apache-2.0
"""A sheet of Image-Goal Navigation episodes: where each begins and ends, what the start sees, and the goal's view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wiw.datasets.cameras import camera_pose
from wiw.datasets.ways_on import CELL, find_ways_on, survey_view
from wiw.datasets.worlds import World
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.runs.scene_map import draw
from wiw.tasks.base import Task
from wiw.types import Episode
from wiw.viz.contact_sheet import CAPTION, GAP, HEIGHT, INK, PAPER

MOST_ROWS = 12
SEEN, GOAL = (255, 214, 60), (40, 170, 70)
WAYS = ((220, 70, 60), (60, 110, 220), (160, 80, 200), (20, 160, 170), (230, 140, 30))
"""Colours of floor in view, of the goal, and of the ways on."""


def draw_episodes(task: Task, episodes: Sequence[Episode]) -> Image.Image:
    """Draw a row per episode: its scene from above, the panorama of the start, the view of the goal.

    Yellow floor is in view of the start. Other colours are the ways on from there, each with a dot where it begins;
    the line is the shortest path to the goal.

    Args:
        task: of which they are, with scenes (`Task.open_world`).
        episodes: to draw.
    """
    rows = [_draw_row(task.open_world(episode), episode) for episode in episodes]
    sheet = Image.new("RGB", (max(row.width for row in rows), GAP + sum(row.height + GAP for row in rows)), PAPER)
    top = GAP
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height + GAP
    return sheet


def save_sheet(task: Task, episodes: Sequence[Episode], path: Path) -> Path:
    """Draw up to `MOST_ROWS` of the episodes, spread evenly over them, into a PNG file, and return its path.

    Raises:
        ArgumentError: the task has no scenes or no goals in them.
        FileError: the file cannot be written.
    """
    if task.name != "imagenav":
        raise ArgumentError(f"--sheet draws starts and goals of imagenav only, not episodes of task '{task.name}'")
    chosen = sorted({round(i) for i in np.linspace(0, len(episodes) - 1, min(MOST_ROWS, len(episodes)))})
    drawn = draw_episodes(task, [episodes[i] for i in chosen])
    with atomic_file(path) as draft:
        drawn.save(draft, "PNG")
    return path


def _draw_row(world: Any, episode: Episode) -> Image.Image:
    start, goal = (np.asarray(place, np.float64) for place in (episode.start_position, episode.goal_position))
    looks = camera_pose(start, episode.start_yaw)[None], camera_pose(goal, episode.goal_yaw)[None]
    before = world.renderer.panorama(looks[0], (HEIGHT, 2 * HEIGHT), outputs=("color",))["color"][0]
    there = world.renderer.perspective(looks[1], (HEIGHT, HEIGHT), 90.0, outputs=("color",))["color"][0]
    pictures = [_draw_map(world, start, goal), Image.fromarray(before), Image.fromarray(there)]
    row = Image.new("RGB", (GAP + sum(p.width + GAP for p in pictures), CAPTION + HEIGHT), PAPER)
    caption = f"{episode.scene}  {episode.tier}  {episode.geodesic:.1f} m"
    ImageDraw.Draw(row).text((GAP, 2), caption, INK, ImageFont.load_default(16))
    left = GAP
    for picture in pictures:
        row.paste(picture, (left, CAPTION))
        left += picture.width + GAP
    return row


def _draw_map(world: World, start: NDArray[np.float64], goal: NDArray[np.float64]) -> Image.Image:
    """Return the scene from above with the floor in view, the ways on, and the shortest path."""
    image, to_pixel = draw(world.scene, world.navmesh, float(start[1]), world.backend)
    shown = Image.new("RGB", image.shape[1::-1], PAPER)
    shown.paste(Image.fromarray(image), mask=Image.fromarray(image[..., 3]))
    pen = ImageDraw.Draw(shown, "RGBA")
    view = survey_view(world, start)
    ways = find_ways_on(world, start, view)
    half = CELL / 2 * float(np.linalg.norm(to_pixel[:, 0]))
    painted = [(view.seen, SEEN), *((way.cells, WAYS[i % len(WAYS)]) for i, way in enumerate(ways))]
    for cells, color in painted:
        for u, v in _to_pixels(view.list_points(cells), to_pixel):
            pen.rectangle((u - half, v - half, u + half, v + half), (*color, 110))
    path = np.asarray(world.navmesh.shortest_path(start, goal), np.float64)
    pen.line([tuple(point) for point in _to_pixels(path, to_pixel)], INK, 5)
    marks = [(start, INK), (goal, GOAL), *((way.beginning, WAYS[i % len(WAYS)]) for i, way in enumerate(ways))]
    for place, color in marks:
        u, v = _to_pixels(place[None], to_pixel)[0]
        pen.ellipse((u - 11, v - 11, u + 11, v + 11), color, PAPER, 3)
    return shown.resize((round(shown.width * HEIGHT / shown.height), HEIGHT), Image.Resampling.LANCZOS)


def _to_pixels(points: NDArray[np.float64], to_pixel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where places on the floor [N, 3] lie in the map: float64 [N, 2]."""
    return np.stack([points[:, 0], points[:, 2], np.ones(len(points))], axis=1) @ to_pixel.T
