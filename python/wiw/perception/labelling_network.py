# SPDX-License-Identifier: Apache-2.0
"""The network of the learned labeller: a U-Net that gives each second pixel of a view category and state logits.

Its input is a view in a fixed angular resolution, with the direction of each pixel beside its colours, so that it
serves any field of view: on a level camera the row says how high things are. Depth, where it is known, says how large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from wiw.errors import ArgumentError

FOCAL = 80.0
"""Focal length of the network's input in pixels: 208 columns for 105 degrees."""
MULTIPLE = 16
"""The input's sides are multiples of this."""
STRIDE = 2
"""Input pixels per output pixel."""
CHANNELS = 8
"""Channels of the input; see `to_network_input`."""


class Network(nn.Module):
    """The U-Net.

    Args:
        categories, states: number of logits of each kind.
        widths: channels of the levels, at a half, a quarter, an eighth and a sixteenth of the input's size.
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
        self.narrow = nn.ModuleList([nn.Conv2d(d, c, 1), nn.Conv2d(c, b, 1), nn.Conv2d(b, a, 1)])
        self.up = nn.ModuleList([block(2 * c, c, c), block(2 * b, b, b), block(2 * a, a, a)])
        self.head = nn.Conv2d(a, categories + states, 1)

    def forward(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Return category logits [B, categories, H/2, W/2] and state logits [B, states, H/2, W/2].

        Args:
            views: float [B, CHANNELS, H, W]; see `to_network_input`.
        """
        logits = self.head(self.compute_features(views)[-1])
        return logits[:, : self.categories], logits[:, self.categories :]

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
            found.append(level(torch.cat([coarse, levels.pop()], dim=1)))
        return found


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
    """The network's input for views of one size and field of view."""

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
    """Resize a view [H, W, 3] to the network's size, averaging pixels where it shrinks."""
    if view.shape[:2] == (size.height, size.width):
        return view
    shrinks = view.shape[0] >= size.height and view.shape[1] >= size.width
    return np.asarray(
        cv2.resize(view, (size.width, size.height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    )


def resize_depth(depth: NDArray[np.float32], size: InputSize) -> NDArray[np.float32]:
    """Pick the depth [H, W] in the middle of each pixel of the network's size; edges are not blurred."""
    rows, columns = (
        (np.arange(new) * 2 + 1) * old // (2 * new)
        for new, old in zip((size.height, size.width), depth.shape, strict=True)
    )
    return depth[rows[:, None], columns]


def to_network_input(
    views: NDArray[np.uint8], tangents: NDArray[np.float32], depth: NDArray[np.float32] | None = None
) -> Tensor:
    """Return float [B, CHANNELS, H, W], channels last.

    The channels are colours from -1 to 1, directions, and of what is seen the logarithm of its planar depth, its height
    above the camera in metres, and whether these two are known; they are 0 where not.

    Args:
        views: uint8 [B, H, W, 3] in the network's size.
        tangents: float32 [B or 1, H, W, 2]; see `compute_tangents`.
        depth: float32 [B, H, W]: planar, in metres; 0 where unknown. None means unknown everywhere.
    """
    made = np.zeros((*views.shape[:3], CHANNELS), np.float32)
    np.multiply(views, 1 / 127.5, out=made[..., :3])
    made[..., :3] -= 1
    made[..., 3:5] = tangents
    if depth is not None:
        known = depth > 0
        made[..., 5] = np.log(depth, where=known, out=np.zeros_like(depth, np.float32))
        made[..., 6] = depth * tangents[..., 1]
        made[..., 7] = known
    return torch.from_numpy(made).permute(0, 3, 1, 2)


def compute_tangents(size: Sequence[int], input_size: InputSize) -> NDArray[np.float32]:
    """Return, for each pixel of the network's input, x / -z and y / -z of its ray: float32 [h, w, 2].

    Args:
        size: (H, W) of the views.
        input_size: of the network's input.
    """
    made = np.empty((input_size.height, input_size.width, 2), np.float32)
    across = (np.arange(input_size.width) + 0.5) / input_size.width - 0.5
    down = (np.arange(input_size.height) + 0.5) / input_size.height - 0.5
    made[..., 0] = across * size[1] / input_size.focal
    made[..., 1] = (-down * size[0] / input_size.focal)[:, None]
    return made
