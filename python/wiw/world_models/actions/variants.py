# SPDX-License-Identifier: Apache-2.0
"""The paper's post-trained models: panorama in and out, one primitive a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

from wiw.world_models.actions.model import PANORAMA, FollowsActions
from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.cosmos_predict2 import CosmosPredict2
from wiw.world_models.ltx import LTX
from wiw.world_models.svd import SVD
from wiw.world_models.wan2_1 import Wan21
from wiw.world_models.wan2_2_5b import Wan22Small
from wiw.world_models.wan2_2_a14b import Wan22


def with_checkpoint(base: type[WorldModel]) -> Requirements:
    """What the model that was trained requires, and the folder with what was trained."""
    return replace(base.requires, options=("checkpoint", *base.requires.options))


@dataclass(kw_only=True, eq=False)
class SVDAction(FollowsActions, SVD):
    """Stable Video Diffusion, trained to follow actions (SVD† in the paper)."""

    accepts = accepts(control="action", frames=14, null_first=True, cacheable=True)
    requires = with_checkpoint(SVD)
    base = "svd"
    denoisers = ("unet",)
    front = (448, 448)

    size: tuple[int, int] = PANORAMA


@dataclass(kw_only=True, eq=False)
class LTXAction(FollowsActions, LTX):
    """LTX-Video 2B, trained to follow actions (LTX-Video† in the paper)."""

    accepts = accepts(control="action", frames=17, null_first=True, cacheable=True)
    requires = with_checkpoint(LTX)
    base = "ltx"

    size: tuple[int, int] = PANORAMA
    frames: int = 17
    guidance: float = 1.0


@dataclass(kw_only=True, eq=False)
class Wan21Action(FollowsActions, Wan21):
    """Wan 2.1 I2V 14B, trained to follow actions (Wan2.1† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = with_checkpoint(Wan21)
    base = "wan2.1"

    size: tuple[int, int] = PANORAMA
    frames: int = 13
    guidance: float = 1.0


@dataclass(kw_only=True, eq=False)
class Wan22SmallAction(FollowsActions, Wan22Small):
    """Wan 2.2 TI2V 5B, trained to follow actions (Wan2.2 5B† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = with_checkpoint(Wan22Small)
    base = "wan2.2-5b"

    size: tuple[int, int] = PANORAMA
    frames: int = 13
    guidance: float = 1.0


@dataclass(kw_only=True, eq=False)
class Wan22Action(FollowsActions, Wan22):
    """Wan 2.2 I2V A14B, both experts trained to follow actions (Wan2.2 A14B† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = with_checkpoint(Wan22)
    base = "wan2.2-a14b"
    denoisers = ("transformer", "transformer_2")

    size: tuple[int, int] = PANORAMA
    frames: int = 13
    guidance: float = 1.0


@dataclass(kw_only=True, eq=False)
class CosmosPredict2Action(FollowsActions, CosmosPredict2):
    """Cosmos-Predict2 2B, trained to follow actions (Cosmos-Predict2† in the paper)."""

    accepts = accepts(control="action", frames=13, null_first=True, cacheable=True)
    requires = with_checkpoint(CosmosPredict2)
    base = "cosmos-predict2"

    size: tuple[int, int] = PANORAMA
    frames: int = 13
    guidance: float = 1.0
