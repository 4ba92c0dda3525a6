# SPDX-License-Identifier: Apache-2.0
"""Semantic labels for world models that take them as input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.loop.imagination import Imagination, ImaginerWrapper, ModelInput, Request
from wiw.loop.imagine import list_depths
from wiw.loop.model_imaginer import as_imaginer
from wiw.loop.privileged import LiveEnvironments
from wiw.perception.semantics import Semantics
from wiw.registry import SEMANTICS

SIMULATOR = "simulator"
"""Name of the environment's own semantics."""


def find_source(semantics: Any) -> Semantics | str:
    """Return a source of semantics by name, class or instance; "simulator" as it is.

    Raises:
        RegistryError: no such source.
        ArgumentError: a source that needs instance ids, which differ from scene to scene.
    """
    if semantics == SIMULATOR:
        return SIMULATOR
    source: Semantics = SEMANTICS.make(semantics)
    if "ids" in source.needs:
        raise ArgumentError(
            f"Agent: {type(source).__name__} knows only one scene; give semantics='simulator' for any scene"
        )
    return source


class Labelled(ImaginerWrapper):
    """A world model that gets a semantic label for each pixel of the panorama.

    Args:
        model: a world model, or an imaginer.
        source: "simulator", "rednet", or another source (`wiw.perception.semantics`).
    """

    def __init__(self, model: Any, source: Any) -> None:
        super().__init__(as_imaginer(model))
        self.source = find_source(source)
        self._environments = LiveEnvironments()

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments, whose own semantics the source "simulator" uses, and pass them on."""
        self._environments = environments
        super().grant(environments)

    @property
    def needs(self) -> frozenset[str]:
        """The model's needs, and depth if the source needs it."""
        own = frozenset() if isinstance(self.source, str) else frozenset(self.source.needs) & {"depth"}
        return super().needs | own

    @property
    def gives(self) -> frozenset[str]:
        """Semantics, in addition to what the wrapped imaginer gives."""
        return super().gives | {"semantic"}

    def imagine(self, request: Request) -> Imagination:
        """Imagine with labels, if the model needs them; existing labels are kept."""
        if "semantic" not in self.accepts.needs:
            return super().imagine(request)
        if isinstance(self.source, str):
            pairs = zip(request.keys, request.inputs, strict=True)
            labels = [
                self._environments.find(key).semantic() if own.semantic is None else own.semantic for key, own in pairs
            ]
        else:
            labels = list(_label(self.source, request.inputs))
        inputs = [replace(own, semantic=label) for own, label in zip(request.inputs, labels, strict=True)]
        return super().imagine(replace(request, inputs=inputs))

    def describe(self) -> dict[str, Any]:
        """Describe the model and the source."""
        source = self.source if isinstance(self.source, str) else self.source.describe()
        return {**super().describe(), "semantics": source}


def _label(source: Semantics, inputs: Any) -> NDArray[np.uint32]:
    own: list[ModelInput] = list(inputs)
    depth = np.stack(list_depths(own)) if "depth" in source.needs else None
    return source.label_panoramas(np.stack([shown.observation.panorama for shown in own]), depth)
