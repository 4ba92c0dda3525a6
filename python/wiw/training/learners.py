# SPDX-License-Identifier: Apache-2.0
"""Small world models that learn from clips of a navigation dataset: for `wiw train`, and for studies of data."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wiw.errors import ArgumentError
from wiw.registry import WORLD_MODELS

if TYPE_CHECKING:
    from wiw.training.place_trainer import PlaceTrainer
    from wiw.training.post_training.recipe import ClipRecipe
    from wiw.world_models.trained import Trained

LEARNERS = ("warpnet", "pocket")


@dataclass(frozen=True)
class Learner:
    """How a world model is trained from nothing, kept, and asked."""

    model: type[Trained]
    """The world model that reads the weights by `weights=FILE`."""
    trainer: type[PlaceTrainer]
    create_recipe: Callable[..., ClipRecipe]
    """Returns the recipe of a study, given `frames`, `size`, `batch`, `clips` and `seed`."""
    load: Callable[[Path], tuple[Any, dict[str, Any]]]
    """Reads a file of weights into a network and its card."""
    save: Callable[[Path, Any, Mapping[str, Any]], None]
    """Writes a file of weights, given a path, a network and a card."""


def make_learner(name: str) -> Learner:
    """Return a learner by the name of its world model.

    Raises:
        ArgumentError: the name is unknown.
        DependencyError: torch or safetensors is not installed.
    """
    if name not in LEARNERS:
        raise ArgumentError(f"expected a model among {', '.join(LEARNERS)}, got '{name}'")
    model = WORLD_MODELS.find(name)
    model.requires.require()
    if name == "warpnet":
        from wiw.training.warpnet_clips import WarpNetClipRecipe, WarpNetClipTrainer
        from wiw.world_models.warpnet import weights as warpnet

        return Learner(model, WarpNetClipTrainer, WarpNetClipRecipe, warpnet.load, warpnet.save)
    from wiw.training.pocket.trainer import PocketTrainer
    from wiw.world_models.pocket import weights as pocket

    return Learner(model, PocketTrainer, _create_pocket_recipe, pocket.load, pocket.save)


def _create_pocket_recipe(**numbers: Any) -> ClipRecipe:
    """Return the shipped recipe for a network about as large as warpnet, with fewer places of more clips, and without
    averaged weights, which lag behind where updates are few.
    """
    from wiw.training.pocket.recipe import PocketRecipe
    from wiw.training.post_training.recipe import load_recipe

    options = {"widths": [32, 64, 96, 128], "places": 3, "ema": 0.0}
    return load_recipe("pocket", options={**options, **numbers}, kind=PocketRecipe)
