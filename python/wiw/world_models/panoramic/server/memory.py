# SPDX-License-Identifier: Apache-2.0
"""A memory of panoramas as points in space, and what it looks like from another place.

Axes are those of the official code of PathDreamer and SE3DS: x to the right, y to the middle of the panorama, z up, in
metres. A panorama's columns cover 360 degrees, its rows 180, pixel centres lie at half integers. Depth is the distance
along the ray as a share of a scale, such as 10 m; 0 is nothing, and what lies at the scale or beyond is 1 and no point.

This file needs NumPy alone and Python 3.8: it also runs in the environments of networks that are older than wiw.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLURRED = 8
"""At the top and the bottom of Matterport3D's panoramas one row in eight is blurred, and is not remembered."""


class Sight(NamedTuple):
    """View of a memory from a place."""

    features: NDArray[Any]
    """[H, W, ...]: of the nearest point in each pixel, 0 if there is none."""
    depth: NDArray[np.float32]
    """float32 [H, W]: its distance, 1 if there is none."""
    seen: NDArray[np.bool_]
    """bool [H, W]: whether there is one."""


class Memory:
    """Points with features, such as colours or labels, gathered from panoramas.

    Args:
        scale: metres that a depth of 1 stands for.
    """

    def __init__(self, scale: float) -> None:
        self.scale = scale
        self._points: list[NDArray[np.float32]] = []
        self._features: list[NDArray[Any]] = []

    def __len__(self) -> int:
        return sum(map(len, self._points))

    def add(
        self,
        features: NDArray[Any],
        depth: NDArray[np.float32],
        position: Sequence[float],
        keep: NDArray[np.bool_] | None = None,
    ) -> None:
        """Add a panorama that was seen at a position, as far as its depth is known.

        Args:
            features: [H, W, ...] of any type.
            depth: float32 [H, W], shares of the scale.
            position: metres.
            keep: bool [H, W]: which pixels to remember; None means all of them.
        """
        known = (depth > 0) & (depth < 1) if keep is None else (depth > 0) & (depth < 1) & keep
        rays = directions(depth.shape)[known]
        distances = self.scale * depth[known].astype(np.float32)
        self._points.append(np.asarray(position, np.float32) + distances[:, None] * rays)
        self._features.append(features[known])

    def view_from(self, position: Sequence[float], size: tuple[int, int]) -> Sight:
        """Return the panorama of a size [H, W] at a position; of points in one pixel the nearest is seen.

        Raises:
            ValueError: nothing was ever added.
        """
        points, features = np.concatenate(self._points), np.concatenate(self._features)
        self._points, self._features = [points], [features]
        pixels, distances = project(points - np.asarray(position, np.float32), size)
        farthest_first = np.argsort(-distances, kind="stable")
        owner = np.full(size[0] * size[1], -1, np.int64)
        owner[pixels[farthest_first]] = farthest_first  # of values for one index the last one stays
        seen = owner >= 0
        picture = np.zeros((len(owner), *features.shape[1:]), features.dtype)
        depth = np.ones(len(owner), np.float32)
        picture[seen] = features[owner[seen]]
        depth[seen] = np.minimum(1, distances[owner[seen]] / self.scale)
        return Sight(picture.reshape(*size, *features.shape[1:]), depth.reshape(size), seen.reshape(size))


def directions(size: tuple[int, ...]) -> NDArray[np.float32]:
    """Return unit vectors through the pixel centres, float32 [H, W, 3]."""
    height, width = size
    down = (np.arange(height) + 0.5) / height * np.pi
    right = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    level, up = np.sin(down)[:, None], np.broadcast_to(np.cos(down)[:, None], (height, width))
    return np.stack([level * np.sin(right), level * np.cos(right), up], axis=-1).astype(np.float32)


def project(points: NDArray[np.float32], size: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of the pixel in which each point [N, 3] lies, counted row by row, and its distance."""
    height, width = size
    x, y, z = points.T
    distance = np.sqrt(x * x + y * y + z * z)
    column = np.floor((np.arctan2(x, y) / (2 * np.pi) + 0.5) * width).astype(np.int64) % width
    row = np.floor(np.arctan2(np.hypot(x, y), z) / np.pi * height).astype(np.int64)
    return np.minimum(row, height - 1) * width + column, distance


def sharp_rows(height: int) -> slice:
    """Return the rows that are not blurred: 64 to 448 of 512."""
    return slice(height // BLURRED, height - height // BLURRED + 1)


def resize_nearest(image: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Resize an image [H, W, ...] without new values: for depth and labels, which do not blend."""
    rows, columns = (((np.arange(size[i]) + 0.5) * image.shape[i] / size[i]).astype(np.int64) for i in (0, 1))
    return image[rows[:, None], columns]


def resize_smooth(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize a panorama uint8 [H, W, 3] bilinearly; its left and right edges meet."""
    rows, columns = (_interpolate_places(image.shape[i], size[i], wraps=i == 1) for i in (0, 1))
    blend = _blend(image.astype(np.float32), *rows) if size[0] != image.shape[0] else image
    if size[1] != image.shape[1]:
        blend = _blend(blend.swapaxes(0, 1).astype(np.float32), *columns).swapaxes(0, 1)
    return np.round(blend).astype(np.uint8)


def _interpolate_places(
    old: int, new: int, wraps: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Return for each of `new` samples the two of `old` that it lies between, and how far from the first."""
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place).astype(np.int64)
    both = np.stack([first, first + 1])
    both = both % old if wraps else np.clip(both, 0, old - 1)
    return both[0], both[1], (place - first).astype(np.float32)[:, None, None]


def _blend(image: NDArray[Any], one: NDArray[np.int64], other: NDArray[np.int64], part: NDArray[Any]) -> NDArray[Any]:
    return (1 - part) * image[one] + part * image[other]


def turn_panorama(image: NDArray[Any], yaw: float) -> NDArray[Any]:
    """Turn a panorama left by `yaw` radians, to the nearest column: a turn by 22.5 degrees is exact."""
    return np.roll(image, round(float(yaw) / (2 * np.pi) * image.shape[1]), axis=1)


def locate_camera(viewpoint: NDArray[np.float64]) -> tuple[tuple[float, float, float], float]:
    """Return the position, in the axes of this file, and the yaw (left positive) of a pose of wiw.

    The pose is T_start_camera [4, 4], whose axes are right, up and back.

    Raises:
        ValueError: a camera that is pitched or rolled, which a turn of a panorama cannot show.
    """
    if abs(viewpoint[1, 1] - 1) > 1e-6:
        raise ValueError("expected cameras that stand upright, got one that is pitched or rolled")
    right, up, back = viewpoint[:3, 3]
    return (float(right), -float(back), float(up)), float(np.arctan2(viewpoint[0, 2], viewpoint[2, 2]))
