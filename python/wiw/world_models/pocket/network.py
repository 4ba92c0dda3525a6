# SPDX-License-Identifier: Apache-2.0
"""The denoiser: what is seen from places around a panorama, of noisy views from there and the panorama itself.

All views face where the panorama does. A place is a displacement (right, ahead) in metres. Panoramas are float
[B, C, H, W] with colours in [-1, 1]; their columns wrap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from wiw.world_models.warpnet.network import enlarge_panorama, plain_room, rays, warp, wrap_columns

RADII = (0.5, 0.9, 1.5, 2.5, 4.5, 10.0)
"""Metres: of the round rooms through which the panorama is warped."""
MIDDLE = 3
"""Index of the room from which the learnt distance begins."""
HEAD_WIDTH = 32
"""Channels of a head of attention."""
PATCH = 2
"""Pixels on a side that are folded into channels."""


@dataclass(frozen=True)
class Estimate:
    """Clean views as the denoiser sees them: a blend of warps, and what no warp shows."""

    log_distance: Tensor
    """[N, 1, h, w], of metres along the ray."""
    weights: Tensor
    """[N, R + 1, h, w], a distribution: how much of each room's warp is seen, last that by the learnt distance."""
    residual: Tensor
    """[N, 3, h, w]: colours to be added."""

    def pick(self, row: int) -> Estimate:
        """Return the estimate of one view alone."""
        rows = slice(row, row + 1)
        return Estimate(self.log_distance[rows], self.weights[rows], self.residual[rows])

    def enlarge(self, height: int, width: int) -> Estimate:
        """Return the estimate for panoramas of another size."""
        parts = [self.log_distance, self.weights, self.residual]
        large = enlarge_panorama(torch.cat(parts, dim=1), height, width)
        return Estimate(*large.split([part.shape[1] for part in parts], dim=1))


@dataclass(frozen=True)
class Views:
    """Views of B panoramas from F places each, if all there is were one round room or another."""

    source: Tensor
    """[B, 3, H, W]."""
    places: Tensor
    """[B, F, 2]."""
    sweep: Tensor
    """[B, F, R, 3, H, W]."""

    @classmethod
    def around(cls, source: Tensor, places: Tensor) -> Views:
        """Warp panoramas [B, 3, H, W] to places [B, F, 2] through all rooms."""
        size, count = source.shape[-2:], places.shape[:2].numel()
        right, ahead = places.flatten(0, 1).unbind(dim=1)
        repeated = source.repeat_interleave(places.shape[1], dim=0)
        rooms = [plain_room(*size, radius, source.device).expand(count, -1, -1, -1) for radius in RADII]
        warps = [warp(repeated, room, ahead, right) for room in rooms]
        return cls(source, places, torch.stack(warps, dim=1).unflatten(0, places.shape[:2]))

    def blend(self, estimate: Estimate) -> Tensor:
        """Return colours [B, F, 3, H, W] of an estimate in the panoramas' size."""
        right, ahead = self.places.flatten(0, 1).unbind(dim=1)
        repeated = self.source.repeat_interleave(self.places.shape[1], dim=0)
        by_distance = warp(repeated, estimate.log_distance, ahead, right)
        warps = torch.cat([self.sweep.flatten(0, 1), by_distance[:, None]], dim=1)
        colors = (estimate.weights[:, :, None] * warps).sum(dim=1) + estimate.residual
        return colors.unflatten(0, self.places.shape[:2])


@cache
@torch.inference_mode(False)  # training may use what was first made for a rollout
def _headings(width: int, device: torch.device) -> Tensor:
    """Return unit vectors (right, ahead) [2, W] of a panorama's columns."""
    longitude = 2 * torch.pi * ((torch.arange(width, device=device) + 0.5) / width - 0.5)
    return torch.stack([longitude.sin(), longitude.cos()])


def map_displacements(places: Tensor, height: int, width: int) -> Tensor:
    """Return metres [N, 2, H, W] that each column's things come closer, and pass by.

    Turning panorama and displacement together rolls these maps, and nothing else.
    """
    sine, cosine = _headings(width, places.device).to(places)
    right, ahead = places[:, :1], places[:, 1:]
    maps = torch.stack([right * sine + ahead * cosine, right * cosine - ahead * sine], dim=1)
    return maps[:, :, None].expand(-1, -1, height, -1)


class Denoiser(nn.Module):
    """A U-Net over the views of each place, with attention between the places.

    Args:
        height: of the panoramas, a multiple of 16; they are twice as wide.
        widths: channels of the four scales, from fine to coarse; all but the first are multiples of 32.
    """

    def __init__(self, height: int = 64, widths: tuple[int, ...] = (48, 96, 160, 224)) -> None:
        super().__init__()
        self.height, self.widths = height, tuple(widths)
        fine = self.widths[0]
        inputs = 3 + 3 * len(RADII) + 2
        self.outputs = (len(RADII) + 1, 3, 1)
        embedding = 4 * fine
        self.embed = nn.Sequential(nn.Linear(4 * FREQUENCIES, embedding), nn.SiLU(), nn.Linear(embedding, embedding))
        self.first = Convolution(inputs * PATCH**2, fine)
        self.down = nn.ModuleList([Scale(fine, fine, embedding, attends=False)])
        self.up, self.shrink, self.grow = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for above, width in pairwise(self.widths):
            self.shrink.append(Convolution(above, width, stride=2))
            self.down.append(Scale(width, width, embedding, attends=True))
            self.grow.append(Convolution(width, above))
            self.up.append(Scale(2 * above, above, embedding, attends=len(self.up) > 0))
        self.norm = nn.GroupNorm(8, fine)
        self.last = nn.Conv2d(fine, sum(self.outputs) * PATCH**2, 1)
        start_at_zero(self.last)
        nn.init.normal_(self.last.weight, std=0.01)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of panoramas; pixels are as wide as high in degrees."""
        return self.height, 2 * self.height

    def forward(self, noisy: Tensor, levels: Tensor, sweep: Tensor, places: Tensor) -> Estimate:
        """Estimate the clean views of B panoramas from F places each.

        Args:
            noisy: [B, F, 3, H, W]: the views, mixed with noise.
            levels: [B]: share of noise, 0 to 1.
            sweep: [B, F, R, 3, H, W], of `sweep_rooms`.
            places: [B, F, 2].
        """
        frames = places.shape[1]
        moved = places.flatten(0, 1)
        up = rays(*self.size, noisy.device)[1:2]
        latitude = torch.cat([up, (1 - up * up).sqrt()]).expand(len(moved), -1, -1, -1)
        pixels = torch.cat([noisy.flatten(0, 1), sweep.flatten(0, 1).flatten(1, 2), latitude], dim=1)
        condition = self.embed(embed_numbers(levels.repeat_interleave(frames), moved.norm(dim=1)))
        made = self._run(functional.pixel_unshuffle(pixels, PATCH), Condition(condition, moved, frames))
        return self._read(functional.pixel_shuffle(made.float(), PATCH))

    def _run(self, pixels: Tensor, condition: Condition) -> Tensor:
        image = self.first(pixels)
        kept = []
        for index, scale in enumerate(self.down):
            image = scale(image, condition)
            if index < len(self.shrink):
                kept.append(image)
                image = self.shrink[index](image)
        for scale, grow in zip(reversed(self.up), reversed(self.grow), strict=True):
            image = grow(functional.interpolate(image, scale_factor=2))
            image = scale(torch.cat([image, kept.pop()], dim=1), condition)
        made: Tensor = self.last(functional.silu(self.norm(image)))
        return made

    def _read(self, made: Tensor) -> Estimate:
        weights, residual, distance = made.split(self.outputs, dim=1)
        room = plain_room(*self.size, RADII[MIDDLE], made.device)
        return Estimate(room + distance, weights.softmax(dim=1), residual)


@dataclass(frozen=True)
class Condition:
    """Condition of each view, at every scale."""

    embedding: Tensor
    """[N, E]: of the noise level and the distance."""
    places: Tensor
    """[N, 2]."""
    frames: int
    """Places per panorama, which are successive in N."""


FREQUENCIES = 16


def embed_numbers(levels: Tensor, metres: Tensor) -> Tensor:
    """Return sines and cosines [N, 4 x FREQUENCIES] of noise levels [N] and distances [N], at frequencies from 1/2 to
    32 rad.
    """
    rates = torch.exp2(torch.linspace(-1, 5, FREQUENCIES, device=levels.device))
    phases = torch.cat([levels[:, None] * rates, metres[:, None] * rates], dim=1)
    return torch.cat([phases.sin(), phases.cos()], dim=1)


class Convolution(nn.Conv2d):
    """A 3x3 convolution whose columns wrap."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__(inputs, outputs, 3, stride, padding=(1, 0))

    def forward(self, image: Tensor) -> Tensor:
        """Return [N, outputs, H / stride, W / stride]."""
        return super().forward(wrap_columns(image, 1))


class Scale(nn.Module):
    """A residual block, and attention between the places if it `attends`."""

    def __init__(self, inputs: int, width: int, embedding: int, attends: bool) -> None:
        super().__init__()
        self.block = Block(inputs, width, embedding)
        self.attention = FrameAttention(width) if attends else None

    def forward(self, image: Tensor, condition: Condition) -> Tensor:
        """Return [N, width, H, W]."""
        image = self.block(image, condition)
        return image if self.attention is None else self.attention(image, condition.frames)


class Block(nn.Module):
    """Two convolutions around a shortcut; the second is modulated by the condition (adaLN, Peebles and Xie 2023)."""

    def __init__(self, inputs: int, width: int, embedding: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(8, inputs)
        self.first = Convolution(inputs, width)
        self.place = nn.Conv2d(2, width, 1, bias=False)
        self.modulated = nn.GroupNorm(8, width, affine=False)
        self.modulation = nn.Linear(embedding, 2 * width)
        self.second = Convolution(width, width)
        self.shortcut = nn.Identity() if inputs == width else nn.Conv2d(inputs, width, 1)
        start_at_zero(self.modulation)
        start_at_zero(self.second)

    def forward(self, image: Tensor, condition: Condition) -> Tensor:
        """Return [N, width, H, W]."""
        made = self.first(functional.silu(self.norm(image)))
        made = made + self.place(map_displacements(condition.places, 1, image.shape[-1]))
        scale, shift = self.modulation(functional.silu(condition.embedding))[:, :, None, None].chunk(2, dim=1)
        made = self.second(functional.silu(self.modulated(made) * (1 + scale) + shift))
        return self.shortcut(image) + made


class FrameAttention(nn.Module):
    """Attention between the views of one panorama, at each of their pixels."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.heads = width // HEAD_WIDTH
        self.norm = nn.GroupNorm(8, width)
        self.project = nn.Conv2d(width, 3 * width, 1)
        self.out = nn.Conv2d(width, width, 1)
        start_at_zero(self.out)

    def forward(self, image: Tensor, frames: int) -> Tensor:
        """Return [N, width, H, W]."""
        height, width = image.shape[-2:]
        projected = self.project(self.norm(image)).unflatten(1, (3, self.heads, -1)).unflatten(0, (-1, frames))
        query, key, value = projected.flatten(-2).permute(2, 0, 5, 3, 1, 4)  # each [B, H W, heads, F, channels]
        scores = query @ key.transpose(-1, -2) / math.sqrt(query.shape[-1])
        mixed = scores.softmax(dim=-1) @ value
        made: Tensor = self.out(mixed.permute(0, 3, 2, 4, 1).reshape(len(image), -1, height, width))
        return image + made


def start_at_zero(layer: nn.Module) -> None:
    """Set a layer's weights to 0."""
    for value in layer.parameters():
        nn.init.zeros_(value)
