# SPDX-License-Identifier: Apache-2.0
"""Similarity of the front view's pixels to a colour, in any light and with some blur."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw.tabletop.workbench import CAMERAS

SHADES = (0.5, 1.1)
"""Range of brightness in which a colour is recognised, in shadow and in the sun, as a factor of its own values."""
MIN_SIMILARITY = 0.2
"""Squared similarity below which a pixel counts as another colour."""
COLOUR_SCALE = 0.2
"""Distance of colours, RGB from 0 to 1, at which the similarity falls to 1/e; proportionally less for dark shades."""


def compare_colour(pixels: ArrayLike, colour: Sequence[float]) -> NDArray[np.float64]:
    """Return the similarity, 0 to 1, of pixels uint8 [..., 3] to the best-fitting shade of a colour: float64 [...]."""
    seen, own = np.asarray(pixels, np.float64) / 255, np.asarray(colour, np.float64)
    shade = np.clip(seen @ own / (own @ own), *SHADES)
    apart = np.linalg.norm(seen - shade[..., None] * own, axis=-1) / shade
    found: NDArray[np.float64] = np.exp(-((apart / COLOUR_SCALE) ** 2))
    return found


def sample_pixels(front: NDArray[np.uint8], points: ArrayLike) -> NDArray[np.uint8]:
    """Return the pixels of a front view that show points [N, 3], or the nearest for those out of view: uint8 [N, 3]."""
    columns, rows = np.floor(CAMERAS["front"].project_points(points, front.shape[:2])).astype(int).T
    found: NDArray[np.uint8] = front[rows.clip(0, front.shape[0] - 1), columns.clip(0, front.shape[1] - 1)]
    return found


def compare_colour_at(front: NDArray[np.uint8], points: ArrayLike, colour: Sequence[float]) -> float:
    """Return the mean similarity to a colour where a front view shows points [N, 3]."""
    return float(compare_colour(sample_pixels(front, points), colour).mean())


def measure_offset(front: NDArray[np.uint8], colour: Sequence[float], point: ArrayLike) -> float:
    """Return the distance of a colour's mean position in a front view from a point [3], the larger of across and in
    depth.

    In metres, measured on the level of the point; infinite where the colour is not visible.
    """
    weights = compare_colour(front, colour) ** 2
    weights[weights < MIN_SIMILARITY] = 0
    if not weights.any():
        return float("inf")
    rows, columns = np.indices(weights.shape) + 0.5
    middle = np.array([(weights * columns).sum(), (weights * rows).sum()]) / weights.sum()
    around = np.asarray(point, np.float64) + np.array([(0, 0, 0), (0.05, 0, 0), (0, 0.05, 0)])
    where, nearer, beside = CAMERAS["front"].project_points(around, front.shape[:2])
    off = np.linalg.solve(np.stack([nearer - where, beside - where], axis=1), middle - where) * 0.05
    return float(np.abs(off).max())


def linear_falloff(distance: float, near: float, far: float) -> float:
    """Return 1 up to a near distance, 0 from a far one on, linear between."""
    return float(np.clip((far - distance) / (far - near), 0, 1))
