# SPDX-License-Identifier: Apache-2.0
"""Ask a world model to imagine the given plans from the given observations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from wiw.loop.imagination import Imagination, Imaginer, Request
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.world_models.base import WorldModel


class ModelImaginer(Imaginer, Privileged):
    """A world model as the loop asks it; the oracle is given forks of the live environments."""

    def __init__(self, model: WorldModel) -> None:
        self._model = model
        self._environments = LiveEnvironments()

    @property
    def model(self) -> WorldModel:
        """The world model."""
        return self._model

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments, of which only the oracle is given forks."""
        self._environments = environments

    def imagine(self, request: Request) -> Imagination:
        """Imagine all plans of all episodes in batches."""
        if "simulator" in self.accepts.needs:
            pairs = zip(request.keys, request.inputs, strict=True)
            inputs = [
                own if own.simulator is not None else replace(own, simulator=self._environments.find(key).fork())
                for key, own in pairs
            ]
            request = replace(request, inputs=inputs)
        return request.space.imagine(self._model, request)


def as_imaginer(model: Any) -> Imaginer:
    """Return the imaginer of a world model, or an imaginer as it is."""
    return model if isinstance(model, Imaginer) else ModelImaginer(model)
