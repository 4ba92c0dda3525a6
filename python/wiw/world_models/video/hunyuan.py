# SPDX-License-Identifier: Apache-2.0
"""HunyuanVideo, image to video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import Clips, declare_requirements
from wiw.world_models.video.text import TextVideoModel

HUB = "hunyuanvideo-community/HunyuanVideo-I2V"
DROPPED = 4
"""Frames at the start that the pipeline leaves out where the observation was concatenated to the latents."""


@dataclass(kw_only=True, eq=False)
class Hunyuan(TextVideoModel):
    """HunyuanVideo I2V 13B: a clip from the front view and the plan in words (Kong et al. 2024).

    Both kinds of checkpoint run: those that replace the first token by the observation, and those that concatenate it
    (33 channels; use guidance=1 with them). The latter lose the first frames, so more are requested, and the clip is
    sampled evenly from the observation to its end.

    Args:
        negative_guidance: scale of guidance away from `negative_prompt`, above 1 if there is one: the networks run
            twice. `guidance` is a number that they receive, not a contrast with a second prompt.
    """

    accepts = accepts(control="text", view="perspective", frames=33, cacheable=True)
    requires = declare_requirements(HUB)
    pipeline_class = "HunyuanVideoImageToVideoPipeline"
    network_precisions = {"vae": "float16", "text_encoder": "float16", "text_encoder_2": "float16"}  # noqa: RUF012
    stride = 4

    weights: str = HUB
    steps: int = 30
    guidance: float = 6.0
    frames: int = 33
    negative_guidance: float = 1.0

    def __post_init__(self) -> None:
        if bool(self.negative_prompt) != (self.negative_guidance > 1):
            raise ArgumentError(
                "Hunyuan: expected a negative_prompt and negative_guidance above 1, or neither, got "
                f"'{self.negative_prompt}' and {self.negative_guidance}"
            )
        super().__post_init__()

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give one row's picture and prompt, and as many frames as leave `frames` after the dropped ones."""
        frames = self.frames + (DROPPED if self._concatenates else 0)
        away = {"negative_prompt": self.negative_prompt, "true_cfg_scale": self.negative_guidance}
        asked = {"image": images[0], "prompt": self.write_prompt(controls[0]), "num_frames": frames}
        return {**asked, **(away if self.negative_prompt else {})}

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Return the clip; where its beginning was dropped, the frame nearest to each moment from start to end."""
        clip = super().generate(images, controls, generators)
        if not self._concatenates:
            return clip
        observation = np.asarray(images[0], np.float32)[None, None] / 255
        moments = np.rint(np.linspace(0, self.frames - 1 + DROPPED, self.frames)).astype(int)
        indices = np.maximum(moments[1:] - DROPPED, 0)
        return np.concatenate([observation, clip[:, indices]], axis=1)

    @property
    def _concatenates(self) -> bool:
        return bool(self.pipeline.transformer.config.image_condition_type == "latent_concat")
