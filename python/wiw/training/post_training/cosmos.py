# SPDX-License-Identifier: Apache-2.0
"""The training objective of Cosmos-Predict2: flow between noise and clip, the first latent frame given."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from wiw.training.post_training.noise import draw_logit_normal
from wiw.training.post_training.objective import FlowObjective, Sampled
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded
from wiw.world_models.video.model import VideoModel

GIVEN_SIGMA = 1e-4
"""Noise that the pipeline says the given frame has."""
MAX_WORDS = 512
"""Tokens of a prompt, as the pipeline pads it."""


class CosmosObjective(FlowObjective):
    """Cosmos-Predict2: ln sigma is standard normal, and the level sigma / (1 + sigma).

    Its preconditioning makes the denoiser's own output the flow: the clip that it stands for is mixture - level x
    output, and the weight (1 + sigma)^2 / sigma^2 of that clip's error makes it the error of the flow.
    """

    keeps_first = True

    def __init__(self, generator: VideoModel, recipe: PostTrainingRecipe) -> None:
        super().__init__(generator, recipe)
        with torch.no_grad():
            self._words, _ = self.pipeline.encode_prompt(
                prompt=[""], do_classifier_free_guidance=False, max_sequence_length=MAX_WORDS, device=self.device
            )
        self.release_text_encoder()
        self._fps = self.read_arguments(1)["fps"]

    @torch.no_grad()
    def encode(self, clips: Tensor) -> Encoded:
        """Return the latents, and that of each first frame, shown for the whole clip as the pipeline does."""
        still = clips[:, :, :1].expand(-1, -1, clips.shape[2], -1, -1)
        first = {name: value[:, :, :1] for name, value in self.encode_distribution(still, "first").items()}
        return {**self.encode_distribution(clips, "latents"), **first}

    def sample(self, encoded: Encoded, random: torch.Generator) -> Sampled:
        """Draw both from their distributions, normalised."""
        config, scale = self.pipeline.vae.config, self.pipeline.scheduler.config.sigma_data
        drawn = {name: self.draw_latents(encoded, name, random) for name in ("latents", "first")}
        mean, std = (
            torch.tensor(each, device=self.device).view(1, -1, 1, 1, 1)
            for each in (config.latents_mean, config.latents_std)
        )
        return {name: (latents - mean) / std * scale for name, latents in drawn.items()}

    def draw_levels(self, place: str, latents: Tensor, random: torch.Generator) -> Tensor:
        """Draw logit-normal levels."""
        return draw_logit_normal(len(latents), random)

    def predict(self, denoiser: Any, noisy: Tensor, levels: Tensor, sampled: Sampled) -> Tensor:
        """Call the transformer with latents [B, C, L, h, w], a time per latent frame, and which frame is given."""
        rows, _, frames, height, width = noisy.shape
        times = levels[:, None, None, None, None].repeat(1, 1, frames, 1, 1)
        times[:, :, 0] = GIVEN_SIGMA / (GIVEN_SIGMA + 1)
        given = noisy.new_zeros(rows, 1, frames, height, width)
        given[:, :, 0] = 1
        return denoiser(
            hidden_states=noisy.to(denoiser.dtype),
            timestep=times.to(denoiser.dtype),
            encoder_hidden_states=self._words.expand(rows, -1, -1),
            fps=self._fps,
            condition_mask=given.to(denoiser.dtype),
            padding_mask=noisy.new_zeros(1, 1, *self.generator.size, dtype=denoiser.dtype),
            return_dict=False,
        )[0]
