# SPDX-License-Identifier: Apache-2.0
"""SANA-WM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import Clips, VideoModel, declare_requirements

HUB = "Efficient-Large-Model/SANA-WM_bidirectional-diffusers"
OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the axes of a camera that looks down -Z with Y up to those of one that looks down +Z with Y down, and back."""


@dataclass(kw_only=True, eq=False)
class SanaWM(VideoModel):
    """SANA-WM: a clip from the front view and the camera's path (NVIDIA 2026).

    The path is interpolated to one pose a frame.

    Args:
        prompt: what the clip shows, in words.
    """

    accepts = accepts(control="trajectory", view="perspective", size=(704, 704), frames=81, cacheable=True)
    requires = declare_requirements(HUB)
    pipeline_class = "SanaWMPipeline"
    multiple = 32
    stride = 8

    weights: str = HUB
    steps: int = 60
    guidance: float = 5.0
    size: tuple[int, int] = (704, 704)
    frames: int = 81
    prompt: str = "First-person view of a camera that moves steadily through a still, furnished indoor scene."

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give one row's picture, the poses of all frames and the pinhole of 90 degrees."""
        height, width = self.size
        return {
            "image": images[0],
            "prompt": self.prompt,
            "c2w": interpolate_path(controls[0], self.frames),
            "intrinsics": [width / 2, width / 2, width / 2, height / 2],
        }

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Return the clip; the pipeline answers without an axis for rows."""
        return super().generate(images, controls, generators)[None]


def interpolate_path(control: Control, frames: int) -> NDArray[np.float32]:
    """Return T_start_camera of each frame, float32 [frames, 4, 4], in axes of right, down and ahead."""
    start = np.eye(4)
    poses = action.resample(control.viewpoints[: control.length], frames - 1, start=start)
    return (OPENCV @ np.concatenate([start[None], poses]) @ OPENCV).astype(np.float32)
