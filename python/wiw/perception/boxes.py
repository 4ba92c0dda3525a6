# SPDX-License-Identifier: Apache-2.0
"""Boxes around masks, in views and across the seam of panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.types import Box

Mask = NDArray[np.bool_]


def box_of(mask: Mask, wraps: bool = False) -> Box | None:
    """The tightest box around a mask [H, W]; None around nothing.

    `wraps`: the columns are a circle, as a panorama's are, and the box is the narrowest one on it: left > right where
    it lies across the seam.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return None
    left, right = _columns(np.asarray(mask.any(axis=0)), wraps)
    return float(left), float(rows[0]), float(right), float(rows[-1] + 1)


def _columns(filled: Mask, wraps: bool) -> tuple[int, int]:
    """First filled column and the one behind the last; on a circle the widest gap is left out."""
    columns = np.flatnonzero(filled)
    if not wraps:
        return int(columns[0]), int(columns[-1] + 1)
    gaps = np.diff(columns, append=columns[0] + len(filled))
    widest = int(gaps[::-1].argmax())  # of equal gaps the last, so that the seam is crossed only if it has to be
    last = len(columns) - 1 - widest
    return int(columns[(last + 1) % len(columns)]), int(columns[last] + 1)


def width_of(box: Box, columns: int) -> float:
    """Pixels from left to right, over the seam of a panorama of so many columns where the box lies across it."""
    return box[2] - box[0] if box[2] >= box[0] else box[2] - box[0] + columns


def scaled(box: Box, scale: float, size: tuple[int, int], wraps: bool = False) -> Box:
    """The box enlarged about its centre, within an image of `size` (H, W); on a panorama it may come to cross the seam.

    Wider than the panorama is the whole of it.
    """
    height, columns = size
    left, top, right, bottom = box
    width = width_of(box, columns)
    more, higher = (scale - 1) * width / 2, (scale - 1) * (bottom - top) / 2
    top, bottom = max(0.0, top - higher), min(float(height), bottom + higher)
    if not wraps:
        return max(0.0, left - more), top, min(float(columns), right + more), bottom
    if width + 2 * more >= columns:
        return 0.0, top, float(columns), bottom
    return (left - more) % columns, top, (right + more) % columns or float(columns), bottom


def largest_part(mask: Mask, wraps: bool = False) -> Mask:
    """The largest of the pieces that hang together (at edges or corners); `wraps` joins them over the seam."""
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    names = np.arange(count)
    if wraps:
        first = np.pad(labels[:, 0], 1)
        for shift in range(3):
            _join(names, labels[:, -1], first[shift : shift + len(labels)])
    pieces = names[labels]
    sizes = np.bincount(pieces.ravel(), minlength=count)
    sizes[0] = 0
    return mask & (pieces == sizes.argmax())


def _join(names: NDArray[np.int64], one: NDArray[Any], other: NDArray[Any]) -> None:
    """Gives labels that touch, pairwise, one name."""
    for a, b in zip(one, other, strict=True):
        if a and b and names[a] != names[b]:
            names[names == names[b]] = names[a]
