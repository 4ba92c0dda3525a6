# SPDX-License-Identifier: Apache-2.0
"""Train pocket's denoiser: flow matching between noise and views, the clean views predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw.training.place_trainer import PlaceTrainer
from wiw.training.pocket.batches import PlaceBatch, draw_batch
from wiw.training.pocket.recipe import PocketRecipe
from wiw.training.post_training.noise import draw_shifted_uniform
from wiw.world_models.pocket.network import Denoiser, Views


class PocketTrainer(PlaceTrainer):
    """Train a denoiser from random weights, and average them."""

    recipe: PocketRecipe
    network: Denoiser

    def create_network(self) -> Denoiser:
        """Return a denoiser of random weights."""
        return Denoiser(self.recipe.size[0], self.recipe.widths)

    def compare_views(
        self, clips: Sequence[NDArray[np.int64]], rng: np.random.Generator, random: torch.Generator
    ) -> Tensor:
        """Return the loss of each clip."""
        return self._compute_losses(draw_batch(self.frames, clips, self.recipe.places, rng), random)

    def _compute_losses(self, batch: PlaceBatch, random: torch.Generator) -> Tensor:
        recipe, batch = self.recipe, batch.to(self.device)
        levels = draw_shifted_uniform(len(batch.source), recipe.shift, random)
        levels[torch.rand(len(levels), generator=random) < recipe.pure_noise] = 1
        noise = torch.randn(batch.views.shape, generator=random).to(self.device)
        levels = levels.to(self.device)
        noisy = torch.lerp(batch.views, noise, levels[:, None, None, None, None])
        views = Views.around(batch.source, batch.places)
        with self.reduce_precision():
            estimate = self.network(noisy, levels, views.sweep, batch.places)
        errors = measure_errors(views.blend(estimate) - batch.views, recipe)
        if batch.log_distances is not None and recipe.distance:
            found = estimate.log_distance.unflatten(0, (*levels.shape, -1))
            errors = errors + recipe.distance * average_sphere((found - batch.log_distances).abs())
        return errors / levels.clamp_min(recipe.least_level).square()


def measure_errors(difference: Tensor, recipe: PocketRecipe) -> Tensor:
    """Return the errors of colours [B, F, 3, H, W] of each clip."""
    return average_sphere(recipe.squared * difference.square() + recipe.absolute * difference.abs())


def average_sphere(values: Tensor) -> Tensor:
    """Return means [B] of panoramas [B, F, C, H, W], in which pixels count as the area that they cover."""
    height = values.shape[-2]
    areas = torch.cos(torch.pi * ((torch.arange(height, device=values.device) + 0.5) / height - 0.5))
    return (values.mean(dim=(1, 2, 4)) * areas).sum(dim=1) / areas.sum()
