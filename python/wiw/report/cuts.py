# SPDX-License-Identifier: Apache-2.0
"""Kept pictures, cut and scaled for a page."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.runs.rows import decode_jpeg, encode_jpeg

BAND = (0.2, 0.8)
"""Rows of a panorama that are shown: 54 degrees up and down; the rest is ceiling and floor."""
FRONT = (0.25, 0.75)
"""Columns of an imagined panorama that are shown: the front half, where the plan leads."""
GAP = 3
"""Pixels between the frames of a strip."""


def panorama(jpeg: bytes, width: int, quality: int) -> bytes:
    """The part of a panorama that is shown, at most so many pixels wide."""
    band = part(decode_jpeg(jpeg), BAND, (0, 1))
    return _jpeg(band, width / band.shape[1], quality)


def front(jpeg: bytes, side: int, quality: int) -> bytes:
    """A camera's picture, at most so many pixels wide."""
    image = decode_jpeg(jpeg)
    return _jpeg(image, side / image.shape[1], quality)


def strip(jpeg: bytes, count: int, height: int, quality: int) -> bytes:
    """Frames side by side, at most so many pixels high; of panoramas only the part towards which the agent looks."""
    tiles = np.split(decode_jpeg(jpeg), count, axis=1)
    if tiles[0].shape[1] > 1.6 * tiles[0].shape[0]:
        tiles = [part(tile, BAND, FRONT) for tile in tiles]
    gap = np.full((len(tiles[0]), GAP, 3), 255, np.uint8)
    spaced = np.concatenate([own for tile in tiles for own in (tile, gap)][:-1], axis=1)
    return _jpeg(spaced, height / len(spaced), quality)


def frames(jpeg: bytes, count: int, height: int, quality: int, whole: bool) -> bytes:
    """A strip of frames without gaps, at most so many pixels high, or the last one of them."""
    image = decode_jpeg(jpeg)
    return _jpeg(image if whole else image[:, -image.shape[1] // count :], height / len(image), quality)


def part(image: NDArray[np.uint8], rows: tuple[float, float], columns: tuple[float, float]) -> NDArray[np.uint8]:
    """Rows and columns between these shares of an image."""
    height, width = image.shape[:2]
    return image[
        round(rows[0] * height) : round(rows[1] * height), round(columns[0] * width) : round(columns[1] * width)
    ]


def _jpeg(image: NDArray[np.uint8], scale: float, quality: int) -> bytes:
    """JPEG bytes of an image, smaller by `scale` where that is below 1."""
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return encode_jpeg(image, quality)
