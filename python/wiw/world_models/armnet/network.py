# SPDX-License-Identifier: Apache-2.0
"""The network: what the front view shows after the gripper has gone from one pose to another.

The arm is known (`body`), so the state is the table without it: a canvas, as far as has been seen. A step composes each
pixel of the next view of four: what the canvas shows there, the canvas carried along with the gripper, the arm over the
bare table, and new paint. Images are float [B, C, H, W] in [0, 1]. The network sees a window of the front view in a
third of its size; its composition is applied in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

FRONT = (160, 160)
"""(height, width) of the front view that the network sees a window of."""
WINDOW = (slice(72, 136), slice(20, 140))
"""Rows and columns: where things are within reach, up to 25 cm above the table."""
FARTHEST = 10.0
"""Pixels that what is carried may be off the gripper's own way."""
ALIKE = 0.1
"""Greatest difference of a channel between the arm as drawn and as seen; where it is greater, a thing is before it."""
LIKELY = 2.0
"""Logits by which the canvas, or the arm where it is, comes first before anything has been learnt."""
SCALARS = 9
MAPS = 7
"""Channels of `Motion`."""


@dataclass(frozen=True)
class Motion:
    """From one pose of the gripper to the next, by pixels of the window."""

    before: Tensor
    """[B, 3]: x, y and depth (metres) of the finger tips."""
    after: Tensor
    scalars: Tensor
    """[B, 9]: openings, heights, the metres moved, the turn of the hand."""
    below: Tensor
    """[B, 2]: the point of the table under the finger tips, afterwards."""


@dataclass(frozen=True)
class Arm:
    """The arm over the bare table, after a step."""

    color: Tensor
    """[B, 3, H, W]."""
    mask: Tensor
    """[B, 1, H, W] in {0, 1}."""


@dataclass(frozen=True)
class Mixture:
    """How a view is composed, in the network's size."""

    shares: Tensor
    """[B, 4, h, w], which sum to 1: canvas, carried, arm or bare table, paint."""
    paint: Tensor
    """[B, 3, h, w]."""
    flow: Tensor
    """[B, 2, h, w]: pixels that what is carried comes from beside the gripper's own way."""


def compute_shading(bare: Tensor, plate: Tensor, mask: Tensor) -> Tensor:
    """Return how much darker than without the arm each pixel is; 1 where the arm itself is."""
    ratio = ((bare + 0.02) / (plate + 0.02)).clamp(0.25, 4.0)
    return torch.where(mask > 0.5, torch.ones_like(ratio), ratio)


def compose_static_view(canvas: Tensor, arm: Arm, plate: Tensor) -> Tensor:
    """Return the view if nothing but the arm had moved."""
    return torch.where(arm.mask > 0.5, arm.color, canvas * compute_shading(arm.color, plate, arm.mask)).clamp(0, 1)


def find_unoccluded_arm(image: Tensor, arm: Arm) -> Tensor:
    """Return where, [B, 1, H, W], a true view shows the arm itself, and no object in front of it."""
    return (arm.mask > 0.5) & ((image - arm.color).abs().amax(1, keepdim=True) < ALIKE)


def clear_arm(image: Tensor, arm: Arm, hidden: Tensor, plate: Tensor, before: Tensor) -> Tensor:
    """Return the canvas after a view: without the arm and its shadow; where that is `hidden`, as it was `before`."""
    return torch.where(hidden, before, (image / compute_shading(arm.color, plate, arm.mask)).clamp(0, 1))


def find_visible_arm(shares: Tensor, arm: Arm) -> Tensor:
    """Return where, [B, 1, H, W], a composed view shows the arm itself: where most of it is the arm."""
    return (arm.mask > 0.5) & (shares[:, 2:3] > 0.5)


def carry_canvas(canvas: Tensor, motion: Motion, flow: Tensor | None = None, scale: float = 1.0) -> Tensor:
    """Move the canvas as an object in the gripper would move: along with it, and larger the nearer it comes.

    Args:
        canvas: [B, C, H, W], `scale` times as large as the motion's pixels are.
        motion: of the gripper.
        flow: [B, 2, H, W] more, in the motion's pixels.
        scale: see there.
    """
    height, width = canvas.shape[-2:]
    x = (torch.arange(width, device=canvas.device) + 0.5) / scale
    y = (torch.arange(height, device=canvas.device) + 0.5) / scale
    grid = torch.stack(torch.meshgrid(x, y, indexing="xy"))[None]
    larger = (motion.after[:, 2] / motion.before[:, 2])[:, None, None, None]
    source = motion.before[:, :2, None, None] + (grid - motion.after[:, :2, None, None]) * larger
    if flow is not None:
        source = source + flow
    size = torch.tensor([width, height], device=canvas.device)[None, :, None, None] / scale
    return functional.grid_sample(
        canvas, (2 * source / size - 1).permute(0, 2, 3, 1), padding_mode="border", align_corners=False
    )


def build_sources(
    mixture: Mixture, canvas: Tensor, arm: Arm, motion: Motion, plate: Tensor, scale: float = 1.0
) -> Tensor:
    """Return canvas, carried canvas, arm or bare table, and paint as they would be seen: [B, 4, 3, H, W]."""
    dark = compute_shading(arm.color, plate, arm.mask)
    moved = carry_canvas(canvas, motion, mixture.flow, scale)
    return torch.stack([canvas * dark, moved * dark, arm.color, mixture.paint], dim=1)


def compose_view(shares: Tensor, sources: Tensor) -> Tensor:
    """Return the next view: sources [B, 4, 3, H, W] by their shares [B, 4, H, W]."""
    return (shares[:, :, None] * sources).sum(1).clamp(0, 1)


class Network(nn.Module):
    """A U-Net of three scales with the mean of the coarsest, from which it tells how many lamps are lit.

    Args:
        widths: channels from fine to coarse.
    """

    def __init__(self, widths: tuple[int, int, int] = (32, 64, 96)) -> None:
        super().__init__()
        self.widths = tuple(widths)
        fine, middle, coarse = widths
        inputs = 4 * (3 * 4 + 2 + MAPS) + SCALARS
        self.fine = nn.Sequential(Block(inputs, fine), Block(fine, fine))
        self.middle = nn.Sequential(Block(fine, middle, 2), Block(middle, middle))
        self.coarse = nn.Sequential(Block(middle, coarse, 2), Block(coarse, coarse))
        self.whole = nn.Linear(coarse + SCALARS, coarse)
        self.deep = nn.Sequential(Block(coarse, coarse), Block(coarse, coarse))
        self.middle_again = nn.Sequential(Block(coarse + middle, middle), Block(middle, middle))
        self.fine_again = nn.Sequential(Block(middle + fine, fine), Block(fine, fine))
        self.last = nn.Conv2d(fine, 4 * 9, 1)
        nn.init.normal_(self.last.weight, std=0.01)
        self.last.bias = nn.Parameter(torch.zeros(4 * 9))

    def forward(self, canvas: Tensor, arm: Arm, arm_before: Tensor, motion: Motion, plate: Tensor) -> Mixture:
        """Return how the view after a motion is composed.

        Args:
            canvas: [B, 3, 64, 120].
            arm: after the motion.
            arm_before: [B, 1, 64, 120], its mask.
            motion: in pixels of the window.
            plate: [1, 3, 64, 120], the bare table.
        """
        seen = [canvas - 0.5, 3 * (canvas - plate), 3 * (carry_canvas(canvas, motion) - plate), arm.color - 0.5]
        image = torch.cat([*seen, arm.mask, arm_before, _maps(motion)], dim=1)
        numbers = motion.scalars
        folded = functional.pixel_unshuffle(image, 2)
        fine = self.fine(torch.cat([folded, numbers[:, :, None, None].expand(-1, -1, *folded.shape[-2:])], dim=1))
        middle = self.middle(fine)
        coarse = self.coarse(middle)
        whole = self.whole(torch.cat([coarse.mean((2, 3)), numbers], dim=1))
        coarse = self.deep(coarse + whole[:, :, None, None])
        middle = self.middle_again(torch.cat([functional.interpolate(coarse, scale_factor=2), middle], dim=1))
        fine = self.fine_again(torch.cat([functional.interpolate(middle, scale_factor=2), fine], dim=1))
        made = functional.pixel_shuffle(self.last(fine), 2).float()
        known = LIKELY * torch.cat([1 - arm.mask, 0 * arm.mask, arm.mask, 0 * arm.mask], dim=1)
        paint = (canvas + made[:, 4:7]).clamp(-0.1, 1.1)
        return Mixture((known + made[:, :4]).softmax(dim=1), paint, FARTHEST * (made[:, 7:] / 4).tanh())


class Block(nn.Module):
    """A 3x3 convolution, normalised."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
        self.norm = nn.GroupNorm(4, outputs)

    def forward(self, image: Tensor) -> Tensor:
        """Return [B, outputs, H / stride, W / stride]."""
        return functional.silu(self.norm(self.convolution(image)))


def _maps(motion: Motion) -> Tensor:
    """Return maps [B, 7, H, W] of a motion.

    They are closeness to the finger tips before and after, to the table's point under them and to the way between them,
    both coordinates seen from the tips, and how far along the way each pixel is.
    """
    height, width = (side.stop - side.start for side in WINDOW)
    grid = torch.stack(torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy"))[None]
    here, there, under = (spot[:, :2, None, None] for spot in (motion.before, motion.after, motion.below))
    way = there - here
    along = (((grid - here) * way).sum(1, keepdim=True) / (way * way).sum(1, keepdim=True).clamp_min(1.0)).clamp(0, 1)

    def near(point: Tensor, sigma: float) -> Tensor:
        return (-((grid - point) ** 2).sum(1, keepdim=True) / (2 * sigma**2)).exp()

    seen_from = ((grid - there) / 20).clamp(-2, 2)
    return torch.cat([near(here, 4), near(there, 4), near(under, 4), near(here + along * way, 4), seen_from, along], 1)
