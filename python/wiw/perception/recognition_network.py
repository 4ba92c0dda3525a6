# SPDX-License-Identifier: Apache-2.0
"""The recogniser's network: each glimpse gives logits and a weight, and those of several glimpses are added up."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from wiw.perception.glimpses import CAMERA_HEIGHT, EXTENT, SHORTEST, SIDE

CHANNELS = 8
"""Colour and box of the close and of the wide view."""
ANGLES = EXTENT.start
"""Columns of `Glimpses.scalars` before those of the extent."""
FARTHEST = 8.0
"""Metres beyond which a distance is not estimated."""
SIZES = 8
"""Columns of `estimate_sizes` and `encode_extents` together."""


def to_network_input(images: Tensor, boxes: Tensor) -> Tensor:
    """Convert images uint8 [N, 2, 64, 64, 3] and boxes [N, 2, 4], relative to the view, to float [N, 8, 64, 64] around
    0.

    The box is a filled rectangle with edges one pixel soft, so that no rounding hides a thin one.
    """
    place = torch.arange(SIDE, dtype=torch.float32)
    low, high = boxes[..., :2, None] * SIDE, boxes[..., 2:, None] * SIDE
    inside = (torch.minimum(place + 1, high) - torch.maximum(place, low)).clamp(0, 1)  # [N, 2, (x, y), 64]
    drawn = 2 * inside[:, :, 1, :, None] * inside[:, :, 0, None, :] - 1
    shown = torch.empty(len(images), SIDE, SIDE, 2, 4)  # channels last, as convolutions like it
    shown[..., :3] = images.permute(0, 2, 3, 1, 4)
    shown[..., :3].div_(127.5).sub_(1)
    shown[..., 3] = drawn.permute(0, 2, 3, 1)
    return shown.flatten(3).permute(0, 3, 1, 2)


def estimate_sizes(scalars: Tensor) -> Tensor:
    """Return sizes of targets in metres, as if their lower edges were on the floor: float [N, 3], from [N, 9].

    Logarithms of distance and width, and the height of the upper edge. Objects that stand on something else, or whose
    lower edge is hidden, are taken to be farther away, in training too.
    """
    width, _, upper, lower = scalars[:, :4].unbind(dim=1)
    distance = (CAMERA_HEIGHT / torch.tan(-lower).clamp_min(CAMERA_HEIGHT / FARTHEST)).clamp_min(0.1)
    broad = 2 * distance * torch.tan(width.clamp(0.01, 2.5) / 2)
    top = CAMERA_HEIGHT + distance * torch.tan(upper.clamp(-1.4, 1.4))
    return torch.stack([distance.log(), broad.log(), top.clamp(-1.0, 4.0)], dim=1)


def encode_extents(scalars: Tensor) -> Tensor:
    """Return what depth tells of targets' sizes: float [N, 5], from [N, 9].

    Whether it was measured, logarithms of both extents, and the heights of the lower and upper end; zeros where it was
    not.
    """
    extent = scalars[:, EXTENT]
    known = (extent[:, :1] > 0).float()
    lengths = extent[:, :2].clamp(SHORTEST, 10.0).log()
    return known * torch.cat([known, lengths, extent[:, 2:].clamp(-1.0, 4.0)], dim=1)


def _build_block(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class Network(nn.Module):
    """Logits of N glimpses by a small convolutional network, and their sums by learned weights.

    The sum over a set's glimpses v is  sum(w_v logits_v) / (sum w_v)^(1 - a),  with 0 < w_v and 0 < a < 1 learned: a =
    1 takes glimpses for independent evidence, a = 0 only averages them. The truth is in between, as glimpses of one
    object have similar errors.

    Args:
        categories: number of logits.
        width: channels of the first layer.
        extents: whether it is also told sizes in metres (`estimate_sizes`, `encode_extents`).
    """

    def __init__(self, categories: int, width: int = 32, extents: bool = False) -> None:
        super().__init__()
        self.categories, self.width, self.extents = categories, width, extents
        self.trunk = nn.Sequential(
            _build_block(CHANNELS, width, 2),
            _build_block(width, 2 * width, 2),
            _build_block(2 * width, 3 * width, 2),
            _build_block(3 * width, 3 * width, 1),
            _build_block(3 * width, 4 * width, 2),
        )
        self.mix = nn.Sequential(nn.Linear(2 * 4 * width + ANGLES + SIZES * extents, 4 * width), nn.ReLU(inplace=True))
        self.drop = nn.Dropout(0.2)
        self.logits = nn.Linear(4 * width, categories)
        self.weight = nn.Linear(4 * width, 1)
        self.independence = nn.Parameter(torch.zeros(()))
        nn.init.zeros_(self.weight.weight)
        nn.init.zeros_(self.weight.bias)

    def encode_glimpses(self, pictures: Tensor, scalars: Tensor) -> tuple[Tensor, Tensor]:
        """Return logits [N, categories] and weights [N] of single glimpses."""
        maps = self.trunk(pictures)
        pooled = [maps.mean(dim=(2, 3)), maps.amax(dim=(2, 3)), scalars[:, :ANGLES]]
        if self.extents:
            pooled += [estimate_sizes(scalars), encode_extents(scalars)]
        mixed = self.drop(self.mix(torch.cat(pooled, dim=1)))
        return self.logits(mixed), nn.functional.softplus(self.weight(mixed)[:, 0]) + 1e-3

    def fuse(self, logits: Tensor, weights: Tensor, owners: Tensor, sets: int) -> Tensor:
        """Return logits [sets, categories]; `owners` int64 [N] is the index of each glimpse's set. Empty sets get
        zeros.
        """
        total = torch.zeros(sets).index_add(0, owners, weights)
        summed = torch.zeros(sets, self.categories).index_add(0, owners, weights[:, None] * logits)
        return summed / total.clamp_min(1e-3)[:, None] ** (1 - torch.sigmoid(self.independence))

    def forward(self, pictures: Tensor, scalars: Tensor, owners: Tensor, sets: int) -> Tensor:
        """Return the logits of each set."""
        return self.fuse(*self.encode_glimpses(pictures, scalars), owners, sets)


def select_float_state(network: Network) -> dict[str, Any]:
    """Return the floating-point state to save; counters of training are left out."""
    return {name: value for name, value in network.state_dict().items() if value.is_floating_point()}
