# SPDX-License-Identifier: Apache-2.0
"""Train the networks of one model, step by step."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torch.utils._pytree import tree_map_only

from wiw.errors import ArgumentError, TrainingError
from wiw.training.checkpoint import ResumableTrainer
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.post_training.clips import ClipBatch, load_clips, mirror_clip
from wiw.training.post_training.corpora import CorpusClips
from wiw.training.post_training.latent_cache import LatentCache
from wiw.training.post_training.optimizers import create_optimizer
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded, TrainableModel


class PostTrainer(ResumableTrainer):
    """Train step by step: step k is a function of the recipe, the clips and the state after step k - 1.

    Networks are trained one after the other, each over all epochs: a model of two experts has two such phases.

    Args:
        model: what is trained.
        clips: what is trained on.
        recipe: of the training.
        cache: where encoded clips are kept; they are encoded each time if None.

    Raises:
        ArgumentError: there are fewer clips than one step takes.
        DependencyError: the recipe's optimiser is not installed.
    """

    def __init__(
        self,
        model: TrainableModel,
        clips: CorpusClips,
        recipe: PostTrainingRecipe,
        cache: LatentCache | None = None,
    ) -> None:
        self.model, self.recipe, self._clips, self._cache = model, recipe, clips, cache
        self.mean_loss = float("nan")
        self.order = arrange_clips(len(clips), recipe)
        self.trained: dict[str, nn.Parameter] = {}
        for place in model.places:
            self.trained |= model.list_trained(place)
        self.optimizer = create_optimizer(list(self.trained.values()), recipe)
        self.averages = {name: value.detach().clone() for name, value in self.trained.items()} if recipe.ema else {}

    @property
    def steps_per_epoch(self) -> int:
        """Steps in an epoch of each network, times the number of networks."""
        return self.order.steps_per_epoch * len(self.model.places)

    def locate(self, step: int) -> tuple[str, int]:
        """Return the network that a step trains, by its place, and the number of its own steps before it."""
        each, places = self.order.steps_per_epoch * self.recipe.epochs, self.model.places
        return places[min(step // each, len(places) - 1)], step % each

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch and return its loss.

        Raises:
            TrainingError: the loss or the gradient is not finite; nothing has changed.
            FileError: a clip cannot be read.
        """
        place, own_step = self.locate(self.step_count)
        self.model.activate(place)
        batch = self.order.select(own_step)
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for first in range(0, self.recipe.batch, self.recipe.rows):
            total += self._add_gradients(place, batch[first : first + self.recipe.rows], first)
        norm = nn.utils.clip_grad_norm_(list(self.trained.values()), self.recipe.clip_norm)
        self._require_finite(norm[None], batch, "gradient")
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.optimizer.step()
        self._average_weights(place)
        self.mean_loss = total if not self.step_count else 0.98 * self.mean_loss + 0.02 * total
        self.step_count += 1
        return total

    def state_dict(self) -> dict[str, Any]:
        """Return the number of steps, the mean loss, weights, averages and the optimiser's state, in main memory."""
        return {
            "count": self.step_count,
            "loss": self.mean_loss,
            "weights": {name: value.detach().cpu() for name, value in self.trained.items()},
            "averages": {name: value.cpu() for name, value in self.averages.items()},
            "optimizer": tree_map_only(Tensor, Tensor.cpu, self.optimizer.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.step_count, self.mean_loss = state["count"], state["loss"]
        with torch.no_grad():
            for name, value in self.trained.items():
                value.copy_(state["weights"][name])
            for name, average in self.averages.items():
                average.copy_(state["averages"][name])
        self.optimizer.load_state_dict(state["optimizer"])

    @contextmanager
    def use_averages(self) -> Iterator[None]:
        """Exchange the weights for their averages, where there are any, as long as the context lasts."""
        self._exchange_averages()
        try:
            yield
        finally:
            self._exchange_averages()

    @torch.no_grad()
    def _exchange_averages(self) -> None:
        for name, average in self.averages.items():
            kept = self.trained[name].clone()
            self.trained[name].copy_(average)
            average.copy_(kept)

    @torch.no_grad()
    def _average_weights(self, place: str) -> None:
        """Move the averages of what is trained at a place towards its weights."""
        if self.averages:
            names = list(self.model.list_trained(place))
            averages, weights = ([each[name] for name in names] for each in (self.averages, self.trained))
            get_ema_multi_avg_fn(self.recipe.ema)(averages, weights, None)

    def _add_gradients(self, place: str, rows: NDArray[np.int64], first: int) -> float:
        """Add the gradients of some clips of a batch, from its clip `first` on; return their part of its mean loss."""
        with _seed_torch(_mix_seed(self.recipe.seed, "step", self.step_count, first), self.model.device) as random:
            losses = self._compute_losses(place, rows, random)
            self._require_finite(losses, rows, "loss")
            loss = losses.sum() / self.recipe.batch
            loss.backward()
        return float(loss.detach())

    def _compute_losses(self, place: str, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        mirrored = torch.rand(len(rows), generator=random) < self.recipe.mirror
        encoded, actions = self._encode_clips(rows, mirrored.tolist())
        return self.model.compute_losses(place, encoded, actions, random)

    def _encode_clips(self, rows: NDArray[np.int64], mirrored: Sequence[bool]) -> tuple[Encoded, Tensor]:
        """Return clips as the networks see them, each encoded by itself, and their actions."""
        found = [self._encode_clip(int(row), mirror) for row, mirror in zip(rows, mirrored, strict=True)]
        encoded = {name: torch.cat([each[name] for each, _ in found]) for name in found[0][0]}
        return encoded, torch.cat([actions for _, actions in found])

    def _encode_clip(self, index: int, mirror: bool) -> tuple[Encoded, Tensor]:
        def make() -> tuple[Encoded, Tensor]:
            clip = self._load_clip(index, mirror)
            encoded = self.model.encode(clip)
            return {name: value.contiguous() for name, value in encoded.items()}, clip.actions  # as a cache has them

        return make() if self._cache is None else self._cache.encode(index, mirror, make, self.model.device)

    def _load_clip(self, index: int, mirror: bool) -> ClipBatch:
        clip = self._clips[index]
        return load_clips([mirror_clip(clip) if mirror else clip], self.recipe.clip_size).to(self.model.device)

    def _require_finite(self, values: Tensor, rows: NDArray[np.int64], what: str) -> None:
        if bool(torch.isfinite(values).all()):
            return
        self.optimizer.zero_grad(set_to_none=True)
        names = [self._clips.describe(int(row)) for row in rows]
        raise TrainingError(
            f"step {self.step_count + 1}: the {what} is not finite on a batch of {'; '.join(names)}. The state before "
            "this step is kept. Look at these clips (`wiw data verify`), or begin anew with a lower rate or "
            "precision=float32"
        )


def arrange_clips(total: int, recipe: PostTrainingRecipe) -> ClipOrder:
    """Return the order of a corpus's clips.

    Raises:
        ArgumentError: there are fewer clips than one step takes.
    """
    order = ClipOrder(total, min(recipe.clips or total, total), recipe.batch, recipe.seed)
    if not order.steps_per_epoch:
        raise ArgumentError(
            f"expected at least {recipe.batch} clips of {recipe.frames} frames, one batch, got {order.count}: collect "
            "more data, or lower batch"
        )
    return order


def seed_weights(recipe: PostTrainingRecipe, device: torch.device) -> Any:
    """Return a context in which random weights are drawn from the recipe's seed."""
    return _seed_torch(_mix_seed(recipe.seed, "weights"), device)


def _mix_seed(seed: int, *parts: object) -> int:
    """Return a seed of torch that depends on all parts."""
    digest = hashlib.blake2b(repr((seed, *parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


@contextmanager
def _seed_torch(seed: int, device: torch.device) -> Iterator[torch.Generator]:
    """Yield a generator on the CPU, and seed torch's own ones, which are as before afterwards."""
    devices = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        yield torch.Generator("cpu").manual_seed(seed)
