# SPDX-License-Identifier: Apache-2.0
"""Batches of labelled views for the labeller's training, augmented on the device that trains."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from wiw.perception.labelling_network import COLOR_CHANNELS, MULTIPLE, PIXELS, find_middles
from wiw.perception.scene_labels import CATEGORIES
from wiw.training.labelled_views import SIZE, LabelledViews

GREATEST_BLUR = 3.2
"""Maximum standard deviation in pixels of the blur of degraded views."""
ROWS = 256
"""Views that are counted at a time."""


@dataclass(frozen=True)
class ViewTensors:
    """The views of `LabelledViews` without their colours, as tensors of the same types and shapes."""

    images: Tensor
    depth: Tensor
    category: Tensor
    state: Tensor
    hfov_deg: Tensor

    def __len__(self) -> int:
        return len(self.images)

    @classmethod
    def of(cls, views: LabelledViews, device: str) -> ViewTensors:
        """Return the tensors of views, on the device if they take at most half of its free memory."""
        held = cls(*(torch.from_numpy(getattr(views, field.name)) for field in fields(cls)))
        if not device.startswith("cuda") or 2 * held.count_bytes() > torch.cuda.mem_get_info(device)[0]:
            return held
        return cls(*(getattr(held, field.name).to(device) for field in fields(cls)))

    def count_bytes(self) -> int:
        """Return the memory that the tensors take."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))

    def take(self, rows: NDArray[np.int64], device: str) -> ViewTensors:
        """Return copies of some views, on a device."""
        index = torch.from_numpy(rows).to(self.images.device)
        return ViewTensors(*(getattr(self, field.name)[index].to(device) for field in fields(self)))


@dataclass(frozen=True)
class Batch:
    """Views as the network takes them, and the labels of their cells."""

    shown: Tensor
    """float [B, CHANNELS, h, w]."""
    category: Tensor
    """int64 [B, h, w]."""
    state: Tensor
    """int64 [B, h, w]."""


def sample_batch(
    views: ViewTensors,
    count: int,
    imagined: float,
    weights: NDArray[np.float64],
    rng: np.random.Generator,
    device: str = "cpu",
    coarse: bool = False,
) -> Batch:
    """Sample views, half of them mirrored, with other brightness and tint, a share of them like imagined ones.

    Args:
        views: to sample from.
        count: number of views; twice as many if `coarse`.
        imagined: share of views without depth, two thirds of which are degraded too.
        weights: float64 [N], the probability of each view.
        rng: what chance depends on.
        device: of torch, where the batch is made.
        coarse: whether to shrink views to about half their size.
    """
    count = 2 * count if coarse else count
    chosen = views.take(rng.choice(len(views), count, p=weights), device)
    random = torch.Generator(device).manual_seed(int(rng.integers(2**63)))
    images = chosen.images.permute(0, 3, 1, 2).to(torch.float32, memory_format=torch.contiguous_format)
    depth = chosen.depth.float()
    labels = torch.stack([chosen.category, chosen.state], dim=-1)
    without_depth = rng.random(count) < imagined
    depth[_find(without_depth, device)] = 0
    degraded = _find(without_depth & (rng.random(count) < 2 / 3), device)
    if len(degraded):
        images[degraded], labels[degraded] = degrade_views(images[degraded], labels[degraded], rng, random)
    mirrored = _find(rng.random(count) < 0.5, device)
    images[mirrored], depth[mirrored] = images[mirrored].flip(-1), depth[mirrored].flip(-1)
    labels[mirrored] = labels[mirrored].flip(2)
    light = rng.uniform(0.75, 1.3, (count, 1, 1, 1)) * rng.uniform(0.92, 1.08, (count, 3, 1, 1))
    images.mul_(torch.from_numpy(light.astype(np.float32)).to(device)).clamp_(0, 255)
    if coarse:
        images, depth, labels = _halve(images, depth, labels)
    tangents = compute_tangents(chosen.hfov_deg, depth.shape[1:])
    return Batch(compose_input(images, tangents, depth), labels[..., 0].long(), labels[..., 1].long())


def _find(flags: NDArray[np.bool_], device: str) -> Tensor:
    """Return the places of what is true."""
    return torch.from_numpy(np.flatnonzero(flags)).to(device)


def compute_tangents(hfov_deg: Tensor, size: torch.Size | tuple[int, int]) -> Tensor:
    """Return the directions of the cells of recorded views, [N, h, w, 2] for h x w cells, on the device of `hfov_deg`.

    They are those of `wiw.perception.labelling_network.compute_tangents`.
    """
    height, width = size
    spread = torch.tan(torch.deg2rad(hfov_deg.double()) / 2).float() * 2
    across = (torch.arange(width, device=hfov_deg.device) + 0.5) / width - 0.5
    up = (0.5 - (torch.arange(height, device=hfov_deg.device) + 0.5) / height) * (SIZE[0] / SIZE[1])
    axes = torch.stack(torch.meshgrid(up, across, indexing="ij")[::-1], dim=-1)
    return spread[:, None, None, None] * axes


def compose_input(images: Tensor, tangents: Tensor, depth: Tensor) -> Tensor:
    """Return the network's input; see `wiw.perception.labelling_network.to_network_input`.

    Args:
        images: float [B, 3, PIXELS * h, PIXELS * w], from 0 to 255.
        tangents: float [B, h, w, 2].
        depth: float [B, h, w]: planar, in metres; 0 where unknown.
    """
    cells = functional.pixel_unshuffle(images / 127.5 - 1, PIXELS).unflatten(1, (3, PIXELS**2))
    colors = cells.transpose(1, 2).reshape(len(images), COLOR_CHANNELS, *depth.shape[1:])
    known = depth > 0
    distance = torch.where(known, depth, 1.0).log()
    rest = torch.stack([tangents[..., 0], tangents[..., 1], distance, depth * tangents[..., 1], known.float()], dim=1)
    return torch.cat([colors, rest], dim=1).contiguous(memory_format=torch.channels_last)


def _halve(images: Tensor, depth: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shrink views, depth and labels to about half their size, a size that the network takes."""
    height, width = (-(-side // (2 * MULTIPLE)) * MULTIPLE for side in depth.shape[1:])
    rows, columns = (
        torch.from_numpy(find_middles(old, new)).to(depth.device)
        for old, new in zip(depth.shape[1:], (height, width), strict=True)
    )
    shown = functional.interpolate(images, (PIXELS * height, PIXELS * width), mode="bilinear", antialias=True)
    return shown, depth[:, rows[:, None], columns], labels[:, rows[:, None], columns]


def degrade_views(
    images: Tensor, labels: Tensor, rng: np.random.Generator, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Make views as imperfect as imagined ones: warped, with their labels, then blurred or coarse, and noisy.

    Args:
        images: float [N, 3, H, W], from 0 to 255.
        labels: uint8 [N, H / PIXELS, W / PIXELS, C].
        rng: what chance decides about each view.
        random: what chance decides about pixels, on the images' device.
    """
    count, _, height, width = images.shape
    columns, rows = _warp(count, height, width, rng, random)
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], dim=-1)
    images = functional.grid_sample(images, grid, mode="bilinear", padding_mode="reflection", align_corners=False)
    row, column = _find_cells(rows, height), _find_cells(columns, width)
    labels = labels[torch.arange(count, device=labels.device)[:, None, None], row, column]
    is_blurred = rng.random(count) < 0.5
    blurred = _find(is_blurred, str(images.device))
    images[blurred] = _blur(images[blurred], rng.uniform(0.5, GREATEST_BLUR, len(blurred)))
    for i in np.flatnonzero(~is_blurred):
        factor = rng.uniform(1.0, 4.5)
        small = functional.interpolate(images[i, None], (round(height / factor), round(width / factor)), mode="area")
        images[i] = functional.interpolate(small, (height, width), mode="bilinear")[0]
    noise = torch.randn(images.shape, generator=random, device=images.device)
    return (images + noise * _per_view(rng.uniform(0, 10, count), images)).clamp(0, 255), labels


def _find_cells(source: Tensor, side: int) -> Tensor:
    """Return from which row or column of cells each cell comes, given that of each pixel [N, H, W]."""
    middles = source[:, PIXELS // 2 :: PIXELS, PIXELS // 2 :: PIXELS]
    return (middles / PIXELS).clamp(0, side // PIXELS - 1).long()


def _warp(
    count: int, height: int, width: int, rng: np.random.Generator, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Return from which column and row of a view each pixel comes, two tensors [count, height, width]."""
    field = torch.randn((count, 2, 5, 6), generator=random, device=random.device)
    field = field * _per_view(rng.uniform(0, 7, count), field)
    offset = functional.interpolate(field, (height, width), mode="bicubic")
    columns = torch.arange(width, device=random.device) + offset[:, 0]
    return columns, torch.arange(height, device=random.device)[:, None] + offset[:, 1]


def _per_view(values: NDArray[np.float64], like: Tensor) -> Tensor:
    """Return one number for each view, [N, 1, 1, 1], on a tensor's device."""
    return torch.from_numpy(values.astype(np.float32)).to(like.device)[:, None, None, None]


def _blur(images: Tensor, deviations: NDArray[np.float64]) -> Tensor:
    """Blur each image [N, C, H, W] by a Gaussian of its own standard deviation in pixels."""
    if not len(images):
        return images
    count, channels = images.shape[:2]
    reach = int(np.ceil(3 * GREATEST_BLUR))
    offsets = torch.arange(-reach, reach + 1, device=images.device)
    taps = torch.exp(-0.5 * (offsets / _per_view(deviations, images).flatten(1)) ** 2)
    taps = (taps / taps.sum(dim=1, keepdim=True)).repeat_interleave(channels, dim=0)[:, None]
    planes = functional.pad(images, (reach,) * 4, mode="reflect").flatten(0, 1)[None]
    planes = functional.conv2d(planes, taps[..., None], groups=count * channels)
    return functional.conv2d(planes, taps[:, :, None], groups=count * channels).reshape(images.shape)


# -- frequencies -------------------------------------------------------------------------------------------------------


def compute_sampling_weights(category: Tensor) -> NDArray[np.float64]:
    """Return each view's sampling probability, proportional to the number of categories that it shows."""
    shown = np.concatenate([_count_categories(rows) for rows in category.split(ROWS)]).astype(np.float64)
    return np.asarray(shown / shown.sum())


def _count_categories(category: Tensor) -> NDArray[np.int64]:
    found = torch.zeros((len(category), len(CATEGORIES)), dtype=torch.bool, device=category.device)
    found.scatter_(1, category.flatten(1).long(), True)
    return np.asarray(found.sum(dim=1).cpu().numpy())


def count_pairs(category: Tensor, state: Tensor, states: int) -> NDArray[np.int64]:
    """Return how many cells show each state of each category, int64 [categories, states]."""
    size = len(CATEGORIES) * states
    counts = [
        torch.bincount((rows.long() * states + values.long()).flatten(), minlength=size).cpu().numpy()
        for rows, values in zip(category.split(ROWS), state.split(ROWS), strict=True)
    ]
    return np.asarray(np.sum(counts, axis=0, dtype=np.int64)).reshape(len(CATEGORIES), states)
