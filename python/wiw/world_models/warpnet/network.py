# SPDX-License-Identifier: Apache-2.0
"""The network: what a panorama shows from d metres further ahead.

One network guesses how far away everything will be, geometry looks up where it is now, another network repairs what
geometry cannot know. Panoramas are float [B, C, H, W] with colours in [-1, 1]; their columns wrap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import gcd

import torch
from torch import Tensor, nn
from torch.nn import functional

NEAREST, FARTHEST = 0.05, 20.0
"""Metres that a distance is clamped to."""
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Prediction:
    """Prediction of the view ahead, in the network's own size."""

    log_distance: Tensor
    """[B, 1, h, w], of metres along the ray."""
    warped: Tensor
    """[B, 3, h, w]: the source's colours, looked up by geometry."""
    painted: Tensor
    """[B, 3, h, w]: what should be seen where they are wrong."""
    mask: Tensor
    """[B, 1, h, w] in [0, 1]: the weight of `painted`."""

    @property
    def colours(self) -> Tensor:
        """[B, 3, h, w]."""
        return blend(self.warped, self.painted, self.mask)


def blend(warped: Tensor, painted: Tensor, mask: Tensor) -> Tensor:
    """Blend `painted` over `warped`."""
    return warped + mask * (painted - warped)


@cache
@torch.inference_mode(False)  # training may use what was first made for a rollout
def rays(height: int, width: int, device: torch.device = CPU) -> Tensor:
    """Return unit vectors [3, H, W] of a panorama's pixels; +x right, +y up, -z ahead."""
    latitude = torch.pi * (0.5 - (torch.arange(height, device=device) + 0.5) / height)[:, None]
    longitude = 2 * torch.pi * ((torch.arange(width, device=device) + 0.5) / width - 0.5)[None]
    x, z = latitude.cos() * longitude.sin(), -latitude.cos() * longitude.cos()
    return torch.stack([x, latitude.sin().expand(height, width), z])


@cache
@torch.inference_mode(False)  # training may use what was first made for a rollout
def plain_room(height: int, width: int, radius: float = 2.5, device: torch.device = CPU) -> Tensor:
    """Return log-distances [1, H, W] from the middle of a round room 2.6 m high, 1 m above its floor."""
    up = rays(height, width, device)[1:2]
    level = (1 - up * up).sqrt()
    floor_or_ceiling = torch.where(up < 0, 1.0, 1.6) / up.abs()
    return torch.minimum(floor_or_ceiling, radius / level).log()


def warp(source: Tensor, log_distance: Tensor, ahead: Tensor, right: Tensor | None = None) -> Tensor:
    """Return colours [B, C, H, W] from `ahead` [B] metres further ahead, and `right` [B] (0 if None) further right,
    where things will be exp(log_distance) away.

    Each pixel's point is carried back into the source's frame and its colour taken there, bilinearly.
    """
    height, width = log_distance.shape[-2:]
    points = log_distance.clamp(_log(NEAREST), _log(FARTHEST)).exp() * rays(height, width, log_distance.device)
    x, y, z = points[:, 0], points[:, 1], points[:, 2] - ahead[:, None, None]
    if right is not None:
        x = x + right[:, None, None]
    longitude, latitude = torch.atan2(x, -z), torch.atan2(y, (x * x + z * z).clamp_min(1e-8).sqrt())
    columns = source.shape[-1]
    u = longitude * ((1 / torch.pi) * columns / (columns + 2))  # one more column on each side
    v = latitude * (-2 / torch.pi)
    return functional.grid_sample(
        wrap_columns(source, 1), torch.stack([u, v], dim=-1), padding_mode="border", align_corners=False
    )


def wrap_columns(panorama: Tensor, columns: int) -> Tensor:
    """Pad each side with columns of the other end."""
    return torch.cat([panorama[..., -columns:], panorama, panorama[..., :columns]], dim=-1)


def enlarge_panorama(panorama: Tensor, height: int, width: int) -> Tensor:
    """Enlarge a panorama bilinearly, across the seam too."""
    common = gcd(panorama.shape[-1], width)
    margin = panorama.shape[-1] // common
    large = (height, width + 2 * (width // common))
    wide = functional.interpolate(wrap_columns(panorama, margin), large, mode="bilinear", align_corners=False)
    return wide[..., width // common : width // common + width]


class Network(nn.Module):
    """Distances, as shares of those in a plain room, by one U-Net; mask and painting by another, the warp between them.

    Args:
        height: of the panoramas that it sees, a multiple of 8.
        widths: channels of each U-Net, from fine to coarse.
    """

    def __init__(self, height: int = 72, widths: tuple[int, int, int] = (32, 64, 128)) -> None:
        super().__init__()
        self.height, self.widths = height, tuple(widths)
        self.distance = UNet(3 + 4, 1, self.widths)
        self.refine = UNet(3 + 3 + 1 + 4, 4, self.widths)
        for last in (self.distance.last, self.refine.last):
            nn.init.normal_(last.weight, std=0.01)
        self.distance.last.bias = nn.Parameter(torch.zeros(4))
        little = torch.tensor([0.0, 0.0, 0.0, -2.0]).repeat_interleave(4)  # is painted at first
        self.refine.last.bias = nn.Parameter(little)

    @property
    def size(self) -> tuple[int, int]:
        """Size of panoramas; pixels are as wide as high in degrees."""
        return self.height, 2 * self.height

    def forward(self, source: Tensor, ahead: Tensor) -> Prediction:
        """Predict the view from `ahead` [B] metres further ahead."""
        place = rays(*self.size, source.device).expand(len(source), -1, -1, -1)
        where = torch.cat([place, ahead[:, None, None, None].expand(-1, 1, *self.size)], dim=1)
        nearer = self.distance(torch.cat([source, where], dim=1)).float()
        log_distance = plain_room(*self.size, device=source.device) + nearer
        warped = warp(source, log_distance, ahead)
        made = self.refine(torch.cat([warped, source, log_distance, where], dim=1)).float()
        return Prediction(log_distance, warped, warped + made[:, :3], made[:, 3:].sigmoid())


class UNet(nn.Module):
    """Three scales, the finest of them half the panorama's: 2x2 pixels are folded into channels."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.fine = nn.Sequential(Block(4 * inputs, fine), Block(fine, fine))
        self.middle = nn.Sequential(Block(fine, middle, 2), Block(middle, middle))
        self.coarse = nn.Sequential(Block(middle, coarse, 2), Block(coarse, coarse), Block(coarse, coarse))
        self.middle_again = nn.Sequential(Block(coarse + middle, middle), Block(middle, middle))
        self.fine_again = nn.Sequential(Block(middle + fine, fine), Block(fine, fine))
        self.last = nn.Conv2d(fine, 4 * outputs, 1)

    def forward(self, image: Tensor) -> Tensor:
        """Return [B, outputs, H, W] of [B, inputs, H, W]."""
        fine = self.fine(functional.pixel_unshuffle(image, 2))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        middle = self.middle_again(torch.cat([functional.interpolate(coarse, scale_factor=2), middle], dim=1))
        fine = self.fine_again(torch.cat([functional.interpolate(middle, scale_factor=2), fine], dim=1))
        return functional.pixel_shuffle(self.last(fine), 2)


class Block(nn.Module):
    """A 3x3 convolution whose columns wrap, normalised."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, padding=(1, 0), bias=False)
        self.norm = nn.GroupNorm(4, outputs)

    def forward(self, image: Tensor) -> Tensor:
        """Return [B, outputs, H / stride, W / stride]."""
        return functional.silu(self.norm(self.convolution(wrap_columns(image, 1))))


def _log(metres: float) -> float:
    return float(torch.tensor(metres).log())
