# SPDX-License-Identifier: Apache-2.0
"""The training objective of the Wan models: flow between noise and clip, on a schedule shifted towards noise."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from wiw.training.post_training.noise import draw_shifted_uniform, weigh_by_bell
from wiw.training.post_training.objective import FlowObjective, Sampled, to_image
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded
from wiw.world_models.video.model import VideoModel

MAX_WORDS = 512
"""Tokens of a prompt, as the pipeline pads it."""


class WanObjective(FlowObjective):
    """Wan 2.1 and 2.2: levels uniform before the shift, weighted by a bell.

    2.2 5B (`expand_timesteps`) finds the observation in place of the first latent frame, with a time per token. The
    others find it in channels of its own beside the noisy clip, whose first frame is noisy and in the loss like the
    rest. Of the two experts of A14B, "transformer" is trained on levels from `boundary_ratio` up, where the pipeline
    uses it, "transformer_2" on those below.
    """

    def __init__(self, generator: VideoModel, recipe: PostTrainingRecipe) -> None:
        super().__init__(generator, recipe)
        self.keeps_first = bool(self.pipeline.config.expand_timesteps)
        self._boundary: float | None = self.pipeline.config.boundary_ratio
        with torch.no_grad():
            self._words, _ = self.pipeline.encode_prompt(
                prompt="", do_classifier_free_guidance=False, max_sequence_length=MAX_WORDS, device=self.device
            )
        self.release_text_encoder()

    @torch.no_grad()
    def encode(self, clips: Tensor) -> Encoded:
        """Return the latents, and of each first frame what the pipeline gives the denoiser."""
        observations = clips[:, :, 0]
        given = torch.cat([self._condition(each[None], clips.shape[2]) for each in observations])
        encoded = {"latents": self._encode(clips), "first" if self.keeps_first else "given": given}
        if self.pipeline.transformer.config.image_dim is not None:
            encoded["pictures"] = torch.cat(
                [self.pipeline.encode_image(to_image(each), self.device) for each in observations]
            )
        return encoded

    def sample(self, encoded: Encoded, random: torch.Generator) -> Sampled:
        """Return the latents as they are: nothing of them is drawn."""
        return encoded

    def draw_levels(self, place: str, latents: Tensor, random: torch.Generator) -> Tensor:
        """Draw levels on the side of the boundary that the denoiser works on."""
        low, high = self.find_range(place)
        return draw_shifted_uniform(len(latents), self.recipe.shift, random, low, high)

    def find_range(self, place: str) -> tuple[float, float]:
        """Return least and largest noise level that the pipeline calls a denoiser with."""
        if self._boundary is None:
            return 0.0, 1.0
        return (self._boundary, 1.0) if place == "transformer" else (0.0, self._boundary)

    def weigh(self, levels: Tensor) -> Tensor:
        """Return the weights of DiffSynth-Studio's recipes."""
        return weigh_by_bell(levels, self.recipe.shift)

    def predict(self, denoiser: Any, noisy: Tensor, levels: Tensor, sampled: Sampled) -> Tensor:
        """Call the transformer with latents [B, C, L, h, w]."""
        words = self._words.to(denoiser.dtype).expand(len(noisy), -1, -1)
        pictures = sampled.get("pictures")
        times = levels * self.pipeline.scheduler.config.num_train_timesteps
        if not self.keeps_first:
            noisy = torch.cat([noisy, sampled["given"]], dim=1)
        return denoiser(
            hidden_states=noisy.to(denoiser.dtype),
            timestep=self._spread(times, noisy, denoiser) if self.keeps_first else times,
            encoder_hidden_states=words,
            encoder_hidden_states_image=None if pictures is None else pictures.to(denoiser.dtype),
            return_dict=False,
        )[0]

    def _spread(self, times: Tensor, noisy: Tensor, denoiser: Any) -> Tensor:
        """Return a time per token, [B, tokens], 0 for those of the first latent frame."""
        frames, height, width = (
            side // patch for side, patch in zip(noisy.shape[2:], denoiser.config.patch_size, strict=True)
        )
        spread = times[:, None].expand(-1, frames * height * width).clone()
        spread[:, : height * width] = 0
        return spread

    def _condition(self, observation: Tensor, frames: int) -> Tensor:
        """Return what the pipeline gives the denoiser of one observation [1, 3, H, W]."""
        height, width = observation.shape[-2:]
        channels = self.pipeline.vae.config.z_dim
        prepared = self.pipeline.prepare_latents(
            observation, 1, channels, height, width, frames, torch.float32, self.device, torch.Generator("cpu")
        )
        return prepared[1]

    def _encode(self, clips: Tensor) -> Tensor:
        """Return normalised latents, float32: the mode of the autoencoder's distribution, as the pipeline takes it."""
        vae = self.pipeline.vae
        found = vae.encode(clips.to(vae.dtype)).latent_dist.mode().float()
        mean, std = (
            torch.tensor(each, device=found.device).view(1, -1, 1, 1, 1)
            for each in (vae.config.latents_mean, vae.config.latents_std)
        )
        return (found - mean) / std
