# SPDX-License-Identifier: Apache-2.0
"""Train the denoisers of one generator and the encoders that tell them each frame's action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.datasets.navigation import Clips
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.errors import ArgumentError
from wiw.training.post_training.clip_trainer import ClipTrainer, mix_seed, seed_torch
from wiw.training.post_training.objective import Objective
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.world_models.video.actions.checkpoint import ADAPTER, supports_lora
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.encoder import ActionEncoder
from wiw.world_models.video.actions.injection import Injection

LORA_LAYERS = ("to_q", "to_k", "to_v", "to_out.0", "ffn.net.0.proj", "ffn.net.2")
"""Layers that a LoRA is put on: attention and feed-forward (paper's repository for Wan, DiffSynth-Studio)."""


class PostTrainer(ClipTrainer):
    """Train on clips; see `ClipTrainer`.

    Denoisers are trained one after the other, each over all epochs: a model of two experts has two such phases.

    Args:
        objective: loss of the generator, whose pipeline holds the denoisers.
        config: of the action encoders.
        places: of the denoisers in the pipeline.
        clips: what is trained on.
        recipe: of the training.

    Raises:
        ArgumentError: a LoRA that a pipeline does not load, or for layers that a denoiser does not have.
    """

    recipe: PostTrainingRecipe

    def __init__(
        self,
        objective: Objective,
        config: ActionConfig,
        places: Sequence[str],
        clips: Clips,
        recipe: PostTrainingRecipe,
    ) -> None:
        super().__init__(clips, recipe, objective.device)
        self.objective, self.places = objective, tuple(places)
        self._active: str | None = None
        self._ids = np.zeros(len(config.vocabulary), np.int64)
        self._ids[list(config.ids)] = list(config.ids.values())
        with seed_torch(mix_seed(recipe.seed, "weights"), objective.device):
            self.encoders = {place: ActionEncoder(config).to(objective.device) for place in self.places}
            for place in self.places:
                prepare_denoiser(objective.pipeline, place, recipe)
        self._injections = {place: Injection(getattr(objective.pipeline, place)) for place in self.places}
        self._freeze_rest()
        self.start_optimizer(self._list_trained())

    @property
    def steps_per_epoch(self) -> int:
        """Steps in an epoch of each denoiser, times the number of denoisers."""
        return self.order.steps_per_epoch * self.phases

    @property
    def phases(self) -> int:
        """Number of denoisers."""
        return len(self.places)

    @property
    def rows(self) -> int:
        """Clips in one pass through the networks."""
        return self.recipe.rows

    def locate(self, step: int) -> tuple[str, int]:
        """Return the denoiser that a step trains, by its place, and the number of its own steps before it."""
        each = self.order.steps_per_epoch * self.recipe.epochs
        return self.places[min(step // each, len(self.places) - 1)], step % each

    def select_batch(self) -> NDArray[np.int64]:
        """Return the clips of the present step, and keep on the device only the denoiser that it trains."""
        place, own_step = self.locate(self.step_count)
        self._activate(place)
        return self.order.select(own_step)

    def compute_losses(self, rows: NDArray[np.int64], random: torch.Generator) -> Tensor:
        """Return the loss of each clip."""
        place, _ = self.locate(self.step_count)
        clips = [self.clips[int(row)] for row in rows]
        batch = load_clips(clips, self.recipe.size, self._ids).to(self.objective.device)
        dropped = (torch.rand(len(clips), generator=random) < self.recipe.drop).to(self.objective.device)
        encoded = self.objective.encode(batch.frames, random)
        vectors = self.encoders[place](batch.actions, dropped)
        with self._injections[place].inject(vectors):
            return self.objective.compute_losses(place, encoded, random)

    def _activate(self, place: str) -> None:
        """Keep on the device only the denoiser that is trained."""
        if self._active != place:
            for each in self.places:
                getattr(self.objective.pipeline, each).to(self.objective.device if each == place else "cpu")
            self._active = place

    def _freeze_rest(self) -> None:
        """Let no gradient reach what is not trained."""
        trained = {
            id(value)
            for place in self.places
            for name, value in getattr(self.objective.pipeline, place).named_parameters()
            if not self.recipe.lora or f".{ADAPTER}." in name
        }
        for network in self.objective.pipeline.components.values():
            if isinstance(network, nn.Module):
                for value in network.parameters():
                    value.requires_grad_(id(value) in trained)

    def _list_trained(self) -> dict[str, nn.Parameter]:
        found: dict[str, nn.Parameter] = {}
        for place in self.places:
            found |= {f"encoder.{place}.{name}": value for name, value in self.encoders[place].named_parameters()}
            denoiser = getattr(self.objective.pipeline, place)
            found |= {f"{place}.{name}": value for name, value in denoiser.named_parameters() if value.requires_grad}
        return found


@dataclass(frozen=True)
class ClipBatch:
    """Clips as tensors."""

    frames: Tensor
    """float32 [B, 3, N, H, W] from -1 to 1."""
    actions: Tensor
    """int64 [B, N]: the action that led to each frame, in the encoder's ids."""

    def to(self, device: torch.device) -> ClipBatch:
        """Return the clips on a device."""
        return ClipBatch(self.frames.to(device), self.actions.to(device))


def load_clips(clips: Sequence[NavigationSegment], size: tuple[int, int], ids: NDArray[np.int64]) -> ClipBatch:
    """Decode clips and bring them to a size (height, width); `ids` maps wiw's actions to the encoder's.

    Raises:
        FileError: a picture is damaged.
    """
    height, width = size
    frames = np.stack([[_resize(frame, height, width) for frame in clip.images] for clip in clips])
    pixels = torch.from_numpy(frames).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    return ClipBatch(pixels, torch.from_numpy(np.stack([ids[clip.actions] for clip in clips])))


def _resize(frame: NDArray[np.uint8], height: int, width: int) -> NDArray[np.uint8]:
    if frame.shape[:2] == (height, width):
        return frame
    return np.asarray(cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


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
        raise ArgumentError(f"lora: {type(pipeline).__name__} takes no LoRA; train the whole denoiser with lora=0")
    denoiser = getattr(pipeline, place)
    names = [name for name, _ in denoiser.named_modules()]
    empty = [layer for layer in layers if not any(name.endswith(f".{layer}") for name in names)]
    if empty:
        raise ArgumentError(
            f"lora: {type(denoiser).__name__} has no layers {', '.join(empty)}, so that a LoRA of them would cover "
            "nothing; train the whole denoiser with lora=0"
        )
    denoiser.requires_grad_(False)
    denoiser.add_adapter(LoraConfig(r=rank, lora_alpha=rank, target_modules=list(layers)), adapter_name=ADAPTER)
    cast_training_params(denoiser, torch.float32)
