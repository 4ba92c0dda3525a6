# SPDX-License-Identifier: Apache-2.0
"""Clips as tensors: resized, mirrored where that is requested, several together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from wiw.action import TURN_LEFT, TURN_RIGHT
from wiw.training.held_out_clips import resize_frames
from wiw.training.post_training.corpora import Clip


@dataclass(frozen=True)
class ClipBatch:
    """Clips as tensors."""

    frames: Tensor
    """uint8 [B, N, H, W, 3]."""
    actions: Tensor
    """int64 [B, N], wiw's primitives that led to each frame; or float64 [B, N, 7], poses of a gripper."""

    @property
    def pixels(self) -> Tensor:
        """float32 [B, 3, N, H, W] from -1 to 1."""
        return self.frames.permute(0, 4, 1, 2, 3).float() / 127.5 - 1

    def to(self, device: torch.device) -> ClipBatch:
        """Return the clips on a device."""
        return ClipBatch(self.frames.to(device), self.actions.to(device))


def load_clips(clips: Sequence[Clip], size: tuple[int, int]) -> ClipBatch:
    """Decode clips and bring them to a size (height, width).

    Raises:
        FileError: a picture is damaged.
    """
    frames = np.stack([resize_frames(clip.images, size) for clip in clips])
    actions = np.stack([clip.actions for clip in clips])
    return ClipBatch(torch.from_numpy(frames), torch.from_numpy(actions.astype(_widen(actions.dtype))))


def mirror_clip(clip: Clip) -> Clip:
    """Return a clip of primitives with left and right exchanged, in frames and actions: as true as the clip itself."""
    actions = clip.actions.copy()
    actions[clip.actions == TURN_LEFT], actions[clip.actions == TURN_RIGHT] = TURN_RIGHT, TURN_LEFT
    return Clip(clip.images[:, :, ::-1], actions)


def _widen(kind: np.dtype) -> type:
    return np.float64 if kind.kind == "f" else np.int64
