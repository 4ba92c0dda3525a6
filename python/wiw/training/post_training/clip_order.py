# SPDX-License-Identifier: Apache-2.0
"""The order of clips in a training: a function of the seed and the step, with no state of its own."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ClipOrder:
    """The first `count` clips of one permutation of all, in another order in each epoch.

    Fewer clips of the same dataset and seed are always a part of more of them.
    """

    total: int
    """Clips of the dataset."""
    count: int
    """Clips that are trained on."""
    batch: int
    """Clips per step; what an epoch leaves over is left out."""
    seed: int

    @property
    def steps_per_epoch(self) -> int:
        """Number of steps in an epoch."""
        return self.count // self.batch

    @cached_property
    def chosen(self) -> NDArray[np.int64]:
        """int64 [count]: indices of the clips that are trained on."""
        return np.random.default_rng((self.seed, 0)).permutation(self.total)[: self.count].copy()

    def select(self, step: int) -> NDArray[np.int64]:
        """Return the indices [batch] of the clips of a step, counted from 0 over all epochs."""
        epoch, place = divmod(step, self.steps_per_epoch)
        order = _shuffle(self.seed, epoch, self.count)
        return self.chosen[order[place * self.batch : (place + 1) * self.batch]]


@lru_cache(maxsize=2)
def _shuffle(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """Return an epoch's order of `count` clips; kept, as each of its steps asks for it."""
    return np.random.default_rng((seed, 1, epoch)).permutation(count)
