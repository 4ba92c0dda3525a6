# SPDX-License-Identifier: Apache-2.0
"""The navigator's network: how far a goal view's camera is from a place, in which direction, and whether in sight.

Place and goal pass the same convolutions. Their features are correlated between any two columns, and the correlations
are ordered by heading: entry (h, j) compares the goal's column j with the place's column where it would be if the goal
view looked in heading h. What follows sees in which heading the goal view is found, and how much wider or narrower.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

HEADINGS = 32
"""Directions into which bearings are divided; 0 is the back of the panorama, as its columns are."""
GOAL_COLUMNS = 8
ROWS = 8
DISTANCES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.5)
"""Metres between the classes of distance."""
CENTRES = (0.25, 0.75, 1.25, 1.75, 2.5, 3.5, 4.75, 6.5, 9.0)
"""Metres in the middle of each class."""
KERNELS, DILATIONS = (5, 3, 3, 3, 3), (1, 2, 4, 8)


@dataclass(frozen=True)
class Features:
    """N encoded views, of W columns: 32 of places, 8 of goals."""

    keys: Tensor
    """[N, heads, channels, 8, W]: unit vectors."""
    context: Tensor
    """[N, 8, W]: what else is known of each column."""
    colors: Tensor
    """[N, 3, 4, W] in [-1, 1]."""

    def take(self, rows: Tensor) -> Features:
        """Return the views of these indices."""
        return Features(self.keys[rows], self.context[rows], self.colors[rows])


@dataclass(frozen=True)
class Estimate:
    """Output of the network for N pairs, as logits."""

    bearings: Tensor
    """[N, 32], by column of the panorama from its left edge on."""
    distances: Tensor
    """[N, 9]."""
    visible: Tensor
    """[N]: whether the goal's camera is in sight of the place."""


def to_input(bands: Tensor, mask: Tensor | None = None) -> Tensor:
    """Convert bands uint8 or float [N, 32, W, 3] of 0 to 255 to [N, 4, 32, W] around 0, the last channel the mask."""
    colors = bands.permute(0, 3, 1, 2).float() / 127.5 - 1
    shown = torch.ones_like(colors[:, :1]) if mask is None else mask.to(colors.dtype).expand_as(colors[:, :1])
    return torch.cat([colors * shown, shown], dim=1)


class Network(nn.Module):
    """See the module."""

    def __init__(self, width: int = 32, heads: int = 12) -> None:
        super().__init__()
        self.width, self.heads = width, heads
        sizes = [(4, width, 2), (width, width, 1), (width, 2 * width, 2), *[(2 * width, 2 * width, 1)] * 2]
        kernels = zip(sizes, KERNELS, strict=True)
        self.trunk = nn.ModuleList(nn.Conv2d(a, b, kernel, stride) for (a, b, stride), kernel in kernels)
        self.norms = nn.ModuleList(nn.GroupNorm(4, b) for _, b, _ in sizes)
        self.key = nn.Conv2d(2 * width, heads * 8, 1)
        self.context = nn.Conv1d(2 * width * ROWS, 8, 1)
        self.volume = nn.ModuleList(
            [nn.Conv2d(ROWS // 2 * (heads + 3) + 16, 48, 3), nn.Conv2d(48, 32, 3)]  # over headings and goal columns
        )
        self.mix = nn.Conv1d(32 * GOAL_COLUMNS, 64, 1)
        self.around = nn.ModuleList(nn.Conv1d(64, 64, 3, dilation=dilation) for dilation in DILATIONS)
        self.bearing = nn.Conv1d(64, 1, 1)
        self.summary = nn.Linear(128, 64)
        self.drop = nn.Dropout(0.1)
        self.distance = nn.Linear(64, len(CENTRES))
        self.visible = nn.Linear(64, 1)
        columns = torch.arange(HEADINGS)[:, None] + torch.arange(GOAL_COLUMNS) - GOAL_COLUMNS // 2
        self.register_buffer("sheared", columns % HEADINGS, persistent=False)

    def encode(self, views: Tensor) -> Features:
        """Encode N views [N, 4, 32, W] of `to_input`: panoramas where W is 128, else goals, which have borders."""
        around, found = views.shape[3] == 4 * HEADINGS, views
        for layer, norm, kernel in zip(self.trunk, self.norms, KERNELS, strict=True):
            found = functional.relu(norm(layer(_pad(found, kernel // 2, around))))
        keys = self.key(found).unflatten(1, (self.heads, 8))
        colors = functional.avg_pool2d(views[:, :3], (8, 4))
        return Features(functional.normalize(keys, dim=2), self.context(found.flatten(1, 2)), colors)

    def compare(self, places: Features, goals: Features) -> Estimate:
        """Compare P places with G goals, each with each: estimates of P * G pairs, those of the first place first."""
        near = torch.einsum("pkdrc,gkdrj->pgkrcj", places.keys, goals.keys)
        near = near.unflatten(3, (ROWS // 2, 2)).mean(dim=4).flatten(2, 3)
        columns = self.get_buffer("sheared")
        index = columns * GOAL_COLUMNS + torch.arange(GOAL_COLUMNS, device=columns.device)
        similar = near.flatten(3)[..., index]  # [P, G, heads * 4, 32, 8]
        colors, context = places.colors.flatten(1, 2)[..., columns], places.context[..., columns]
        contrast = (colors[:, None] - goals.colors.flatten(1, 2)[None, ..., None, :]).abs()
        shape = (len(places.keys), len(goals.keys), -1, HEADINGS, GOAL_COLUMNS)
        parts = [similar, contrast, context[:, None].expand(shape), goals.context[None, ..., None, :].expand(shape)]
        return self._judge(torch.cat(parts, dim=2).flatten(0, 1))

    def _judge(self, volume: Tensor) -> Estimate:
        """Estimate from a volume [N, channels, 32 headings, 8 goal columns]."""
        for layer in self.volume:
            wide = functional.pad(torch.cat([volume[:, :, -1:], volume, volume[:, :, :1]], dim=2), (1, 1))
            volume = functional.relu(layer(wide))
        found = functional.relu(self.mix(volume.permute(0, 1, 3, 2).flatten(1, 2)))
        for layer, dilation in zip(self.around, DILATIONS, strict=True):
            wide = torch.cat([found[..., -dilation:], found, found[..., :dilation]], dim=-1)
            found = found + functional.relu(layer(wide))
        pooled = functional.relu(self.summary(torch.cat([found.mean(dim=2), found.amax(dim=2)], dim=1)))
        pooled = self.drop(pooled)
        return Estimate(self.bearing(found)[:, 0], self.distance(pooled), self.visible(pooled)[:, 0])

    def forward(self, places: Tensor, goals: Tensor) -> Estimate:
        """Compare each of P places [P, 4, 32, 128] with each of G goals [G, 4, 32, 32]."""
        return self.compare(self.encode(places), self.encode(goals))


def _pad(views: Tensor, margin: int, around: bool) -> Tensor:
    """Add a margin; a panorama's left and right edge are next to each other."""
    if around:
        views = torch.cat([views[..., -margin:], views, views[..., :margin]], dim=-1)
        return functional.pad(views, (0, 0, margin, margin))
    return functional.pad(views, (margin, margin, margin, margin))


def get_sizes(network: Network) -> dict[str, Any]:
    """Return what a network of the same shape is built of."""
    return {"width": network.width, "heads": network.heads}
