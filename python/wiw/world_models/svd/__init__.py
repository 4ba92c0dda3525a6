# SPDX-License-Identifier: Apache-2.0
"""Stable Video Diffusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wiw.types import Control
from wiw.world_models.base import Requirements, accepts
from wiw.world_models.video import PACKAGES, VideoModel

HUB = "stabilityai/stable-video-diffusion-img2vid"


@dataclass(kw_only=True, eq=False)
class SVD(VideoModel):
    """Stable Video Diffusion: the front view comes to life; it is told nothing of the plan (Blattmann et al. 2023).

    Frame k of the clip stands for what follows action k.

    Args:
        fps: frames a second that the clip is made for.
        motion: how much moves, from 1 to 255 (`motion_bucket_id`).
        noise: standard deviation of the noise on the observation; more of it, more motion.
    """

    accepts = accepts(control="image", view="perspective", frames=14, cacheable=True)
    requires = Requirements(PACKAGES, "diffusers", HUB, gpu=True)
    pipeline = "StableVideoDiffusionPipeline"
    guided_by = "max_guidance_scale"
    half = "float16"
    multiple = 8
    most_rows = 16
    every_frame = True

    weights: str = HUB
    steps: int = 30
    guidance: float = 3.0
    frames: int = 14
    fps: int = 7
    motion: int = 127
    noise: float = 0.02

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Images alone; guidance grows from 1 at the first frame."""
        return {
            "image": list(images),
            "fps": self.fps,
            "motion_bucket_id": self.motion,
            "noise_aug_strength": self.noise,
        }
