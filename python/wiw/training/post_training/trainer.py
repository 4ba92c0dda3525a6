# SPDX-License-Identifier: Apache-2.0
"""Train the denoisers of one generator and the encoders that tell them each frame's action."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.datasets.navigation import Clips
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.errors import ArgumentError, TrainingError
from wiw.training.checkpoint import ResumableTrainer
from wiw.training.held_out_clips import resize_frames
from wiw.training.post_training.clip_order import ClipOrder
from wiw.training.post_training.objective import Objective
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.world_models.video.actions.checkpoint import ADAPTER, supports_lora
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.encoder import ActionEncoder
from wiw.world_models.video.actions.injection import Injection

LORA_LAYERS = ("to_q", "to_k", "to_v", "to_out.0", "ffn.net.0.proj", "ffn.net.2")
"""Layers that a LoRA is put on: attention and feed-forward (paper's repository for Wan, DiffSynth-Studio)."""


class PostTrainer(ResumableTrainer):
    """Train step by step: step k is a function of the recipe, the clips and the state after step k - 1.

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

    def __init__(
        self,
        objective: Objective,
        config: ActionConfig,
        places: Sequence[str],
        clips: Clips,
        recipe: PostTrainingRecipe,
    ) -> None:
        self.objective, self.recipe, self._clips = objective, recipe, clips
        self.places = tuple(places)
        self.mean_loss = float("nan")
        self._active: str | None = None
        self.order = arrange_clips(len(clips), recipe)
        self.action_ids = np.zeros(len(config.vocabulary), np.int64)
        self.action_ids[list(config.ids)] = list(config.ids.values())
        with _seed_torch(_mix_seed(recipe.seed, "weights"), objective.device):
            self.encoders = {place: ActionEncoder(config).to(objective.device) for place in self.places}
            for place in self.places:
                prepare_denoiser(objective.pipeline, place, recipe)
        self._injections = {place: Injection(getattr(objective.pipeline, place)) for place in self.places}
        self._freeze_rest()
        self.trained = self._list_trained()
        self.optimizer = torch.optim.AdamW(
            list(self.trained.values()), lr=recipe.rate, weight_decay=recipe.weight_decay
        )

    @property
    def steps_per_epoch(self) -> int:
        """Steps in an epoch of each denoiser, times the number of denoisers."""
        return self.order.steps_per_epoch * len(self.places)

    def locate(self, step: int) -> tuple[str, int]:
        """Return the denoiser that a step trains, by its place, and the number of its own steps before it."""
        each = self.order.steps_per_epoch * self.recipe.epochs
        return self.places[min(step // each, len(self.places) - 1)], step % each

    def train_step(self, learning_rate: float) -> float:
        """Train on one batch and return its loss.

        Raises:
            TrainingError: the loss or the gradient is not finite; nothing has changed.
            FileError: a clip cannot be read.
        """
        place, own_step = self.locate(self.step_count)
        self._activate(place)
        batch = self.order.select(own_step)
        self.optimizer.zero_grad(set_to_none=True)
        total = 0.0
        for first in range(0, self.recipe.batch, self.recipe.rows):
            rows = batch[first : first + self.recipe.rows]
            with _seed_torch(
                _mix_seed(self.recipe.seed, "step", self.step_count, first), self.objective.device
            ) as random:
                losses = self._compute_losses(place, [self._clips[int(row)] for row in rows], random)
                loss = losses.sum() / self.recipe.batch
                self._require_finite(losses, rows, "loss")
                loss.backward()
            total += float(loss.detach())
        norm = nn.utils.clip_grad_norm_(list(self.trained.values()), self.recipe.clip_norm)
        self._require_finite(norm[None], batch, "gradient")
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate
        self.optimizer.step()
        self.mean_loss = total if not self.step_count else 0.98 * self.mean_loss + 0.02 * total
        self.step_count += 1
        return total

    def state_dict(self) -> dict[str, Any]:
        """Return the number of steps, the mean loss, the trained weights and the optimiser's state, in main memory."""
        optimizer = self.optimizer.state_dict()
        moments = {key: {name: value.cpu() for name, value in each.items()} for key, each in optimizer["state"].items()}
        return {
            "count": self.step_count,
            "loss": self.mean_loss,
            "weights": {name: value.detach().cpu() for name, value in self.trained.items()},
            "optimizer": {**optimizer, "state": moments},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned."""
        self.step_count, self.mean_loss = state["count"], state["loss"]
        with torch.no_grad():
            for name, value in self.trained.items():
                value.copy_(state["weights"][name])
        self.optimizer.load_state_dict(state["optimizer"])

    def _compute_losses(self, place: str, clips: Sequence[NavigationSegment], random: torch.Generator) -> Tensor:
        batch = load_clips(clips, self.recipe.size, self.action_ids).to(self.objective.device)
        dropped = (torch.rand(len(clips), generator=random) < self.recipe.drop).to(self.objective.device)
        encoded = self.objective.encode(batch.frames, random)
        vectors = self.encoders[place](batch.actions, dropped)
        with self._injections[place].inject(vectors):
            return self.objective.compute_losses(place, encoded, random)

    def _require_finite(self, values: Tensor, rows: NDArray[np.int64], what: str) -> None:
        if bool(torch.isfinite(values).all()):
            return
        self.optimizer.zero_grad(set_to_none=True)
        names = [describe_clip(self._clips, int(row)) for row in rows]
        raise TrainingError(
            f"step {self.step_count + 1}: the {what} is not finite on a batch of {'; '.join(names)}. The state before "
            "this step is kept. Look at these clips (`wiw data verify`), or begin anew with a lower rate or "
            "precision=float32"
        )

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


def arrange_clips(total: int, recipe: PostTrainingRecipe) -> ClipOrder:
    """Return the order of a dataset's clips.

    Raises:
        ArgumentError: there are fewer clips than one step takes.
    """
    order = ClipOrder(total, min(recipe.clips or total, total), recipe.batch, recipe.seed)
    if not order.steps_per_epoch:
        raise ArgumentError(
            f"expected at least {recipe.batch} clips of {recipe.frames} frames, one batch, got {order.count}: collect "
            "more data, or lower batch"
        )
    return order


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
    frames = np.stack([resize_frames(clip.images, size) for clip in clips])
    pixels = torch.from_numpy(frames).permute(0, 4, 1, 2, 3).float() / 127.5 - 1
    return ClipBatch(pixels, torch.from_numpy(np.stack([ids[clip.actions] for clip in clips])))


def describe_clip(clips: Clips, index: int) -> str:
    """Return where a clip is in its dataset."""
    segment, start = clips.locate(index)
    clip = clips[index]
    return f"clip {index} (scene {clip.scene}, segment {segment} of the dataset, from frame {start})"


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


def _mix_seed(seed: int, *parts: object) -> int:
    """Return a seed of torch that depends on all parts."""
    digest = hashlib.blake2b(repr((seed, *parts)).encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


@contextmanager
def _seed_torch(seed: int, device: torch.device) -> Iterator[torch.Generator]:
    """Yield a generator on the CPU, and seed torch's own ones, which are as before afterwards."""
    devices = [device] if device.type == "cuda" else []
    with torch.random.fork_rng(devices):
        torch.manual_seed(seed)
        yield torch.Generator("cpu").manual_seed(seed)
