# SPDX-License-Identifier: Apache-2.0
"""Train warpnet on clips of a navigation dataset instead of walks.

Of a clip, its first or its last place and another one make a pair; both panoramas are turned so that they face from one
to the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError
from wiw.training.held_out_panoramas import turn_panoramas
from wiw.training.place_trainer import PlaceTrainer
from wiw.training.pocket.batches import draw_places
from wiw.training.post_training.recipe import ClipRecipe
from wiw.training.reduced_frames import ReducedFrames
from wiw.training.trainer import warmup_cosine_schedule
from wiw.training.warpnet import Pairs, Recipe, build_pairs, compute_losses
from wiw.world_models.warpnet.model import STILL
from wiw.world_models.warpnet.network import Network


@dataclass(frozen=True, kw_only=True)
class WarpNetClipRecipe(ClipRecipe):
    """Numbers of a training of warpnet on clips; weights of errors are those of its training on walks.

    Raises:
        ArgumentError: a number is out of range.
    """

    rate: float = Recipe.rate
    widths: tuple[int, int, int] = Recipe.widths
    """Channels of the U-Nets' levels."""
    warmup: float = 0.05
    """Share of the steps in which the learning rate grows from 0; then it falls as a cosine."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shift != ClipRecipe.shift:
            raise ArgumentError(f"recipe: shift: warpnet has no noise levels; leave it out, got {self.shift}")

    def scale_rate(self, progress: float) -> float:
        """Return the factor of the learning rate after a share of the steps, 0 to 1."""
        return warmup_cosine_schedule(self.warmup)(progress)


class WarpNetClipTrainer(PlaceTrainer):
    """Train warpnet from random weights, on frames with distances; see `PlaceTrainer`."""

    recipe: WarpNetClipRecipe
    network: Network

    @classmethod
    def check_dataset(cls, data: NavigationData) -> None:
        """Check that a dataset has depth.

        Raises:
            ArgumentError: it has not.
        """
        if data.meta["depth"] is None:
            raise ArgumentError(
                f"warpnet learns distances, but the dataset has no depth: {data.folder}; collect it without --no-depth"
            )

    def create_network(self) -> Network:
        """Return a network of random weights."""
        return Network(self.recipe.clip_size[0], self.recipe.widths)

    def compare_views(
        self, clips: Sequence[NDArray[np.int64]], rng: np.random.Generator, random: torch.Generator
    ) -> Tensor:
        """Return the loss of each clip."""
        pairs = draw_pairs(self.frames, clips, rng).to(self.device)
        with self.reduce_precision():
            found = self.network(pairs.source, pairs.ahead)
        return compute_losses(found, pairs, Recipe())


def draw_pairs(frames: ReducedFrames, clips: Sequence[NDArray[np.int64]], rng: np.random.Generator) -> Pairs:
    """Draw a pair from each clip; of a clip of a single place, that place twice."""
    chosen = np.stack([draw_places(clip, 1, rng) for clip in clips])
    poses = frames.poses[chosen]
    x, z = (poses[:, 1, :2] - poses[:, 0, :2]).T
    ahead = np.hypot(x, z)
    facing = np.where(ahead > STILL, np.arctan2(-x, -z), poses[:, 0, 2])
    turns = facing[:, None] - poses[:, :, 2]
    images = turn_panoramas(frames.images[chosen], turns)
    distances = turn_panoramas(frames.log_distances[chosen[:, 1], ..., None], turns[:, 1])[..., 0]
    return build_pairs(images[:, 0], images[:, 1], distances, ahead, rng)
