# SPDX-License-Identifier: Apache-2.0
"""Crop, scale and compress stored images for pages; `scale` makes them smaller still."""

from __future__ import annotations

import io

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wiw.runs.rows import decode_jpeg

BAND = (0.2, 0.8)
"""Rows of a panorama that pages show: 54 degrees up and down; the rest is ceiling and floor."""
FRONT = (0.25, 0.75)
"""Columns of an imagined panorama that pages show: the front half, where the plan leads."""
MAP_QUALITY = 60
GAP = 3
"""Pixels between the frames of a strip."""


def panorama(jpeg: bytes, width: int, quality: int, scale: float = 1.0) -> bytes:
    """Return the band of a panorama that pages show, at most `width` pixels wide."""
    band = cut_part(decode_jpeg(jpeg), BAND, (0, 1))
    return _shrink(band, scale * min(1, width / band.shape[1]), quality)


def cut_front(jpeg: bytes, side: int, quality: int, scale: float = 1.0) -> bytes:
    """Return a camera image, at most `side` pixels wide."""
    image = decode_jpeg(jpeg)
    return _shrink(image, scale * min(1, side / image.shape[1]), quality)


def strip(jpeg: bytes, count: int, height: int, quality: int, scale: float = 1.0) -> bytes:
    """Return frames side by side, at most `height` pixels high; of panoramas only the part in front of the agent."""
    tiles = np.split(decode_jpeg(jpeg), count, axis=1)
    if tiles[0].shape[1] > 1.6 * tiles[0].shape[0]:
        tiles = [cut_part(tile, BAND, FRONT) for tile in tiles]
    gap = np.full((len(tiles[0]), GAP, 3), 255, np.uint8)
    spaced = np.concatenate([own for tile in tiles for own in (tile, gap)][:-1], axis=1)
    return _shrink(spaced, scale * min(1, height / len(spaced)), quality)


def cut_frames(jpeg: bytes, count: int, height: int, quality: int, whole: bool, scale: float = 1.0) -> bytes:
    """Return frames side by side without gaps, at most `height` pixels high, or only the last one."""
    image = decode_jpeg(jpeg)
    shown = image if whole else image[:, -image.shape[1] // count :]
    return _shrink(shown, scale * min(1, height / len(image)), quality)


def shrink_map(webp: bytes, side: int) -> bytes:
    """Return a scene's map with its long side at most `side` pixels; transparent outside the scene."""
    image = Image.open(io.BytesIO(webp))
    if max(image.size) <= side:
        return webp
    image.thumbnail((side, side))
    file = io.BytesIO()
    image.save(file, "WEBP", quality=MAP_QUALITY)
    return file.getvalue()


def cut_part(image: NDArray[np.uint8], rows: tuple[float, float], columns: tuple[float, float]) -> NDArray[np.uint8]:
    """Return the rows and columns between these fractions of an image."""
    height, width = image.shape[:2]
    return image[
        round(rows[0] * height) : round(rows[1] * height), round(columns[0] * width) : round(columns[1] * width)
    ]


def _shrink(image: NDArray[np.uint8], scale: float, quality: int) -> bytes:
    """Return the WebP bytes of an image, scaled down by `scale` where that is below 1."""
    if scale < 1:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    _, data = cv2.imencode(".webp", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_WEBP_QUALITY, quality])
    return bytes(data)
