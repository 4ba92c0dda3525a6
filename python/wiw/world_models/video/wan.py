# SPDX-License-Identifier: Apache-2.0
"""Wan, text and image to video: 2.1, 2.2 with 5B, and 2.2 with two experts of 14B."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wiw.types import Control
from wiw.world_models.base import accepts
from wiw.world_models.video.model import declare_requirements
from wiw.world_models.video.text import TextVideoModel

HUB_21 = "Wan-AI/Wan2.1-I2V-14B-480P-Diffusers"
HUB_22_5B = "Wan-AI/Wan2.2-TI2V-5B-Diffusers"
HUB_22_A14B = "Wan-AI/Wan2.2-I2V-A14B-Diffusers"


@dataclass(kw_only=True, eq=False)
class Wan(TextVideoModel):
    """A clip from the front view and the plan in words (Wan team 2025)."""

    accepts = accepts(control="text", view="perspective", frames=25, cacheable=True)
    pipeline_class = "WanImageToVideoPipeline"
    network_precisions = {"vae": "float32", "image_encoder": "float32"}  # noqa: RUF012
    stride = 4

    steps: int = 30
    guidance: float = 5.0
    frames: int = 25
    negative_prompt: str = "static, blurry, low quality, worst quality, distorted, overexposed, subtitles, people"

    def arguments(self, images: Sequence[Any], controls: Sequence[Control]) -> dict[str, Any]:
        """Give one row's picture and prompt."""
        return {"image": images[0], "prompt": self.write_prompt(controls[0]), "negative_prompt": self.negative_prompt}


@dataclass(kw_only=True, eq=False)
class Wan21(Wan):
    """Wan 2.1 I2V 14B: a clip from the front view and the plan in words (Wan team 2025)."""

    requires = declare_requirements(HUB_21, packages=("ftfy",))
    index_flags = {"expand_timesteps": False, "boundary_ratio": False}  # noqa: RUF012

    weights: str = HUB_21


@dataclass(kw_only=True, eq=False)
class Wan22Small(Wan):
    """Wan 2.2 TI2V 5B: a clip from the front view and the plan in words (Wan team 2025)."""

    requires = declare_requirements(HUB_22_5B, packages=("ftfy",))
    compatible_pipelines = ("WanPipeline",)
    index_flags = {"expand_timesteps": True, "boundary_ratio": False}  # noqa: RUF012
    multiple = 32

    weights: str = HUB_22_5B


@dataclass(kw_only=True, eq=False)
class Wan22(Wan):
    """Wan 2.2 I2V A14B: a clip from the front view and the plan in words (Wan team 2025).

    Two experts share the work: one for the noisy steps, one for the others.

    Args:
        lora_2: LoRA of the second expert; `lora` is the first one's.
    """

    requires = declare_requirements(HUB_22_A14B, packages=("ftfy",))
    index_flags = {"expand_timesteps": False, "boundary_ratio": True}  # noqa: RUF012
    wording_options = (*TextVideoModel.wording_options, "lora_2")
    immaterial = (*TextVideoModel.immaterial, "lora_2")

    weights: str = HUB_22_A14B
    guidance: float = 3.5
    lora_2: str | Path | None = None

    def list_loras(self) -> dict[str, str | Path]:
        """Return the LoRA files of the two experts."""
        second: dict[str, str | Path] = {} if self.lora_2 is None else {"transformer_2": self.lora_2}
        return {**super().list_loras(), **second}
