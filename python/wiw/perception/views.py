# SPDX-License-Identifier: Apache-2.0
"""Perspective views centred on the boxed target, cut out of panoramas, for answering what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wiw import annotate
from wiw.errors import ArgumentError
from wiw.panorama import PerspectivePlan
from wiw.perception.boxes import box_width, find_box
from wiw.types import Box

PITCH_STEP = 5.0
"""Degrees; views look up and down in whole steps, so that their look-up tables are shared."""
ZOOMS = (30.0, 45.0, 60.0, 90.0, 120.0)
"""Fields of view that `hfov_deg="fit"` chooses from, in degrees."""
MARGIN = 1.4
"""Width of a fitted view relative to the box's extent."""


@dataclass(frozen=True)
class TargetViews:
    """Views of those of K frames that show the target."""

    images: NDArray[np.uint8]
    """uint8 [N, h, w, 3]."""
    boxes: tuple[Box, ...]
    """The target's box in each view."""
    frames: NDArray[np.int64]
    """int64 [N]: index of each view's frame."""
    hfov_deg: NDArray[np.float64]
    """float64 [N]."""
    lost_frames: NDArray[np.int64]
    """int64 [K - N]: frames without the target: no help in answering, but evidence of a poor plan."""


def cut_target_views(
    panoramas: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    size: tuple[int, int] = (384, 384),
    hfov_deg: float | Literal["fit"] = 90.0,
    draw: bool = True,
) -> TargetViews:
    """Cut a view centred on the target out of each panorama that shows it.

    Args:
        panoramas: uint8 [K, H, W, 3].
        masks: bool [K, H, W]: the target, e.g. `Track.masks`, or `observation.target.mask[None]`.
        size: (h, w) of the views; the paper's by default.
        hfov_deg: 90 as in the paper, or "fit": the narrowest of `ZOOMS` that holds the box and some surroundings.
        draw: whether to draw the box in red.

    Raises:
        ArgumentError: arrays of other shapes.
    """
    if panoramas.ndim != 4 or panoramas.shape[3] != 3 or masks.shape != panoramas.shape[:3]:
        raise ArgumentError(
            f"cut_target_views: expected panoramas [K, H, W, 3] and masks [K, H, W], got {panoramas.shape} and "
            f"{masks.shape}"
        )
    images, boxes, frames, angles = [], [], [], []
    for frame, (panorama, mask) in enumerate(zip(panoramas, masks, strict=True)):
        around = find_box(mask, wraps=True)
        if around is None:
            continue
        angle = _choose_field(around, mask.shape) if hfov_deg == "fit" else float(hfov_deg)
        yaw, pitch = _find_direction(around, mask.shape)
        plan = _get_plan(mask.shape, size, angle, pitch)
        box = find_box(plan(mask.astype(np.uint8), yaw, interpolation="nearest") > 0)
        if box is None:  # wider than the view, which looks through its middle
            continue
        view = plan(panorama, yaw)
        images.append(annotate.box(view, box, outside=True) if draw else view)
        boxes.append(box)
        frames.append(frame)
        angles.append(angle)
    shown = np.array(frames, np.int64)
    return TargetViews(
        np.stack(images) if images else np.zeros((0, *size, 3), np.uint8),
        tuple(boxes),
        shown,
        np.array(angles),
        np.setdiff1d(np.arange(len(panoramas)), shown),
    )


def _find_direction(box: Box, size: Sequence[int]) -> tuple[float, float]:
    """Return yaw (a whole column) and pitch (a whole step) of a box's middle in degrees, left and up positive."""
    rows, columns = size
    middle = round(box[0] + box_width(box, columns) / 2) % columns
    pitch = 90 - 180 * (box[1] + box[3]) / 2 / rows
    return (columns / 2 - middle) * 360 / columns, round(pitch / PITCH_STEP) * PITCH_STEP


def _choose_field(box: Box, size: Sequence[int]) -> float:
    rows, columns = size
    latitude = np.pi / 2 - np.pi * (box[1] + box[3]) / 2 / rows
    wide = box_width(box, columns) * 360 / columns * np.cos(latitude)
    high = (box[3] - box[1]) * 180 / rows
    return next((zoom for zoom in ZOOMS if zoom >= MARGIN * max(wide, high)), ZOOMS[-1])


@lru_cache(maxsize=64)
def _get_plan(pano_size: tuple[int, int], size: tuple[int, int], hfov_deg: float, pitch_deg: float) -> PerspectivePlan:
    return PerspectivePlan(pano_size, size, hfov_deg, pitch_deg)
