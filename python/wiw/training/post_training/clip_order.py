# SPDX-License-Identifier: Apache-2.0
"""The order of clips in a training: a function of the seed and the step, with no state of its own."""

from __future__ import annotations

from dataclasses import dataclass

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

    def select(self, step: int) -> NDArray[np.int64]:
        """Return the indices [batch] of the clips of a step, counted from 0 over all epochs."""
        epoch, place = divmod(step, self.steps_per_epoch)
        chosen = np.random.default_rng((self.seed, 0)).permutation(self.total)[: self.count]
        order = np.random.default_rng((self.seed, 1, epoch)).permutation(self.count)
        return chosen[order[place * self.batch : (place + 1) * self.batch]]
