# SPDX-License-Identifier: Apache-2.0
"""Pictures to Runway's service, videos from it."""

from __future__ import annotations

import base64
import http.client
import tempfile
import urllib.request
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import InfrastructureError

MOST_BYTES = 256 << 20
SECONDS = 60.0
"""That the server may keep silent."""


def encode_data_uri(image: NDArray[np.uint8]) -> str:
    """Encode an image uint8 [H, W, 3] as PNG in a data URI."""
    png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1]
    return f"data:image/png;base64,{base64.b64encode(png.tobytes()).decode('ascii')}"


def fetch_video(url: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return all frames of the video at an address, uint8 [T, H, W, 3] in (height, width) `size`.

    Raises:
        InfrastructureError: it cannot be downloaded as a whole, is larger than 256 MB, or is not a video.
    """
    if not url.startswith(("https://", "http://")):
        raise InfrastructureError(f"RunwayGen4: expected the address of a video, got '{url[:80]}'")
    try:
        with urllib.request.urlopen(url, timeout=SECONDS) as answer:
            content = answer.read(MOST_BYTES + 1)
            missing = answer.length or 0
    except (OSError, http.client.HTTPException) as error:
        raise InfrastructureError(f"RunwayGen4: the video cannot be downloaded: {error}") from error
    if len(content) > MOST_BYTES:
        raise InfrastructureError(f"RunwayGen4: the video is larger than {MOST_BYTES >> 20} MB")
    if missing:
        raise InfrastructureError(f"RunwayGen4: the video cannot be downloaded: its last {missing} bytes did not come")
    return decode_video(content, size)


def decode_video(content: bytes, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return all frames of a video file's content, uint8 [T, H, W, 3] in (height, width) `size`.

    Raises:
        InfrastructureError: it has no frame.
    """
    height, width = size
    frames = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        path.write_bytes(content)
        video = cv2.VideoCapture(str(path))
        while True:
            there, frame = video.read()
            if not there:
                break
            small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
            frames.append(cv2.cvtColor(small, cv2.COLOR_BGR2RGB))
        video.release()
    if not frames:
        raise InfrastructureError(f"RunwayGen4: {len(content)} bytes were received, which are not a video")
    return np.asarray(np.stack(frames), np.uint8)
