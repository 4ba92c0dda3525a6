# SPDX-License-Identifier: Apache-2.0
"""Stable Video Diffusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import VideoModel, declare_requirements

HUB = "stabilityai/stable-video-diffusion-img2vid"


@dataclass(kw_only=True, eq=False)
class SVD(VideoModel):
    """Stable Video Diffusion: a clip from the front view; the plan does not control it (Blattmann et al. 2023).

    Frame k of the clip is the view after action k.

    Args:
        fps: frames a second that the clip is made for.
        motion: the amount of motion, from 1 to 255 (`motion_bucket_id`).
        noise: standard deviation of the noise on the observation; more of it, more motion.
    """

    accepts = accepts(control="image", view="perspective", frames=14, cacheable=True)
    requires = declare_requirements(HUB)
    pipeline_class = "StableVideoDiffusionPipeline"
    guidance_argument = "max_guidance_scale"
    half_precision = "float16"
    multiple = 8
    max_batch = 16
    frame_per_action = True

    weights: str = HUB
    steps: int = 30
    guidance: float = 3.0
    frames: int = 14
    fps: int = 7
    motion: int = 127
    noise: float = 0.02

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give images alone; guidance grows from 1 at the first frame."""
        return {
            "image": list(images),
            "fps": self.fps,
            "motion_bucket_id": self.motion,
            "noise_aug_strength": self.noise,
        }
