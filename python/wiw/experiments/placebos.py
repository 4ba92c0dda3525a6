# SPDX-License-Identifier: Apache-2.0
"""Placebos at equal compute: the world model does as much work, but its rollouts do not depend on the plan.

"shuffled" imagines plans of the same primitives in another order, and shows their futures as the plans' own. "swapped"
imagines the actual plans, but from the first observation of another episode. "blind" gives an empty prompt to a model
that is told plans in words. If a placebo reaches a world model's score, the model's help is not due to foresight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw._core import core, planner
from wiw.action import STOP
from wiw.errors import ArgumentError
from wiw.loop.imagination import Imagination, ImaginerWrapper, ModelInput, Request
from wiw.loop.imagine import make_model_spec
from wiw.loop.model_imaginer import as_imaginer
from wiw.types import Key, Proposal

PLACEBOS = ("shuffled", "swapped", "blind")
DRAWS = 64
"""Number of orders to try in search of one that costs as much as the plans themselves."""
_PURPOSE = 0x706C6163
"""Separates these draws from all other draws of the decision."""


class Placebo(ImaginerWrapper):
    """A world model that gets as many requests, but not for the actual plans.

    Args:
        model: a world model, or an imaginer.
    """

    kind: str

    def __init__(self, model: Any) -> None:
        super().__init__(as_imaginer(model))

    def describe(self) -> dict[str, Any]:
        """Describe the model and the kind of placebo."""
        return {**super().describe(), "placebo": self.kind}


class ShuffledPlacebo(Placebo):
    """Imagines plans of the same primitives in shuffled order, and returns their rollouts as those of the plans."""

    kind = "shuffled"

    def imagine(self, request: Request) -> Imagination:
        """Imagine the plans' primitives in another order.

        Raises:
            ArgumentError: the plans are not made of primitives.
        """
        if any(plan.actions.ndim != 1 for plans in request.plans for plan in plans):
            raise ArgumentError(NO_POSES)
        spec = make_model_spec(self.accepts)
        plans = [shuffle(own, key, spec) for own, key in zip(request.plans, request.keys, strict=True)]
        return super().imagine(replace(request, plans=plans))


class FirstObservations(Protocol):
    """Source of another episode's first observation, for swapped placebos."""

    def of(self, key: Key) -> ModelInput:
        """Return the first observation of another episode, the same one at each decision of the key's episode."""

    def forget(self, key: Key) -> None:
        """Drop the state of an episode that has ended."""


class SwappedPlacebo(Placebo):
    """Imagines the plans from the first observation of another episode.

    Args:
        model: a world model, or an imaginer.
        moments: the other episodes' first moments; `wiw.runs` gives the run's next episode's.
    """

    kind = "swapped"

    def __init__(self, model: Any, moments: FirstObservations) -> None:
        super().__init__(model)
        self._moments = moments

    def imagine(self, request: Request) -> Imagination:
        """Imagine the plans in another episode; real views after leading turns stay the episode's own."""
        return super().imagine(replace(request, inputs=[self._moments.of(key) for key in request.keys]))

    def forget(self, key: Key) -> None:
        """Drop the observation stored for an episode."""
        super().forget(key)
        self._moments.forget(key)


class BlindPlacebo(Placebo):
    """Imagines the plans with an empty prompt: what a model that is told plans in words makes of the view alone.

    Args:
        model: a world model with control "text", or an imaginer of one.

    Raises:
        ArgumentError: a model that is told plans otherwise.
    """

    kind = "blind"

    def __init__(self, model: Any) -> None:
        super().__init__(model)
        require_words(self.accepts.control)

    def imagine(self, request: Request) -> Imagination:
        """Imagine the plans without their words."""
        return super().imagine(replace(request, wordless=True))


def require_words(control: str) -> None:
    """Check that a world model is told plans in words, which a blind placebo leaves out.

    Raises:
        ArgumentError: it is not.
    """
    if control != "text":
        raise ArgumentError(
            "placebo-blind asks a world model with an empty prompt: expected one with control 'text', got "
            f"'{control}'; placebo-shuffled and placebo-swapped work with any"
        )


NO_POSES = "placebo='shuffled' reshuffles primitives, but these plans contain none; use 'swapped'"


def shuffle(plans: Sequence[Proposal], key: Key, spec: planner.ModelSpec) -> list[Proposal]:
    """Shuffle the primitives over all plans, by the decision's key; each plan keeps its length.

    Stops stay where they are: nothing follows them. Leading turns, equal plans and common beginnings cost a model
    nothing, and an order may have more or fewer of them. Of `DRAWS` orders the first is taken that leaves no plan as it
    is and asks for as many rollouts and frames as the plans do, or else the one that comes nearest, in this order.
    """
    pool = np.concatenate([plan.actions for plan in plans])
    movable = np.flatnonzero(pool != STOP)
    wanted = _count_cost([plan.actions for plan in plans], spec)
    ends = np.cumsum([len(plan.actions) for plan in plans])[:-1]
    best: tuple[tuple[int, int, int], list[NDArray[np.int8]]] | None = None
    for draw in range(DRAWS):
        key_of_draw = core.fold_key([key.seed, key.episode, key.decision, _PURPOSE, draw])
        dealt = pool.copy()
        dealt[movable] = pool[movable[np.argsort(core.uniform(key_of_draw, len(movable)))]]
        made = np.split(dealt, ends)
        rows, frames = _count_cost(made, spec)
        same = sum(np.array_equal(one, plan.actions) for one, plan in zip(made, plans, strict=True))
        miss = same, abs(rows - wanted[0]), abs(frames - wanted[1])
        if best is None or miss < best[0]:
            best = miss, made
        if not any(miss):
            break
    assert best is not None
    return [Proposal(actions, plan.prior, plan.note) for actions, plan in zip(best[1], plans, strict=True)]


def _count_cost(plans: Sequence[NDArray[np.int8]], spec: planner.ModelSpec) -> tuple[int, int]:
    """Return the rollouts and frames that plans of one episode ask of a model."""
    batch = planner.Batch.build([list(plans)], spec)
    return len(batch.row_length), int((batch.row_length - batch.row_shared).sum())
