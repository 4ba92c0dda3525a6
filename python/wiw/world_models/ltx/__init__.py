# SPDX-License-Identifier: Apache-2.0
"""LTX-Video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wiw.types import Control
from wiw.world_models.base import Requirements, accepts
from wiw.world_models.video import PACKAGES, VideoModel

HUB = "Lightricks/LTX-Video"


@dataclass(kw_only=True, eq=False)
class LTX(VideoModel):
    """LTX-Video 2B: the front view and the plan in words become a clip (HaCohen et al. 2024).

    Args:
        negative: what the clip is steered away from, in words.
    """

    accepts = accepts(control="text", view="perspective", frames=33, cacheable=True)
    requires = Requirements(PACKAGES, "diffusers", HUB, gpu=True)
    pipeline = "LTXImageToVideoPipeline"
    kin = ("LTXPipeline", "LTXConditionPipeline")
    multiple = 32
    stride = 8
    most_rows = 64

    weights: str = HUB
    steps: int = 50
    guidance: float = 3.0
    frames: int = 33
    negative: str = "worst quality, inconsistent motion, blurry, jittery, distorted"

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """A picture and a prompt a row; decoders since 0.9.1 are told of their last bit of noise."""
        return {
            "image": list(images),
            "prompt": [control.text for control in controls],
            "negative_prompt": [self.negative] * len(images),
            "decode_timestep": 0.05,
            "decode_noise_scale": 0.025,
            "max_sequence_length": 256,
        }
