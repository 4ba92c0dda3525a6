# SPDX-License-Identifier: Apache-2.0
"""One segment of the navigation dataset: frames between two waypoints, with the actions that led from one to the next.

A turn on the spot moves no pixel of a panorama but along its rows, so that only the first panorama of each position is
kept. The frames after turns are exact rolls of it: a left turn of 22.5 degrees by W / 16 columns.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from wiw.action import FORWARD, NULL, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, FileError

DEPTH_UNITS = 1000
"""A metre: depth is in millimetres."""
JPEG_QUALITY = 95
PNG_FILTER_UP = 32
"""PNG_FILTER_UP of libpng. Depth panoramas change least from row to row, so that this is both smaller and faster than
what libpng chooses: 131 kB and 6 ms against 148 kB and 10 ms."""


@dataclass(frozen=True)
class NavigationSegment:
    """T frames between two waypoints; frame 0 is before the first action. Pictures are decoded when asked for."""

    scene: str
    pass_index: int
    """Number of the pass over the scene, from 0."""
    island: int
    """Index of the part of the navigation mesh."""
    segment: int
    """Number within the pass over the scene."""
    seed: int
    """Seed of the dataset."""
    height: float
    """Metres of the camera above the floor."""
    actions: NDArray[np.int8]
    """int8 [T]: the action that led to each frame, in the numbering of `wiw.action`; 0 (Null) in frame 0."""
    poses: NDArray[np.float64]
    """float64 [T, 4, 4]: T_world_camera."""
    sources: NDArray[np.int32]
    """int32 [T]: the frame whose picture shows this one, once it is rolled; never a later one."""
    rolls: NDArray[np.int32]
    """int32 [T]: columns to roll it by, to the right."""
    encoded_images: tuple[bytes | None, ...]
    """T pictures, JPEG or lossless WebP; None if `sources` names another frame."""
    encoded_depths: tuple[bytes | None, ...] | None
    """T depths, 16-bit PNG in millimetres, likewise; None if none were collected."""

    def __len__(self) -> int:
        return len(self.actions)

    @cached_property
    def images(self) -> NDArray[np.uint8]:
        """uint8 [T, H, W, 3]: what is seen in each frame.

        Raises:
            FileError: a picture is damaged.
        """
        return self._show(self.encoded_images, cv2.IMREAD_COLOR)[..., ::-1]

    @cached_property
    def depths(self) -> NDArray[np.float32] | None:
        """float32 [T, H, W]: metres, 0 where nothing is hit; None if none were collected.

        Along the ray for panoramas, planar for perspective views.

        Raises:
            FileError: a picture is damaged.
        """
        if self.encoded_depths is None:
            return None
        return self._show(self.encoded_depths, cv2.IMREAD_UNCHANGED).astype(np.float32) / np.float32(DEPTH_UNITS)

    def clip(self, start: int, length: int) -> NavigationSegment:
        """Return `length` frames from frame `start` as a separate segment, whose first action is Null.

        Raises:
            ArgumentError: the segment does not have these frames.
        """
        if start < 0 or length < 1 or start + length > len(self):
            raise ArgumentError(
                f"{self.scene}, segment {self.segment}: expected a clip within its {len(self)} frames, got {length} "
                f"from frame {start}"
            )
        frames = slice(start, start + length)
        first = int(self.sources[start])
        actions = self.actions[frames].copy()
        actions[0] = int(NULL)
        sources = np.maximum(self.sources[frames] - start, 0)

        def cut_pictures(pictures: tuple[bytes | None, ...]) -> tuple[bytes | None, ...]:
            return (pictures[first], *pictures[start + 1 : start + length])

        return replace(
            self,
            actions=actions,
            poses=self.poses[frames],
            sources=sources.astype(np.int32),
            rolls=self.rolls[frames],
            encoded_images=cut_pictures(self.encoded_images),
            encoded_depths=None if self.encoded_depths is None else cut_pictures(self.encoded_depths),
        )

    def decode(self, frame: int) -> tuple[NDArray[np.uint8], NDArray[np.uint16] | None]:
        """Return what is stored in a frame with a picture: uint8 [H, W, 3], and depth uint16 [H, W] in millimetres.

        Raises:
            FileError: the frame has no picture, or a damaged one.
        """
        color = self._decode(self.encoded_images, frame, cv2.IMREAD_COLOR)[..., ::-1]
        if self.encoded_depths is None:
            return color, None
        return color, self._decode(self.encoded_depths, frame, cv2.IMREAD_UNCHANGED)

    def _show(self, pictures: Sequence[bytes | None], how: int) -> NDArray[Any]:
        decoded = {int(source): self._decode(pictures, int(source), how) for source in np.unique(self.sources)}
        if len({image.shape for image in decoded.values()}) > 1:
            raise FileError(f"{self._name}: expected images of one size, got several; {_REMEDY}")
        return np.stack(
            [np.roll(decoded[int(i)], int(roll), axis=1) for i, roll in zip(self.sources, self.rolls, strict=True)]
        )

    def _decode(self, pictures: Sequence[bytes | None], frame: int, how: int) -> NDArray[Any]:
        data = pictures[frame]
        image = None
        if data:
            try:
                image = cv2.imdecode(np.frombuffer(data, np.uint8), how)
            except cv2.error:
                image = None
        if image is None:
            raise FileError(f"{self._name}: expected an image in frame {frame}, got something else; {_REMEDY}")
        return image

    @property
    def _name(self) -> str:
        return f"{self.scene}, segment {self.segment}"


_REMEDY = "`wiw data verify` finds the damaged file; delete it and repeat `wiw collect` to recreate it"


def encode_color(image: NDArray[np.uint8], lossless: bool) -> bytes:
    """Encode a picture uint8 [H, W, 3] as JPEG of quality 95 with full colour resolution, or as lossless WebP."""
    if lossless:
        memory = io.BytesIO()
        Image.fromarray(image).save(memory, "WEBP", lossless=True, method=0, quality=0)  # the fastest
        return memory.getvalue()
    fine = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *fine])[1])


def encode_millimetres(depth: NDArray[np.float32]) -> bytes:
    """Encode metres float32 [H, W] as a 16-bit PNG in millimetres; 65.535 m stands for anything farther away."""
    return encode_units(np.clip(np.rint(depth * DEPTH_UNITS), 0, np.iinfo(np.uint16).max).astype(np.uint16))


def encode_units(units: NDArray[np.uint16]) -> bytes:
    """Encode millimetres uint16 [H, W] as a 16-bit PNG."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1]
    if (choice := getattr(cv2, "IMWRITE_PNG_FILTER", None)) is not None:  # older OpenCV: larger files, the same pixels
        options += [choice, PNG_FILTER_UP]
    return bytes(cv2.imencode(".png", units, options)[1])


def describe_segment(segment: NavigationSegment) -> dict[str, Any]:
    """Return a segment's row of `segments.parquet`, but for where it is stored and how it ended."""
    return {
        "scene": segment.scene,
        "pass": segment.pass_index,
        "island": segment.island,
        "segment": segment.segment,
        "frames": len(segment),
        "pictures": len(np.unique(segment.sources)),
        "forward": int((segment.actions == FORWARD).sum()),
        "turn_left": int((segment.actions == TURN_LEFT).sum()),
        "turn_right": int((segment.actions == TURN_RIGHT).sum()),
    }
