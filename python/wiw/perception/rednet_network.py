# SPDX-License-Identifier: Apache-2.0
"""RedNet (Jiang et al. 2018), an encoder-decoder for colour and depth, with names and shapes of published weights.

Two ResNet-50 encode colour and depth; after each stage depth's features are added to colour's. The decoder goes up in
residual stages, and each takes in the encoder's sum of its size through a convolution ("agant").
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

BLOCKS = (3, 4, 6, 3)
"""Blocks of each stage of ResNet-50."""
DECODER = (6, 4, 3, 3)
"""Blocks of the decoder's stages, the coarsest first."""
EXPANSION = 4


class Encoding(nn.Module):
    """A bottleneck of ResNet: 1x1, 3x3 with the stride, 1x1 to four times the width."""

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        outputs = width * EXPANSION
        self.conv1, self.bn1 = nn.Conv2d(inputs, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outputs, 1, bias=False), nn.BatchNorm2d(outputs)
        if stride > 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, H, W] to [B, 4 * width, H / stride, W / stride]."""
        y = self.bn1(self.conv1(x)).relu()
        y = self.bn2(self.conv2(y)).relu()
        return (self.bn3(self.conv3(y)) + (self.downsample(x) if hasattr(self, "downsample") else x)).relu()


class Decoding(nn.Module):
    """Two 3x3 convolutions with a residual; where it doubles the size, the second is transposed."""

    def __init__(self, inputs: int, outputs: int, doubles: bool) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inputs, inputs, 3, padding=1, bias=False), nn.BatchNorm2d(inputs)
        self.conv2: nn.Module = nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        if doubles:
            self.conv2 = nn.ConvTranspose2d(inputs, outputs, 3, 2, 1, output_padding=1, bias=False)
            grow = nn.ConvTranspose2d(inputs, outputs, 2, 2, bias=False)
            self.upsample = nn.Sequential(grow, nn.BatchNorm2d(outputs))
        self.bn2 = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, H, W] to [B, outputs, H, W], or twice that size."""
        y = self.bn2(self.conv2(self.bn1(self.conv1(x)).relu()))
        return (y + (self.upsample(x) if hasattr(self, "upsample") else x)).relu()


class RedNet(nn.Module):
    """Scores of `classes` categories for each pixel. `width` is 64 in the paper."""

    def __init__(self, classes: int = 40, width: int = 64) -> None:
        super().__init__()
        self._add_encoder(3, width, "")
        self._add_encoder(1, width, "_d")
        widths = (width, width, 2 * width, 4 * width, 8 * width)
        joined = (width, *(EXPANSION * stage for stage in widths[1:]))
        for level, (inputs, outputs) in enumerate(zip(joined, widths, strict=True)):
            layers = nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
            self.add_module(f"agant{level}", nn.Sequential(*layers))
        for level, blocks in enumerate(DECODER, start=1):
            inputs, outputs = widths[5 - level], widths[4 - level]
            same = [Decoding(inputs, inputs, doubles=False) for _ in range(blocks - 1)]
            self.add_module(f"deconv{level}", nn.Sequential(*same, Decoding(inputs, outputs, doubles=True)))
        self.final_conv = nn.Sequential(*(Decoding(width, width, doubles=False) for _ in range(3)))
        self.final_deconv_custom = nn.ConvTranspose2d(width, classes, 2, 2)
        for level in (5, 4, 3, 2):  # heads on coarser stages that only training asks
            self.add_module(f"out{level}_conv_custom", nn.Conv2d(widths[level - 2], classes, 1))

    def _add_encoder(self, channels: int, width: int, suffix: str) -> None:
        self.add_module(f"conv1{suffix}", nn.Conv2d(channels, width, 7, 2, 3, bias=False))
        self.add_module(f"bn1{suffix}", nn.BatchNorm2d(width))
        inputs = width
        for stage, blocks in enumerate(BLOCKS):
            inner = width << stage
            first = Encoding(inputs, inner, 1 if stage == 0 else 2)
            inputs = inner * EXPANSION
            rest = [Encoding(inputs, inner, 1) for _ in range(blocks - 1)]
            self.add_module(f"layer{stage + 1}{suffix}", nn.Sequential(first, *rest))

    def forward(self, colour: Tensor, depth: Tensor) -> Tensor:
        """Scores [B, classes, H, W] from [B, 3, H, W] and [B, 1, H, W], H and W multiples of 32."""
        part = self.get_submodule
        x, d = part("bn1")(part("conv1")(colour)).relu(), part("bn1_d")(part("conv1_d")(depth)).relu()
        joined = [x + d]
        x, d = (nn.functional.max_pool2d(y, 3, 2, 1) for y in (joined[0], d))
        for stage in range(1, 5):
            x, d = part(f"layer{stage}")(x), part(f"layer{stage}_d")(d)
            x = x + d
            joined.append(x)
        x = part("agant4")(joined[4])
        for level in range(1, 5):
            x = part(f"deconv{level}")(x) + part(f"agant{4 - level}")(joined[4 - level])
        scores: Tensor = self.final_deconv_custom(self.final_conv(x))
        return scores


def infer_width(state: dict[str, Tensor]) -> int:
    """Return the width of the network that a state belongs to."""
    return int(state["conv1.weight"].shape[0])


def create_empty(classes: int, width: int) -> RedNet:
    """Create the network without memory for its weights, to be given a state."""
    with torch.device("meta"):
        return RedNet(classes, width)
