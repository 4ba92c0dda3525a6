# SPDX-License-Identifier: Apache-2.0
"""LTX-Video."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from wiw.errors import ArgumentError
from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import Clips, declare_requirements
from wiw.world_models.video.text import TextVideoModel

HUB = "Lightricks/LTX-Video"


@dataclass(kw_only=True, eq=False)
class LTX(TextVideoModel):
    """LTX-Video 2B: a clip from the front view and the plan in words (HaCohen et al. 2024).

    Decoders since 0.9.1 take away the last bit of noise themselves. The pipeline draws it from one generator, where the
    decoder is, so it takes one row at a time with them.
    """

    accepts = accepts(control="text", view="perspective", frames=33, cacheable=True)
    requires = declare_requirements(HUB)
    pipeline_class = "LTXImageToVideoPipeline"
    compatible_pipelines = ("LTXPipeline", "LTXConditionPipeline")
    multiple = 32
    stride = 8
    max_batch = 64

    weights: str = HUB
    steps: int = 50
    guidance: float = 3.0
    frames: int = 33
    negative_prompt: str = "worst quality, inconsistent motion, blurry, jittery, distorted"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._decoder_draws_noise = bool(self.pipeline.vae.config.timestep_conditioning)
        if self._decoder_draws_noise and self.batch > 1:
            raise ArgumentError(
                f"{type(self).__name__}: {self.pipeline_class} takes one row at a time with the decoders of LTX-Video "
                f"0.9.1 and later, got batch={self.batch}"
            )

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give a picture and a prompt per row, and how much noise is left to the decoders that take it away."""
        return {
            "image": list(images),
            "prompt": [self.write_prompt(control) for control in controls],
            "negative_prompt": [self.negative_prompt] * len(images),
            "decode_timestep": 0.05,
            "decode_noise_scale": 0.025,
            "max_sequence_length": 256,
        }

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Return the clips; with a generator on the decoder's device where the decoder's noise is drawn too."""
        if self._decoder_draws_noise:
            import torch

            generators = [torch.Generator(self.device).manual_seed(each.initial_seed()) for each in generators]
        return super().generate(images, controls, generators)
