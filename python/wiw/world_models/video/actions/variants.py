# SPDX-License-Identifier: Apache-2.0
"""The paper's post-trained models: panorama in and out, one primitive per frame."""

from __future__ import annotations

from dataclasses import replace

from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.video.actions.model import ActionConditioned
from wiw.world_models.video.cosmos import CosmosPredict2
from wiw.world_models.video.ltx import LTX
from wiw.world_models.video.svd import SVD
from wiw.world_models.video.wan import Wan21, Wan22, Wan22Small


def require_checkpoint(generator: type[WorldModel]) -> Requirements:
    """Return what the generator requires, and the folder with what was trained."""
    return replace(generator.requires, options=("checkpoint", *generator.requires.options))


class SVDAction(ActionConditioned):
    """Stable Video Diffusion, trained to follow actions (SVD† in the paper)."""

    accepts = accepts(control="action", frames=14, null_first=True, cacheable=True)
    requires = require_checkpoint(SVD)
    generator_class = SVD
    base = "svd"
    denoisers = ("unet",)
    front_size = (448, 448)
    defaults = {}  # noqa: RUF012


class LTXAction(ActionConditioned):
    """LTX-Video 2B, trained to follow actions (LTX-Video† in the paper)."""

    accepts = accepts(control="action", frames=17, null_first=True, cacheable=True)
    requires = require_checkpoint(LTX)
    generator_class = LTX
    base = "ltx"


class Wan21Action(ActionConditioned):
    """Wan 2.1 I2V 14B, trained to follow actions (Wan2.1† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = require_checkpoint(Wan21)
    generator_class = Wan21
    base = "wan2.1"


class Wan22SmallAction(ActionConditioned):
    """Wan 2.2 TI2V 5B, trained to follow actions (Wan2.2 5B† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = require_checkpoint(Wan22Small)
    generator_class = Wan22Small
    base = "wan2.2-5b"


class Wan22Action(ActionConditioned):
    """Wan 2.2 I2V A14B, both experts trained to follow actions (Wan2.2 A14B† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = require_checkpoint(Wan22)
    generator_class = Wan22
    base = "wan2.2-a14b"
    denoisers = ("transformer", "transformer_2")


class CosmosPredict2Action(ActionConditioned):
    """Cosmos-Predict2 2B, trained to follow actions (Cosmos-Predict2† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = require_checkpoint(CosmosPredict2)
    generator_class = CosmosPredict2
    base = "cosmos-predict2"
