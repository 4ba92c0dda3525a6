# SPDX-License-Identifier: Apache-2.0
"""What the generations of Wan have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wiw.types import Control
from wiw.world_models.video.model import VideoModel


@dataclass(kw_only=True, eq=False)
class Wan(VideoModel):
    """The front view and the plan in words become a clip (Wan team 2025).

    Args:
        negative: what the clip is steered away from, in words.
    """

    pipeline = "WanImageToVideoPipeline"
    parts = {"vae": "float32", "image_encoder": "float32"}  # noqa: RUF012
    stride = 4

    steps: int = 30
    frames: int = 25
    negative: str = "static, blurry, low quality, worst quality, distorted, overexposed, subtitles, people"

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """One row: its picture and prompt."""
        return {"image": images[0], "prompt": controls[0].text, "negative_prompt": self.negative}
