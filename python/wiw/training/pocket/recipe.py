# SPDX-License-Identifier: Apache-2.0
"""The recipe of pocket: `wiw/configs/post-training/pocket.yaml`, a file of one's own, and options on top."""

from __future__ import annotations

import math
from dataclasses import dataclass

from wiw.errors import ArgumentError
from wiw.training.post_training.recipe import ClipRecipe


@dataclass(frozen=True, kw_only=True)
class PocketRecipe(ClipRecipe):
    """Numbers of a training of pocket.

    Raises:
        ArgumentError: a number is out of range.
    """

    size: tuple[int, int] = (64, 128)
    widths: tuple[int, ...] = (48, 96, 160, 224)
    """Channels of the four scales, from fine to coarse."""
    places: int = 6
    """Places of a clip that are predicted from another one of it, in each step."""
    warmup: float = 0.01
    """Share of the steps in which the learning rate grows from 0."""
    decay: float = 0.4
    """Share of the steps, the last, in which the learning rate falls to 0."""
    pure_noise: float = 0.5
    """Share of the clips that are noise alone, so that one step of the sampler is regression."""
    least_level: float = 0.45
    """Errors count 1 / level^2, no level below this one."""
    absolute: float = 0.1
    """Weight of absolute errors of colours."""
    squared: float = 4.0
    """Weight of squared errors of colours, which lie from -1 to 1."""
    distance: float = 0.1
    """Weight of absolute errors of log-distances; 0 where the dataset has no depth."""
    ema: float = 0.995

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "widths", tuple(self.widths))
        self._require_counts("places")
        self._require_shares("warmup", "decay", "pure_noise")
        if not 0 < self.least_level <= 1:
            raise ArgumentError(f"recipe: least_level: expected a level above 0 and up to 1, got {self.least_level}")
        weights = (self.absolute, self.squared, self.distance)
        if not all(0 <= each < math.inf for each in weights):
            raise ArgumentError(f"recipe: expected finite weights of errors of 0 or more, got {weights}")
        height, width = self.size
        if height % 16 or width != 2 * height:
            raise ArgumentError(f"recipe: size: expected a height of a multiple of 16, twice as wide, got {self.size}")
        if len(self.widths) != 4 or any(each < 8 or each % 8 for each in self.widths):
            raise ArgumentError(f"recipe: widths: expected four multiples of 8, got {self.widths}")
        self._require_whole_heads()

    def scale_rate(self, progress: float) -> float:
        """Return the factor of the learning rate after a share of the steps, 0 to 1."""
        rise = progress / self.warmup if self.warmup else 1.0
        fall = (1 - progress) / self.decay if self.decay else 1.0
        return min(1.0, rise, fall)

    def _require_whole_heads(self) -> None:
        """Check that the network's heads of attention, at all scales but the finest, have whole numbers of channels."""
        from wiw.world_models.pocket.network import HEAD_WIDTH

        if any(each < HEAD_WIDTH or each % (each // HEAD_WIDTH) for each in self.widths[1:]):
            raise ArgumentError(
                f"recipe: widths: expected {HEAD_WIDTH} or more after the first, best multiples of {HEAD_WIDTH}, so "
                f"that heads of attention share the channels evenly, got {self.widths}"
            )
