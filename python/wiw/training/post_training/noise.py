# SPDX-License-Identifier: Apache-2.0
"""How noisy the clips are that a flow-matching model is trained on, and how much each level of noise counts.

A level is the share of noise, from 0 (the clip) to 1 (noise alone).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

FEW_TOKENS, MANY_TOKENS = 1024, 4096
LOW_MEAN, HIGH_MEAN = 0.95, 2.05
"""Means of LTX-Video's logit-normal levels for few and for many tokens, linear in between and beyond."""


def draw_token_shifted(rows: int, tokens: int, random: torch.Generator) -> Tensor:
    """Draw logit-normal levels [rows] whose mean grows with the number of tokens, as LTX-Video's trainer does."""
    slope = (HIGH_MEAN - LOW_MEAN) / (MANY_TOKENS - FEW_TOKENS)
    mean = LOW_MEAN + slope * (tokens - FEW_TOKENS)
    return torch.sigmoid(mean + torch.randn(rows, generator=random))


def draw_logit_normal(rows: int, random: torch.Generator) -> Tensor:
    """Draw levels [rows] whose logit is standard normal, as Cosmos-Predict2 has it: ln sigma ~ N(0, 1)."""
    return torch.sigmoid(torch.randn(rows, generator=random))


def draw_shifted_uniform(
    rows: int, shift: float, random: torch.Generator, low: float = 0.0, high: float = 1.0
) -> Tensor:
    """Draw levels [rows] from `low` to `high` out of a schedule of Wan: uniform, then shifted towards noise."""
    first, last = unshift_level(low, shift), unshift_level(high, shift)
    return shift_level(first + (last - first) * torch.rand(rows, generator=random), shift)


def shift_level(level: Tensor, shift: float) -> Tensor:
    """Move levels towards noise: s u / (1 + (s - 1) u) (Esser et al. 2024)."""
    return shift * level / (1 + (shift - 1) * level)


def unshift_level(level: float, shift: float) -> float:
    """Return the level that `shift_level` moves to this one."""
    return level / (shift - (shift - 1) * level)


def weigh_by_bell(levels: Tensor, shift: float) -> Tensor:
    """Return a weight for each level: exp(-2 (t - 1/2)^2) less its least value, of mean 1 over the shifted schedule.

    The weights of DiffSynth-Studio's recipes for Wan: levels in the middle count most, the ends nothing.
    """
    schedule = shift_level((torch.arange(1000) + 0.5) / 1000, shift)
    return _compute_bell(levels) / _compute_bell(schedule).mean().to(levels.device)


def _compute_bell(levels: Tensor) -> Tensor:
    return torch.exp(-2 * (levels - 0.5) ** 2) - math.exp(-0.5)
