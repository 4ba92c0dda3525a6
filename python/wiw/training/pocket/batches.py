# SPDX-License-Identifier: Apache-2.0
"""Batches of pocket's training: views from places of a clip, all facing where the first one does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw.training.reduced_frames import ReducedFrames
from wiw.world_models.warpnet.model import to_network


@dataclass(frozen=True)
class PlaceBatch:
    """B panoramas, and the views from F places around each."""

    source: Tensor
    """[B, 3, H, W] in [-1, 1]."""
    places: Tensor
    """[B, F, 2]: metres (right, ahead)."""
    views: Tensor
    """[B, F, 3, H, W]."""
    log_distances: Tensor | None
    """[B, F, 1, H, W] of the views; None if the dataset has no depth."""

    def to(self, device: torch.device) -> PlaceBatch:
        """Return the batch on a device."""
        distances = None if self.log_distances is None else self.log_distances.to(device)
        return PlaceBatch(self.source.to(device), self.places.to(device), self.views.to(device), distances)


def draw_batch(
    frames: ReducedFrames, clips: Sequence[NDArray[np.int64]], count: int, rng: np.random.Generator
) -> PlaceBatch:
    """Draw `count` places of each clip, and show them from its first or its last place, at will.

    Panoramas and displacements are turned together by any angle, half of the clips are mirrored, and light and tint
    change.

    Args:
        frames: of the dataset.
        clips: the panoramas of each, in order.
        count: places.
        rng: of all that is drawn.
    """
    chosen = np.stack([draw_places(clip, count, rng) for clip in clips])  # [B, 1 + F], the source first
    poses = frames.poses[chosen]
    columns = frames.images.shape[2]
    turned = rng.integers(0, columns, len(chosen))
    mirrored = rng.random(len(chosen)) < 0.5
    facing = poses[:, 0, 2] + turned * (2 * np.pi / columns)
    places = compute_displacements(poses[:, :, :2], facing)
    places[mirrored, :, 0] *= -1
    rolls = np.round((facing[:, None] - poses[:, :, 2]) * (columns / (2 * np.pi))).astype(int)
    gain = rng.uniform(0.8, 1.2, (len(chosen), 1, 1, 1, 1)) * rng.uniform(0.92, 1.08, (len(chosen), 1, 3, 1, 1))
    images = _turn(frames.images[chosen], rolls, mirrored)
    colors = to_network(images.reshape(-1, *images.shape[2:])).unflatten(0, chosen.shape)
    colors = (colors + 1) * torch.from_numpy(gain.astype(np.float32)) - 1
    distances = None
    if frames.log_distances.size:
        distances = torch.from_numpy(
            _turn(frames.log_distances[chosen], rolls, mirrored)[:, 1:, None].astype(np.float32)
        )
    return PlaceBatch(colors[:, 0], torch.from_numpy(places[:, 1:].astype(np.float32)), colors[:, 1:], distances)


def draw_places(clip: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw 1 + `count` panoramas of a clip: its first or its last, and others in their order from there.

    Others are drawn more than once where there are too few. A clip of one panorama shows it alone.
    """
    ordered = clip if rng.random() < 0.5 else clip[::-1]
    others = max(1, len(ordered) - 1)
    drawn = rng.choice(others, count, replace=count > others)
    return ordered[np.concatenate([[0], np.minimum(np.sort(drawn) + 1, len(ordered) - 1)])]


def compute_displacements(positions: NDArray[np.float64], facing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return displacements (right, ahead) [B, N, 2] from the first of positions (x, z) [B, N, 2], for an agent that
    faces so many radians [B] to the left of -Z.
    """
    x, z = np.moveaxis(positions - positions[:, :1], -1, 0)
    sine, cosine = np.sin(facing)[:, None], np.cos(facing)[:, None]
    return np.stack([x * cosine - z * sine, -x * sine - z * cosine], axis=-1)


def _turn(panoramas: NDArray[Any], rolls: NDArray[np.int64], mirrored: NDArray[np.bool_]) -> NDArray[Any]:
    """Roll panoramas [B, N, H, W, ...] by columns [B, N] to the right, then mirror those of some rows [B]."""
    made = np.stack(
        [
            [np.roll(each, int(by), axis=1) for each, by in zip(row, bys, strict=True)]
            for row, bys in zip(panoramas, rolls, strict=True)
        ]
    )
    made[mirrored] = made[mirrored, :, :, ::-1]
    return made
