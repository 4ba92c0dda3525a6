# SPDX-License-Identifier: Apache-2.0
"""The training loop that all networks of `wiw train` share: number of steps, learning-rate schedule, checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeVar, cast

import numpy as np
from torch.nn import Module
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer

from wiw.errors import ArgumentError, TrainingError
from wiw.training.checkpoint import Checkpoint, ResumableTrainer


class Trainer(Protocol):
    """A network in training, with everything that its next step depends on."""

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch and return its loss."""


T = TypeVar("T", bound=Trainer)


def run_training(
    create_trainer: Callable[[], T],
    recipe: Any,
    steps_per_epoch: int,
    minutes: float | None,
    schedule: Callable[[float], float],
    on_step: Callable[[int, int, float], None],
    checkpoint: Checkpoint | None = None,
) -> tuple[T, Any]:
    """Train from the start, or from a checkpoint, to the end.

    Args:
        create_trainer: returns a trainer at step 0, the same one at every call.
        recipe: a dataclass with `epochs` and `rate`, the peak learning rate.
        steps_per_epoch: number of steps in an epoch.
        minutes: if given, reduces the number of epochs so that training takes about this long, as measured by a few
            trial steps.
        schedule: maps the share of all steps done, 0 to 1, to a factor of the learning rate.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        checkpoint: where a trainer with a state is saved from time to time, and from where it resumes.

    Returns:
        The trainer after its last step, and the recipe that reproduces it without a time limit.

    Raises:
        ArgumentError: `minutes` is not above 0.
        TrainingError: the loss or a gradient is not finite; the last state that was written is kept.
    """
    if minutes is not None and not (minutes > 0 and math.isfinite(minutes)):
        raise ArgumentError(f"minutes: expected a finite number above 0, got {minutes}")
    resumed = checkpoint.load() if checkpoint else None
    if resumed is not None:
        recipe = replace(recipe, epochs=resumed.epochs)
    elif minutes is not None:
        seconds = _measure_step_seconds(create_trainer())
        recipe = replace(recipe, epochs=max(1, min(recipe.epochs, int(60 * minutes / (seconds * steps_per_epoch)))))
    trainer = create_trainer()
    steps, mean, first = recipe.epochs * steps_per_epoch, float("nan"), 0
    if resumed is not None:
        cast(ResumableTrainer, trainer).load_state_dict(resumed.state)
        first = resumed.step
        resumed = None  # frees its copy of the state
    for step in range(first, steps):
        loss = _take_step(trainer, recipe.rate * schedule(step / steps), step + 1)
        mean = loss if step == first else 0.98 * mean + 0.02 * loss
        on_step(step + 1, steps, mean)
        if checkpoint:
            checkpoint.save_if_due(cast(ResumableTrainer, trainer), recipe.epochs, step + 1)
    return trainer, recipe


def _take_step(trainer: Trainer, learning_rate: float, number: int) -> float:
    try:
        loss = trainer.train_step(learning_rate)
        if not math.isfinite(loss):
            raise FloatingPointError("the loss")
    except FloatingPointError as error:
        raise TrainingError(
            f"step {number}: {error} is not finite. The last state that was written is from before this step, whose "
            "batch depends only on the seed and its number. Train with a lower rate or another seed"
        ) from error
    return loss


def apply_gradients(optimiser: Optimizer, network: Module, learning_rate: float, largest: float = 1.0) -> None:
    """Update weights at a learning rate by their gradients, those of the network clipped to a norm; clear these.

    Raises:
        FloatingPointError: a gradient of the network is not finite; the weights are as they were.
    """
    if not clip_grad_norm_(network.parameters(), largest).isfinite():
        raise FloatingPointError("a gradient")
    for group in optimiser.param_groups:
        group["lr"] = float(learning_rate)
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)


def warmup_cosine_schedule(warmup: float, floor: float = 0.005) -> Callable[[float], float]:
    """Return a learning-rate schedule: linear warm-up over a share of the training, then cosine decay to a floor."""

    def schedule(progress: float) -> float:
        if progress < warmup:
            return progress / warmup + 0.02
        return floor + 0.5 * (1 + math.cos(math.pi * (progress - warmup) / (1 - warmup)))

    return schedule


def take_middles(schedule: Callable[[float], float], steps: int) -> Callable[[float], float]:
    """Return a schedule that takes the factor in the middle of each of so many steps, not at its beginning: a rate that
    rises from 0 is then 0 in no step.
    """
    return lambda progress: schedule(progress + 0.5 / steps)


def _measure_step_seconds(trainer: Trainer, trials: int = 10) -> float:
    """Return the median time of a few steps, leaving out the first two, which are slow."""
    times = [time.monotonic() for _ in range(trials) if trainer.train_step(0.0) is not None]
    return float(np.median(np.diff(times[1:])))
