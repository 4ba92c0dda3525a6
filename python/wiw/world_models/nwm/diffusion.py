# SPDX-License-Identifier: Apache-2.0
"""Sampling as NWM was trained: DDPM on 1000 linear betas, respaced, its variance learned between two bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.utils.torch_utils import randn_tensor
from torch import Generator, Tensor

TIMES = 1000
"""Diffusion times of the training."""


def scheduler(steps: int) -> DDPMScheduler:
    """Return the chain of `steps` out of `TIMES` diffusion times, the first and the last among them."""
    chain = DDPMScheduler(
        num_train_timesteps=TIMES,
        beta_start=1e-4,
        beta_end=0.02,
        beta_schedule="linear",
        variance_type="learned_range",
        clip_sample=False,
        timestep_spacing="linspace",
    )
    chain.set_timesteps(steps)
    return chain


def sample(
    predict: Callable[[Tensor, Tensor], Tensor],
    shape: Sequence[int],
    generators: Sequence[Generator],
    steps: int,
    device: torch.device,
) -> Tensor:
    """Draw latents [B, C, H, W], each row from its own generator, so that it does not depend on the others.

    `predict` takes noisy latents and diffusion times [B] and gives noise and variance weights [B, 2 C, H, W].
    """
    chain = scheduler(steps)
    own: Any = list(generators)
    latents = randn_tensor(tuple(shape), generator=own, device=device)
    for time in chain.timesteps:
        output = predict(latents, time.to(device).expand(shape[0]))
        latents = chain.step(output.float(), time, latents, generator=own, return_dict=False)[0]
    return latents
