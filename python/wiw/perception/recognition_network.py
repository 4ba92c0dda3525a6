# SPDX-License-Identifier: Apache-2.0
"""The recogniser's network: one look at a target becomes logits and a weight, several looks are added up."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from wiw.perception.glimpses import SCALARS, SIDE

CHANNELS = 8
"""Colour and box of the close and of the wide view."""


def pictures(images: Tensor, boxes: Tensor) -> Tensor:
    """Float [N, 8, 64, 64] around 0 from uint8 [N, 2, 64, 64, 3] and boxes [N, 2, 4] in parts of a view.

    The box is a filled rectangle, soft by a pixel at its edges, so that no rounding hides a thin one.
    """
    colours = images.permute(0, 1, 4, 2, 3).float() / 127.5 - 1
    place = torch.arange(SIDE, dtype=torch.float32)
    low, high = boxes[..., :2, None] * SIDE, boxes[..., 2:, None] * SIDE
    inside = (torch.minimum(place + 1, high) - torch.maximum(place, low)).clamp(0, 1)  # [N, 2, (x, y), 64]
    drawn = 2 * inside[:, :, 1, :, None] * inside[:, :, 0, None, :] - 1
    stacked = torch.cat([colours, drawn[:, :, None]], dim=2)
    return stacked.flatten(1, 2).contiguous(memory_format=torch.channels_last)


def _block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Network(nn.Module):
    """Logits of N looks by a small convolutional network; sums of them by learned weights.

    The sum over a set's looks v is  sum(w_v logits_v) / (sum w_v)^(1 - a),  with 0 < w_v and 0 < a < 1 learned: a = 1
    takes looks for independent evidence, a = 0 only averages them. The truth lies between, for looks at one thing err
    alike.
    """

    def __init__(self, categories: int, width: int = 32) -> None:
        super().__init__()
        self.categories, self.width = categories, width
        self.trunk = nn.Sequential(
            _block(CHANNELS, width, 2),
            _block(width, 2 * width, 2),
            _block(2 * width, 3 * width, 2),
            _block(3 * width, 3 * width, 1),
            _block(3 * width, 4 * width, 2),
        )
        self.mix = nn.Sequential(nn.Linear(2 * 4 * width + SCALARS, 4 * width), nn.ReLU(inplace=True))
        self.drop = nn.Dropout(0.2)
        self.logits = nn.Linear(4 * width, categories)
        self.weight = nn.Linear(4 * width, 1)
        self.independence = nn.Parameter(torch.zeros(()))
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def looks(self, pictures: Tensor, scalars: Tensor) -> tuple[Tensor, Tensor]:
        """Logits [N, categories] and weights [N] of single looks."""
        maps = self.trunk(pictures)
        pooled = torch.cat([maps.mean(dim=(2, 3)), maps.amax(dim=(2, 3)), scalars], dim=1)
        mixed = self.drop(self.mix(pooled))
        return self.logits(mixed), nn.functional.softplus(self.weight(mixed)[:, 0]) + 1e-3

    def fused(self, logits: Tensor, weights: Tensor, owners: Tensor, sets: int) -> Tensor:
        """Logits [sets, categories]; `owners` int64 [N] names the set of each look. A set without looks has zeros."""
        total = torch.zeros(sets).index_add(0, owners, weights)
        summed = torch.zeros(sets, self.categories).index_add(0, owners, weights[:, None] * logits)
        return summed / total.clamp_min(1e-3)[:, None] ** (1 - torch.sigmoid(self.independence))

    def forward(self, pictures: Tensor, scalars: Tensor, owners: Tensor, sets: int) -> Tensor:
        """Logits of each set."""
        return self.fused(*self.looks(pictures, scalars), owners, sets)


def parameters(network: Network) -> int:
    """How many numbers are learned."""
    return sum(value.numel() for value in network.parameters())


def state(network: Network) -> dict[str, Any]:
    """What has to be kept of it, all floats; counters of training are left out."""
    return {name: value for name, value in network.state_dict().items() if value.is_floating_point()}
