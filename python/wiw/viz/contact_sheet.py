# SPDX-License-Identifier: Apache-2.0
"""A sheet of scenes: each from above, and panoramas from inside."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wiw.runs.scene_map import draw

HEIGHT, GAP, CAPTION = 288, 12, 26
"""Pixels: of a picture, between pictures, above a row."""
PAPER, INK = (250, 249, 246), (40, 40, 38)
CAMERA_HEIGHT = 1.0


def short_name(scene: str) -> str:
    """Return a scene's name without its folders; specs such as "apartments:val/3" as they are."""
    return Path(scene).name if Path(scene).suffix else scene


def contact_sheet(worlds: Sequence[Any], views: int = 2, backend: str = "auto") -> Image.Image:
    """Draw one row per scene: seen from above, then `views` panoramas from places far apart.

    Args:
        worlds: loaded scenes with "name", "scene", "renderer", "navmesh" and "ground".
        views: panoramas of each.
        backend: of the renderer that draws from above.
    """
    rows = [_row(world, views, backend) for world in worlds]
    width = max(row.width for row in rows) + 2 * GAP
    sheet = Image.new("RGB", (width, GAP + sum(row.height + GAP for row in rows)), PAPER)
    top = GAP
    for row in rows:
        sheet.paste(row, (GAP, top))
        top += row.height + GAP
    return sheet


def _row(world: Any, views: int, backend: str) -> Image.Image:
    places = _spread_places(world, views)
    pictures = [_from_above(world, float(places[0][1]), backend)]
    pictures += [_panorama(world, place) for place in places[:views]]
    row = Image.new("RGB", (sum(p.width + GAP for p in pictures) - GAP, CAPTION + HEIGHT), PAPER)
    ImageDraw.Draw(row).text((0, 2), short_name(world.name), INK, ImageFont.load_default(16))
    left = 0
    for picture in pictures:
        row.paste(picture, (left, CAPTION))
        left += picture.width + GAP
    return row


def _spread_places(world: Any, count: int) -> NDArray[np.float64]:
    """Return places on the largest floor, at least one: the first amid the others, each next one as far from those
    before as can be.
    """
    points = np.asarray(world.ground.put_down(world.navmesh.sample(256, 1, world.floor)), np.float64)
    chosen = [int(np.argmin(np.linalg.norm(points - np.median(points, axis=0), axis=1)))]
    while len(chosen) < max(1, count):
        nearest = np.min([np.linalg.norm(points - points[i], axis=1) for i in chosen], axis=0)
        chosen.append(int(np.argmax(nearest)))
    return points[chosen][: max(1, count)]


def _from_above(world: Any, floor: float, backend: str) -> Image.Image:
    image, _ = draw(world.scene, world.navmesh, floor, backend)
    picture = Image.fromarray(image)
    paper = Image.new("RGB", picture.size, PAPER)
    paper.paste(picture, mask=picture.getchannel("A"))
    return paper.resize((round(paper.width * HEIGHT / paper.height), HEIGHT), Image.Resampling.LANCZOS)


def _panorama(world: Any, place: NDArray[np.float64]) -> Image.Image:
    pose = np.eye(4)
    pose[:3, 3] = place + np.array([0, CAMERA_HEIGHT, 0])
    return Image.fromarray(
        world.renderer.panorama(pose[None], (HEIGHT, HEIGHT * 16 // 9), outputs=("color",))["color"][0]
    )
