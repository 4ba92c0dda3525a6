# SPDX-License-Identifier: Apache-2.0
"""The network: what a noised path of the gripper would be without the noise, given what is seen.

After "3D Diffuser Actor" (Ke, Gkanatsios, Fragkiadaki 2024): features of the picture become tokens at their places in
the world, the noised poses of a path are tokens at theirs, and attention relates them by relative places alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from wiw.errors import ArgumentError
from wiw.policies.diffuser.attention import RelativeAttention
from wiw.policies.diffuser.diffusion import STEPS
from wiw.policies.diffuser.paths import MIDDLE, SCALE
from wiw.policies.diffuser.sight import CELL


@dataclass(frozen=True)
class Shape:
    """How large the network is.

    Raises:
        ArgumentError: a width that heads do not divide into sixfolds, or something below 1.
    """

    width: int = 96
    heads: int = 4
    layers: int = 4
    """Of the denoiser."""
    tokens: int = 640
    """Of the scene, at most."""
    poses: int = 6
    """That a path leads to."""

    def __post_init__(self) -> None:
        if min(self.width, self.heads, self.layers, self.tokens, self.poses) < 1 or self.width % (6 * self.heads):
            raise ArgumentError(f"diffuser: expected numbers from 1 and a width of 6 heads times something, got {self}")


@dataclass(frozen=True)
class Scene:
    """What paths are told: tokens [B, N, width] at places [B, N, 3], the hand's last; `hidden` [B, N] are padding."""

    tokens: Tensor
    places: Tensor
    hidden: Tensor
    hand: Tensor
    """[B, width]: how the gripper is turned, and whether it is open."""


class Network(nn.Module):
    """Looks once, then denoises any number of paths.

    Args:
        shape: see there.
    """

    def __init__(self, shape: Shape = Shape()) -> None:
        super().__init__()
        width, self.shape = shape.width, shape
        fine, coarse = width // 3, 2 * width // 3
        self.eye = nn.Sequential(
            nn.Conv2d(4, fine, CELL // 2, CELL // 2),
            Block(fine),
            nn.Conv2d(fine, coarse, 3, 2, padding=1),
            Block(coarse),
            Block(coarse, 2),
            nn.Conv2d(coarse, width, 1),
        )
        self.hand = nn.Sequential(nn.Linear(7, width), nn.SiLU(), nn.Linear(width, width))
        self.start = nn.Linear(6, width)
        self.order = nn.Parameter(torch.randn(shape.poses, width) * 0.5)
        self.level = nn.Sequential(nn.Linear(32, width), nn.SiLU(), nn.Linear(width, width))
        self.layers = nn.ModuleList(Layer(width, shape.heads) for _ in range(shape.layers))
        self.norm = nn.LayerNorm(width)
        self.last = nn.Linear(width, 10)

    def look(self, image: Tensor, height: Tensor, places: Tensor, now: Tensor) -> Scene:
        """What there is to know of a picture.

        Args:
            image: uint8 [B, h, w, 3].
            height: [B, h, w], of its pixels, as `Sight` has it.
            places: [B, h / CELL, w / CELL, 3], likewise.
            now: [B, 10], the gripper's present vector.
        """
        seen = torch.cat([image / 127.5 - 1, height[..., None].float()], dim=-1).permute(0, 3, 1, 2)
        features = self.eye(seen).flatten(2).transpose(1, 2)
        tokens, places, hidden = _nearby(features, places.flatten(1, 2), self.shape.tokens)
        hand = self.hand(now[:, 3:])
        tokens = torch.cat([tokens, hand[:, None]], dim=1)
        places = torch.cat([places, metres(now[:, None, :3])], dim=1)
        return Scene(tokens, places, functional.pad(hidden, (0, 1), value=False), hand)

    def denoise(self, scene: Scene, noised: Tensor, level: Tensor) -> tuple[Tensor, Tensor]:
        """Clean vectors [B, R, L, 9] and the gripper's logits [B, R, L] of R paths a scene, of levels [B, R]."""
        told = self.level(_waves(level)) + scene.hand[:, None]
        tokens = self.start(noised[..., 3:]) + self.order
        places = metres(noised[..., :3])
        for layer in self.layers:
            tokens = layer(tokens, places, scene, told=told)
        found = self.last(self.norm(tokens))
        clean = torch.cat([noised[..., :3] + found[..., :3], found[..., 3:9]], dim=-1)
        return clean, found[..., 9]


class Layer(nn.Module):
    """Attention to the scene, to the other poses of the path, and a thought of one's own."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.crossing, self.among = RelativeAttention(width, heads), RelativeAttention(width, heads)
        self.think = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.norms = nn.ModuleList(nn.LayerNorm(width, elementwise_affine=False) for _ in range(3))
        self.told = nn.Linear(width, 6 * width)

    def forward(self, tokens: Tensor, places: Tensor, scene: Scene, told: Tensor) -> Tensor:
        """Tokens [B, R, L, width] of R paths a scene, which are `told` [B, R, width] of the noise and the hand."""
        scales = self.told(told)[..., None, :].chunk(6, dim=-1)

        def normal(which: int) -> Tensor:
            return self.norms[which](tokens) * (1 + scales[2 * which]) + scales[2 * which + 1]

        asking, here = normal(0).flatten(1, 2), places.flatten(1, 2)  # all paths of a scene in one go
        tokens = tokens + self.crossing(asking, here, scene.tokens, scene.places, scene.hidden).view_as(tokens)
        path, here = normal(1).flatten(0, 1), places.flatten(0, 1)
        tokens = tokens + self.among(path, here, path, here).view_as(tokens)
        return tokens + self.think(normal(2))


class Block(nn.Module):
    """Two 3x3 convolutions beside a way around them."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.inner = nn.Sequential(
            nn.GroupNorm(4, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation),
            nn.GroupNorm(4, width),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation),
        )

    def forward(self, image: Tensor) -> Tensor:
        """[B, width, H, W]."""
        return image + self.inner(image)


def metres(vectors: Tensor) -> Tensor:
    """Places in the world of vectors' first three numbers."""
    return vectors * SCALE + torch.as_tensor(MIDDLE, dtype=vectors.dtype)


def _nearby(features: Tensor, places: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """Tokens in the workspace, padded to the same number in each scene: features, places, and which are padding."""
    outside = places[..., 2] < 0
    count = min(most, max(1, int((~outside).sum(dim=1).max())))
    order = outside.to(torch.uint8).argsort(dim=1, stable=True)[:, :count, None]
    hidden = outside.gather(1, order[..., 0])
    places = places.gather(1, order.expand(-1, -1, 3)).masked_fill(hidden[..., None], 0.0)
    return features.gather(1, order.expand(-1, -1, features.shape[2])), places, hidden


def _waves(level: Tensor) -> Tensor:
    """[..., 32]: a level of noise as sines and cosines."""
    rates = torch.logspace(0, 2, 16)
    angles = level[..., None] / STEPS * rates
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
