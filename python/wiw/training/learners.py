# SPDX-License-Identifier: Apache-2.0
"""Small world models that learn from windows of a navigation dataset within minutes, for studies of data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.shrunk_navigation import ShrunkNavigation
from wiw.errors import ArgumentError
from wiw.training.held_out_clips import Imagine
from wiw.training.post_training.clip_order import ClipOrder


class Learner(Protocol):
    """How a model is trained from nothing, kept, and asked."""

    name: str
    """Of the world model that reads its weights by `weights=FILE`."""
    needs_depth: bool
    """Whether it learns from depth too."""

    def train(
        self,
        data: ShrunkNavigation,
        windows: NDArray[np.int64],
        order: ClipOrder,
        steps: int,
        seed: int,
        on_step: Callable[[int], None],
    ) -> Any:
        """Return a network trained for so many steps: step k on `windows[order.select(k)]`.

        The learning rate's schedule ends with the last step. The result depends on nothing but the arguments.
        """

    def save(self, network: Any, path: Path, card: dict[str, Any]) -> None:
        """Write the weights to a file."""

    def load(self, path: Path) -> Any:
        """Read a network from a file."""

    def imagine(self, network: Any) -> Imagine:
        """Return how a network imagines."""


LEARNERS = ("warpnet",)


def make_learner(name: str) -> Learner:
    """Return a learner by the name of its world model.

    Raises:
        ArgumentError: there is none of that name.
        DependencyError: torch is not installed.
    """
    if name not in LEARNERS:
        raise ArgumentError(f"expected a model among {', '.join(LEARNERS)}, got '{name}'")
    from wiw.registry import WORLD_MODELS
    from wiw.world_models import devices

    devices.require(WORLD_MODELS.find(name).requires)
    from wiw.training.warpnet_clips import WarpNetLearner

    return {"warpnet": WarpNetLearner}[name]()
