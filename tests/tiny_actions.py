# SPDX-License-Identifier: Apache-2.0
"""Action-conditioned checkpoints of the tiny pipelines, as training would leave them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from peft import LoraConfig

from wiw.registry import WORLD_MODELS
from wiw.world_models.video.actions import checkpoint
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.encoder import ActionEncoder
from wiw.world_models.video.actions.injection import embedding_width

LORA = ("wan2.1-action", "wan2.2-a14b-action")


def save(name: str, pipeline: Any, folder: Path, **config: Any) -> Path:
    """Random encoders and, for the larger models, a random LoRA; written to `folder`, which is given back."""
    model = WORLD_MODELS.find(name)
    encoders = {}
    for place in model.denoisers:
        width = embedding_width(getattr(pipeline, place))
        values = {
            "base": model.unwrapped,
            "weights": str(folder.parent),
            "stride": model.generator_class.stride,
            "width": width,
            **config,
        }
        encoders[place] = randomised(ActionEncoder(ActionConfig(**values)))
        if name in LORA:
            layers = ["to_q", "to_k", "to_v", "to_out.0", "ffn.net.0.proj", "ffn.net.2"]
            lora = LoraConfig(r=4, lora_alpha=8, target_modules=layers, init_lora_weights=False)
            getattr(pipeline, place).add_adapter(lora, adapter_name=checkpoint.ADAPTER)
    return checkpoint.save(folder, encoders, pipeline, lora=name in LORA)


def randomised(encoder: ActionEncoder) -> ActionEncoder:
    """Vectors that a tiny network cannot miss."""
    torch.nn.init.normal_(encoder.mlp[-1].weight, std=0.3)
    return encoder
