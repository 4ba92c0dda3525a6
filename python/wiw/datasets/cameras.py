# SPDX-License-Identifier: Apache-2.0
"""Cameras of agents in scenes: where they are, and what is in view of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.worlds import World

CAMERA_HEIGHT = 1.0
"""Metres above the floor."""


def is_in_view(world: World, start: NDArray[np.float64], goal: NDArray[np.float64], margin: float = 0.3) -> bool:
    """Return whether the goal camera's position is visible from the start camera's, by the depth along the ray."""
    eye, place = (np.add(p, [0.0, CAMERA_HEIGHT, 0.0]) for p in (start, goal))
    way = place - eye
    pose = camera_pose(start, float(np.arctan2(-way[0], -way[2])))
    pitch = np.arctan2(way[1], np.hypot(way[0], way[2]))
    depth = world.renderer.panorama(pose[None], (64, 128), outputs=("depth",))["depth"][0]
    row = int((0.5 - pitch / np.pi) * 64)
    seen = depth[max(row - 1, 0) : row + 2, 63:65]
    return bool((seen == 0).any() or seen.max() > np.linalg.norm(way) - margin)


def camera_pose(position: NDArray[np.float64], yaw: float, height: float = CAMERA_HEIGHT) -> NDArray[np.float64]:
    """Return T_world_camera [4, 4] of an agent at `position` on the floor, heading `yaw` radians."""
    pose = np.eye(4)
    pose[0, 0] = pose[2, 2] = np.cos(yaw)
    pose[0, 2], pose[2, 0] = np.sin(yaw), -np.sin(yaw)
    pose[:3, 3] = np.add(position, [0.0, height, 0.0])
    return pose
