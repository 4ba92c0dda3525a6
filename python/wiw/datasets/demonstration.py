# SPDX-License-Identifier: Apache-2.0
"""One demonstration of a manipulation task."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.errors import FileError

DEPTH_UNITS = 5000
"""A metre."""


@dataclass(frozen=True)
class Outline:
    """Facts about a demonstration that are known without its pictures."""

    task: str
    seed: int
    """Seed of the table."""
    ended: NDArray[np.bool_]
    """bool [T]: whether an action ends in this frame."""


@dataclass(frozen=True)
class Demonstration:
    """An expert's execution of an instruction, in T frames evenly spaced in time; frame 0 precedes all actions.

    Pictures are decoded when they are first asked for.
    """

    task: str
    variation: int
    seed: int
    episode: int
    """Its number within the task."""
    instruction: str
    success: bool
    places: Mapping[str, NDArray[np.float64]]
    """T_world_object [4, 4] in frame 0, by name."""
    seconds: NDArray[np.float64]
    """float64 [T], of the physics."""
    poses: NDArray[np.float64]
    """float64 [T, 7]: where the gripper is."""
    actions: NDArray[np.float64]
    """float64 [T, 7]: the commanded pose."""
    keys: NDArray[np.int32]
    """int32 [T]: number of the action under way, from 1; 0 in frame 0."""
    ended: NDArray[np.bool_]
    """bool [T]: whether the action ends in this frame."""
    encoded_images: tuple[bytes, ...]
    """T front views, JPEG or PNG."""
    encoded_depths: tuple[bytes, ...] | None = None
    """T depths of the front view, 16-bit PNG."""
    encoded_wrist_images: tuple[bytes, ...] | None = None
    """T views of the wrist camera, JPEG or PNG; None if none were collected."""
    encoded_wrist_depths: tuple[bytes, ...] | None = None
    """T depths of the wrist camera's view, 16-bit PNG."""
    wrist_poses: NDArray[np.float64] | None = None
    """float64 [T, 4, 4]: T_world_camera of the wrist camera."""

    def __len__(self) -> int:
        return len(self.seconds)

    @cached_property
    def images(self) -> NDArray[np.uint8]:
        """uint8 [T, H, W, 3]: the front views.

        Raises:
            FileError: one of them is damaged.
        """
        return self.decode(range(len(self.encoded_images)))

    def decode(self, frames: Iterable[int]) -> NDArray[np.uint8]:
        """Return the front views in some frames, uint8 [T, H, W, 3].

        Raises:
            FileError: one of them is damaged.
        """
        return decode_colors([self.encoded_images[frame] for frame in frames])

    @cached_property
    def depths(self) -> NDArray[np.float32] | None:
        """float32 [T, H, W]: their planar depths in metres, 0 where nothing is hit; None if none were collected.

        Raises:
            FileError: one of them is damaged.
        """
        return None if self.encoded_depths is None else decode_depths(self.encoded_depths)


def decode_colors(pictures: Sequence[bytes]) -> NDArray[np.uint8]:
    """Return pictures in colour, uint8 [T, H, W, 3].

    Raises:
        FileError: one of them is damaged, or of another size than the others.
    """
    return decode_pictures(pictures, cv2.IMREAD_COLOR)[..., ::-1]


def decode_depths(pictures: Sequence[bytes]) -> NDArray[np.float32]:
    """Return planar depths in metres, float32 [T, H, W].

    Raises:
        FileError: one of them is damaged, or of another size than the others.
    """
    return decode_pictures(pictures, cv2.IMREAD_UNCHANGED).astype(np.float32) / np.float32(DEPTH_UNITS)


def decode_pictures(pictures: Sequence[bytes], how: int) -> NDArray[Any]:
    """[T, H, W, ...]; what is damaged is not a picture, or one of another size."""
    try:
        images = [cv2.imdecode(np.frombuffer(data, np.uint8), how) if data else None for data in pictures]
        whole = [image for image in images if image is not None]
        if len(whole) < len(images):
            raise ValueError("no picture")
        return np.stack(whole)
    except (ValueError, cv2.error) as error:
        raise FileError(
            f"a picture of a demonstration is damaged ({error}); delete its file and repeat `wiw collect` to recreate "
            "it"
        ) from error


def name_demonstration(outline: Outline | Demonstration) -> str:
    """Return the name by which a demonstration is held out: its task and the seed of its table."""
    return f"{outline.task} {outline.seed}"
