# SPDX-License-Identifier: Apache-2.0
"""What each pixel of an observation is, for world models that read semantics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from wiw.errors import ArgumentError
from wiw.perception.semantics import Semantics
from wiw.registry import SEMANTICS

SIMULATOR = "simulator"
"""The environment's own semantics come with each query, for they are of its scene."""


def semantics_source(semantics: Any) -> Semantics | str | None:
    """A source of semantics from a name, class or instance; "simulator" and None as they are.

    Raises:
        RegistryError: no such source.
        ArgumentError: a source that needs instance ids, which differ from scene to scene.
    """
    if semantics is None or semantics == SIMULATOR:
        return semantics
    source = SEMANTICS.make(semantics)
    if "ids" in source.needs:
        raise ArgumentError(f"Agent: {type(source).__name__} knows one scene; give semantics='simulator' for any")
    return source


def labelled(source: Semantics | str | None, queries: Sequence[Any]) -> list[Any]:
    """The queries with semantics from a source; those of the simulator have them already.

    Raises:
        ArgumentError: the source needs depth, and an observation has none.
    """
    if source is None or isinstance(source, str):
        return list(queries)
    depth = None
    if "depth" in source.needs:
        if any(query.observation.depth is None for query in queries):
            raise ArgumentError(f"{type(source).__name__} needs depth: make the environment with depth=True")
        depth = np.stack([query.observation.depth for query in queries])
    labels = source.label_panoramas(np.stack([query.observation.panorama for query in queries]), depth)
    return [replace(query, semantic=own) for query, own in zip(queries, labels, strict=True)]
