# SPDX-License-Identifier: Apache-2.0
"""Annotate images for a model or a person: boxes, discs, axes, strips of titled frames.

Images are uint8 [H, W, 3]; every function returns a new one. Coordinates are pixels, 0 at the left (upper) edge of the
first pixel. Text is ASCII; other characters are shown as "?". A wrong shape or a number that is not finite raises
``wiw.errors.ArgumentError``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import annotate as _core

__all__ = ["axes", "box", "mark", "strip"]

Image = NDArray[np.uint8]
Color = tuple[int, int, int]
RED: Color = (220, 40, 40)


def box(
    image: Image,
    edges: Sequence[float],
    label: str = "",
    *,
    color: Color = RED,
    thickness: int = 3,
    outside: bool = False,
) -> Image:
    """Outline a box (left, top, right, bottom), the line inside it, the label above it.

    left > right means a box across the seam of a panorama: both parts are drawn, open at the seam. `outside` draws the
    line around the box, within the image, so that it hides nothing of a small one.
    """
    if outside:
        left, top, right, bottom = edges
        height, width = image.shape[:2]
        left, top = max(0, left - thickness), max(0, top - thickness)
        edges = (left, top, min(width, right + thickness), min(height, bottom + thickness))
    return _core.box(image, list(edges), color, thickness, label)


def mark(
    image: Image, center: Sequence[float], label: str = "", *, color: Color = RED, radius: int = 7, gap: int = 2
) -> Image:
    """Draw a disc at (x, y) with a label on a line: ``gap`` pixels to its right, or to its left if negative."""
    return _core.mark(image, list(center), color, radius, label, gap)


def axes(image: Image, origin: Sequence[float], ends: Sequence[Sequence[float]], *, thickness: int = 2) -> Image:
    """Draw arrows from ``origin`` (x, y) to three points: x red, y green, z blue."""
    return _core.axes(image, list(origin), [list(end) for end in ends], thickness)


def strip(
    frames: Image | Sequence[Image], titles: Sequence[str], *, columns: int | None = None, bar: int = 0, gap: int = 4
) -> Image:
    """Arrange frames [T, H, W, 3] side by side, each under a bar with its title, e.g. "Imagined action 1: forward 0.20
    m".

    ``columns`` frames per row (None: all in one), ``bar`` pixels of title (0: to suit the width), ``gap`` pixels
    between. A title that does not fit is set smaller, then cut with "...".
    """
    stacked: Any = np.asarray(frames)
    return _core.strip(stacked, list(titles), columns or 0, bar, gap)
