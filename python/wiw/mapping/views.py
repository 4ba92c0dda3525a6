# SPDX-License-Identifier: Apache-2.0
"""The four wide views that a panorama is looked at in, with planar depth and cameras in the frame of the start."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.panorama import distance_to_planar, to_perspective

VIEW_NAMES = ("front", "left", "right", "back")
VIEW_YAWS_DEG = (0.0, 90.0, -90.0, 180.0)
"""Degrees by which each view is turned to the left of the agent's heading."""
HFOV_DEG = 105.0
"""Neighbouring views share 15 degrees, so that whatever is cut by the edge of one is whole in another."""
SIZE = (384, 448)
"""(H, W) of a view."""
CAMERA_HEIGHT = 1.0
"""Metres above what the agent stands on, which is the floor unless it has stepped onto something low."""
LEVELS = (0.85, 1.6)
"""Metres below the camera between which the floor is looked for."""
LEVEL_STEP = 0.05
"""Metres between levels that are told apart."""
LEAST_ROWS = 64
"""Rows of a panorama from which levels can be measured."""
LEVEL_REACH = 5.0
"""Metres within which the floor's level is measured."""
LEVEL_STRIDE = 4
"""Every so many rows and columns of a panorama are measured."""


@dataclass(frozen=True)
class Views:
    """Perspective views of one observation, in the order of `VIEW_NAMES`."""

    images: NDArray[np.uint8]
    """uint8 [4, H, W, 3]."""
    depth: NDArray[np.float32]
    """float32 [4, H, W]: planar, along each view's axis, in metres; 0 where nothing is hit."""
    T_start_camera: NDArray[np.float64]
    """float64 [4, 4, 4]: camera coordinates (right +X, up +Y, looking down -Z) to the frame of the start."""
    odometry: NDArray[np.float64]
    """float64 [3]: where the agent stood."""
    hfov_deg: float = HFOV_DEG

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of each view."""
        return self.depth.shape[1], self.depth.shape[2]

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.size[1] / (2.0 * np.tan(np.radians(self.hfov_deg) / 2.0))


def cut_views(
    panorama: NDArray[np.uint8],
    depth: NDArray[np.float32],
    odometry: NDArray[np.float64],
    size: tuple[int, int] = SIZE,
    hfov_deg: float = HFOV_DEG,
) -> Views:
    """Cut the four views out of a panorama uint8 [H, W, 3] and its distances along the ray float32 [H, W].

    Raises:
        ArgumentError: arrays of other shapes.
    """
    check_panorama(depth, odometry)
    if panorama.shape != (*depth.shape, 3):
        raise ArgumentError(
            f"cut_views: expected a panorama of {(*depth.shape, 3)}, the size of its depth, got {panorama.shape}"
        )
    images = cut_images(panorama, size, hfov_deg)
    distance = cut_labels(depth, size, hfov_deg)
    cameras = place_cameras(odometry, measure_camera_height(depth))
    return Views(images, distance_to_planar(distance, hfov_deg), cameras, odometry.copy(), hfov_deg)


def cut_images(
    panorama: NDArray[np.uint8], size: tuple[int, int] = SIZE, hfov_deg: float = HFOV_DEG
) -> NDArray[np.uint8]:
    """Cut the four views out of a panorama uint8 [H, W, 3]: [4, h, w, 3]."""
    return to_perspective(panorama, hfov_deg, size, VIEW_YAWS_DEG)


def cut_labels(values: NDArray[Any], size: tuple[int, int] = SIZE, hfov_deg: float = HFOV_DEG) -> NDArray[Any]:
    """Cut the four views out of a panorama [H, W] of ids, labels or distances, none of them interpolated: [4, h, w]."""
    return to_perspective(values[..., None], hfov_deg, size, VIEW_YAWS_DEG, interpolation="nearest")[..., 0]


def place_cameras(odometry: NDArray[np.float64], height: float = CAMERA_HEIGHT) -> NDArray[np.float64]:
    """Return T_start_camera of the four views, float64 [4, 4, 4], for an agent at (x, y, azimuth), its camera so many
    metres above the floor.
    """
    x, y, azimuth = odometry
    angles = azimuth + np.radians(VIEW_YAWS_DEG)
    cos, sin = np.cos(angles), np.sin(angles)
    poses = np.zeros((len(angles), 4, 4))
    poses[:, 0, 0], poses[:, 1, 0] = sin, -cos  # the camera's right
    poses[:, 2, 1] = 1.0  # its up
    poses[:, 0, 2], poses[:, 1, 2] = -cos, -sin  # its back
    poses[:, :, 3] = (x, y, height, 1.0)
    return poses


def measure_camera_height(depth: NDArray[np.float32]) -> float:
    """Return how many metres the camera of a panorama of distances float32 [H, W] is above the floor.

    The floor is the level below the camera at which most area lies. Agents can step onto low things, such as a coffee
    table; odometry does not tell, and all that they see from there would be mapped too low. Levels near `CAMERA_HEIGHT`
    count as that. Beside a larger floor up to 0.6 m lower, that is taken for the floor, and the agent's own for things.
    """
    if depth.shape[0] < LEAST_ROWS:
        return CAMERA_HEIGHT
    rows, down, away = _get_rays_below(depth.shape[0])
    seen = depth[rows, LEVEL_STRIDE // 2 :: LEVEL_STRIDE].astype(np.float64)
    level, flat = seen * down, seen * away
    found = (seen > 0) & (flat < LEVEL_REACH) & (level > LEVELS[0]) & (level < LEVELS[1])
    if not found.any():
        return CAMERA_HEIGHT
    level, area = level[found], (seen * flat / down)[found]  # of a level surface, by solid angle
    steps = (level / LEVEL_STEP).astype(np.intp)
    totals = np.convolve(np.bincount(steps, area), np.ones(3), "same")  # a level may lie at the edge of two steps
    near = np.abs(steps - totals.argmax()) <= 1
    height = float(np.average(level[near], weights=area[near]))
    return height if height > CAMERA_HEIGHT + 2 * LEVEL_STEP else CAMERA_HEIGHT


@lru_cache(maxsize=8)
def _get_rays_below(height: int) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return the measured rows below the horizon, [R], and how far their rays lead down and away per metre, [R, 1]."""
    rows = np.arange(height // 2 + LEVEL_STRIDE // 2, height, LEVEL_STRIDE)
    pitch = np.pi * ((rows + 0.5) / height - 0.5)
    return rows, np.sin(pitch)[:, None], np.cos(pitch)[:, None]


def unproject(views: Views, view: NDArray[np.intp], rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[Any]:
    """Return the points, float64 [N, 3] in the frame of the start, that N pixels show."""
    height, width = views.size
    depth = views.depth[view, rows, columns].astype(np.float64)
    right = (columns + (0.5 - width / 2.0)) * depth
    up = (height / 2.0 - 0.5 - rows) * depth
    axes = views.T_start_camera[:, :3, :3] * (1.0 / views.focal, 1.0 / views.focal, -1.0)
    points = np.empty((len(view), 3))
    for axis in range(3):
        points[:, axis] = (
            axes[view, axis, 0] * right
            + axes[view, axis, 1] * up
            + axes[view, axis, 2] * depth
            + views.T_start_camera[view, axis, 3]
        )
    return points


def project(views: Views, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where N points appear in each view: pixels (x, y) float64 [4, N, 2], and planar depth [4, N].

    A point behind a camera has a depth of at most 0, and no meaningful pixel.
    """
    height, width = views.size
    rotation, origin = views.T_start_camera[:, :3, :3], views.T_start_camera[:, :3, 3]
    local = np.einsum("vij,vni->vnj", rotation, points[None] - origin[:, None])
    depth = -local[..., 2]
    scale = views.focal / np.where(depth > 0, depth, np.inf)
    pixels = np.stack([width / 2.0 + local[..., 0] * scale, height / 2.0 - local[..., 1] * scale], axis=-1)
    return pixels, depth


def check_panorama(depth: NDArray[np.float32], odometry: NDArray[np.float64]) -> None:
    """Check the arrays of one observation.

    Raises:
        ArgumentError: naming what is not as expected.
    """
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ArgumentError(f"expected depth float32 [H, W] of a panorama, got {depth.dtype} {list(depth.shape)}")
    if odometry.shape != (3,) or not np.isfinite(odometry).all():
        raise ArgumentError(f"expected odometry float64 [3] (x, y, azimuth), all finite, got {odometry}")
