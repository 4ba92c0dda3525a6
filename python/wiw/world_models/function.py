# SPDX-License-Identifier: Apache-2.0
"""A function as a world model: `wiw.world_model(function, accepts=wiw.accepts(...))`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import Conditioning, Control
from wiw.world_models.base import Accepts, WorldModel


class Function(WorldModel):
    """Wrap anything that can be called as `WorldModel.rollout` is: what a notebook has before it has a class.

    Args:
        function: takes observations, controls and seeds, gives frames; see `WorldModel.rollout`.
        accepts: its declaration, from `wiw.accepts(...)`.

    Raises:
        ArgumentError: it cannot be called, or the declaration is none.
    """

    def __init__(self, function: Callable[..., Any], accepts: Accepts) -> None:
        if not callable(function) or not isinstance(accepts, Accepts):
            raise ArgumentError(
                f"world_model: expected a function and accepts=wiw.accepts(...), got {function!r} and {accepts!r}"
            )
        self.function, self._accepts = function, accepts

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """The declaration that came with the function."""
        return self._accepts

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return what the function returns."""
        frames: NDArray[np.uint8] = self.function(observations, controls, seeds)
        return frames

    def describe(self) -> dict[str, Any]:
        """The function's name."""
        return {"name": getattr(self.function, "__qualname__", type(self.function).__name__)}
