# SPDX-License-Identifier: Apache-2.0
"""Wan 2.2, text and image to video, 5B."""

from __future__ import annotations

from dataclasses import dataclass

from wiw.world_models.base import Requirements, accepts
from wiw.world_models.video import PACKAGES
from wiw.world_models.video.wan import Wan

HUB = "Wan-AI/Wan2.2-TI2V-5B-Diffusers"


@dataclass(kw_only=True, eq=False)
class Wan22Small(Wan):
    """Wan 2.2 TI2V 5B: the front view and the plan in words become a clip (Wan team 2025)."""

    accepts = accepts(control="text", view="perspective", frames=25, cacheable=True)
    requires = Requirements((*PACKAGES, "ftfy"), "diffusers", HUB, gpu=True)
    kin = ("WanPipeline",)
    marks = {"expand_timesteps": True, "boundary_ratio": False}  # noqa: RUF012
    multiple = 32

    weights: str = HUB
    guidance: float = 5.0
