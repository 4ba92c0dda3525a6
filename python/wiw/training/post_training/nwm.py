# SPDX-License-Identifier: Apache-2.0
"""The objective of Navigation World Models: the noise in a future frame, given past frames and the motion to it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from wiw import action
from wiw.errors import ArgumentError
from wiw.networks import autocast_uncached
from wiw.training.held_out_clips import STEPS, Frames, imagine_with
from wiw.training.held_out_front_views import FrontView, FrontViewClips, select_front_views
from wiw.training.post_training.clips import ClipBatch
from wiw.training.post_training.corpora import Corpus, NavigationCorpus
from wiw.training.post_training.recipe import PostTrainingRecipe
from wiw.training.post_training.trainable import Encoded, TrainableModel
from wiw.types import Conditioning
from wiw.world_models.nwm import weights
from wiw.world_models.nwm.cdit import CDiT
from wiw.world_models.nwm.diffusion import TIMES, scheduler
from wiw.world_models.nwm.images import rows_seen, to_network
from wiw.world_models.nwm.model import NWM
from wiw.world_models.nwm.motion import SHIFT, normalise_steps

PLACE = "cdit"


class TrainableNWM(TrainableModel):
    """Train the CDiT as the world model runs it: on the codec's modes of the same middle of the front view.

    A clip is the context, frames one action apart, and the frames after it, of which one is drawn as the target. Its
    motion is its pose in the frame of the last of the context. A share `still` of the clips has that last frame alone
    as context, repeated: what the world model has at the first decision of an episode.

    Args:
        network: the CDiT, in float32.
        codec: the autoencoder of images.
        recipe: of the training.
        spacing: metres between waypoints, as the world model's option.
        steps: of diffusion for each frame that is imagined, as the world model's option.
        device: of torch.

    Raises:
        ArgumentError: a recipe with a LoRA or null actions, or whose clips are no longer than the context.
    """

    places = (PLACE,)

    def __init__(
        self, network: CDiT, codec: Any, recipe: PostTrainingRecipe, spacing: float, steps: int, device: str
    ) -> None:
        self.device, self.recipe, self.spacing = torch.device(device), recipe, spacing
        self.network, self.codec = network.to(self.device), codec.to(self.device)
        _check_recipe(recipe, network.size.context)
        self.network.requires_grad_(True).train()
        self.network.checkpointing = recipe.checkpointing
        self._diffusion = VariationalDiffusion()
        options = {"spacing": spacing, "steps": steps, "device": device, "precision": recipe.precision}
        self._imagine = imagine_with(NWM.with_networks(self.network, self.codec, **options))

    def list_trained(self, place: str) -> dict[str, nn.Parameter]:
        """Return the parameters of the CDiT."""
        return {f"{PLACE}.{name}": value for name, value in self.network.named_parameters()}

    def list_units(self, place: str) -> Sequence[nn.Module]:
        """Return the blocks, and the network."""
        return [*self.network.blocks, self.network]

    @torch.no_grad()
    def encode(self, batch: ClipBatch) -> Encoded:
        """Return latents [B, N, C, h, w] of all frames."""
        side = self.network.size.latent_side * 2 ** (len(self.codec.config.block_out_channels) - 1)
        pixels = to_network(batch.frames.flatten(0, 1).cpu().numpy(), side).to(self.device)
        with self._use_precision():
            latents = self.codec.encode(pixels).latent_dist.mode().float() * self.codec.config.scaling_factor
        return {"latents": latents.unflatten(0, batch.frames.shape[:2])}

    def describe_latents(self) -> dict[str, Any]:
        """Return a digest of the codec, the size and the precision."""
        described = {"codec": weights.digest(self.codec), "side": self.network.size.latent_side}
        return {**described, "precision": self.recipe.precision}

    def compute_losses(self, place: str, encoded: Encoded, actions: Tensor, random: torch.Generator) -> Tensor:
        """Return the error of the predicted noise and the bound on the variance for each clip."""
        latents, count = encoded["latents"], self.network.size.context
        ahead = torch.randint(1, latents.shape[1] - count + 1, (len(latents),), generator=random)
        still = torch.rand(len(latents), generator=random) < self.recipe.still
        places = torch.where(still[:, None], count - 1, torch.arange(count))
        rows = torch.arange(len(latents))
        motion = self.measure_motions(actions, ahead).to(self.device)

        def predict(noisy: Tensor, times: Tensor) -> Tensor:
            with self._use_precision():
                return self.network(noisy, times, motion, latents[rows[:, None], places], ahead.to(motion) * SHIFT)

        return self._diffusion.compute_losses(predict, latents[rows, count - 1 + ahead], random)

    def measure_motions(self, actions: Tensor, ahead: Tensor) -> Tensor:
        """Return the motion from the last frame of the context to the one `ahead` [B] of it, float32 [B, 3]."""
        count = self.network.size.context
        plans = actions.cpu().numpy().astype(np.int8)
        ends = [
            action.to_trajectory(plan[count : count + steps])[-1:]
            for plan, steps in zip(plans, ahead.tolist(), strict=True)
        ]
        return torch.from_numpy(normalise_steps(np.concatenate(ends), self.spacing)).float()

    def activate(self, place: str) -> None:
        """Do nothing: the one network stays on the device."""

    def list_networks(self) -> Sequence[nn.Module]:
        """Return the CDiT and the codec."""
        return [self.network, self.codec]

    def imagine(
        self, observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Imagine frame after frame, as the world model does; see `TrainableModel.imagine`."""
        return self._imagine(observations, plans, seeds, wanted)

    def select_clips(self, held_out: Corpus) -> FrontViewClips:
        """Select clips of the context and the actions after it, 14 where segments are that long.

        Frames are the part of the front view that the network sees, which is also all that it imagines.
        """
        assert isinstance(held_out, NavigationCorpus), "the only value for this family"
        context, size = self.network.size.context, self.recipe.clip_size
        longest = max((row["frames"] for row in held_out.data.segments), default=0)
        clips = held_out.data.clips(max(context + 1, min(context + max(STEPS), longest)))
        view = FrontView(size, rows_seen(*size))
        return select_front_views(
            clips, held_out.cut_views, view, context, self.recipe.validate_clips, self.recipe.seed
        )

    def write(self, folder: Path) -> None:
        """Write network and codec, as `wiw.world_model("nwm", weights=folder)` reads them."""
        weights.save(folder, self.network, self.codec)

    def _use_precision(self) -> Any:
        return autocast_uncached(self.device, self.recipe.precision == "bfloat16")


def _check_recipe(recipe: PostTrainingRecipe, context: int) -> None:
    if recipe.lora or recipe.drop:
        raise ArgumentError(
            f"recipe: NWM has no LoRA and no null action: expected lora=0 and drop=0, got {recipe.lora}, {recipe.drop}"
        )
    if recipe.frames <= context:
        raise ArgumentError(
            f"recipe: frames: expected over {context}, the context and a frame to predict, got {recipe.frames}"
        )


class VariationalDiffusion:
    """The loss of a diffusion model that also learns its variance (Nichol and Dhariwal 2021, section 3.1).

    The noise is learnt by its squared error. The share by which the variance lies between its bounds is learnt by the
    variational bound, in bits a dimension, through which no gradient reaches the noise.
    """

    def __init__(self) -> None:
        chain = scheduler(TIMES)
        kept, beta = chain.alphas_cumprod.double(), chain.betas.double()
        before = torch.cat([torch.ones(1, dtype=torch.float64), kept[:-1]])
        posterior = beta * (1 - before) / (1 - kept)
        self._kept = kept
        self._of_clean = before.sqrt() * beta / (1 - kept)
        self._of_noisy = (1 - beta).sqrt() * (1 - before) / (1 - kept)
        self._least = torch.cat([posterior[1:2], posterior[1:]]).log()  # the first is 0, whose logarithm is none
        self._most = beta.log()

    def compute_losses(self, predict: Any, latents: Tensor, random: torch.Generator) -> Tensor:
        """Return the loss of each row, float32 [B].

        Args:
            predict: maps noisy latents and diffusion times [B] to noise and variance weights [B, 2 C, H, W].
            latents: [B, C, H, W].
            random: on the CPU.
        """
        times = torch.randint(0, TIMES, (len(latents),), generator=random)
        noise = torch.randn(latents.shape, generator=random).to(latents.device)
        kept = self._read(self._kept, times, latents)
        noisy = kept.sqrt() * latents + (1 - kept).sqrt() * noise
        predicted, shares = predict(noisy, times.to(latents.device)).float().chunk(2, dim=1)
        error = mse_loss(predicted, noise, reduction="none").mean(dim=(1, 2, 3))
        clean = (noisy - (1 - kept).sqrt() * predicted.detach()) / kept.sqrt()
        return error + self._compute_bound(latents, noisy, clean, shares, times)

    def _compute_bound(self, latents: Tensor, noisy: Tensor, clean: Tensor, shares: Tensor, times: Tensor) -> Tensor:
        """Return the term of the variational bound at these times, bits a dimension, [B]."""
        least, most = (self._read(each, times, latents) for each in (self._least, self._most))
        log_variance = least + (shares + 1) / 2 * (most - least)
        true_mean, mean = (
            self._read(self._of_clean, times, latents) * each + self._read(self._of_noisy, times, latents) * noisy
            for each in (latents, clean)
        )
        divergence = (log_variance - least + (least - log_variance).exp() - 1) / 2
        divergence = divergence + (true_mean - mean).square() * (-log_variance).exp() / 2
        likelihood = measure_likelihood(latents, mean, log_variance / 2)
        nats = torch.where((times == 0).to(latents.device)[:, None, None, None], -likelihood, divergence)
        return nats.mean(dim=(1, 2, 3)) / math.log(2)

    @staticmethod
    def _read(table: Tensor, times: Tensor, like: Tensor) -> Tensor:
        return table[times].to(like)[:, None, None, None]


def measure_likelihood(values: Tensor, mean: Tensor, log_deviation: Tensor) -> Tensor:
    """Return the logarithm of a normal distribution's mass in the bin of width 2 / 255 around each value.

    The outermost bins of -1 to 1 reach to infinity (Ho, Jain and Abbeel 2020, equation 13).
    """
    scale, offset = (-log_deviation).exp(), values - mean
    above, below = torch.special.ndtr(scale * (offset + 1 / 255)), torch.special.ndtr(scale * (offset - 1 / 255))
    mass = torch.where(values < -0.999, above, torch.where(values > 0.999, 1 - below, above - below))
    return mass.clamp(min=1e-12).log()
