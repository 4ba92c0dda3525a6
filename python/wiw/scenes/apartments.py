# SPDX-License-Identifier: Apache-2.0
"""Generated apartments."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

from wiw import _core
from wiw.scenes import store
from wiw.scenes.specs import parse_single

Scene = _core.scene.Scene

COLORS = (
    "white", "grey", "black", "brown", "beige", "red", "orange", "yellow", "green", "turquoise", "blue", "purple",
    "pink",
)  # fmt: skip
"""Colour words of apartments. Weights count classes by their order."""

_log = logging.getLogger("wiw.scenes")


def apartment(seed: int, split: str = "val", cache: bool = True, *, edits: Sequence[str] = ()) -> Scene:
    """Generate a furnished apartment, the same for the same seed and split; splits share neither layouts nor palettes.

    With `cache` it is generated once, in seconds, and then mapped from disk like imported scenes, until the compiled
    core changes. An edit changes one thing and leaves everything else unchanged, with light baked for the edited
    apartment: "color:sofa_1=blue", "state:floor_lamp_1=off", "remove:vase_1" or "swap:plant_1,floor_lamp_2". Names are
    those of instances, with "_" or "+" for a space; if several doors or windows share a name, ".2" is the second.

    Raises:
        ArgumentError: `split` is not "train", "val" or "test"; or an edit cannot be done, with what is possible.
    """
    edits = _core.scene.canonical_edits(list(edits))

    def make() -> Scene:
        started = time.perf_counter()
        scene = _core.scene.apartment(seed, split, edits)
        _log.info("%s built in %.1f s", scene.name, time.perf_counter() - started)
        return scene

    identity: list[str | int] = ["apartment", store.build_digest(), split, int(seed), *edits]
    return store.load_generated(identity, make) if cache else make()


def apartment_table(seed: int, split: str = "val", *, edits: Sequence[str] = ()) -> Scene:
    """Return rooms and instances of an apartment without its textures and light, in a fraction of the time.

    `instances`, `rooms`, `attributes` and all triangles are those of `apartment`, so it is suitable for questions and
    navigation meshes; renderings of it show plain colours.
    """
    return _core.scene.apartment_outline(seed, split, _core.scene.canonical_edits(list(edits)))


def possible_edits(spec: str) -> list[str]:
    """Return the edits that can be added to a single apartment's spec, without baking it.

    Raises:
        ArgumentError: the spec does not name a single apartment.
    """
    seed, split, edits = parse_single(spec)
    return _core.scene.possible_edits(seed, split, edits)
