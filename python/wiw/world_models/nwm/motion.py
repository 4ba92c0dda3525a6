# SPDX-License-Identifier: Apache-2.0
"""Camera trajectories as the motions that NWM was trained on.

A motion is (forward, left, turn) from one frame to the next. Metres are divided by the spacing of the training data's
waypoints and mapped to [-1, 1] by the bounds LOW and HIGH; turns stay in radians. The map is affine, so standing still
is not zero: it is (-1/3, 0, 0).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LOW = np.array([-2.5, -4.0])
HIGH = np.array([5.0, 4.0])
"""Bounds of (forward, left) in waypoint spacings."""

SHIFT = 1 / 128
"""What one step ahead is called in time."""


def normalise_steps(steps: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Convert [..., 3] in metres and radians to what the network takes; turns are wrapped to [-pi, pi)."""
    plane = 2 * (steps[..., :2] / spacing - LOW) / (HIGH - LOW) - 1
    return np.concatenate([plane, _wrap_angle(steps[..., 2:])], axis=-1)


def motions(trajectory: NDArray[np.float64], spacing: float, rollout_convention: bool = False) -> NDArray[np.float64]:
    """Return what leads from each frame of a rollout to the next, float64 [K, 3].

    Args:
        trajectory: [K, 3], the pose after each action in the frame of the start: x forward, y left, azimuth.
        spacing: metres between waypoints of the training data.
        rollout_convention: False maps each step, seen from where it begins, as training does. True repeats the
            published rollout script: it maps the poses and takes their differences, so only the first step carries the
            map's offset, and all are in the frame of the start.
    """
    poses = np.concatenate([np.zeros((1, 3)), trajectory])
    if rollout_convention:
        mapped = np.concatenate([np.zeros((1, 3)), normalise_steps(trajectory, spacing)])
        steps = np.diff(mapped, axis=0)
        return np.concatenate([steps[:, :2], _wrap_angle(np.diff(poses[:, 2:], axis=0))], axis=-1)
    return normalise_steps(_steps(poses), spacing)


def _steps(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each pose relative to the one before."""
    change, azimuth = np.diff(poses, axis=0), poses[:-1, 2]
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    forward = cos * change[:, 0] + sin * change[:, 1]
    left = -sin * change[:, 0] + cos * change[:, 1]
    return np.stack([forward, left, change[:, 2]], axis=-1)


def _wrap_angle(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return (angle + np.pi) % (2 * np.pi) - np.pi
