# SPDX-License-Identifier: Apache-2.0
"""Training on clips of frames and actions, step by step: what post-trained generators and small networks share."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torch.utils._pytree import tree_map_only

from wiw.errors import ArgumentError, TrainingError
from wiw.training.checkpoint import ResumableTrainer
from wiw.training.post_training import distributed
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.post_training.optimizers import create_optimizer
from wiw.training.post_training.recipe import ClipRecipe


class NamedClips(Protocol):
    """Clips that can be found in their dataset."""

    def __len__(self) -> int: ...

    def describe(self, index: int) -> str:
        """Return where a clip is in its dataset, in words."""


class ClipTrainer(ResumableTrainer, ABC):
    """Train step by step: step k is a function of the recipe, the clips and the state after step k - 1.

    Args:
        clips: what is trained on.
        recipe: of the training.
        device: of torch.

    Raises:
        ArgumentError: there are fewer clips than one step takes, or its passes cannot be shared out evenly.
    """

    trained: dict[str, nn.Parameter]
    """Trained parameters by name."""
    averages: dict[str, Tensor]
    """Averages of what is trained, where the recipe asks for them."""
    optimizer: torch.optim.Optimizer

    def __init__(self, clips: NamedClips, recipe: ClipRecipe, device: torch.device) -> None:
        self.clips, self.recipe, self.device = clips, recipe, device
        self.order = arrange_clips(len(clips), recipe)
        require_equal_shares(recipe.batch, self.rows, distributed.count_processes())
        self.mean_loss = float("nan")

    def start_optimizer(self, trained: dict[str, nn.Parameter]) -> None:
        """Set what is trained, its optimiser, and its averages where the recipe asks for them.

        Raises:
            DependencyError: the recipe's optimiser is not installed.
        """
        self.trained = trained
        self.optimizer = create_optimizer(list(trained.values()), self.recipe)
        self.averages = {name: value.detach().clone() for name, value in trained.items()} if self.recipe.ema else {}

    @property
    def steps_per_epoch(self) -> int:
        """Number of steps in an epoch."""
        return self.order.steps_per_epoch

    @property
    def phases(self) -> int:
        """Number of networks that are trained one after the other, each with a schedule of its own."""
        return 1

    @property
    def updates(self) -> int:
        """Number of updates that the network in training has had."""
        return self.step_count

    @property
    def rows(self) -> int:
        """Clips in one pass through the networks; gradients of several passes are added up."""
        return self.recipe.batch

    @property
    def gradient_scale(self) -> int:
        """Factor of the loss before the backward pass: the number of processes where gradients become their mean."""
        return 1

    @abstractmethod
    def compute_losses(self, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        """Return the loss of each clip, float32 [B]; `random` is on the CPU, so that draws are alike on all devices.

        Raises:
            FileError: a clip cannot be read.
        """

    def select_batch(self) -> NDArray[np.int64]:
        """Return the clips of the present step, and make ready what it trains."""
        return self.order.select(self.step_count)

    def list_active(self) -> Sequence[str]:
        """Return the names of what the present step trains."""
        return list(self.trained)

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch and return its loss.

        Raises:
            TrainingError: the loss or the gradient is not finite; nothing has changed.
            FileError: a clip cannot be read.
        """
        batch = self.select_batch()
        self.optimizer.zero_grad(set_to_none=True)
        own = distributed.select_share(range(0, self.recipe.batch, self.rows))
        losses = {first: self._add_gradients(batch, first) for first in own}
        total = sum(loss for _, loss in sorted(pair for each in distributed.collect(losses) for pair in each.items()))
        distributed.sum_gradients(self.trained.values())
        norm = nn.utils.clip_grad_norm_(list(self.trained.values()), self.recipe.clip_norm)
        self._require_finite(distributed.join_tensor(norm), batch, "gradient")
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)  # frees their memory, for instance for validation
        self._average_weights()
        self.mean_loss = total if not self.step_count else 0.98 * self.mean_loss + 0.02 * total
        self.step_count += 1
        return total

    def state_dict(self) -> dict[str, Any]:
        """Return the number of steps, the mean loss, weights, averages and the optimiser's state, in main memory.

        To be called in all processes; in the first one, tensors are whole, in the others they are empty.
        """
        state = {
            "count": self.step_count,
            "loss": self.mean_loss,
            "weights": dict(self.trained),
            "averages": dict(self.averages),
            "optimizer": self.optimizer.state_dict(),
        }
        return tree_map_only(Tensor, distributed.gather_tensor, state)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned, in any number of processes."""
        self.step_count, self.mean_loss = state["count"], state["loss"]
        with torch.no_grad():
            for name, value in self.trained.items():
                value.copy_(distributed.shard_like(state["weights"][name], value))
            for name, average in self.averages.items():
                average.copy_(distributed.shard_like(state["averages"][name], average))
        moments = {
            place: {
                name: distributed.shard_like(value, parameter)
                for name, value in state["optimizer"]["state"][place].items()
            }
            for place, parameter in enumerate(self.trained.values())
            if place in state["optimizer"]["state"]
        }
        self.optimizer.load_state_dict({**state["optimizer"], "state": moments})

    @contextmanager
    def use_averages(self) -> Iterator[None]:
        """Exchange the weights for their averages, if there are any, as long as the context lasts."""
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
    def _average_weights(self) -> None:
        """Move the averages of what the step trained towards its weights; the sooner, the nearer their start is."""
        if self.averages:
            decay = min(self.recipe.ema, (1 + self.updates) / (10 + self.updates))
            names = self.list_active()
            averages, weights = ([each[name] for name in names] for each in (self.averages, self.trained))
            get_ema_multi_avg_fn(decay)(averages, weights, None)

    def _add_gradients(self, batch: NDArray[np.int64], first: int) -> float:
        """Add the gradients of one pass, from clip `first` of a batch on; return its part of the batch's mean loss."""
        rows = batch[first : first + self.rows]
        with seed_torch(mix_seed(self.recipe.seed, "step", self.step_count, first), self.device) as random:
            losses = self.compute_losses(rows, random)
            self._require_finite(losses, rows, "loss")
            loss = losses.sum() / self.recipe.batch
            (loss * self.gradient_scale).backward()
        return float(loss.detach())

    def _require_finite(self, values: Tensor, rows: NDArray[np.int64], what: str) -> None:
        """Check values in all processes; called alike in each, it raises in all of them."""
        own = [] if bool(torch.isfinite(values).all()) else rows.tolist()
        rows = np.array(list(dict.fromkeys(row for each in distributed.collect(own) for row in each)), np.int64)
        if not len(rows):
            return
        self.optimizer.zero_grad(set_to_none=True)
        names = [self.clips.describe(int(row)) for row in rows]
        raise TrainingError(
            f"step {self.step_count + 1}: the {what} is not finite on a batch of {'; '.join(names)}. The state before "
            "this step is kept. Check these clips (`wiw data verify`), or start again with a lower rate or "
            "precision=float32"
        )


def arrange_clips(total: int, recipe: ClipRecipe) -> ClipOrder:
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


def require_equal_shares(batch: int, rows: int, processes: int) -> None:
    """Check that processes can share out the passes of a step evenly.

    Args:
        batch: clips of a step.
        rows: clips of a pass.
        processes: how many there are.

    Raises:
        ArgumentError: they cannot.
    """
    passes = batch // rows
    if passes % processes:
        raise ArgumentError(
            f"a step of {batch} clips has {passes} passes of {rows}, which cannot be split evenly among {processes} "
            "processes; expected a number of processes that divides the passes: change --gpus or --nodes, or the "
            "recipe's batch or rows"
        )


def mix_seed(seed: int, *parts: object) -> int:
    """Return a seed of torch that depends on all parts."""
    digest = hashlib.blake2b(repr((seed, *parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


@contextmanager
def seed_torch(seed: int, device: torch.device) -> Iterator[torch.Generator]:
    """Yield a generator on the CPU, and seed torch's own ones, which are as before afterwards."""
    devices = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        yield torch.Generator("cpu").manual_seed(seed)
