# SPDX-License-Identifier: Apache-2.0
"""Set-of-Marks: each landmark outlined in the views and numbered, so that a model can name it by its number.

The numbers stand at the innermost point of each landmark. They never overlap each other, and they do not hide the
landmarks that a question asks about as long as there is room elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.mapping.landmarks import Landmark

COLORS: tuple[tuple[int, int, int], ...] = (
    (230, 25, 75), (60, 180, 75), (255, 225, 25), (0, 130, 200), (245, 130, 48), (145, 30, 180), (70, 240, 240),
    (240, 50, 230), (210, 245, 60), (250, 190, 212), (0, 128, 128), (220, 190, 255), (170, 110, 40), (255, 250, 200),
    (128, 0, 0), (170, 255, 195), (128, 128, 0), (255, 215, 180), (0, 0, 128), (128, 128, 128),
)  # fmt: skip
FONT, SCALE, THICKNESS, PADDING = cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1, 2
COVERED = 0.2
"""Share of a landmark that its own number may hide; the number of a smaller one stands beside it."""
SPOTS = 6
"""Innermost points of a landmark that are tried."""
GRID = 8
"""Pixels between the places that are tried where no point of the landmark is left."""

LabelBox = tuple[int, int, int, int]
"""Left, top, right, bottom; the right column and the bottom row are outside."""


@dataclass(frozen=True)
class MarkedViews:
    """Views with marks, and what the marks mean."""

    images: NDArray[np.uint8]
    """uint8 [4, H, W, 3]."""
    names: Mapping[int, Mapping[int, str]]
    """Category of each mark, by number of the view and number of the mark."""
    landmarks: Mapping[int, Landmark]
    """By number of the mark. One landmark has one number in all views."""
    boxes: Mapping[int, Mapping[int, LabelBox]]
    """Boxes of the numbers drawn, by number of the view and number of the mark."""


def draw_marks(images: NDArray[np.uint8], landmarks: Sequence[Landmark], asked: Iterable[int] = ()) -> MarkedViews:
    """Mark landmarks in views uint8 [4, H, W, 3], numbered from 1 on in their order.

    `asked` has the ids of landmarks that a question is about: other numbers keep off them.
    """
    kept = frozenset(asked)
    marked = images.copy()
    names: dict[int, dict[int, str]] = {}
    boxes: dict[int, dict[int, LabelBox]] = {}
    for view in range(len(images)):
        shown = {number: mark for number, mark in enumerate(landmarks, start=1) if view in mark.masks}
        masks = {number: mark.masks[view] for number, mark in shown.items()}
        spared = [number for number, mark in shown.items() if mark.id in kept]
        boxes[view] = place_labels(masks, spared)
        names[view] = {number: shown[number].category for number in sorted(boxes[view])}
        _draw(marked[view], masks, boxes[view])
    return MarkedViews(marked, names, dict(enumerate(landmarks, start=1)), boxes)


def place_labels(masks: Mapping[int, NDArray[np.bool_]], spared: Sequence[int] = ()) -> dict[int, LabelBox]:
    """Return the place of each mask's [H, W] number: no two overlap, and all lie in the picture.

    No other number hides anything of the masks in `spared`, as long as there is room elsewhere. A mask whose number
    fits nowhere is left out.
    """
    boxes: dict[int, LabelBox] = {}
    filled = [number for number in masks if masks[number].any()]
    if not filled:
        return boxes
    size = masks[filled[0]].shape
    taken = np.zeros(size, bool)
    kept = np.zeros(size, bool)
    for number in spared:
        if number in masks:
            kept |= masks[number]
    order = sorted(filled, key=lambda number: (number not in spared, int(masks[number].sum()), number))
    for number in order:
        label = _measure_label(number)
        box = _place(masks[number], label, taken, kept & ~masks[number] if number in spared else kept)
        if box is not None:
            boxes[number] = box
            taken[box[1] : box[3], box[0] : box[2]] = True
    return boxes


def _measure_label(number: int) -> tuple[int, int]:
    """Return width and height of a number's box in pixels."""
    (width, height), _ = cv2.getTextSize(str(number), FONT, SCALE, THICKNESS)
    return width + 2 * PADDING, height + 2 * PADDING + 1


def _place(
    mask: NDArray[np.bool_], label: tuple[int, int], taken: NDArray[np.bool_], kept: NDArray[np.bool_]
) -> LabelBox | None:
    """Return the first place that is free: on the mask, then beside it, and last on what is to be kept free."""
    height, width = mask.shape
    if label[0] > width or label[1] > height:
        return None
    own, used, spared = _integrate(mask), _integrate(taken), _integrate(taken | kept)
    most = COVERED * int(mask.sum())
    inside = [_center_box(x, y, label, mask.shape) for x, y in _find_inner_points(mask)]
    for box in inside:
        if _sum(spared, box) == 0 and _sum(own, box) <= most:
            return box
    around = _list_places(mask, label)
    for sums, least in ((spared, 0), (spared, label[0] * label[1]), (used, 0), (used, label[0] * label[1])):
        for box in around:
            if _sum(sums, box) == 0 and _sum(own, box) <= least:
                return box
    return None


def _integrate(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.asarray(cv2.integral(mask.view(np.uint8)), np.int32)


def _find_inner_points(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the points (x, y) of a mask that are furthest from its edge, each outside of the others' circles."""
    padded = np.pad(mask.view(np.uint8), 1)
    inner = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1].copy()
    found = []
    for _ in range(SPOTS):
        _, depth, _, (x, y) = cv2.minMaxLoc(inner)
        if depth <= 0:
            break
        found.append((int(x), int(y)))
        cv2.circle(inner, (int(x), int(y)), max(int(depth), GRID), 0.0, -1)
    return found


def _list_places(mask: NDArray[np.bool_], label: tuple[int, int]) -> list[LabelBox]:
    """Return boxes on a grid over the picture, the nearest to the mask first."""
    height, width = mask.shape
    ys, xs = np.meshgrid(
        np.arange(0, height - label[1] + 1, GRID // 2), np.arange(0, width - label[0] + 1, GRID), indexing="ij"
    )
    away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, 3)
    middle = away[ys + label[1] // 2, xs + label[0] // 2]
    order = np.argsort(middle.ravel(), kind="stable")
    lefts, tops = xs.ravel()[order].tolist(), ys.ravel()[order].tolist()
    return [(x, y, x + label[0], y + label[1]) for x, y in zip(lefts, tops, strict=True)]


def _center_box(x: int, y: int, label: tuple[int, int], shape: tuple[int, ...]) -> LabelBox:
    left = min(max(0, x - label[0] // 2), shape[1] - label[0])
    top = min(max(0, y - label[1] // 2), shape[0] - label[1])
    return left, top, left + label[0], top + label[1]


def _sum(integral: NDArray[np.int32], box: LabelBox) -> int:
    left, top, right, bottom = box
    return int(integral[bottom, right] - integral[top, right] - integral[bottom, left] + integral[top, left])


def _draw(image: NDArray[np.uint8], masks: Mapping[int, NDArray[np.bool_]], boxes: Mapping[int, LabelBox]) -> None:
    """Draw outlines, lines from numbers that stand beside, and the numbers on top."""
    colors = {number: COLORS[(number - 1) % len(COLORS)] for number in boxes}
    for number in sorted(boxes):
        outline, _ = cv2.findContours(masks[number].view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(image, outline, -1, colors[number], 1, cv2.LINE_8)
    for number, (left, top, right, bottom) in sorted(boxes.items()):
        x, y = (left + right) // 2, (top + bottom) // 2
        if not masks[number][top:bottom, left:right].any():
            ((near_x, near_y), *_) = _find_inner_points(masks[number])
            cv2.line(image, (x, y), (near_x, near_y), colors[number], 1, cv2.LINE_AA)
    for number, (left, top, right, bottom) in sorted(boxes.items()):
        cv2.rectangle(image, (left, top), (right - 1, bottom - 1), colors[number], -1)
        dark = sum(colors[number]) < 380
        corner = (left + PADDING, bottom - PADDING - 1)
        ink = (255, 255, 255) if dark else (0, 0, 0)
        cv2.putText(image, str(number), corner, FONT, SCALE, ink, THICKNESS, cv2.LINE_AA)
