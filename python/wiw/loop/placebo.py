# SPDX-License-Identifier: Apache-2.0
"""Placebos at equal compute: the world model works as hard as ever, and what it imagines says nothing of the plan.

"shuffled" imagines plans made of the same primitives in another order and shows their futures as the plans' own.
"swapped" imagines the very plans, but from the first observation of another episode. A world model whose score a
placebo reaches has helped by something else than foresight.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core, planner
from wiw.action import STOP
from wiw.types import Key, Proposal

Placebo = Literal["shuffled", "swapped"]
PLACEBOS: tuple[Placebo, ...] = ("shuffled", "swapped")
DRAWS = 64
"""Orders that are tried for one that costs as much as the plans themselves."""
_PURPOSE = 0x706C6163
"""Keeps these draws apart from all others of the decision."""


def shuffled(plans: Sequence[Proposal], key: Key, spec: planner.ModelSpec) -> list[Proposal]:
    """The primitives of all plans pooled, put in another order drawn by the decision's key, and dealt at equal lengths.

    Stops stay where they are: nothing follows them. Leading turns, equal plans and common beginnings cost a model
    nothing, and an order may have more or fewer of them. Of `DRAWS` orders the first is taken that asks for as many
    rollouts and frames as the plans do, or else the one that comes nearest.
    """
    pool = np.concatenate([plan.actions for plan in plans])
    movable = np.flatnonzero(pool != STOP)
    wanted = _cost([plan.actions for plan in plans], spec)
    ends = np.cumsum([len(plan.actions) for plan in plans])[:-1]
    best: tuple[tuple[int, int], list[NDArray[np.int8]]] | None = None
    for draw in range(DRAWS):
        key_of_draw = core.fold_key([key.seed, key.episode, key.decision, _PURPOSE, draw])
        dealt = pool.copy()
        dealt[movable] = pool[movable[np.argsort(core.uniform(key_of_draw, len(movable)))]]
        made = np.split(dealt, ends)
        rows, frames = _cost(made, spec)
        miss = abs(rows - wanted[0]), abs(frames - wanted[1])
        if best is None or miss < best[0]:
            best = miss, made
        if miss == (0, 0):
            break
    assert best is not None
    return [Proposal(actions, plan.prior, plan.note) for actions, plan in zip(best[1], plans, strict=True)]


def _cost(plans: Sequence[NDArray[np.int8]], spec: planner.ModelSpec) -> tuple[int, int]:
    """Rollouts and frames that plans of one episode ask of a model."""
    batch = planner.Batch.build([list(plans)], spec)
    return len(batch.row_length), int((batch.row_length - batch.row_shared).sum())
