# SPDX-License-Identifier: Apache-2.0
"""The action-conditioned models that are trained here, each with its loss, and the generators they begin with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wiw.errors import ArgumentError
from wiw.suggestions import did_you_mean
from wiw.training.post_training.cosmos import CosmosObjective
from wiw.training.post_training.ltx import LTXObjective
from wiw.training.post_training.objective import Objective
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.svd import SVDObjective
from wiw.training.post_training.wan import WanObjective
from wiw.world_models.video.actions import variants
from wiw.world_models.video.actions.model import ActionConditioned
from wiw.world_models.video.model import VideoModel

FAMILIES: Mapping[str, tuple[type[ActionConditioned], type[Objective]]] = {
    "svd-action": (variants.SVDAction, SVDObjective),
    "ltx-action": (variants.LTXAction, LTXObjective),
    "wan2.1-action": (variants.Wan21Action, WanObjective),
    "wan2.2-5b-action": (variants.Wan22SmallAction, WanObjective),
    "wan2.2-a14b-action": (variants.Wan22Action, WanObjective),
    "cosmos-predict2-action": (variants.CosmosPredict2Action, CosmosObjective),
}
"""World model and loss, by the model's name."""


def find_family(name: str) -> tuple[type[ActionConditioned], type[Objective]]:
    """Return world model and loss of an action-conditioned model.

    Raises:
        ArgumentError: it is not trained here.
    """
    if name not in FAMILIES:
        raise ArgumentError(
            f"post-training: '{name}' is not trained here; expected one of {', '.join(FAMILIES)}."
            f"{did_you_mean(name, list(FAMILIES))}"
        )
    return FAMILIES[name]


def load_generator(
    model: type[ActionConditioned], recipe: PostTrainingRecipe, weights: str | None, options: Mapping[str, Any]
) -> VideoModel:
    """Load the stock generator, its frozen networks in the recipe's precision and what is trained whole in float32.

    Args:
        model: the world model that is to be trained.
        recipe: of the training.
        weights: of the generator, a folder or a name on the hub; the generator's usual ones if None.
        options: others of the generator, such as device and revision.

    Raises:
        WeightsError, DependencyError, DeviceMemoryError, ArgumentError: see `VideoModel`.
    """
    stock = model.generator_class
    whole: dict[str, Any] = {} if recipe.lora else dict.fromkeys(model.denoisers, "float32")
    settings = {
        "half_precision": recipe.precision,
        "network_precisions": {**stock.network_precisions, **whole},
        "__doc__": stock.__doc__,
    }
    generator: type[VideoModel] = type(stock.__name__, (stock,), settings)
    given: dict[str, Any] = {"frames": recipe.frames, "size": recipe.size, "precision": recipe.precision}
    given = {**model.defaults, **given, **options}
    if weights is not None:
        given["weights"] = weights
    return generator(**given)
