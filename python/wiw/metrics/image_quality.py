# SPDX-License-Identifier: Apache-2.0
"""How good an image looks on its own, without a reference image: sharpness and colourfulness by formula.

Both are plain statistics of pixels. They ignore what is shown: noise counts as sharp, and a poster as colourful.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError


def sharpness(image: NDArray[np.uint8]) -> float:
    """Return the variance of the Laplacian of an image's luma, in squared grey levels; 0 for a plain area.

    Source: Pech-Pacheco et al., Diatom autofocusing in brightfield microscopy, ICPR 2000 (LAPV). The Laplacian is the
    3x3 one with -4 in its centre; beyond the border the image is mirrored.

    Args:
        image: uint8 [H, W, 3], RGB, at least 3x3 pixels.

    Raises:
        ArgumentError: another type or shape.
    """
    luma = cv2.cvtColor(_require_image(image, "sharpness"), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(luma, cv2.CV_64F).var())


def colourfulness(image: NDArray[np.uint8]) -> float:
    """Return the colourfulness of an image: 0 for grey, about 15 slightly, 45 fairly, 109 extremely colourful.

    Source: Hasler and Suesstrunk, Measuring colourfulness in natural images, SPIE 5007 (2003), their metric M3: with
    rg = R - G and yb = (R + G) / 2 - B it is sqrt(var rg + var yb) + 0.3 sqrt(mean(rg)^2 + mean(yb)^2).

    Args:
        image: uint8 [H, W, 3], RGB, at least 3x3 pixels.

    Raises:
        ArgumentError: another type or shape.
    """
    red, green, blue = np.moveaxis(_require_image(image, "colourfulness").astype(np.float64), -1, 0)
    rg, yb = red - green, (red + green) / 2 - blue
    return float(np.hypot(rg.std(), yb.std()) + 0.3 * np.hypot(rg.mean(), yb.mean()))


def paper_quality(aesthetic: Any, musiq: Any) -> Any:
    """Return q = (10 aesthetic + MUSIQ) / 2, the mean of both predictors on a scale of 100.

    Source: World-in-World averages an aesthetic predictor (1 to 10) and MUSIQ (0 to 100, Ke et al. 2021) without saying
    on which scale; this takes both to 100.

    Args:
        aesthetic: from 1 to 10; a number or an array.
        musiq: from 0 to 100; likewise.
    """
    return (10 * aesthetic + musiq) / 2


def _require_image(image: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    given = np.asarray(image)
    if given.dtype != np.uint8 or given.ndim != 3 or given.shape[-1] != 3 or min(given.shape[:2]) < 3:
        raise ArgumentError(
            f"{name}: expected a uint8 image [H, W, 3] of 3x3 pixels or more, got {given.dtype} "
            f"{given.shape}; give one RGB frame at a time"
        )
    return np.ascontiguousarray(given)
