# SPDX-License-Identifier: Apache-2.0
"""The network of the learned labeller: a U-Net that gives each cell of a view category and state logits.

A cell is a square of 2 x 2 pixels of a view in a fixed angular resolution. The network reads its four colours, and its
direction, so that it serves any field of view: on a level camera the row says how high things are. Depth, where it is
known, says how large. Inside, the network works on every second cell, and its last layer predicts four cells each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from wiw.errors import ArgumentError

Value = TypeVar("Value", bound=np.generic)

FOCAL = 80.0
"""Focal length in cells: 208 columns for 105 degrees."""
MULTIPLE = 16
"""A view has a multiple of this many rows and columns of cells."""
PIXELS = 2
"""Rows and columns of pixels in a cell."""
FINE = 2
"""Rows and columns of cells per output of the finest level."""
FINE_CELLS = FINE**2
COLOR_CHANNELS = 3 * PIXELS**2
CHANNELS = COLOR_CHANNELS + 5
"""Channels of the input; see `to_network_input`."""
_LEVELS = (np.arange(256) * (1 / 127.5)).astype(np.float32) - 1
"""Values of the input by byte: from -1 to 1."""


class Network(nn.Module):
    """The U-Net.

    Args:
        categories, states: number of logits of each kind.
        widths: channels of the levels, at a half, a quarter, an eighth and a sixteenth of the cells.
        normalised: whether convolutions are followed by batch normalisation, as in training; `fuse` merges the two.
    """

    def __init__(self, categories: int, states: int, widths: Sequence[int], normalised: bool = True) -> None:
        super().__init__()
        if len(widths) != 4 or min(categories, states, *widths) < 1:
            raise ArgumentError(f"Network: expected positive categories, states and four widths, got {widths}")
        self.categories, self.states, self.widths, self.normalised = categories, states, tuple(widths), normalised
        a, b, c, d = widths

        def block(*channels: int, stride: int = 1) -> nn.Sequential:
            pairs = pairwise(channels)
            return nn.Sequential(
                *(Convolution(i, o, normalised, stride if not row else 1) for row, (i, o) in enumerate(pairs))
            )

        self.down = nn.ModuleList(
            [
                block(CHANNELS, a, a, stride=2),
                block(a, b, b, stride=2),
                block(b, c, c, c, stride=2),
                block(c, d, d, d, stride=2),
            ]
        )
        self.context = nn.Linear(d, d)
        self.narrow = nn.ModuleList([Pointwise(d, c), Pointwise(c, b), Pointwise(b, a)])
        self.up = nn.ModuleList([block(c, c, c), block(b, b), block(a, a)])
        self.head = nn.Linear(a, FINE_CELLS * (categories + states))

    def forward(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Return category logits [B, categories, H, W] and state logits [B, states, H, W].

        Args:
            views: float [B, CHANNELS, H, W]; see `to_network_input`.
        """
        logits = ungroup_cells(torch.cat(self.compute_logits(self.compute_features(views)[-1]), dim=-1))
        return logits.permute(0, 3, 1, 2).split([self.categories, self.states], dim=1)

    def compute_logits(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return category and state logits of cells in groups, [B, H/2, W/2, FINE_CELLS, N]; see `group_cells`.

        Args:
            features: float [B, widths[0], H/2, W/2], of the finest level.
        """
        logits = self.head(features.permute(0, 2, 3, 1)).unflatten(-1, (FINE_CELLS, self.categories + self.states))
        return logits.split([self.categories, self.states], dim=-1)

    def compute_features(self, views: Tensor) -> list[Tensor]:
        """Return the features that are decoded at each level, [B, widths[i], h, w], the coarsest first."""
        levels = []
        for level in self.down:
            views = level(views)
            levels.append(views)
        x = levels.pop()
        found = [x + self.context(x.mean(dim=(2, 3)))[:, :, None, None]]  # which room it is
        for narrow, level in zip(self.narrow, self.up, strict=True):
            coarse = functional.interpolate(narrow(found[-1]), scale_factor=2.0, mode="nearest")
            found.append(level(coarse + levels.pop()))
        return found


class Pointwise(nn.Linear):
    """A linear layer for each pixel of [B, C, H, W]; on CPUs faster than a 1 x 1 convolution."""

    def forward(self, x: Tensor) -> Tensor:
        """Map each pixel."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Convolution(nn.Module):
    """A 3 x 3 convolution, batch normalisation where asked for, its input added where shapes agree, and a rectifier."""

    def __init__(self, inputs: int, outputs: int, normalised: bool, stride: int) -> None:
        super().__init__()
        self.weights = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=not normalised)
        self.norm = nn.BatchNorm2d(outputs, momentum=0.05) if normalised else nn.Identity()
        self.residual = inputs == outputs and stride == 1

    def forward(self, x: Tensor) -> Tensor:
        """Convolve."""
        y = self.norm(self.weights(x))
        return functional.relu(y + x if self.residual else y)


def group_cells(values: Tensor) -> Tensor:
    """Return the values of cells [B, H, W, ...] in groups, row by row: [B, H/2, W/2, FINE_CELLS, ...]."""
    count, height, width, *rest = values.shape
    grouped = values.reshape(count, height // FINE, FINE, width // FINE, FINE, *rest).transpose(2, 3)
    return grouped.reshape(count, height // FINE, width // FINE, FINE_CELLS, *rest)


def ungroup_cells(values: Tensor) -> Tensor:
    """Return the values of cells [B, H, W, ...] from those of groups; the inverse of `group_cells`."""
    count, height, width, _, *rest = values.shape
    spread = values.reshape(count, height, width, FINE, FINE, *rest).transpose(2, 3)
    return spread.reshape(count, FINE * height, FINE * width, *rest)


def fuse(network: Network) -> Network:
    """Return a network without batch normalisation that computes the same in evaluation mode."""
    fused = Network(network.categories, network.states, network.widths, normalised=False)
    state = network.eval().state_dict()
    merged = dict(network.named_modules())
    for name, module in fused.named_modules():
        source = merged[name]
        if isinstance(source, Convolution) and isinstance(source.norm, nn.BatchNorm2d):
            whole = nn.utils.fusion.fuse_conv_bn_eval(source.weights.eval(), source.norm.eval())
            assert isinstance(module, Convolution)
            module.weights.load_state_dict(whole.state_dict())
    rest = {name: value for name, value in state.items() if name.split(".")[0] in ("context", "narrow", "head")}
    fused.load_state_dict(rest, strict=False)
    return fused.eval()


@dataclass(frozen=True)
class InputSize:
    """The rows and columns of cells of views of one size and field of view."""

    height: int
    width: int
    focal: float
    """In pixels of the views."""

    @classmethod
    def of(cls, size: Sequence[int], hfov_deg: float) -> InputSize:
        """Return the input's size for views of (H, W)."""
        focal = size[1] / (2 * np.tan(np.radians(hfov_deg) / 2))
        height, width = (max(MULTIPLE, round(side * FOCAL / focal / MULTIPLE) * MULTIPLE) for side in size)
        return cls(height, width, float(focal))


def resize_view(view: NDArray[np.uint8], size: InputSize) -> NDArray[np.uint8]:
    """Resize a view [H, W, 3] to the pixels of its cells, averaging where it shrinks."""
    height, width = PIXELS * size.height, PIXELS * size.width
    if view.shape[:2] == (height, width):
        return view
    shrinks = view.shape[0] >= height and view.shape[1] >= width
    return np.asarray(cv2.resize(view, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR))


def sample_cells(values: NDArray[Value], size: InputSize) -> NDArray[Value]:
    """Pick the value, of those of each pixel [..., H, W], in the middle of each cell: depth and labels, not blurred."""
    height, width = values.shape[-2:]
    return values[..., find_middles(height, size.height)[:, None], find_middles(width, size.width)]


def find_middles(old: int, new: int) -> NDArray[np.int64]:
    """Return which of `old` rows or columns are in the middles of `new` ones: int64 [new]."""
    return (np.arange(new, dtype=np.int64) * 2 + 1) * old // (2 * new)


def to_network_input(
    views: NDArray[np.uint8], tangents: NDArray[np.float32], depth: NDArray[np.float32] | None = None
) -> Tensor:
    """Return float [B, CHANNELS, H, W], channels last, for H x W cells.

    The channels are the pixels' colours from -1 to 1, the cell's direction, and of what is seen the logarithm of its
    planar depth, its height above the camera in metres, and whether these two are known; they are 0 where not.

    Args:
        views: uint8 [B, PIXELS * H, PIXELS * W, 3].
        tangents: float32 [B or 1, H, W, 2]; see `compute_tangents`.
        depth: float32 [B, H, W]: planar, in metres; 0 where unknown. None means unknown everywhere.
    """
    count, height, width = len(views), views.shape[1] // PIXELS, views.shape[2] // PIXELS
    made = np.zeros((count, height, width, CHANNELS), np.float32)
    colors, rest = made[..., :COLOR_CHANNELS], made[..., COLOR_CHANNELS:]
    cells = _LEVELS.take(views).reshape(count, height, PIXELS, width, 3 * PIXELS)
    colors.reshape(count, height, width, PIXELS, 3 * PIXELS)[:] = cells.transpose(0, 1, 3, 2, 4)
    rest[..., :2] = tangents
    if depth is not None:
        known = depth > 0
        rest[..., 2] = np.log(depth, where=known, out=np.zeros_like(depth, np.float32))
        rest[..., 3] = depth * tangents[..., 1]
        rest[..., 4] = known
    return torch.from_numpy(made).permute(0, 3, 1, 2)


def compute_tangents(size: Sequence[int], input_size: InputSize) -> NDArray[np.float32]:
    """Return, for each cell, x / -z and y / -z of the ray through its middle: float32 [h, w, 2].

    Args:
        size: (H, W) of the views.
        input_size: of their cells.
    """
    made = np.empty((input_size.height, input_size.width, 2), np.float32)
    across = (np.arange(input_size.width) + 0.5) / input_size.width - 0.5
    down = (np.arange(input_size.height) + 0.5) / input_size.height - 0.5
    made[..., 0] = across * size[1] / input_size.focal
    made[..., 1] = (-down * size[0] / input_size.focal)[:, None]
    return made
