# SPDX-License-Identifier: Apache-2.0
"""Optimisers of post-training: AdamW, with moments of 32 or of 8 bits."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from wiw.errors import DependencyError
from wiw.training.post_training.recipe import ClipRecipe


def create_optimizer(parameters: Sequence[nn.Parameter], recipe: ClipRecipe) -> torch.optim.Optimizer:
    """Return the recipe's optimiser; "adamw8bit" keeps both moments in blocks of 8 bits (Dettmers et al. 2022).

    Raises:
        DependencyError: bitsandbytes is not installed and the recipe asks for 8 bits.
    """
    options: dict[str, Any] = {"lr": recipe.rate, "weight_decay": recipe.weight_decay}
    if recipe.optimizer == "adamw":
        return torch.optim.AdamW(parameters, **options)
    if importlib.util.find_spec("bitsandbytes") is None:
        raise DependencyError(
            "optimizer=adamw8bit needs bitsandbytes, which is not installed; pip install 'wiw[lowbit]', or use "
            "optimizer=adamw"
        )
    from bitsandbytes.optim import AdamW8bit

    return AdamW8bit(parameters, **options)
