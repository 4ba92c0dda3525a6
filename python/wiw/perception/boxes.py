# SPDX-License-Identifier: Apache-2.0
"""Bounding boxes of masks, in views and across the seam of panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.types import Box

Mask = NDArray[np.bool_]


def find_box(mask: Mask, wraps: bool = False) -> Box | None:
    """Return the tightest box around a mask [H, W]; None for an empty mask.

    With `wraps` the columns form a circle, as in a panorama, and the box is the narrowest one on it: left > right
    where it crosses the seam.
    """
    rows = np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return None
    left, right = _find_column_range(np.asarray(mask.any(axis=0)), wraps)
    return float(left), float(rows[0]), float(right), float(rows[-1] + 1)


def _find_column_range(filled: Mask, wraps: bool) -> tuple[int, int]:
    """Return the first filled column and the one after the last; on a circle, the widest gap is left out."""
    columns = np.flatnonzero(filled)
    if not wraps:
        return int(columns[0]), int(columns[-1] + 1)
    gaps = np.diff(columns, append=columns[0] + len(filled))
    widest = int(gaps[::-1].argmax())  # of equal gaps the last, so that the seam is crossed only if it has to be
    last = len(columns) - 1 - widest
    return int(columns[(last + 1) % len(columns)]), int(columns[last] + 1)


def box_width(box: Box, columns: int) -> float:
    """Return the width in pixels, across the seam of a panorama with `columns` columns where the box crosses it."""
    return box[2] - box[0] if box[2] >= box[0] else box[2] - box[0] + columns


def scale_box(box: Box, scale: float, size: tuple[int, int], wraps: bool = False) -> Box:
    """Scale the box about its centre, within an image of `size` (H, W); on a panorama it may then cross the seam.

    A box wider than the panorama becomes the whole of it.
    """
    height, columns = size
    left, top, right, bottom = box
    width = box_width(box, columns)
    more, higher = (scale - 1) * width / 2, (scale - 1) * (bottom - top) / 2
    top, bottom = max(0.0, top - higher), min(float(height), bottom + higher)
    if not wraps:
        return max(0.0, left - more), top, min(float(columns), right + more), bottom
    if width + 2 * more >= columns:
        return 0.0, top, float(columns), bottom
    return (left - more) % columns, top, (right + more) % columns or float(columns), bottom


def keep_largest_part(mask: Mask, wraps: bool = False) -> Mask:
    """Keep the largest connected component (edges and corners connect); `wraps` connects across the seam."""
    import cv2

    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    names = np.arange(count)
    if wraps:
        first = np.pad(labels[:, 0], 1)
        for shift in range(3):
            _merge_labels(names, labels[:, -1], first[shift : shift + len(labels)])
    pieces = names[labels]
    sizes = np.bincount(pieces.ravel(), minlength=count)
    sizes[0] = 0
    return mask & (pieces == sizes.argmax())


def _merge_labels(names: NDArray[np.int64], one: NDArray[Any], other: NDArray[Any]) -> None:
    """Give one label to pairs of labels that touch."""
    for a, b in zip(one, other, strict=True):
        if a and b and names[a] != names[b]:
            names[names == names[b]] = names[a]
