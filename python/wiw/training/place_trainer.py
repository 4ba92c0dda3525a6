# SPDX-License-Identifier: Apache-2.0
"""Training of small networks on views from the places of clips, which are kept in memory."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.datasets.navigation import Clips, NavigationData, SelectedClips
from wiw.networks import autocast_bfloat16
from wiw.training.post_training.clip_trainer import ClipTrainer, mix_seed, seed_torch
from wiw.training.post_training.recipe import ClipRecipe
from wiw.training.reduced_frames import ReducedFrames


class PlaceTrainer(ClipTrainer):
    """Train a network from random weights.

    Args:
        clips: what is trained on.
        frames: of the same dataset, in the recipe's size.
        recipe: of the training.
        device: of torch, where the network is trained.

    Raises:
        ArgumentError: there are fewer clips than one step takes.
    """

    clips: Clips | SelectedClips
    network: nn.Module

    def __init__(
        self, clips: Clips | SelectedClips, frames: ReducedFrames, recipe: ClipRecipe, device: str = "cpu"
    ) -> None:
        super().__init__(clips, recipe, torch.device(device))
        self.frames = frames
        with seed_torch(mix_seed(recipe.seed, "weights"), self.device):
            self.network = self.create_network().train().to(self.device)
        self.start_optimizer(dict(self.network.named_parameters()))

    @classmethod
    def check_dataset(cls, data: NavigationData) -> None:
        """Check that a dataset has what the network learns from, before its frames are decoded.

        Raises:
            ArgumentError: it has not.
        """

    @abstractmethod
    def create_network(self) -> nn.Module:
        """Return the network with random weights."""

    @abstractmethod
    def compare_views(
        self, clips: Sequence[NDArray[np.int64]], rng: np.random.Generator, random: torch.Generator
    ) -> Tensor:
        """Return the loss of each clip, given as its panoramas in order; both generators are of this step alone."""

    def reduce_precision(self) -> torch.autocast:
        """Return a context that computes products in bfloat16, if the recipe says so and it is faster on the device."""
        return autocast_bfloat16(self.device.type, self.recipe.precision == "bfloat16")

    def compute_losses(self, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        """Return the loss of each clip."""
        clips = [self.frames.find_places(*self.clips.locate(int(row)), self.recipe.frames) for row in rows]
        rng = np.random.default_rng(int(torch.randint(2**62, (), generator=random)))
        return self.compare_views(clips, rng, random)
