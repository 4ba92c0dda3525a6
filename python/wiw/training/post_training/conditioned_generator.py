# SPDX-License-Identifier: Apache-2.0
"""A video generator in training to follow actions: its denoisers, and an encoder of actions for each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.errors import ArgumentError
from wiw.training.held_out_clips import Frames, HeldOutClips, make_control
from wiw.training.post_training import distributed
from wiw.training.post_training.clips import ClipBatch
from wiw.training.post_training.corpora import Corpus
from wiw.training.post_training.objective import Objective
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded, TrainableModel
from wiw.types import Conditioning, Control
from wiw.world_models.video.actions import checkpoint
from wiw.world_models.video.actions.checkpoint import ADAPTER, supports_lora
from wiw.world_models.video.actions.conditioning import ActionConditioning
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.encoder import ActionEncoder
from wiw.world_models.video.actions.injection import embedding_width
from wiw.world_models.video.model import VideoModel

LORA_LAYERS = ("to_q", "to_k", "to_v", "to_out.0", "ffn.net.0.proj", "ffn.net.2")
"""Layers that a LoRA is put on: attention and feed-forward (paper's repository for Wan, DiffSynth-Studio)."""


class ConditionedGenerator(TrainableModel):
    """Train denoisers of a generator, or a LoRA of them, together with an action encoder for each.

    Random weights are drawn from torch's own generator.

    Args:
        objective: loss of the generator, whose pipeline holds the denoisers.
        config: of the action encoders.
        places: of the denoisers in the pipeline.

    Raises:
        ArgumentError: a LoRA that a pipeline does not load, or for layers that a denoiser does not have.
    """

    def __init__(self, objective: Objective, config: ActionConfig, places: Sequence[str]) -> None:
        self.objective, self.recipe, self.device = objective, objective.recipe, objective.device
        self.places = tuple(places)
        self._active: str | None = None
        self.action_ids: Tensor | None = None
        if config.kind == "discrete":
            self.action_ids = torch.tensor([config.ids[each] for each in range(len(config.ids))], device=self.device)
        self.encoders = {place: ActionEncoder(config).to(self.device) for place in self.places}
        for place in self.places:
            prepare_denoiser(objective.pipeline, place, self.recipe)
        self._conditioning = ActionConditioning(self.encoders, objective.pipeline, str(self.device))
        self._freeze_rest()

    def find_denoiser(self, place: str) -> Any:
        """Return the denoiser at a place."""
        return getattr(self.objective.pipeline, place)

    def list_trained(self, place: str) -> dict[str, nn.Parameter]:
        """Return the parameters of the encoder, and those of the denoiser or its LoRA."""
        encoder = {f"encoder.{place}.{name}": value for name, value in self.encoders[place].named_parameters()}
        denoiser = self.find_denoiser(place).named_parameters()
        return encoder | {f"{place}.{name}": value for name, value in denoiser if value.requires_grad}

    def list_units(self, place: str) -> Sequence[nn.Module]:
        """Return the denoiser's blocks, the denoiser, and the encoder."""
        denoiser = self.find_denoiser(place)
        blocks = [block for each in denoiser.children() if isinstance(each, nn.ModuleList) for block in each]
        return [*blocks, denoiser, self.encoders[place]]

    def encode(self, batch: ClipBatch) -> Encoded:
        """Return what the autoencoder and the image encoder say of clips."""
        return self.objective.encode(batch.pixels)

    def describe_latents(self) -> dict[str, Any]:
        """Return the generator's weights and precision."""
        return {
            "weights": identify_weights(self.objective.generator),
            "precision": self.recipe.precision,
            "objective": type(self.objective).__name__,
        }

    def compute_losses(self, place: str, encoded: Encoded, actions: Tensor, random: torch.Generator) -> Tensor:
        """Return the denoiser's loss with each frame's action injected, or the null action in a share of the clips."""
        dropped = (torch.rand(len(actions), generator=random) < self.recipe.drop).to(self.device)
        vectors = self.encoders[place](self._identify_actions(actions), dropped)
        with self._conditioning.injections[place].inject(vectors):
            return self.objective.compute_losses(place, self.objective.sample(encoded, random), random)

    def list_networks(self) -> Sequence[nn.Module]:
        """Return all networks of the pipeline that have weights."""
        parts = [each for each in self.objective.pipeline.components.values() if isinstance(each, nn.Module)]
        return [each for each in parts if next(each.parameters(), None) is not None]

    def imagine(
        self, observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Generate clips by the generator's own pipeline and sampler; see `TrainableModel.imagine`."""
        generator, pipeline = self.objective.generator, self.objective.pipeline
        controls = [self._make_control(plan, int(own.max())) for plan, own in zip(plans, wanted, strict=True)]
        scheduler, clips = pipeline.scheduler, []
        pipeline.scheduler = deepcopy(scheduler)
        try:
            for rows in generator.batches(len(controls)):
                ids = torch.from_numpy(np.stack([np.asarray(control.ids) for control in controls[rows]]))
                actions = self._identify_actions(ids.to(self.device)).cpu().numpy()
                with self._autocast_denoisers(), self._conditioning.apply(actions):
                    clips.append(generator.make_clips(observations.image[rows], controls[rows], seeds[rows]))
        finally:
            pipeline.scheduler = scheduler
        frames = np.rint(np.concatenate(clips) * 255).astype(np.uint8)
        return frames[np.arange(len(controls))[:, None], wanted]

    @contextmanager
    def _autocast_denoisers(self) -> Iterator[None]:
        """Let the denoisers compute in the recipe's precision, as in training, as long as the context lasts.

        The other networks compute in their own: the world model runs them so, and the pipeline reads their outputs.
        """
        denoisers = list(map(self.find_denoiser, self.places))
        own = [vars(each).get("forward") for each in denoisers]  # a hook's, such as of offloading
        for each in denoisers:
            each.forward = self.objective.autocast()(each.forward)
        try:
            yield
        finally:
            for each, forward in zip(denoisers, own, strict=True):
                del each.forward
                if forward is not None:
                    each.forward = forward

    def select_clips(self, held_out: Corpus) -> HeldOutClips[Any]:
        """Select clips of the length that it is trained on; see `TrainableModel.select_clips`."""
        recipe = self.recipe
        return held_out.select_clips(recipe.frames, recipe.validate_clips, recipe.seed, recipe.clip_size)

    def _identify_actions(self, actions: Tensor) -> Tensor:
        """Return actions as the encoder takes them: its own ids of primitives [B, N], or poses [B, N, 7]."""
        return actions if self.action_ids is None else self.action_ids[actions.long()]

    def _make_control(self, plan: NDArray[Any], own: int) -> Control:
        """Return primitives [K], of which `own` are wanted, or poses [K + 1, 7], at the generator's length."""
        if self.action_ids is None:
            return Control.of_poses(len(plan) - 1, ids=plan)
        return make_control(plan, self.objective.generator.frames - 1, own)

    def write(self, folder: Path) -> None:
        """Write an action-conditioned checkpoint; see `wiw.world_models.video.actions.checkpoint`."""
        checkpoint.save(folder, self.encoders, self.objective.pipeline, lora=bool(self.recipe.lora))

    def activate(self, place: str) -> None:
        """Keep on the device only the denoiser that is trained; sharded ones stay there."""
        if self._active != place and not distributed.is_sharded(self.find_denoiser(place)):
            for each in self.places:
                self.find_denoiser(each).to(self.device if each == place else "cpu")
            self._active = place

    def _freeze_rest(self) -> None:
        """Let no gradient reach what is not trained."""
        trained = {
            id(value)
            for place in self.places
            for name, value in self.find_denoiser(place).named_parameters()
            if not self.recipe.lora or f".{ADAPTER}." in name
        }
        for network in self.objective.pipeline.components.values():
            if isinstance(network, nn.Module):
                for value in network.parameters():
                    value.requires_grad_(id(value) in trained)


def build_config(base: str, place: str, generator: VideoModel, **kind: Any) -> ActionConfig:
    """Return the configuration of encoders for the denoisers of a generator; `kind` are the fields about actions."""
    return ActionConfig(
        base=base,
        weights=generator.weights,
        revision=identify_weights(generator).get("commit"),
        width=embedding_width(getattr(generator.pipeline, place)),
        stride=generator.stride,
        **kind,
    )


def identify_weights(generator: VideoModel) -> dict[str, str]:
    """Return the hub's commit of a generator's weights, or the digest of their folder, and their variant if any."""
    described = generator.describe()
    return {key: str(described[key]) for key in ("commit", "digest", "variant") if described.get(key) is not None}


def prepare_denoiser(pipeline: Any, place: str, recipe: PostTrainingRecipe) -> None:
    """Make a denoiser ready for training: a LoRA on it if the recipe has one, and gradient checkpointing.

    Raises:
        ArgumentError: the pipeline loads no LoRA, or the denoiser lacks layers that it is meant for.
    """
    denoiser = getattr(pipeline, place)
    if recipe.lora:
        add_lora(pipeline, place, recipe.lora)
    denoiser.train()
    if recipe.checkpointing:
        denoiser.enable_gradient_checkpointing()


def add_lora(pipeline: Any, place: str, rank: int, layers: Sequence[str] = LORA_LAYERS) -> None:
    """Put a LoRA in float32 on the layers of a denoiser whose names end in one of `layers`.

    Raises:
        ArgumentError: the pipeline loads no LoRA, or one of `layers` covers nothing.
    """
    from diffusers.training_utils import cast_training_params
    from peft import LoraConfig

    if not supports_lora(pipeline):
        raise ArgumentError(
            f"lora: {type(pipeline).__name__} does not support LoRA; train the whole denoiser with lora=0"
        )
    denoiser = getattr(pipeline, place)
    names = [name for name, _ in denoiser.named_modules()]
    empty = [layer for layer in layers if not any(name.endswith(f".{layer}") for name in names)]
    if empty:
        raise ArgumentError(
            f"lora: {type(denoiser).__name__} has no layers {', '.join(empty)}, so a LoRA would have no effect; train "
            "the whole denoiser with lora=0"
        )
    denoiser.requires_grad_(False)
    denoiser.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=list(layers)), adapter_name=ADAPTER)
    cast_training_params(denoiser, torch.float32)
