# SPDX-License-Identifier: Apache-2.0
"""A detector in its own process, queried over HTTP; `docs/perception.md` has the protocol and a server script."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Sequence
from http.client import HTTPException
from typing import Any
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, Request, build_opener

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, RemoteError
from wiw.perception.detection import Detections, Detector, no_detections

VERSION = 1
MAX_BYTES = 64 * 2**20
"""Greatest size of a response."""


class Remote(Detector):
    """Sends images and names, and receives boxes.

    Args:
        address: http://HOST:PORT. There is no token and no encryption: keep it on this machine, or in a tunnel.
        seconds: timeout of a request.

    Raises:
        ArgumentError: an invalid address, or a timeout that is not above 0.
    """

    def __init__(self, address: str, seconds: float = 60.0) -> None:
        if not _is_address(address):
            raise ArgumentError(f"expected a detector's address http://HOST:PORT, got '{address}'")
        if not seconds > 0:
            raise ArgumentError(f"seconds: expected more than 0, got {seconds}")
        self.address, self.seconds = address.rstrip("/"), seconds

    def find(
        self, images: Sequence[NDArray[np.uint8]], names: Sequence[str], ids: Sequence[NDArray[np.uint32]]
    ) -> list[Detections]:
        """Send one request for all images.

        Raises:
            RemoteError: no connection ("connection"), no response in time ("deadline"), an error of the server
                ("raised"), or a response that breaks the protocol ("message").
        """
        question = {"version": VERSION, "names": list(names), "images": [_encode_png(image) for image in images]}
        response = self._post(json.dumps(question).encode())
        try:
            answers = json.loads(response)["detections"]
            return [_parse_detections(answer) for answer in answers]
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise RemoteError(
                f"{self.address}: expected {{'detections': [[{{'box': 4 numbers, 'score': number, 'label': name}}]]}} "
                f"with a list for each image, got {response[:80]!r} ({type(error).__name__}: {error})",
                "message",
            ) from error

    def _post(self, body: bytes) -> bytes:
        request = Request(f"{self.address}/detect", body, {"Content-Type": "application/json"})
        try:
            with build_opener(ProxyHandler({})).open(request, timeout=self.seconds) as answer:
                response = self._read_body(answer)
        except HTTPError as error:
            raise RemoteError(f"{self.address} answered {error.code}: {_read_reason(error)}", "raised") from error
        except (OSError, HTTPException) as error:
            if isinstance(error, TimeoutError) or isinstance(getattr(error, "reason", None), TimeoutError):
                text = f"{self.address}: no answer within {self.seconds} s; send fewer images or wait longer (seconds=)"
                raise RemoteError(text, "deadline") from error
            text = f"{self.address} cannot be reached ({error}); start the detector's server, see docs/perception.md"
            raise RemoteError(text, "connection") from error
        if len(response) > MAX_BYTES:
            raise RemoteError(f"{self.address}: the answer is longer than {MAX_BYTES} bytes", "message")
        return response

    def _read_body(self, answer: Any) -> bytes:
        """Read piece by piece, so that a slow stream cannot exceed the timeout."""
        until, response = time.monotonic() + self.seconds, bytearray()
        while (piece := answer.read1(1 << 16)) and len(response) <= MAX_BYTES:
            response += piece
            if time.monotonic() > until:
                raise TimeoutError
        return bytes(response)


def _is_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # of a port that is no number, or half an IPv6 address
        return False


def _read_reason(error: HTTPError) -> str:
    """Return the beginning of the text of an error, empty if it does not arrive."""
    try:
        return error.read(2000).decode(errors="replace").strip()
    except (OSError, HTTPException):
        return ""


def _encode_png(image: NDArray[np.uint8]) -> str:
    return base64.b64encode(cv2.imencode(".png", image[..., ::-1])[1].tobytes()).decode()


def _parse_detections(answer: list[dict[str, Any]]) -> Detections:
    if not answer:
        return no_detections()
    boxes = np.array([found["box"] for found in answer], np.float32)
    scores = np.array([found["score"] for found in answer], np.float32)
    if boxes.shape != (len(answer), 4) or scores.shape != (len(answer),):
        raise ValueError(f"boxes {boxes.shape} and scores {scores.shape}")
    return Detections(boxes, scores, tuple(str(found["label"]) for found in answer))
