# SPDX-License-Identifier: Apache-2.0
"""Noise on paths, and how it is taken away again (DDPM's noise, DDIM's steps).

Places are noised on the scaled-linear schedule, rotations on the squared cosine's, as in 3D Diffuser Actor. The network
names the clean path itself rather than the noise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

STEPS = 100
"""Levels of noise, 0 the least."""
FIRST, LAST = 0.00085, 0.012
"""Variances that the scaled-linear schedule adds at its first and last of 1000 levels, of which every tenth is used."""


def _kept() -> Tensor:
    """[STEPS, 9]: the part of a clean vector's variance that is left at each level, for places and rotations."""
    variances = np.linspace(FIRST**0.5, LAST**0.5, 1000) ** 2
    place = np.cumprod(1 - variances)[1000 // STEPS - 1 :: 1000 // STEPS]
    angle = (np.arange(1, STEPS + 1) / STEPS + 0.008) / 1.008 * np.pi / 2
    turn = np.maximum(np.cos(angle) ** 2 / np.cos(0.008 / 1.008 * np.pi / 2) ** 2, 1e-3)
    return torch.from_numpy(np.concatenate([place[:, None].repeat(3, 1), turn[:, None].repeat(6, 1)], axis=1)).float()


KEPT = _kept()


def noised(clean: Tensor, noise: Tensor, level: Tensor) -> Tensor:
    """Vectors [..., L, 9] with as much noise as their levels [...] say."""
    kept = KEPT[level][..., None, :]
    return kept.sqrt() * clean + (1 - kept).sqrt() * noise


def sampled(
    denoise: Callable[[Tensor, Tensor], tuple[Tensor, Tensor]], noise: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Clean vectors [..., L, 9] and grippers [..., L], from noise of the same shape in so many steps.

    Args:
        denoise: from noised vectors [..., L, 9] and their levels [...] to clean ones and grippers' logits [..., L].
        noise: standard normal.
        steps: at most `STEPS`.
    """
    now, found, logits = noise, noise, noise[..., 0]
    levels = np.linspace(STEPS - 1, 0, steps).round().astype(int)
    for level, following in zip(levels, [*levels[1:], -1], strict=True):
        found, logits = denoise(now, torch.full(noise.shape[:-2], int(level)))
        if following >= 0:
            here, there = KEPT[level], KEPT[following]
            left = (now - here.sqrt() * found) / (1 - here).sqrt()
            now = there.sqrt() * found + (1 - there).sqrt() * left
    return found, logits.sigmoid()
