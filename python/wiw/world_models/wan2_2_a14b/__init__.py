# SPDX-License-Identifier: Apache-2.0
"""Wan 2.2, image to video, two experts of 14B."""

from __future__ import annotations

from dataclasses import dataclass

from wiw.world_models.base import Requirements, accepts
from wiw.world_models.video import PACKAGES
from wiw.world_models.video.wan import Wan

HUB = "Wan-AI/Wan2.2-I2V-A14B-Diffusers"


@dataclass(kw_only=True, eq=False)
class Wan22(Wan):
    """Wan 2.2 I2V A14B: the front view and the plan in words become a clip (Wan team 2025).

    Two experts share the work: one for the noisy steps, one for the others.
    """

    accepts = accepts(control="text", view="perspective", frames=25, cacheable=True)
    requires = Requirements((*PACKAGES, "ftfy"), "diffusers", HUB, gpu=True)
    marks = {"expand_timesteps": False, "boundary_ratio": True}  # noqa: RUF012

    weights: str = HUB
    guidance: float = 3.5
