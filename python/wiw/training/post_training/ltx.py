# SPDX-License-Identifier: Apache-2.0
"""The training objective of LTX-Video: flow between noise and clip, tokens of the first frame given."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from wiw.training.post_training.noise import draw_token_shifted
from wiw.training.post_training.objective import FlowObjective, Sampled, require
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded
from wiw.world_models.video.model import VideoModel

FRAME_RATE = 25
"""Frames a second that the pipeline assumes."""


class LTXObjective(FlowObjective):
    """LTX-Video: a time per token, 0 for those of the first frame; levels shifted by the number of tokens."""

    keeps_first = True

    def __init__(self, generator: VideoModel, recipe: PostTrainingRecipe) -> None:
        super().__init__(generator, recipe)
        config = self.pipeline.transformer.config
        require((config.patch_size, config.patch_size_t) == (1, 1), "an LTX transformer of patches of 1", config)
        with torch.no_grad():
            words = self.pipeline.encode_prompt(
                prompt=[""],
                do_classifier_free_guidance=False,
                max_sequence_length=self.read_arguments(1)["max_sequence_length"],
                device=self.device,
            )
        self._words, self._mask = words[0], words[1]
        self.release_text_encoder()

    @torch.no_grad()
    def encode(self, clips: Tensor) -> Encoded:
        """Return the latents, and those of the first frames alone, as the pipeline encodes an observation."""
        first = self.encode_distribution(clips[:, :, :1], "first")
        return {**self.encode_distribution(clips, "latents"), **first}

    def sample(self, encoded: Encoded, random: torch.Generator) -> Sampled:
        """Draw both from their distributions, normalised."""
        vae = self.pipeline.vae
        drawn = {name: self.draw_latents(encoded, name, random) for name in ("latents", "first")}
        mean, std = (each.view(1, -1, 1, 1, 1).to(drawn["first"]) for each in (vae.latents_mean, vae.latents_std))
        return {name: (latents - mean) / std for name, latents in drawn.items()}

    def draw_levels(self, place: str, latents: Tensor, random: torch.Generator) -> Tensor:
        """Draw logit-normal levels, the noisier the more tokens there are."""
        return draw_token_shifted(len(latents), latents[0, 0].numel(), random)

    def predict(self, denoiser: Any, noisy: Tensor, levels: Tensor, sampled: Sampled) -> Tensor:
        """Call the transformer with tokens [B, L h w, C]."""
        rows, _, frames, height, width = noisy.shape
        times = levels[:, None].expand(rows, frames * height * width).clone()
        times[:, : height * width] = 0
        tokens = denoiser(
            hidden_states=noisy.flatten(2).transpose(1, 2).to(self._words.dtype),
            encoder_hidden_states=self._words.expand(rows, -1, -1),
            timestep=times * self.pipeline.scheduler.config.num_train_timesteps,
            encoder_attention_mask=self._mask.expand(rows, -1),
            num_frames=frames,
            height=height,
            width=width,
            rope_interpolation_scale=(
                self.pipeline.vae_temporal_compression_ratio / FRAME_RATE,
                self.pipeline.vae_spatial_compression_ratio,
                self.pipeline.vae_spatial_compression_ratio,
            ),
            return_dict=False,
        )[0]
        return tokens.transpose(1, 2).unflatten(2, (frames, height, width))
