# SPDX-License-Identifier: Apache-2.0
"""The course of any training here: how many steps, at which rates, and how fast they are."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from wiw.training.checkpoint import Checkpoint, Kept


class Lesson(Protocol):
    """A network in training, with all that its next step depends on."""

    def step(self, rate: float) -> float:
        """Learns from one batch at a learning rate; its loss."""


L = TypeVar("L", bound=Lesson)


def taught(
    begin: Callable[[], L],
    recipe: Any,
    an_epoch: int,
    minutes: float | None,
    pace: Callable[[float], float],
    show: Callable[[int, int, float], None],
    checkpoint: Checkpoint | None = None,
) -> tuple[L, Any]:
    """A lesson at its end, and the recipe that would give the same one again.

    Args:
        begin: a lesson at its beginning, the same at every call.
        recipe: with `epochs` and `rate`.
        an_epoch: its steps.
        minutes: if given, epochs are left out so that training takes about as long, by the speed of some trial steps.
        pace: factor of the learning rate after a part of all steps, 0 to 1.
        show: called after each step with its number, how many there are, and a running mean of the loss.
        checkpoint: where a lesson that has a state is kept now and then, and gone on from.
    """
    stand = checkpoint.stand() if checkpoint else None
    if stand is not None:
        recipe = replace(recipe, epochs=stand.epochs)
    elif minutes is not None:
        seconds = _seconds_a_step(begin())
        recipe = replace(recipe, epochs=max(1, min(recipe.epochs, int(60 * minutes / (seconds * an_epoch)))))
    lesson = begin()
    steps, mean, first = recipe.epochs * an_epoch, float("nan"), 0
    if stand is not None:
        cast(Kept, lesson).restore(stand.state)
        first = stand.step
    for step in range(first, steps):
        loss = lesson.step(recipe.rate * pace(step / steps))
        mean = loss if step == first else 0.98 * mean + 0.02 * loss
        show(step + 1, steps, mean)
        if checkpoint:
            checkpoint.keep(cast(Kept, lesson), recipe.epochs, step + 1)
    return lesson, recipe


def up_and_down(rise: float, floor: float = 0.005) -> Callable[[float], float]:
    """A pace: up over a first share of the training, then down along a cosine to a floor."""

    def pace(done: float) -> float:
        if done < rise:
            return done / rise + 0.02
        return floor + 0.5 * (1 + math.cos(math.pi * (done - rise) / (1 - rise)))

    return pace


def _seconds_a_step(lesson: Lesson, trials: int = 10) -> float:
    """Median time of some steps after the first two, which are slow."""
    moments = [time.monotonic() for _ in range(trials) if lesson.step(0.0) is not None]
    return float(np.median(np.diff(moments[1:])))
