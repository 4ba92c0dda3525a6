# SPDX-License-Identifier: Apache-2.0
"""The recogniser's input for a target: a close and a wide view centred on its box, the box's angles, and its extent in
metres where depth is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.errors import ArgumentError
from wiw.panorama import PerspectivePlan
from wiw.perception.boxes import Mask, box_width, find_box

SIDE = 64
"""Pixels of a view."""
CLOSE_FILL = 0.6
"""Part of the close view that the box fills, along its longer side."""
WIDE_FACTOR = 2.5
"""How many times as wide the wide view is."""
NARROWEST, WIDEST = np.tan(np.radians([4.0, 65.0]))
"""Half fields of view, as tangents."""
STEP = 1.2
"""Fields of view are powers of it, so that look-up tables are shared."""
PITCH_STEP = 3.0
"""Degrees; views look up and down in whole steps, for the same reason."""
SCALARS = 9
"""Width and height of the box, elevation of its upper and lower edge (radians), whether the view is real; the four of
`measure_extent`, zeros where depth is unknown.
"""
EXTENT = slice(5, 9)
"""The columns of `measure_extent`."""
CAMERA_HEIGHT = 1.0
"""Metres above the floor."""
CUT_OFF = 3.0
"""Percentage of a target's pixels ignored at either end of each axis: those whose depth is of what is behind."""
SHORTEST = 0.01
"""Minimum length in metres of a measured extent, which tells it from an unknown one."""


@dataclass(frozen=True)
class Glimpses:
    """N glimpses of targets."""

    images: NDArray[np.uint8]
    """uint8 [N, 2, 64, 64, 3]: close and wide."""
    boxes: NDArray[np.float32]
    """float32 [N, 2, 4]: left, top, right, bottom in each, 0 to 1."""
    scalars: NDArray[np.float32]
    """float32 [N, 9], see `SCALARS`."""

    def __post_init__(self) -> None:
        count = len(self.images)
        shapes = ((count, 2, SIDE, SIDE, 3), (count, 2, 4), (count, SCALARS))
        given = tuple(np.shape(values) for values in (self.images, self.boxes, self.scalars))
        if given != shapes or self.images.dtype != np.uint8:
            raise ArgumentError(
                f"Glimpses: expected images uint8 {shapes[0]}, boxes {shapes[1]}, scalars {shapes[2]}, "
                f"got {self.images.dtype} {given[0]}, {given[1]}, {given[2]}"
            )
        if not (np.isfinite(self.boxes).all() and np.isfinite(self.scalars).all()):
            raise ArgumentError("Glimpses: expected finite boxes and scalars, got NaN or infinity")

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, rows: NDArray[np.int64]) -> Glimpses:
        return Glimpses(self.images[rows], self.boxes[rows], self.scalars[rows])


def join_glimpses(parts: Sequence[Glimpses]) -> Glimpses:
    """Concatenate glimpses; an empty list gives none."""
    empty = np.zeros((0, 2, SIDE, SIDE, 3), np.uint8), np.zeros((0, 2, 4)), np.zeros((0, SCALARS))
    columns = zip(*((part.images, part.boxes, part.scalars) for part in parts), strict=True)
    images, boxes, scalars = (np.concatenate(column) for column in columns) if parts else empty
    return Glimpses(images, boxes.astype(np.float32), scalars.astype(np.float32))


def extract_glimpses(
    panoramas: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    real: NDArray[np.bool_],
    depths: Sequence[NDArray[np.float32] | None] | None = None,
) -> tuple[Glimpses, NDArray[np.int64]]:
    """Extract glimpses of the target from those of K panoramas that show it; return them with the panoramas' indices.

    Args:
        panoramas: uint8 [K, H, W, 3].
        masks: bool [K, H, W]: the target's pixels. Views are centred on the box around them; only extents depend on
            the pixels themselves.
        real: bool [K]: True where the panorama is an observation, False where it is imagined.
        depths: K maps, float32 [H, W]: metres along the ray, 0 where unknown; None for panoramas without depth, such as
            imagined ones. None means that none of them has depth.

    Raises:
        ArgumentError: arrays of other shapes.
    """
    if panoramas.ndim != 4 or panoramas.shape[3] != 3 or masks.shape != panoramas.shape[:3]:
        raise ArgumentError(
            f"extract_glimpses: expected panoramas [K, H, W, 3] and masks [K, H, W], got {panoramas.shape} and "
            f"{masks.shape}"
        )
    if np.shape(real) != (len(panoramas),):
        raise ArgumentError(
            f"extract_glimpses: expected one flag per panorama [{len(panoramas)}], got {np.shape(real)}"
        )
    maps = [None] * len(panoramas) if depths is None else list(depths)
    unlike = [np.shape(depth) for depth in maps if depth is not None and np.shape(depth) != masks.shape[1:]]
    if len(maps) != len(panoramas) or unlike:
        raise ArgumentError(
            f"extract_glimpses: expected depth {masks.shape[1:]} or None per panorama [{len(panoramas)}], got "
            f"{unlike[0] if unlike else len(maps)}"
        )
    frames = np.flatnonzero(masks.any(axis=(1, 2)))
    return join_glimpses([_extract_glimpse(panoramas[k], masks[k], bool(real[k]), maps[k]) for k in frames]), frames


def measure_extent(mask: Mask, depth: NDArray[np.float32]) -> NDArray[np.float64]:
    """Measure a target in metres: its longest extent along the floor, the one across, and the heights above the floor
    of its lower and upper end.

    Extents along the floor are along the principal axes of the visible points. Each measure ignores `CUT_OFF` percent
    of the points at either end. The camera is taken to be `CAMERA_HEIGHT` above the floor on which the target stands.

    Args:
        mask: bool [H, W]: the target's pixels in a panorama.
        depth: float32 [H, W]: metres along the ray, 0 where unknown.

    Returns:
        float64 [4]; zeros if no pixel of the target has depth, else both extents are at least `SHORTEST`.
    """
    pixels = np.flatnonzero(mask & np.isfinite(depth) & (depth > 0))
    if not len(pixels):
        return np.zeros(4)
    points = _get_rays(*mask.shape)[pixels].astype(np.float64) * depth.ravel()[pixels, None]
    flat = points[:, [0, 2]] - points[:, [0, 2]].mean(axis=0)
    _, axes = np.linalg.eigh(flat.T @ flat)
    span = np.percentile(flat @ axes, [CUT_OFF, 100 - CUT_OFF], axis=0)
    lengths = np.sort(np.maximum(span[1] - span[0], SHORTEST))[::-1]
    return np.array([*lengths, *(CAMERA_HEIGHT + np.percentile(points[:, 1], [CUT_OFF, 100 - CUT_OFF]))])


def _extract_glimpse(image: NDArray[np.uint8], mask: Mask, real: bool, depth: NDArray[np.float32] | None) -> Glimpses:
    yaw, pitch = _find_direction(mask)
    x, y, elevation = _compute_angles(mask, yaw, pitch)
    close = _quantise_field(float(max(np.abs(x).max(), np.abs(y).max())) / CLOSE_FILL)
    fields = [close, _quantise_field(close * WIDE_FACTOR)]
    half = np.pi / image.shape[1]  # of a pixel, whose rays pass through its middle
    extent = np.array([x.min() - half, -y.max() - half, x.max() + half, half - y.min()])
    width, height = np.arctan([extent[2] - extent[0], extent[3] - extent[1]])
    measured = np.zeros(4) if depth is None else measure_extent(mask, depth)
    scalars = [width, height, elevation.max() + half, elevation.min() - half, float(real), *measured]
    return Glimpses(
        np.stack([_cut_view(image, yaw, pitch, field) for field in fields])[None],
        np.stack([np.clip((extent / field + 1) / 2, 0, 1) for field in fields])[None].astype(np.float32),
        np.array([scalars], np.float32),
    )


def _find_direction(mask: Mask) -> tuple[float, float]:
    """Return yaw (a whole column) and pitch (a whole step) of the middle of the mask's box; left and up positive."""
    rows, columns = mask.shape
    box = find_box(mask, wraps=True)
    assert box is not None
    middle = round(box[0] + box_width(box, columns) / 2) % columns
    pitch = 90 - 90 * (box[1] + box[3]) / rows
    return (columns / 2 - middle) * 360 / columns, round(pitch / PITCH_STEP) * PITCH_STEP


def _compute_angles(mask: Mask, yaw_deg: float, pitch_deg: float) -> tuple[NDArray[np.float64], ...]:
    """Return the mask's pixels as tangents to the right and up in a view of this direction, and as elevations in
    radians.
    """
    rays = _get_rays(mask.shape[0], mask.shape[1])[np.flatnonzero(mask)]
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    sin, cos = np.sin(yaw), np.cos(yaw)
    ahead = np.array([-sin * np.cos(pitch), np.sin(pitch), -cos * np.cos(pitch)])
    right = np.array([cos, 0.0, -sin])
    x, y, z = (rays @ np.stack([right, np.cross(right, ahead), ahead], axis=1)).T
    z = np.maximum(z, 0.1)  # what is aside or behind lies at the view's edge
    return x / z, y / z, np.arcsin(np.clip(rays[:, 1], -1, 1))


def _quantise_field(field: float) -> float:
    field = float(np.clip(field, NARROWEST, WIDEST))
    return float(STEP ** np.ceil(np.log(field) / np.log(STEP) - 1e-9))


def _cut_view(image: NDArray[np.uint8], yaw: float, pitch: float, field: float) -> NDArray[np.uint8]:
    """Cut a square view; where its pixels are coarser than the panorama's, average finer ones."""
    coarser = (2 * field / SIDE) / (2 * np.pi / image.shape[1])
    finer = 1 if coarser < 1.4 else 2 if coarser < 2.8 else 4
    plan = _get_plan((image.shape[0], image.shape[1]), finer * SIDE, field, pitch)
    view = plan(image, yaw)
    return view if finer == 1 else panorama.resize(view, (SIDE, SIDE))


@lru_cache(maxsize=256)
def _get_plan(size: tuple[int, int], side: int, field: float, pitch: float) -> PerspectivePlan:
    return PerspectivePlan(size, (side, side), float(np.degrees(2 * np.arctan(field))), pitch)


@lru_cache(maxsize=4)
def _get_rays(rows: int, columns: int) -> NDArray[np.float32]:
    rays = panorama.directions((rows, columns)).reshape(-1, 3)
    rays.setflags(write=False)
    return rays
