# SPDX-License-Identifier: Apache-2.0
"""Distances between images: PSNR and SSIM, plain or weighted over the sphere of a panorama."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw._core import metrics as _core
from wiw.errors import ArgumentError

Weights = Literal["uniform", "latitude"]


def psnr(
    a: ArrayLike, b: ArrayLike, *, weights: Weights = "uniform", data_range: float | None = None
) -> float | NDArray[np.float64]:
    """Return the peak signal-to-noise ratio in dB, higher is closer; equal images give 100, so that means stay finite.

    Args:
        a: uint8 or float [..., H, W, C].
        b: the same shape and type.
        weights: "latitude" weighs rows by the cosine of their latitude, for equirectangular panoramas (WS-PSNR).
        data_range: span of the values; default 255 for uint8, 1 for floats.

    Returns:
        A float for two images, float64 [...] for batches.

    Raises:
        ArgumentError: shapes or types that differ, or NaN.
    """
    return _compare(_core.psnr, a, b, weights, data_range)


def ssim(
    a: ArrayLike, b: ArrayLike, *, weights: Weights = "uniform", data_range: float | None = None
) -> float | NDArray[np.float64]:
    """Return SSIM in [-1, 1], 1 for equal images: Gaussian window 11x11, sigma 1.5, mean over channels.

    Windows lie inside the image; with weights="latitude" they wrap around a panorama's seam and count with the cosine
    of their latitude. Arguments, result and errors as for `psnr`; images are at least 11x11 pixels.
    """
    return _compare(_core.ssim, a, b, weights, data_range)


def _compare(
    measure: Callable[..., Any], a: ArrayLike, b: ArrayLike, weights: str, data_range: float | None
) -> float | NDArray[np.float64]:
    first, second = np.asarray(a), np.asarray(b)
    if first.shape != second.shape or first.dtype != second.dtype or first.ndim < 3:
        raise ArgumentError(
            "expected two images [..., H, W, C] of one shape and type, got "
            f"{first.dtype} {first.shape} and {second.dtype} {second.shape}"
        )
    if first.dtype != np.uint8 and not np.issubdtype(first.dtype, np.floating):
        raise ArgumentError(f"expected uint8 or float images, got {first.dtype}")
    kind = np.uint8 if first.dtype == np.uint8 else np.float32
    span = data_range if data_range is not None else (255.0 if kind is np.uint8 else 1.0)
    batch = first.shape[:-3]
    left, right = (image.astype(kind, copy=False).reshape(-1, *image.shape[-3:]) for image in (first, second))
    values = np.asarray(measure(left, right, span, weights))
    return values.reshape(batch) if batch else float(values[0])
