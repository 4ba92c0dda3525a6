# SPDX-License-Identifier: Apache-2.0
"""Orientation of a home: the direction of its walls, which maps are aligned with.

Homes have right angles (the Manhattan world of Coughlan and Yuille, 1999), and an agent may start with any heading.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.views import check_panorama

BAND_DEG = (5.0, 35.0)
"""Elevations that are looked at: above most furniture, below the ceiling nearby."""
LONGEST = 0.3
"""Metres from one column's point to the next one's beyond which they lie on different things."""


def find_wall_azimuth(depth: NDArray[np.float32], odometry: NDArray[np.float64]) -> float:
    """Return the azimuth along which walls stand, from -pi / 4 to pi / 4: other walls are at right angles to it.

    It is the mean direction, modulo a quarter turn, from each point of a row to the next, weighted by the distance.

    Args:
        depth: float32 [H, W]: distances along the ray of a panorama.
        odometry: x, y, azimuth of the agent.

    Raises:
        ArgumentError: arrays of other shapes.
    """
    check_panorama(depth, odometry)
    height, width = depth.shape
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    rows = (elevation > np.radians(BAND_DEG[0])) & (elevation < np.radians(BAND_DEG[1]))
    azimuth = odometry[2] + np.pi - (np.arange(width) + 0.5) / width * 2 * np.pi
    flat = depth[rows].astype(np.float64) * np.cos(elevation[rows])[:, None]
    points = flat * np.exp(1j * azimuth)
    steps = np.roll(points, -1, axis=1) - points
    usable = (flat > 0) & (np.roll(flat, -1, axis=1) > 0) & (np.abs(steps) < LONGEST) & (np.abs(steps) > 0)
    found = 0.0
    for width_deg in (45.0, 10.0):  # of all directions first, then of those near to it: what stands aslant drops out
        turned = steps[usable] * np.exp(-1j * found)
        weights, fourfold = np.abs(turned), (turned / np.abs(turned)) ** 4
        near = np.abs(np.angle(fourfold)) <= np.radians(4 * width_deg)
        found += float(np.angle((weights * fourfold)[near].sum()) / 4)
    return (found + np.pi / 4) % (np.pi / 2) - np.pi / 4


def turn_odometry(odometry: NDArray[np.float64], azimuth: float) -> NDArray[np.float64]:
    """Return x, y, azimuth in a frame whose x axis points along an azimuth of the old one."""
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    x, y, heading = odometry
    return np.array([x * cos + y * sin, y * cos - x * sin, heading - azimuth])
