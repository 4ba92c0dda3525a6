# SPDX-License-Identifier: Apache-2.0
"""Equirectangular panoramas: perspective views, cube maps, turns, directions, sizes.

Columns cover 360 degrees, with the front in the middle and the right at larger columns; rows cover 180 degrees from
straight up to straight down, whatever the aspect ratio; pixel centres lie at half integers. Images are arrays ``[H,
W]``, ``[H, W, C]`` or ``[B, H, W, C]`` of uint8, float32 or, for ids and with ``interpolation="nearest"`` only, uint32.
A wrong shape, type or angle raises ``wiw.errors.ArgumentError``.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import panorama as _core
from wiw.errors import ArgumentError

__all__ = [
    "PerspectivePlan",
    "directions",
    "distance_to_planar",
    "from_cubemap",
    "planar_to_distance",
    "resize",
    "rotate",
    "to_cubemap",
    "to_perspective",
]

Image = NDArray[Any]
Size = tuple[int, int]
Interpolation = Literal["bilinear", "nearest"]
Convention = Literal["wiw", "py360convert"]


def _batch(images: Image) -> tuple[Image, int]:
    """Return any accepted image array as [B, H, W, C], and its original number of axes."""
    images = np.asarray(images)
    if images.ndim == 2:
        return images[None, :, :, None], 2
    if images.ndim == 3:
        return images[None], 3
    if images.ndim == 4:
        return images, 4
    raise ArgumentError(f"images: expected [H, W], [H, W, C] or [B, H, W, C], got {list(images.shape)}")


def _unbatch(images: Image, ndim: int) -> Image:
    if ndim == 4:
        return images
    return images[0] if ndim == 3 else images[0, ..., 0]


def _reshape_view(out: Image, shape: tuple[int, ...]) -> Image:
    """Return ``out`` with the axes of size 1 that the caller left out; never a copy."""
    if out.size != np.prod(shape) or not out.flags.c_contiguous:
        raise ArgumentError(f"out: expected a C-contiguous array of {shape}, got {list(out.shape)}")
    return out.reshape(shape)


class PerspectivePlan:
    """Perspective views of panoramas of one size; build it once, call it often.

    The look-up table is shared by all yaws that are whole columns (at W = 1024 every multiple of 22.5 degrees); other
    yaws get their own, of which the latest 16 are kept.

    Args:
        pano_size: (H, W) of the panoramas; W even.
        size: (h, w) of the views.
        hfov_deg: horizontal field of view between the outer edges of the outer pixels, 0 to 180 exclusive; pixels are
            square.
        pitch_deg: positive looks up, -90 to 90.
        convention: ``"py360convert"`` reproduces ``py360convert.e2p`` with a scalar field of view: the angle lies
            between the centres of the outer pixels, is the same in both axes, and a positive yaw looks right.
    """

    def __init__(
        self,
        pano_size: Size,
        size: Size,
        hfov_deg: float,
        pitch_deg: float = 0.0,
        *,
        convention: Convention = "wiw",
    ) -> None:
        if convention not in ("wiw", "py360convert"):
            raise ArgumentError(f"convention: expected 'wiw' or 'py360convert', got {convention!r}")
        self.pano_size = (int(pano_size[0]), int(pano_size[1]))
        self.size = (int(size[0]), int(size[1]))
        self.hfov_deg = float(hfov_deg)
        self.pitch_deg = float(pitch_deg)
        self.convention = convention
        other = convention == "py360convert"
        self._yaw_sign = -1.0 if other else 1.0
        self._plan = _core.PerspectivePlan(self.pano_size, self.size, self.hfov_deg, self.pitch_deg, other)

    def __call__(
        self,
        panos: Image,
        yaw_deg: float | Sequence[float] = 0.0,
        interpolation: Interpolation = "bilinear",
        out: Image | None = None,
    ) -> Image:
        """Cut views out of ``panos``.

        ``yaw_deg`` is positive to the left. One yaw gives ``[h, w, C]`` per panorama (with a leading B for a batch); a
        sequence of Y yaws gives all views of each, ``[Y, h, w, C]`` or ``[B, Y, h, w, C]``. ``out``, a C-contiguous
        array of the result's shape and type, is written to and returned; reusing one in a loop saves the allocation of
        a new array.
        """
        images, ndim = _batch(panos)
        yaws = np.asarray(yaw_deg, dtype=np.float64)
        if yaws.ndim > 1:
            raise ArgumentError(f"yaw_deg: expected a number or a sequence [Y], got {list(yaws.shape)}")
        angles = (self._yaw_sign * yaws.reshape(-1)).tolist()
        shape = (images.shape[0], len(angles), *self.size, images.shape[3])
        views = self._plan(images, angles, interpolation, None if out is None else _reshape_view(out, shape))
        if yaws.ndim == 0:
            views = views[:, 0]
        return _unbatch(views, ndim)


@lru_cache(maxsize=32)
def _perspective_plan(
    pano_size: Size, size: Size, hfov: float, pitch: float, convention: Convention
) -> PerspectivePlan:
    return PerspectivePlan(pano_size, size, hfov, pitch, convention=convention)


@lru_cache(maxsize=8)
def _cube_plan(pano_size: Size, face_size: int, to_cube: bool) -> Any:
    return _core.CubePlan(pano_size, face_size, to_cube)


def to_perspective(
    pano: Image,
    hfov_deg: float,
    size: Size,
    yaw_deg: float | Sequence[float] = 0.0,
    pitch_deg: float = 0.0,
    interpolation: Interpolation = "bilinear",
    *,
    convention: Convention = "wiw",
) -> Image:
    """Cut a perspective view of ``size`` (h, w) out of ``pano`` ``[H, W, C]`` or ``[B, H, W, C]``.

    Plans of recent sizes and angles are kept. See :class:`PerspectivePlan` for angles, conventions and shapes.
    """
    images, _ = _batch(pano)
    pano_size = (images.shape[1], images.shape[2])
    plan = _perspective_plan(pano_size, (int(size[0]), int(size[1])), float(hfov_deg), float(pitch_deg), convention)
    return plan(pano, yaw_deg, interpolation)


def to_cubemap(pano: Image, face_size: int, interpolation: Interpolation = "bilinear") -> Image:
    """Return six faces ``[6, S, S, C]`` (``[B, 6, S, S, C]`` for a batch) of 90 degrees between pixel edges.

    Order: front, right, back, left, up, down. Side faces are upright; the lower edge of ``up`` and the upper edge of
    ``down`` touch the front.
    """
    images, ndim = _batch(pano)
    stack = _cube_plan((images.shape[1], images.shape[2]), int(face_size), True)(images, interpolation)
    faces = stack.reshape(stack.shape[0], 6, face_size, face_size, stack.shape[-1])
    return _unbatch(faces, ndim)


def from_cubemap(faces: Image, size: Size, interpolation: Interpolation = "bilinear") -> Image:
    """Return the panorama of ``size`` (H, W) from faces ``[6, S, S]``, ``[6, S, S, C]`` or ``[B, 6, S, S, C]``.

    Inverse of :func:`to_cubemap`. Texels of both faces are blended across the cube's edges, without a seam.
    """
    faces = np.asarray(faces)
    ndim = faces.ndim - 1
    if ndim == 2:
        faces = faces[None, ..., None]
    elif ndim == 3:
        faces = faces[None]
    if faces.ndim != 5 or faces.shape[1] != 6 or faces.shape[2] != faces.shape[3]:
        raise ArgumentError(f"faces: expected [6, S, S], [6, S, S, C] or [B, 6, S, S, C], got {list(faces.shape)}")
    count, _, side, _, channels = faces.shape
    stack = faces.reshape(count, 6 * side, side, channels)
    return _unbatch(_cube_plan((int(size[0]), int(size[1])), side, False)(stack, interpolation), ndim)


def rotate(pano: Image, yaw_deg: float, interpolation: Interpolation = "bilinear") -> Image:
    """Return the view after a turn to the left by ``yaw_deg``: 22.5 degrees roll the image by exactly +W/16 columns.

    Turns by whole columns copy them, whatever the type; other yaws blend neighbouring columns (uint32: only
    ``"nearest"``).
    """
    images, ndim = _batch(pano)
    return _unbatch(_core.rotate(images, float(yaw_deg), interpolation), ndim)


def resize(images: Image, size: Size) -> Image:
    """Shrink uint8 or float32 images to ``size`` (H, W) by the exact mean over each new pixel's area."""
    batch, ndim = _batch(images)
    return _unbatch(_core.resize(batch, (int(size[0]), int(size[1]))), ndim)


def directions(size: Size) -> NDArray[np.float32]:
    """Return unit vectors ``[H, W, 3]`` through the pixel centres of a panorama: Y up, front -Z, right +X."""
    return _core.directions((int(size[0]), int(size[1])))


@lru_cache(maxsize=8)
def _ray_lengths(size: Size, hfov_deg: float) -> NDArray[np.float32]:
    """Return the length of the ray [x, y, -1] of each pixel of a perspective view."""
    height, width = size
    pitch = 2.0 * np.tan(np.radians(hfov_deg) / 2.0) / width
    x = (np.arange(width) + 0.5 - width / 2.0) * pitch
    y = (np.arange(height) + 0.5 - height / 2.0) * pitch
    lengths = np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    lengths.setflags(write=False)
    return lengths


def distance_to_planar(distance: NDArray[np.float32], hfov_deg: float) -> NDArray[np.float32]:
    """Convert distances along the ray in perspective views ``[..., h, w]`` to planar depth (along the optical axis).

    A view cut out of a panorama's depth holds distances; perspective cameras report planar depth. Both in metres; 0,
    where nothing is hit, stays 0.
    """
    return distance / _ray_lengths((distance.shape[-2], distance.shape[-1]), float(hfov_deg))


def planar_to_distance(planar: NDArray[np.float32], hfov_deg: float) -> NDArray[np.float32]:
    """Convert planar depth to distance along the ray: the inverse of :func:`distance_to_planar`."""
    return planar * _ray_lengths((planar.shape[-2], planar.shape[-1]), float(hfov_deg))
