# SPDX-License-Identifier: Apache-2.0
"""The models that are trained here: what corpora they learn from, and how each is made ready for training."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from wiw.action import PoseGrid
from wiw.errors import ArgumentError
from wiw.networks import is_path, resolve_device
from wiw.suggestions import did_you_mean
from wiw.training.post_training.conditioned_generator import ConditionedGenerator, build_config, identify_weights
from wiw.training.post_training.corpora import Corpus, NavigationCorpus, require_panoramas
from wiw.training.post_training.cosmos import CosmosObjective
from wiw.training.post_training.ltx import LTXObjective
from wiw.training.post_training.nwm import TrainableNWM
from wiw.training.post_training.objective import Objective
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.svd import SVDObjective
from wiw.training.post_training.trainable import TrainableModel
from wiw.training.post_training.trainer import seed_weights
from wiw.training.post_training.wan import WanObjective
from wiw.types import GRIPPER_POSES
from wiw.world_models.base import Requirements
from wiw.world_models.nwm.model import NWM
from wiw.world_models.video.actions import variants
from wiw.world_models.video.actions.model import PANORAMA, ActionConditioned
from wiw.world_models.video.model import VideoModel

_log = logging.getLogger("wiw.training")


@dataclass(frozen=True)
class PretrainedWeights:
    """Source of a training's first weights, and the device that it runs on."""

    weights: str | None = None
    """A folder or a name on the hub; the model's usual ones if None."""
    revision: str | None = None
    variant: str | None = None
    """Variant of the weight files, such as "fp16"."""
    device: str | None = None

    def resolve_folder(self) -> str | None:
        """Return a folder with its whole path, which the checkpoint names; a name on the hub as it is."""
        if self.weights is None:
            return None
        folder = Path(self.weights).expanduser()
        return str(folder.resolve()) if folder.is_dir() or is_path(self.weights) else self.weights


@dataclass(frozen=True)
class Loaded:
    """A model ready for training."""

    model: TrainableModel
    recipe: PostTrainingRecipe
    """With frames and size as the model takes them."""
    identity: dict[str, str]
    """Identity of its first weights."""


class Family(ABC):
    """A model that is trained here."""

    world_model: str
    """Name of the world model that runs what is trained."""
    checkpoint_option: str
    """Option of that world model which names the folder."""

    @abstractmethod
    def fit(self, corpus: Corpus, recipe: PostTrainingRecipe) -> tuple[Corpus, PostTrainingRecipe]:
        """Return a corpus in the views that the model sees, and the recipe with frames and size as it takes them.

        Raises:
            ArgumentError: the model cannot be trained on such a corpus, which says on which it can be, or the recipe
                has an option that it does not read.
        """

    def list_options(self, corpus: Corpus, recipe: PostTrainingRecipe) -> dict[str, Any]:
        """Return options that the world model has to be run with, where they are not its own."""
        return {}

    @abstractmethod
    def load(self, corpus: Corpus, recipe: PostTrainingRecipe, source: PretrainedWeights) -> Loaded:
        """Load the pretrained weights and make what is trained ready.

        Raises:
            WeightsError, DependencyError, DeviceMemoryError: see the world model.
            ArgumentError: a recipe that the model cannot have.
        """


@dataclass(frozen=True)
class VideoFamily(Family):
    """A stock video generator that is trained to follow actions: primitives in panoramas, or poses in front views."""

    world_model: str
    model: type[ActionConditioned]
    objective: type[Objective]
    unread: tuple[str, ...] = ("shift", "still")
    """Options of a recipe that it does not read."""
    most_drop: float = 1.0
    """Largest share `drop` that it can have."""
    checkpoint_option = "checkpoint"

    def fit(self, corpus: Corpus, recipe: PostTrainingRecipe) -> tuple[Corpus, PostTrainingRecipe]:
        """Return the corpus as it is, and the recipe with frames and size as the generator rounds them."""
        require_read(self.world_model, recipe, self.unread)
        if recipe.drop > self.most_drop:
            raise ArgumentError(
                f"recipe: drop: {self.world_model} drops the observation's embedding, its channels, or both, in this "
                f"share of the clips each; expected a third at most, got {recipe.drop}"
            )
        if corpus.space != GRIPPER_POSES:
            require_panoramas(self.world_model, corpus)
        if corpus.space == GRIPPER_POSES and recipe.mirror:
            raise ArgumentError(
                "recipe: mirror: the mirror image of a robot arm is a different arm; expected 0 for poses"
            )
        return corpus, round_shape(self.model.generator_class, recipe, recipe.size or self._find_size(corpus))

    def list_options(self, corpus: Corpus, recipe: PostTrainingRecipe) -> dict[str, Any]:
        """Return size and frames of the clips."""
        trained = {"size": list(recipe.size or ()), "frames": recipe.frames}
        usual = {"size": list(self._find_size(corpus)), "frames": self.model.accepts.frames}
        return {name: value for name, value in trained.items() if value != usual[name]}

    def _find_size(self, corpus: Corpus) -> tuple[int, int]:
        return self.model.front_size if corpus.space == GRIPPER_POSES else PANORAMA

    def load(self, corpus: Corpus, recipe: PostTrainingRecipe, source: PretrainedWeights) -> Loaded:
        """Load the generator and add encoders of the corpus's actions; see `Family.load`."""
        Requirements(("peft",), "diffusers").require()
        generator = load_generator(self.model, recipe, source)
        recipe = replace(recipe, frames=generator.frames, size=generator.size)
        objective = self.objective(generator, recipe)
        with seed_weights(recipe, objective.device):
            config = build_config(self.model.base, self.model.denoisers[0], generator, **describe_actions(corpus))
            model = ConditionedGenerator(objective, config, self.model.denoisers)
        return Loaded(model, recipe, identify_weights(generator))


def round_shape(generator: type[VideoModel], recipe: PostTrainingRecipe, size: tuple[int, int]) -> PostTrainingRecipe:
    """Return a recipe with frames and a size that a generator can divide, as it rounds them itself once it is made."""
    height, width = (max(1, round(side / generator.multiple)) * generator.multiple for side in size)
    frames = 1 + math.ceil((recipe.frames - 1) / generator.stride) * generator.stride
    return replace(recipe, frames=frames, size=(height, width))


def announce_shape(name: str, asked: PostTrainingRecipe, fitted: PostTrainingRecipe) -> None:
    """Warn where frames or size of a recipe are not those that a model takes."""
    changed = [f"frames={fitted.frames} in place of {asked.frames}"] if fitted.frames != asked.frames else []
    if asked.size not in (None, fitted.size):
        changed.append(f"size={list(fitted.clip_size)} in place of {list(asked.clip_size)}")
    if changed:
        _log.warning("%s takes other shapes; it is trained with %s", name, " and ".join(changed))


def require_read(name: str, recipe: PostTrainingRecipe, unread: Sequence[str]) -> None:
    """Check that a recipe leaves the options that a model does not read as they are by default.

    Raises:
        ArgumentError: it sets one of them.
    """
    for field in fields(recipe):
        if field.name in unread and getattr(recipe, field.name) != field.default:
            raise ArgumentError(
                f"recipe: {field.name}: {name} does not read it; leave it out, got {getattr(recipe, field.name)}"
            )


class NWMFamily(Family):
    """Navigation World Models, which is conditioned on motions between front views already."""

    world_model = "nwm"
    checkpoint_option = "weights"

    def fit(self, corpus: Corpus, recipe: PostTrainingRecipe) -> tuple[Corpus, PostTrainingRecipe]:
        """Return front views; they are cut out of panoramas as the loop does."""
        if not isinstance(corpus, NavigationCorpus):
            raise ArgumentError(
                "nwm-action follows a moving agent, but this dataset is of a gripper; expected a dataset of `wiw "
                "collect navigation`, or a video model (NAME-action)"
            )
        require_read("nwm-action", recipe, ("shift",))
        size = recipe.size or NWM.accepts.size
        return corpus.show_front(size), replace(recipe, size=size)

    def load(self, corpus: Corpus, recipe: PostTrainingRecipe, source: PretrainedWeights) -> Loaded:
        """Load the CDiT and its codec; see `Family.load`."""
        from wiw.world_models.nwm import weights

        NWM.requires.require()
        if source.variant is not None:
            raise ArgumentError(f"nwm-action: its weights have no variants, got variant={source.variant}")
        path = weights.fetch(source.resolve_folder() or NWM.weights, NWM.file, source.revision)
        network, codec = weights.load_cdit(path), weights.load_codec(weights.codec_beside(path), None)
        identity = {"digest": weights.digest(network, codec)}
        model = TrainableNWM(network, codec, recipe, NWM.spacing, NWM.steps, resolve_device(source.device))
        return Loaded(model, recipe, identity)


FAMILIES: Mapping[str, Family] = {
    "svd-action": VideoFamily("svd-action", variants.SVDAction, SVDObjective, most_drop=1 / 3),
    "ltx-action": VideoFamily("ltx-action", variants.LTXAction, LTXObjective),
    "wan2.1-action": VideoFamily("wan2.1-action", variants.Wan21Action, WanObjective, ("still",)),
    "wan2.2-5b-action": VideoFamily("wan2.2-5b-action", variants.Wan22SmallAction, WanObjective, ("still",)),
    "wan2.2-a14b-action": VideoFamily("wan2.2-a14b-action", variants.Wan22Action, WanObjective, ("still",)),
    "cosmos-predict2-action": VideoFamily("cosmos-predict2-action", variants.CosmosPredict2Action, CosmosObjective),
    "nwm-action": NWMFamily(),
}
"""Models that are trained here, by their names on the command line."""


def find_family(name: str) -> Family:
    """Return a model that is trained here.

    Raises:
        ArgumentError: it is not trained here.
    """
    if name not in FAMILIES:
        raise ArgumentError(
            f"post-training: '{name}' is not trained here; expected one of {', '.join(FAMILIES)}."
            f"{did_you_mean(name, list(FAMILIES))}"
        )
    return FAMILIES[name]


def load_generator(model: type[ActionConditioned], recipe: PostTrainingRecipe, source: PretrainedWeights) -> VideoModel:
    """Load the stock generator, its frozen networks in the recipe's precision and what is trained whole in float32.

    Args:
        model: the world model that is to be trained.
        recipe: of the training, with a size.
        source: of the generator's weights.

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
    given = {**model.defaults, **given}
    given |= {"revision": source.revision, "variant": source.variant, "device": source.device}
    if model is variants.CosmosPredict2Action:
        given["guardrail"] = False  # its filter has nothing to look at where nothing is shown
    if source.weights is not None:
        given["weights"] = source.resolve_folder()
    return generator(**given)


def describe_actions(corpus: Corpus) -> dict[str, Any]:
    """Return the fields of `ActionConfig` about a corpus's actions; poses lie in the workspace of `PoseGrid`."""
    if corpus.space == GRIPPER_POSES:
        return {"kind": GRIPPER_POSES, "low": PoseGrid.low, "high": PoseGrid.high}
    return {}
