# SPDX-License-Identifier: Apache-2.0
"""Images as data URIs, the form that OpenAI-compatible servers accept."""

from __future__ import annotations

import base64
import binascii
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError

ImageFormat = Literal["png", "jpeg"]
JPEG_QUALITY = 95
PNG_OPTIONS = (cv2.IMWRITE_PNG_COMPRESSION, 3, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
"""Run-length coding: for rendered views smaller files than a search for repeats gives, in half the time."""


def to_data_uri(image: NDArray[np.uint8], kind: ImageFormat = "png") -> str:
    """Encode an image uint8 [H, W, 3] as "data:image/png;base64,...".

    Raises:
        ArgumentError: another shape or type.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ArgumentError(f"vlm: expected an image uint8 [H, W, 3], got {image.dtype} {image.shape}")
    options = PNG_OPTIONS if kind == "png" else (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
    _, data = cv2.imencode(f".{kind}", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode()}"


def from_data_uri(uri: str) -> NDArray[np.uint8]:
    """Decode the image uint8 [H, W, 3] in a data URI.

    Raises:
        ArgumentError: something else, or an image that cannot be read.
    """
    head, comma, data = uri.partition(",")
    if not comma or not head.startswith("data:image/") or not head.endswith(";base64"):
        raise ArgumentError(f"expected an image as data:image/...;base64,..., got '{uri[:40]}'")
    try:
        raw = base64.b64decode(data, validate=True)
        image = cv2.imdecode(np.frombuffer(raw, np.uint8), cv2.IMREAD_COLOR) if raw else None
    except (binascii.Error, cv2.error) as error:
        raise ArgumentError(f"the image of {len(data)} characters cannot be read: {error}") from None
    if image is None:
        raise ArgumentError(f"the image of {len(data)} characters cannot be read: expected PNG or JPEG")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
