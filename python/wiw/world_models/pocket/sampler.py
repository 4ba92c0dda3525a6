# SPDX-License-Identifier: Apache-2.0
"""Sampling of pocket: from noise to views in a few steps of the flow."""

from __future__ import annotations

import torch
from torch import Tensor

from wiw.world_models.pocket.network import Denoiser, Estimate, Views


def draw_noise(views: Views, seeds: list[int]) -> Tensor:
    """Return standard normal noise [B, F, 3, H, W], each panorama's from its own seed."""
    shape = (*views.places.shape[1:2], *views.source.shape[1:])
    return torch.stack([torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds])


def sample_views(network: Denoiser, views: Views, noise: Tensor, steps: int) -> Estimate:
    """Return the estimate of the last of so many Euler steps along the straight flow from noise to views.

    Levels of noise fall evenly from 1 to 0; the views left over at level 0 are the last estimate itself.
    """
    noisy = noise
    for step in range(steps):
        level, following = 1 - step / steps, 1 - (step + 1) / steps
        estimate = network(noisy, noisy.new_full((len(noisy),), level), views.sweep, views.places)
        if following:
            noisy = torch.lerp(views.blend(estimate), noisy, following / level)
    return estimate
