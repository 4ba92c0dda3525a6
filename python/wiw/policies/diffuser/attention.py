# SPDX-License-Identifier: Apache-2.0
"""Attention between points in space that depends on their relative positions only.

Queries and keys are rotated by angles in proportion to their positions (rotary position embeddings, one third of a
head's channels for each axis), so that their products depend on position differences alone. Each head also returns the
mean offset to the points it attends to, so that the network can point at what it finds.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

LONGEST_WAVE, SHORTEST_WAVE = 2.4, 0.06
"""Metres in which the slowest and the fastest channels complete one rotation."""
OFFSET_UNIT = 0.25
"""Unit of the returned offsets in metres."""


def rotate_channels(values: Tensor, places: Tensor) -> Tensor:
    """Rotate channels [B, N, H, 6 F] in pairs according to positions [B, N, 3] in metres."""
    count = values.shape[-1] // 6
    waves = torch.logspace(0, 1, count, base=SHORTEST_WAVE / LONGEST_WAVE) * LONGEST_WAVE
    angles = (places[..., None] * (2 * torch.pi / waves)).flatten(-2)[:, :, None]  # [B, N, 1, 3 F]
    one, other = values.chunk(2, dim=-1)
    cosine, sine = angles.cos(), angles.sin()
    return torch.cat([one * cosine - other * sine, one * sine + other * cosine], dim=-1)


class RelativeAttention(nn.Module):
    """Attention of queries [B, N, width] at positions [B, N, 3] to a context [B, M, width] with its own positions.

    Args:
        width: channels, a multiple of 6 `heads`.
        heads: their number.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.out = nn.Linear(width + 3 * heads, width)

    def forward(
        self, queries: Tensor, places: Tensor, context: Tensor, context_places: Tensor, hidden: Tensor | None = None
    ) -> Tensor:
        """Return [B, N, width]; context tokens that are `hidden`, bool [B, M], are ignored."""
        shape = (-1, self.heads, queries.shape[-1] // self.heads)
        query = rotate_channels(self.query(queries).unflatten(-1, shape[1:]), places)
        key = rotate_channels(self.key(context).unflatten(-1, shape[1:]), context_places)
        value = self.value(context).unflatten(-1, shape[1:])
        likeness = torch.einsum("bnhc,bmhc->bhnm", query, key) / shape[2] ** 0.5
        if hidden is not None:
            likeness = likeness.masked_fill(hidden[:, None, None], float("-inf"))
        weights = likeness.softmax(dim=-1)
        read = torch.einsum("bhnm,bmhc->bnhc", weights, value)
        off = torch.einsum("bhnm,bmx->bnhx", weights, context_places) - places[:, :, None]
        return self.out(torch.cat([read, off / OFFSET_UNIT], dim=-1).flatten(-2))
