# SPDX-License-Identifier: Apache-2.0
"""Train the networks of one pretrained model, step by step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.training.post_training import distributed
from wiw.training.post_training.clip_trainer import ClipTrainer, mix_seed, seed_torch
from wiw.training.post_training.clips import ClipBatch, load_clips, mirror_clip
from wiw.training.post_training.corpora import CorpusClips
from wiw.training.post_training.latent_cache import LatentCache
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded, TrainableModel


class PostTrainer(ClipTrainer):
    """Train on clips; see `ClipTrainer`.

    Networks are trained one after the other, each over all epochs: a model of two experts has two such phases.

    Args:
        model: what is trained.
        clips: what is trained on.
        recipe: of the training.
        cache: where encoded clips are kept; they are encoded each time if None.

    Raises:
        ArgumentError: there are fewer clips than one step takes, or its passes cannot be shared out evenly.
        DependencyError: the recipe's optimiser is not installed.
    """

    recipe: PostTrainingRecipe
    clips: CorpusClips

    def __init__(
        self,
        model: TrainableModel,
        clips: CorpusClips,
        recipe: PostTrainingRecipe,
        cache: LatentCache | None = None,
    ) -> None:
        super().__init__(clips, recipe, model.device)
        self.model, self._cache = model, cache
        self._units = [unit for place in model.places for unit in model.list_units(place)] if recipe.shard else []
        distributed.shard_modules(self._units, model.device)
        trained: dict[str, nn.Parameter] = {}
        for place in model.places:
            trained |= model.list_trained(place)
        self.start_optimizer(trained)

    @property
    def steps_per_epoch(self) -> int:
        """Steps in an epoch of each network, times the number of networks."""
        return self.order.steps_per_epoch * self.phases

    @property
    def phases(self) -> int:
        """Number of networks."""
        return len(self.model.places)

    @property
    def updates(self) -> int:
        """Number of updates that the network of the present step has had."""
        return self.locate(self.step_count)[1]

    @property
    def rows(self) -> int:
        """Clips in one pass through the networks."""
        return self.recipe.rows

    @property
    def gradient_scale(self) -> int:
        """The number of processes where weights are sharded: FSDP2 takes the mean of gradients."""
        return distributed.count_processes() if self._units else 1

    @contextmanager
    def use_final_weights(self) -> Iterator[None]:
        """Have in the networks what is to be written, as long as the context lasts: averages if any, and whole."""
        with self.use_averages(), distributed.gather_state_dicts(self._units):
            yield

    def locate(self, step: int) -> tuple[str, int]:
        """Return the network that a step trains, by its place, and the number of its own steps before it."""
        each, places = self.order.steps_per_epoch * self.recipe.epochs, self.model.places
        return places[min(step // each, len(places) - 1)], step % each

    def list_active(self) -> Sequence[str]:
        """Return the names of what is trained at the place of the present step."""
        return list(self.model.list_trained(self.locate(self.step_count)[0]))

    def select_batch(self) -> NDArray[np.int64]:
        """Return the clips of the present step, and keep on the device only what it trains."""
        place, own_step = self.locate(self.step_count)
        self.model.activate(place)
        return self.order.select(own_step)

    def compute_losses(self, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        """Return the loss of each clip."""
        return self._compute_losses(self.locate(self.step_count)[0], rows, random)

    def _compute_losses(self, place: str, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        mirrored = torch.rand(len(rows), generator=random) < self.recipe.mirror
        encoded, actions = self._encode_clips(rows, mirrored.tolist())
        return self.model.compute_losses(place, encoded, actions, random)

    def _encode_clips(self, rows: NDArray[np.int64], mirrored: Sequence[bool]) -> tuple[Encoded, Tensor]:
        """Return clips as the networks see them, each encoded separately, and their actions."""
        found = [self._encode_clip(int(row), mirror) for row, mirror in zip(rows, mirrored, strict=True)]
        encoded = {name: torch.cat([each[name] for each, _ in found]) for name in found[0][0]}
        return encoded, torch.cat([actions for _, actions in found])

    def _encode_clip(self, index: int, mirror: bool) -> tuple[Encoded, Tensor]:
        def make() -> tuple[Encoded, Tensor]:
            return encode_clip(self.model, self._load_clip(index, mirror))

        return make() if self._cache is None else self._cache.encode(index, mirror, make, self.model.device)

    def _load_clip(self, index: int, mirror: bool) -> ClipBatch:
        return load_clip(self.clips, self.recipe.clip_size, index, mirror).to(self.model.device)


def load_clip(clips: CorpusClips, size: tuple[int, int], index: int, mirror: bool) -> ClipBatch:
    """Return a clip, or its mirror image, in a height and width, as a batch of one.

    Raises:
        FileError: it cannot be read.
    """
    clip = clips[index]
    return load_clips([mirror_clip(clip) if mirror else clip], size)


def encode_clip(model: TrainableModel, clip: ClipBatch) -> tuple[Encoded, Tensor]:
    """Return a clip as the frozen networks encode it, and its actions, both as a cache has them."""
    return {name: value.contiguous() for name, value in model.encode(clip).items()}, clip.actions


def seed_weights(recipe: PostTrainingRecipe, device: torch.device) -> Any:
    """Return a context in which random weights are drawn from the recipe's seed."""
    return seed_torch(mix_seed(recipe.seed, "weights"), device)
