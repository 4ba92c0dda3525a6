# SPDX-License-Identifier: Apache-2.0
"""Base of world models that change how another one is asked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wiw.world_models.base import Accepts, WorldModel


class ModelWrapper(WorldModel):
    """Stands in for the wrapped model; a subclass says how it is asked (`rollout`)."""

    def __init__(self, model: WorldModel) -> None:
        self.model = model

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """The model's."""
        return self.model.accepts

    @property
    def unwrapped(self) -> WorldModel:
        """The model behind everything that wraps it."""
        return self.model.unwrapped

    @property
    def spent(self) -> Mapping[str, float]:
        """The model's."""
        return self.model.spent

    def describe(self) -> dict[str, Any]:
        """Describe the model."""
        return self.model.describe()

    def fingerprint(self) -> str:
        """Return the model's."""
        return self.model.fingerprint()
