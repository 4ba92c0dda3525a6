# SPDX-License-Identifier: Apache-2.0
"""The policy's input: parts of images that show the workspace, and the 3D positions of their pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.tabletop.workbench import TABLE, Camera

CELL = 8
"""Side in pixels of the cell that becomes one token."""
WRIST_SIZE = 120
"""Side in pixels that the wrist camera's view is reduced to: it is near to what it sees."""
WORKSPACE = np.array([[-0.06, -0.34, TABLE - 0.01], [0.40, 0.34, TABLE + 0.12]])
"""Least and greatest x, y, z of the workspace, in metres."""
NOWHERE = (0.0, 0.0, -10.0)
"""Position of pixels that show nothing of the workspace, in metres."""


HEIGHT_UNIT = 0.1
"""Unit of heights in metres."""


@dataclass(frozen=True)
class WorkspaceView:
    """An image of the workspace, or part of an image; h and w are multiples of `CELL`."""

    image: NDArray[np.uint8]
    """uint8 [..., h, w, 3]."""
    height: NDArray[np.float16]
    """float16 [..., h, w]: above the table, in units of `HEIGHT_UNIT`; -1 where nothing of the workspace is seen."""
    places: NDArray[np.float32]
    """float32 [..., h / CELL, w / CELL, 3]: positions of the cells' centres in metres, or `NOWHERE`."""

    def select(self, rows: NDArray[np.int64]) -> WorkspaceView:
        """Return copies of some rows of stacked views, by their numbers."""
        return WorkspaceView(self.image[rows], self.height[rows], self.places[rows])


def stack_views(views: Sequence[WorkspaceView]) -> WorkspaceView:
    """Return N views by one camera as one, with an axis for them in front."""
    return WorkspaceView(*(np.stack([getattr(each, name) for each in views]) for name in ("image", "height", "places")))


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera that looks along -z with +y up; pixel centres are at + 0.5.

    Args:
        intrinsics: float64 [3, 3].
        T_world_camera: float64 [4, 4].
    """

    intrinsics: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]

    @classmethod
    def from_camera(
        cls, camera: Camera, size: tuple[int, ...], T_world_camera: NDArray[np.float64] | None = None
    ) -> PinholeCamera:
        """Create the model of a camera of the workbench; one on the hand is where `T_world_camera` says."""
        height, width = size
        focal = width / 2 / np.tan(np.radians(camera.hfov_deg) / 2)
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return cls(intrinsics, camera.pose if T_world_camera is None else T_world_camera)

    def reduce(self, factor: int) -> PinholeCamera:
        """Return the camera of images whose sides are so many times shorter."""
        return PinholeCamera(np.diag([1 / factor, 1 / factor, 1.0]) @ self.intrinsics, self.T_world_camera)

    def find_window(self, size: tuple[int, int]) -> tuple[slice, slice]:
        """Return rows and columns around the workspace in an image [height, width], whole cells.

        Raises:
            ArgumentError: it is not in view.
        """
        corners = np.array(list(product(*WORKSPACE.T))) - self.T_world_camera[:3, 3]
        seen = corners @ self.T_world_camera[:3, :3] * (1, -1, -1)
        pixels = (seen @ self.intrinsics.T / seen[:, 2:])[:, 1::-1]
        least = np.maximum(np.floor(pixels.min(axis=0) / CELL), 0).astype(int) * CELL
        most = np.minimum(np.ceil(pixels.max(axis=0) / CELL), np.array(size) // CELL).astype(int) * CELL
        if (seen[:, 2] <= 0).any() or (most - least < 4 * CELL).any():
            raise ArgumentError(f"the workspace is not in view of the camera at {self.T_world_camera[:3, 3].tolist()}")
        return slice(int(least[0]), int(most[0])), slice(int(least[1]), int(most[1]))

    def crop(self, rows: slice, columns: slice) -> PinholeCamera:
        """Return the camera of a window of its images."""
        intrinsics = self.intrinsics.copy()
        intrinsics[:2, 2] -= columns.start, rows.start
        return PinholeCamera(intrinsics, self.T_world_camera)

    def view_workspace(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> WorkspaceView:
        """Return the workspace's part of an image [H, W, 3] with planar depth [H, W] in metres.

        Raises:
            ArgumentError: the workspace is not in view.
        """
        rows, columns = self.find_window(depth.shape)
        return self.crop(rows, columns)._view(image[rows, columns], depth[rows, columns])

    def view_from_wrist(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> WorkspaceView:
        """Return the whole image [H, W, 3] with planar depth [H, W] in metres, reduced to `WRIST_SIZE`.

        A reduced pixel has the mean colour of its pixels, and the depth of the one in its middle, lest there be points
        between an edge and what is behind it.

        Raises:
            ArgumentError: the image is not square, or its side is no multiple of `WRIST_SIZE`.
        """
        factor, rest = divmod(depth.shape[0], WRIST_SIZE)
        if depth.shape[0] != depth.shape[1] or rest or not factor:
            raise ArgumentError(
                f"the wrist camera's view: expected a square with a side that is a multiple of {WRIST_SIZE}, got "
                f"{depth.shape[0]}x{depth.shape[1]}"
            )
        blocks = image.reshape(WRIST_SIZE, factor, WRIST_SIZE, factor, 3)
        middles = slice(factor // 2, None, factor)
        reduced = np.rint(blocks.mean(axis=(1, 3), dtype=np.float32)).astype(np.uint8)
        return self.reduce(factor)._view(reduced, depth[middles, middles])

    def _view(self, image: NDArray[np.uint8], depth: NDArray[np.float32]) -> WorkspaceView:
        points = self.unproject(depth)
        middles = slice(CELL // 2, None, CELL)
        height = np.clip((points[..., 2] - TABLE) / HEIGHT_UNIT, -1, 2)
        return WorkspaceView(
            np.ascontiguousarray(image),
            height.astype(np.float16),
            points[middles, middles].astype(np.float32, order="C"),
        )

    def unproject(self, depth: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the 3D positions of pixels with planar depth [..., h, w]: float64 [..., h, w, 3], in metres.

        Pixels outside the workspace, and those that hit nothing, are `NOWHERE`.
        """
        height, width = depth.shape[-2:]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
        rays = (pixels @ np.linalg.inv(self.intrinsics).T * (1, -1, -1)) @ self.T_world_camera[:3, :3].T
        found = depth[..., None] * rays + self.T_world_camera[:3, 3]
        inside = ((found > WORKSPACE[0]) & (found < WORKSPACE[1])).all(axis=-1) & (depth > 0)
        return np.where(inside[..., None], found, NOWHERE)
