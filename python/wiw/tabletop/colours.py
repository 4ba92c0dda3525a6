# SPDX-License-Identifier: Apache-2.0
"""How much pixels of the front view look like a colour, in any light and somewhat blurred."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.tabletop.workbench import CAMERAS

SHADES = (0.5, 1.1)
"""How dark and how bright a colour may be seen, in shadow and in the sun, as shares of its own values."""
SEEN = 0.2
"""Squared likeness below which a pixel is of another colour."""
APART = 0.2
"""Distance of colours, RGB from 0 to 1, at which likeness has gone down to 1/e; of dark shades in proportion."""


def alike(pixels: ArrayLike, colour: Sequence[float]) -> NDArray[np.float64]:
    """float64 [...] from 0 to 1: likeness of pixels uint8 [..., 3] to a colour in the shade that fits best."""
    seen, own = np.asarray(pixels, np.float64) / 255, np.asarray(colour, np.float64)
    shade = np.clip(seen @ own / (own @ own), *SHADES)
    apart = np.linalg.norm(seen - shade[..., None] * own, axis=-1) / shade
    found: NDArray[np.float64] = np.exp(-((apart / APART) ** 2))
    return found


def pixels_at(front: NDArray[np.uint8], points: ArrayLike) -> NDArray[np.uint8]:
    """uint8 [N, 3]: the pixels of a front view that show points [N, 3], or the nearest where they are not in view."""
    columns, rows = np.floor(CAMERAS["front"].pixels_of(points, front.shape[:2])).astype(int).T
    found: NDArray[np.uint8] = front[rows.clip(0, front.shape[0] - 1), columns.clip(0, front.shape[1] - 1)]
    return found


def alike_at(front: NDArray[np.uint8], points: ArrayLike, colour: Sequence[float]) -> float:
    """Mean likeness to a colour where a front view shows points [N, 3]."""
    return float(alike(pixels_at(front, points), colour).mean())


def metres_off(front: NDArray[np.uint8], colour: Sequence[float], point: ArrayLike) -> float:
    """How far the middle of a colour's pixels is from where a point [3] is seen, the larger of across and in depth.

    Measured on the level of the point; infinite where nothing of the colour is seen.
    """
    weights = alike(front, colour) ** 2
    weights[weights < SEEN] = 0
    if not weights.any():
        return float("inf")
    rows, columns = np.indices(weights.shape) + 0.5
    middle = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    around = np.asarray(point, np.float64) + np.array([(0, 0, 0), (0.05, 0, 0), (0, 0.05, 0)])
    where, nearer, beside = CAMERAS["front"].pixels_of(around, front.shape[:2])
    off = np.linalg.solve(np.stack([nearer - where, beside - where], axis=1), middle - where) * 0.05
    return float(np.abs(off).max())


def nearness(distance: float, near: float, far: float) -> float:
    """1 up to a distance, 0 from another on, even between."""
    return float(np.clip((far - distance) / (far - near), 0, 1))
