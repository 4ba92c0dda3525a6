# SPDX-License-Identifier: Apache-2.0
"""Wan 2.1, image to video."""

from __future__ import annotations

from dataclasses import dataclass

from wiw.world_models.base import Requirements, accepts
from wiw.world_models.video import PACKAGES
from wiw.world_models.video.wan import Wan

HUB = "Wan-AI/Wan2.1-I2V-14B-480P-Diffusers"


@dataclass(kw_only=True, eq=False)
class Wan21(Wan):
    """Wan 2.1 I2V 14B: the front view and the plan in words become a clip (Wan team 2025)."""

    accepts = accepts(control="text", view="perspective", frames=25, cacheable=True)
    requires = Requirements((*PACKAGES, "ftfy"), "diffusers", HUB, gpu=True)
    marks = {"expand_timesteps": False, "boundary_ratio": False}  # noqa: RUF012

    weights: str = HUB
    guidance: float = 5.0
