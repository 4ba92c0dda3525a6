# SPDX-License-Identifier: Apache-2.0
"""Pictures of what an explorer believes: its map, and the things of its map marked in what it sees."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from wiw.action import to_trajectory
from wiw.mapping.drawing import FREE, INK, Color, DrawnThing, Plan, draw_map
from wiw.mapping.fragments import find_packable, pack_voxels
from wiw.mapping.landmarks import LEAST_SHARE, Landmark
from wiw.mapping.marks import draw_marks
from wiw.mapping.object_map import MapObject
from wiw.mapping.views import VIEW_NAMES, Views, cut_views, unproject
from wiw.policies.base import Situation
from wiw.types import Decision

OVERHEAD = 1.8
"""Metres above the floor from which on a thing hangs above the agent."""
VIEW_SIZE = (192, 224)
"""(H, W) of the views that are labelled, and in which things are found again."""
SHOWN_SIZE = (288, 336)
"""(H, W) of the views that are drawn."""
LINE = 15
"""Pixels of a line of names below a view."""
RGB: Mapping[str, Color] = {
    "white": (246, 246, 242), "grey": (150, 150, 150), "black": (52, 52, 54), "brown": (139, 98, 62),
    "beige": (222, 203, 170), "red": (200, 62, 54), "orange": (236, 140, 60), "yellow": (240, 208, 84),
    "green": (98, 158, 92), "turquoise": (84, 190, 186), "blue": (80, 126, 200), "purple": (146, 98, 176),
    "pink": (236, 158, 186),
}  # fmt: skip
NO_COLOR: Color = (204, 200, 214)
"""Fill of things whose colour is not known."""


def draw_beliefs(memory: Any, situation: Situation, decision: Decision, north: float) -> dict[str, NDArray[np.uint8]]:
    """Return the map of an explorer's memory, and its views with the things that it believes to see.

    `north` is the azimuth, in the frame of the start, of what is up on the map.
    """
    pose = memory.pose
    things = memory.home.objects.values()
    focus = frozenset(thing.id for thing in memory.belief.things)
    rooms = {
        number: f"{name} ({100 * max(memory.home.room_kinds[name].values()):.0f} %)"
        for number, name in memory.home.room_names.items()
    }
    plans = [
        Plan(_follow(pose, plan.actions), chosen=index == decision.chosen)
        for index, plan in enumerate(decision.proposals)
    ]
    drawn = [_make_drawn(thing, thing.id in focus) for thing in things]
    return {
        "map": draw_map(memory.grid, drawn, pose, up=north - memory.azimuth, rooms=rooms, plans=plans),
        "views": _draw_views(situation, pose, list(things), focus),
    }


def _make_drawn(thing: MapObject, focus: bool) -> DrawnThing:
    low = float(thing.bounds[0, 2])
    return DrawnThing(thing.points, describe(thing), RGB.get(thing.color, NO_COLOR), low > OVERHEAD, focus)


def describe(thing: MapObject) -> str:
    """Return e.g. "lamp, white, on"."""
    return ", ".join(filter(None, (thing.category, thing.color, thing.state)))


def _follow(pose: NDArray[np.float64], actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the places that primitives lead past if no step is refused, float64 [K + 1, 2]."""
    ahead = np.concatenate([np.zeros((1, 2)), to_trajectory(actions)[:, :2]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(pose[:2] + ahead @ np.array([[cos, sin], [-sin, cos]]))


def _draw_views(
    situation: Situation, pose: NDArray[np.float64], things: Sequence[MapObject], focus: Collection[int]
) -> NDArray[np.uint8]:
    """Return front and back above left and right, with the things of the map outlined, numbered and named."""
    observation = situation.observation
    views = cut_views(observation.panorama, observation.depth, pose, VIEW_SIZE)
    owners = _find_owners(views, things)
    marks = _find_marks(owners, things)
    shown = cut_views(observation.panorama, observation.depth, pose, SHOWN_SIZE)
    marked = draw_marks(shown.images, marks, asked=focus)
    names = {thing.id: describe(thing) for thing in things}
    tiles = []
    for view, title in enumerate(VIEW_NAMES):
        legend = [f"{number} {names[marked.landmarks[number].id]}" for number in marked.names[view]]
        tiles.append(_caption(marked.images[view], title, _wrap(legend)))
    front, left, right, back = tiles
    return np.concatenate([_join(front, back), _join(left, right)])


def _find_owners(views: Views, things: Sequence[MapObject]) -> NDArray[np.int32]:
    """Return the id of the thing in whose voxels each pixel lies, int32 [4, H, W]; 0 where it lies in none."""
    owners = np.zeros(views.depth.shape, np.int32)
    if not things:
        return owners
    where = np.nonzero(find_packable(views))
    keys = np.concatenate([thing.voxels for thing in things])
    ids = np.concatenate([np.full(len(thing.voxels), thing.id, np.int32) for thing in things])
    order = np.argsort(keys, kind="stable")
    found = pack_voxels(unproject(views, *where))
    place = np.minimum(np.searchsorted(keys[order], found), len(keys) - 1)
    owners[where] = np.where(keys[order][place] == found, ids[order][place], 0)
    return owners


def _find_marks(owners: NDArray[np.int32], things: Sequence[MapObject]) -> list[Landmark]:
    """Return the things that fill enough of a view to be marked in it, with their pixels at the size of shown views."""
    least = LEAST_SHARE * owners[0].size
    marks = []
    for thing in things:
        masks = {}
        for view in range(len(owners)):
            mask = cv2.morphologyEx((owners[view] == thing.id).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3)))
            if int(mask.sum()) >= least:
                masks[view] = cv2.resize(mask, SHOWN_SIZE[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)
        if masks:
            marks.append(Landmark(thing.id, thing.category, thing.center, masks, 0.0))
    return marks


def _wrap(names: Sequence[str]) -> list[str]:
    """Return names as lines that fit below a view."""
    font, lines = ImageFont.load_default(12), [""]
    for name in names:
        longer = f"{lines[-1]}   {name}" if lines[-1] else name
        if lines[-1] and font.getlength(longer) > SHOWN_SIZE[1] - 8:
            lines.append(name)
        else:
            lines[-1] = longer
    return lines


def _caption(image: NDArray[np.uint8], title: str, lines: Sequence[str]) -> NDArray[np.uint8]:
    canvas = Image.new("RGB", (image.shape[1], image.shape[0] + LINE * len(lines) + 8), FREE)
    canvas.paste(Image.fromarray(image))
    draw = ImageDraw.Draw(canvas)
    draw.text((6, 4), title, INK, ImageFont.load_default(13), stroke_width=2, stroke_fill=FREE)
    for number, line in enumerate(lines):
        draw.text((4, image.shape[0] + 3 + LINE * number), line, INK, ImageFont.load_default(12))
    return np.asarray(canvas)


def _join(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return two pictures of one width side by side, the lower one extended in white."""
    height = max(len(one), len(other))
    gap = np.full((height, 6, 3), 255, np.uint8)
    padded = [np.pad(each, ((0, height - len(each)), (0, 0), (0, 0)), constant_values=255) for each in (one, other)]
    return np.concatenate([padded[0], gap, padded[1]], axis=1)
