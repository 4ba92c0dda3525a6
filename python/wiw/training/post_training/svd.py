# SPDX-License-Identifier: Apache-2.0
"""The training objective of Stable Video Diffusion: noise of a log-normal level, in the preconditioning of EDM."""

from __future__ import annotations

import torch
from torch import Tensor

from wiw.training.post_training.objective import Objective, Sampled, to_image
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded
from wiw.world_models.video.model import VideoModel

LOG_SIGMA = (0.7, 1.6)
"""Mean and standard deviation of the noise's logarithm."""
LOG_GIVEN = (-3.0, 0.5)
"""The same of the noise on the observation."""


class SVDObjective(Objective):
    """SVD: predict v = (noise - sigma x clip) / sqrt(sigma^2 + 1), all levels weighted alike (Karras et al. 2022).

    The observation goes in beside the noisy clip, in channels of its own, and as an embedding; all frames are noisy and
    in the loss, as the pipeline generates them all. For guidance, the embedding alone, both, or the channels alone are
    blank in a share `drop` of the clips each.
    """

    def __init__(self, generator: VideoModel, recipe: PostTrainingRecipe) -> None:
        super().__init__(generator, recipe)
        arguments = self.read_arguments(1)
        self._ids = (arguments["fps"] - 1, arguments["motion_bucket_id"])  # the pipeline counts frames a second so

    @torch.no_grad()
    def encode(self, clips: Tensor) -> Encoded:
        """Return the latents of all frames, the observation, and its embedding."""
        observations = clips[:, :, 0]
        found = self.encode_distribution(clips.transpose(1, 2).flatten(0, 1), "latents")
        pictures = self.pipeline._encode_image([to_image(each) for each in observations], self.device, 1, False)
        return {
            **{name: value.unflatten(0, (len(clips), clips.shape[2])) for name, value in found.items()},
            "observation": observations,
            "pictures": pictures,
        }

    @torch.no_grad()
    def sample(self, encoded: Encoded, random: torch.Generator) -> Sampled:
        """Return the latents [B, N, C, h, w], and the observation as embedding and as latents of its noisy picture."""
        vae, observations = self.pipeline.vae, encoded["observation"]
        latents = self.draw_latents(encoded, "latents", random) * vae.config.scaling_factor
        logs = LOG_GIVEN[0] + LOG_GIVEN[1] * torch.randn(len(observations), generator=random)
        noise = torch.exp(logs).to(observations)
        noisy = observations + noise[:, None, None, None] * self.draw_normal(observations, random)
        return {
            "latents": latents,
            "given": vae.encode(noisy.to(vae.dtype)).latent_dist.mode().float(),
            "noise": noise,
            "pictures": encoded["pictures"].float(),
        }

    def compute_losses(self, place: str, sampled: Sampled, random: torch.Generator) -> Tensor:
        """Return the mean squared error of v for each clip."""
        latents = sampled["latents"]
        logs = (LOG_SIGMA[0] + LOG_SIGMA[1] * torch.randn(len(latents), generator=random)).to(latents)
        sigma = logs.exp()[:, None, None, None, None]
        noise = self.draw_normal(latents, random)
        scale = (sigma.square() + 1).sqrt()
        given, pictures = self._blank(sampled, random)
        unet = getattr(self.pipeline, place)
        beside = given[:, None].expand(-1, latents.shape[1], -1, -1, -1)
        with self.autocast():
            predicted = unet(
                torch.cat([(latents + sigma * noise) / scale, beside], dim=2).to(unet.dtype),
                0.25 * logs,
                encoder_hidden_states=pictures.to(unet.dtype),
                added_time_ids=self._identify(sampled["noise"]).to(unet.dtype),
                return_dict=False,
            )[0]
        wanted = (noise - sigma * latents) / scale
        return (predicted.float() - wanted).square().mean(dim=(1, 2, 3, 4))

    def _identify(self, noise: Tensor) -> Tensor:
        """Return what the pipeline says of a clip, [B, 3]: frames per second, motion, noise on the observation."""
        return torch.stack([torch.full_like(noise, self._ids[0]), torch.full_like(noise, self._ids[1]), noise], dim=1)

    def _blank(self, sampled: Sampled, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the observation's channels and embedding, each blank in a share of the clips."""
        drop = self.recipe.drop
        lot = torch.rand(len(sampled["latents"]), generator=random).to(sampled["latents"].device)
        pictures = sampled["pictures"].masked_fill((lot < 2 * drop)[:, None, None], 0)
        channels = (lot >= drop) & (lot < 3 * drop)
        return sampled["given"].masked_fill(channels[:, None, None, None], 0), pictures
