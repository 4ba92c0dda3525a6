# SPDX-License-Identifier: Apache-2.0
"""A picture of an agent's map: floor, walls, rooms, things, where the agent has been and where its plans lead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from wiw.mapping.occupancy import CELL, OccupancyGrid

PIXELS_PER_METRE = 60.0
LONGEST_SIDE = 1000
"""Pixels at most; larger places are drawn smaller."""
MARGIN = 0.3
"""Metres around what is known."""
NARROWEST = 460
"""Pixels of width at least, for the legend."""
LEGEND_HEIGHT = 44

Color = tuple[int, int, int]
UNKNOWN: Color = (222, 219, 212)
FREE: Color = (255, 255, 255)
OCCUPIED: Color = (172, 168, 160)
WALL: Color = (74, 72, 70)
LINTEL: Color = (205, 201, 194)
INK: Color = (34, 36, 42)
PATH: Color = (38, 98, 196)
PLAN: Color = (228, 108, 10)
OTHER_PLAN: Color = (236, 176, 120)
FOCUS: Color = (214, 26, 66)
FRONTIER: Color = (0, 150, 136)
ROOM_TINTS: tuple[Color, ...] = (
    (232, 241, 252), (252, 240, 226), (231, 246, 231), (249, 233, 243), (250, 248, 222), (232, 230, 248),
    (224, 245, 245), (245, 235, 228),
)  # fmt: skip


@dataclass(frozen=True)
class DrawnThing:
    """A thing on the map."""

    points: NDArray[np.float64]
    """float64 [N, 2 or 3] in the frame of the start; what they enclose on the floor is filled."""
    label: str
    color: Color
    overhead: bool = False
    """Whether it hangs above the agent: only its outline is drawn."""
    focus: bool = False
    """Whether it is what the agent's belief rests on: it is ringed, and its label comes first."""


@dataclass(frozen=True)
class Plan:
    """Places that a plan leads through."""

    points: NDArray[np.float64]
    """float64 [K + 1, 2] in the frame of the start."""
    chosen: bool = False


@dataclass(frozen=True)
class _Frame:
    """Map from the frame of the start to pixels of the picture."""

    scale: float
    right: NDArray[np.float64]
    up: NDArray[np.float64]
    left_edge: float
    top_edge: float
    size: tuple[int, int]
    """Height, width."""

    def to_pixels(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return pixels (x, y) float64 [N, 2] of points [N, 2 or 3]."""
        flat = np.asarray(points, np.float64).reshape(-1, np.shape(points)[-1])[:, :2]
        return np.stack([flat @ self.right - self.left_edge, self.top_edge - flat @ self.up], axis=1) * self.scale

    def to_points(self) -> NDArray[np.float64]:
        """Return the point of each pixel's middle, float64 [H * W, 2]."""
        rows, columns = np.mgrid[: self.size[0], : self.size[1]]
        across = (columns.ravel() + 0.5) / self.scale + self.left_edge
        along = self.top_edge - (rows.ravel() + 0.5) / self.scale
        return np.asarray(across[:, None] * self.right + along[:, None] * self.up)


def draw_map(
    grid: OccupancyGrid,
    things: Sequence[DrawnThing],
    pose: NDArray[np.float64],
    *,
    up: float = 0.0,
    rooms: Mapping[int, str] | None = None,
    plans: Sequence[Plan] = (),
) -> NDArray[np.uint8]:
    """Return a picture of a map, uint8 [H, W, 3].

    Args:
        grid: what is known of the floor; the agent's places are its `visits`.
        things: what stands there. Labels that would overlap others are left out.
        pose: x, y, azimuth of the agent.
        up: azimuth, in the frame of the start, of what is up in the picture.
        rooms: names of rooms by their number in the grid.
        plans: where they lead from here.
    """
    frame = _place_frame(grid, pose, up)
    image = _paint_floor(grid, frame)
    _draw_openings(image, grid, frame)
    for thing in sorted(things, key=lambda each: (each.overhead, -_measure_footprint(each))):
        _draw_thing(image, thing, frame)
    _draw_ways(image, grid, pose, plans, frame)
    canvas = Image.fromarray(image)
    _write_labels(canvas, grid, things, rooms or {}, frame)
    return np.asarray(_add_legend(canvas))


def _place_frame(grid: OccupancyGrid, pose: NDArray[np.float64], up: float) -> _Frame:
    above = np.array([np.cos(up), np.sin(up)])
    right = np.array([np.sin(up), -np.cos(up)])
    cells = grid.to_points(np.argwhere(grid.known))
    points = np.concatenate([cells, np.asarray(pose, np.float64)[None, :2]])
    across, along = points @ right, points @ above
    width, height = np.ptp(across) + 2 * MARGIN, np.ptp(along) + 2 * MARGIN
    scale = min(PIXELS_PER_METRE, LONGEST_SIDE / max(width, height))
    size = (round(height * scale), max(NARROWEST, round(width * scale)))
    left = float(across.min() + across.max()) / 2 - size[1] / scale / 2
    return _Frame(scale, right, above, left, float(along.max()) + MARGIN, size)


def _paint_floor(grid: OccupancyGrid, frame: _Frame) -> NDArray[np.uint8]:
    """Return floor, obstacles and walls; between the middles of cells their colours fade into each other."""
    colors = np.full((*grid.free.shape, 3), UNKNOWN, np.uint8)
    tints = np.array([FREE, *ROOM_TINTS], np.uint8)
    rooms = grid.rooms
    tinted = tints[np.where(rooms > 0, (rooms - 1) % len(ROOM_TINTS) + 1, 0)]
    colors[grid.free] = tinted[grid.free]
    colors[grid.free & grid.wall_cells] = LINTEL
    colors[grid.occupied] = OCCUPIED
    colors[grid.wall_cells & ~(grid.free & ~grid.occupied)] = WALL
    cells = (frame.to_points() / CELL - np.array(grid.origin) - 0.5).astype(np.float32)
    rows, columns = (cells[:, axis].reshape(frame.size) for axis in (0, 1))
    image = cv2.remap(colors, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=UNKNOWN)
    return np.asarray(image, np.uint8)


def _draw_openings(image: NDArray[np.uint8], grid: OccupancyGrid, frame: _Frame) -> None:
    for opening in grid.openings:
        ends = _round(frame.to_pixels(opening.edges))
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), PATH, 2, cv2.LINE_AA)
    for frontier in grid.frontiers:
        (middle,) = _round(frame.to_pixels(frontier.position[None]))
        cv2.drawMarker(image, middle.tolist(), FRONTIER, cv2.MARKER_DIAMOND, 11, 2, cv2.LINE_AA)


def _draw_thing(image: NDArray[np.uint8], thing: DrawnThing, frame: _Frame) -> None:
    hull = cv2.convexHull(_round(frame.to_pixels(thing.points)).astype(np.int32))
    if not thing.overhead:
        cv2.fillConvexPoly(image, hull, thing.color, cv2.LINE_AA)
    cv2.polylines(image, [hull], True, FOCUS if thing.focus else INK, 3 if thing.focus else 1, cv2.LINE_AA)


def _draw_ways(
    image: NDArray[np.uint8],
    grid: OccupancyGrid,
    pose: NDArray[np.float64],
    plans: Sequence[Plan],
    frame: _Frame,
) -> None:
    """Draw where the agent has been, where plans lead, and the agent."""
    visits = _round(frame.to_pixels(np.array([*grid.visits, pose[:2]])))
    cv2.polylines(image, [visits], False, PATH, 2, cv2.LINE_AA)
    for x, y in visits[:-1].tolist():
        cv2.circle(image, (x, y), 3, PATH, -1, cv2.LINE_AA)
    for plan in sorted(plans, key=lambda each: each.chosen):
        way = _round(frame.to_pixels(plan.points))
        cv2.polylines(image, [way], False, PLAN if plan.chosen else OTHER_PLAN, 3, cv2.LINE_AA)
        cv2.circle(image, way[-1].tolist(), 4, PLAN if plan.chosen else OTHER_PLAN, -1, cv2.LINE_AA)
    heading = np.array([[0.26, 0.0], [-0.16, 0.15], [-0.08, 0.0], [-0.16, -0.15]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    body = pose[:2] + heading @ np.array([[cos, sin], [-sin, cos]])
    arrow = _round(frame.to_pixels(body))
    cv2.fillPoly(image, [arrow], PATH, cv2.LINE_AA)
    cv2.polylines(image, [arrow], True, FREE, 2, cv2.LINE_AA)


def _write_labels(
    canvas: Image.Image,
    grid: OccupancyGrid,
    things: Sequence[DrawnThing],
    rooms: Mapping[int, str],
    frame: _Frame,
) -> None:
    """Write the names of what matters most, each where nothing is written yet."""
    draw, taken = ImageDraw.Draw(canvas), list[tuple[float, float, float, float]]()
    ordered = sorted(things, key=lambda each: (not each.focus, -_measure_footprint(each)))
    for thing in [each for each in ordered if each.focus]:
        _write(draw, thing.label, _find_middle(thing, frame), 13, FOCUS, taken, frame)
    for number, name in sorted(rooms.items()):
        cells = np.argwhere(grid.rooms == number)
        if len(cells):
            middle = cells[np.square(cells - cells.mean(axis=0)).sum(axis=1).argmin()]
            (place,) = frame.to_pixels(grid.to_points(middle)[None])
            _write(draw, name, place, 15, (74, 70, 120), taken, frame)
    for thing in [each for each in ordered if not each.focus]:
        _write(draw, thing.label, _find_middle(thing, frame), 12, INK, taken, frame)


def _write(
    draw: ImageDraw.ImageDraw,
    text: str,
    place: NDArray[np.float64],
    size: int,
    color: Color,
    taken: list[tuple[float, float, float, float]],
    frame: _Frame,
) -> None:
    """Write a text around a place where it fits, if it fits anywhere."""
    if not text:
        return
    font = ImageFont.load_default(size)
    left, top, right, bottom = draw.textbbox((0, 0), text, font=font)
    width, height = right - left + 4, bottom - top + 4
    for shift_x, shift_y in ((0, 0), (0, -1), (0, 1), (0.6, 0), (-0.6, 0), (0.6, 1), (-0.6, 1), (0.6, -1), (-0.6, -1)):
        x = float(np.clip(place[0] - width / 2 + shift_x * width, 0, max(0, frame.size[1] - width)))
        y = float(np.clip(place[1] - height / 2 + shift_y * height, 0, max(0, frame.size[0] - height)))
        box = (x, y, x + width, y + height)
        if not any(_overlap(box, other) for other in taken):
            taken.append(box)
            draw.text((x + 2 - left, y + 2 - top), text, color, font, stroke_width=2, stroke_fill=FREE)
            return


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _add_legend(canvas: Image.Image) -> Image.Image:
    """Return the picture with what its colours mean below it."""
    entries: Sequence[tuple[Color, str]] = (
        (UNKNOWN, "unknown"), (WALL, "wall"), (OCCUPIED, "obstacle"), (PATH, "agent, path, doorway"),
        (PLAN, "plan"), (OTHER_PLAN, "other plans"), (FRONTIER, "frontier"), (FOCUS, "belief rests on this"),
    )  # fmt: skip
    whole = Image.new("RGB", (canvas.width, canvas.height + LEGEND_HEIGHT), FREE)
    whole.paste(canvas)
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(12)
    x, y = 8.0, canvas.height + 6
    for color, text in entries:
        width = 16 + draw.textlength(text, font=font) + 12
        if x + width > canvas.width:
            x, y = 8.0, y + 18
        draw.rectangle((x, y + 2, x + 10, y + 12), color, OCCUPIED)
        draw.text((x + 15, y), text, INK, font)
        x += width
    return whole


def _measure_footprint(thing: DrawnThing) -> float:
    """Return the square metres of the box around a thing."""
    return float(np.prod(np.ptp(thing.points[:, :2], axis=0) + 0.05))


def _find_middle(thing: DrawnThing, frame: _Frame) -> NDArray[np.float64]:
    pixels = frame.to_pixels(thing.points)
    return np.asarray((pixels.min(axis=0) + pixels.max(axis=0)) / 2)


def _round(pixels: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(pixels).astype(np.int32)
