# SPDX-License-Identifier: Apache-2.0
"""Training objectives of denoisers: the base of one class per line of models.

A denoiser is called as its pipeline calls it, with the pipeline's own embeddings of the empty prompt, which is what
an action-conditioned world model is given.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from wiw.errors import ArgumentError
from wiw.networks import autocast_uncached
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded
from wiw.types import Control
from wiw.world_models.video.model import VideoModel

Sampled = Mapping[str, Tensor]
"""Clips as the denoiser sees them: "latents" [B, C, L, h, w] and what is given to it beside the noisy clip."""


class Objective(ABC):
    """The loss of one generator.

    Args:
        generator: whose pipeline holds the denoisers; they may be of any precision.
        recipe: of the training.
    """

    def __init__(self, generator: VideoModel, recipe: PostTrainingRecipe) -> None:
        self.generator, self.recipe = generator, recipe
        self.pipeline = generator.pipeline
        self.device = torch.device(str(generator.device))

    @abstractmethod
    def encode(self, clips: Tensor) -> Encoded:
        """Return what the frozen networks say of clips, float32 [B, 3, N, H, W] from -1 to 1; without gradients."""

    @abstractmethod
    def sample(self, encoded: Encoded, random: torch.Generator) -> Sampled:
        """Return encoded clips as the denoiser sees them, with what is drawn anew each time; without gradients."""

    @abstractmethod
    def compute_losses(self, place: str, sampled: Sampled, random: torch.Generator) -> Tensor:
        """Return the loss of each clip, float32 [B], for the denoiser at this place in the pipeline.

        `random` is a generator on the CPU, so that draws are the same on all devices.
        """

    def autocast(self) -> torch.autocast:
        """Return a context in which denoisers compute in the recipe's precision."""
        return autocast_uncached(self.device, self.recipe.precision == "bfloat16")

    def release_text_encoder(self) -> None:
        """Move the text encoder off the device, once the empty prompt is encoded."""
        self.pipeline.text_encoder.to("cpu")

    def draw_normal(self, like: Tensor, random: torch.Generator) -> Tensor:
        """Return standard normal noise, float32, of the shape and on the device of `like`."""
        return torch.randn(like.shape, generator=random).to(like.device)

    def draw_latents(self, encoded: Encoded, name: str, random: torch.Generator) -> Tensor:
        """Draw latents, float32, from the autoencoder's distribution that `encode_distribution` returned."""
        mean, std = encoded[f"{name}_mean"].float(), encoded[f"{name}_std"].float()
        return mean + std * self.draw_normal(mean, random)

    def encode_distribution(self, frames: Tensor, name: str) -> dict[str, Tensor]:
        """Return mean and standard deviation of the latents of frames, in the autoencoder's precision."""
        vae = self.pipeline.vae
        found = vae.encode(frames.to(vae.dtype)).latent_dist
        return {f"{name}_mean": found.mean, f"{name}_std": found.std}

    def read_arguments(self, images: int) -> dict[str, Any]:
        """Return what the world model hands its pipeline for so many rows without words."""
        empty = Control(np.zeros(0, np.int8), np.zeros((0, 3)), np.zeros((0, 4, 4)))
        return self.generator.arguments([None] * images, [empty] * images)


class FlowObjective(Objective):
    """Rectified flow (Liu et al. 2023; Esser et al. 2024): predict noise less clip from a mixture of both.

    Where `keeps_first`, the first latent frame is given without noise, at time 0, and has no part in the loss.
    """

    keeps_first: bool
    """Whether the denoiser finds the observation in place of the first latent frame, rather than in other channels."""

    @abstractmethod
    def draw_levels(self, place: str, latents: Tensor, random: torch.Generator) -> Tensor:
        """Return noise levels, float32 [B] from 0 to 1, for latents [B, C, L, h, w]."""

    @abstractmethod
    def predict(self, denoiser: Any, noisy: Tensor, levels: Tensor, sampled: Sampled) -> Tensor:
        """Return what the denoiser predicts, [B, C, L, h, w]."""

    def weigh(self, levels: Tensor) -> Tensor:
        """Return how much each level counts, [B]: alike unless a subclass says otherwise."""
        return torch.ones_like(levels)

    def compute_losses(self, place: str, sampled: Sampled, random: torch.Generator) -> Tensor:
        """Return the mean squared error of the predicted flow, weighted, for each clip."""
        latents = sampled["latents"]
        levels = self.draw_levels(place, latents, random).to(latents.device)
        noise = self.draw_normal(latents, random)
        share = levels[:, None, None, None, None]
        noisy = torch.lerp(latents, noise, share)
        if self.keeps_first:
            noisy = torch.cat([sampled["first"], noisy[:, :, 1:]], dim=2)
        with self.autocast():
            predicted = self.predict(getattr(self.pipeline, place), noisy, levels, sampled)
        errors = (predicted.float() - (noise - latents)).square()
        if self.keeps_first:
            errors = errors[:, :, 1:]
        return self.weigh(levels) * errors.mean(dim=(1, 2, 3, 4))


def require(condition: bool, expected: str, found: object) -> None:
    """Raise ArgumentError unless a network is of the kind that is expected."""
    if not condition:
        raise ArgumentError(f"weights: expected {expected}, got {found}")


def to_image(pixels: Tensor) -> Image.Image:
    """Return an observation, [3, H, W] from -1 to 1, as the picture it was."""
    levels = ((pixels + 1) * 127.5).round().clamp(0, 255).permute(1, 2, 0).cpu().numpy()
    return Image.fromarray(levels.astype(np.uint8))
