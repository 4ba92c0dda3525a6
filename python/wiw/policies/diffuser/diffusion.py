# SPDX-License-Identifier: Apache-2.0
"""The diffusion process on paths: adding noise (DDPM) and removing it (DDIM).

Positions use the scaled-linear schedule, rotations the squared-cosine one, as in 3D Diffuser Actor. The network
predicts the clean path itself rather than the noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

NOISE_LEVELS = 100
"""Number of noise levels; 0 is the least."""
BETA_START, BETA_END = 0.00085, 0.012
"""Variances that the scaled-linear schedule adds at the first and last of 1000 levels; every tenth is used."""


def _compute_alpha_bars() -> Tensor:
    """Return the share of a clean vector's variance left at each level, for positions and rotations: [NOISE_LEVELS,
    9].
    """
    variances = np.linspace(BETA_START**0.5, BETA_END**0.5, 1000) ** 2
    place = np.cumprod(1 - variances)[1000 // NOISE_LEVELS - 1 :: 1000 // NOISE_LEVELS]
    angle = (np.arange(1, NOISE_LEVELS + 1) / NOISE_LEVELS + 0.008) / 1.008 * np.pi / 2
    turn = np.maximum(np.cos(angle) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2, 1e-3)
    return torch.from_numpy(np.concatenate([place[:, None].repeat(3, 1), turn[:, None].repeat(6, 1)], axis=1)).float()


ALPHA_BARS = _compute_alpha_bars()


def add_noise(clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
    """Add noise to vectors [..., L, 9] at levels [...]."""
    kept = ALPHA_BARS[level][..., None, :]
    return kept.sqrt() * clean + (1 - kept).sqrt() * noise


def sample_ddim(
    denoise: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], noise: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Denoise to clean vectors [..., L, 9] and gripper openings [..., L], from noise of the same shape.

    Args:
        denoise: maps noised vectors [..., L, 9] and their levels [...] to clean ones and the gripper's logits [..., L].
        noise: standard normal.
        steps: number of steps, at most `NOISE_LEVELS`.
    """
    now, found, logits = noise, noise, noise[..., 0]
    levels = np.linspace(NOISE_LEVELS - 1, 0, steps).round().astype(int)
    for level, following in zip(levels, [*levels[1:], -1], strict=True):
        found, logits = denoise(now, torch.full(noise.shape[:-2], int(level)))
        if following >= 0:
            here, there = ALPHA_BARS[level], ALPHA_BARS[following]
            left = (now - here.sqrt() * found) / (1 - here).sqrt()
            now = there.sqrt() * found + (1 - there).sqrt() * left
    return found, logits.sigmoid()
