# SPDX-License-Identifier: Apache-2.0
"""Attention between things in space that knows only where they are from each other.

Queries and keys are turned by angles in proportion to where they are (rotary position embeddings, one third of a head's
channels for each axis), so that their products depend on differences of places alone. Each head also reports how far
off, and in which direction, the place lies that it attends to, so that what is found can be pointed at.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

LONGEST, SHORTEST = 2.4, 0.06
"""Metres in which the slowest and the fastest channels turn once."""
UNIT = 0.25
"""Metres in which distances are reported."""


def turned(values: Tensor, places: Tensor) -> Tensor:
    """Channels [B, N, H, 6 F] turned in pairs by where they are: places [B, N, 3] in metres."""
    count = values.shape[-1] // 6
    waves = torch.logspace(0, 1, count, base=SHORTEST / LONGEST) * LONGEST
    angles = (places[..., None] * (2 * torch.pi / waves)).flatten(-2)[:, :, None]  # [B, N, 1, 3 F]
    one, other = values.chunk(2, dim=-1)
    cosine, sine = angles.cos(), angles.sin()
    return torch.cat([one * cosine - other * sine, one * sine + other * cosine], dim=-1)


class RelativeAttention(nn.Module):
    """Of queries [B, N, width] at places [B, N, 3] to a context [B, M, width] at places of its own.

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
        """[B, N, width]; what is `hidden`, bool [B, M], of the context is not attended to."""
        shape = (-1, self.heads, queries.shape[-1] // self.heads)
        query = turned(self.query(queries).unflatten(-1, shape[1:]), places)
        key = turned(self.key(context).unflatten(-1, shape[1:]), context_places)
        value = self.value(context).unflatten(-1, shape[1:])
        likeness = torch.einsum("bnhc,bmhc->bhnm", query, key) / shape[2] ** 0.5
        if hidden is not None:
            likeness = likeness.masked_fill(hidden[:, None, None], float("-inf"))
        weights = likeness.softmax(dim=-1)
        read = torch.einsum("bhnm,bmhc->bnhc", weights, value)
        off = torch.einsum("bhnm,bmx->bnhx", weights, context_places) - places[:, :, None]
        return self.out(torch.cat([read, off / UNIT], dim=-1).flatten(-2))
