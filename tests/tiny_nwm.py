# SPDX-License-Identifier: Apache-2.0
"""NWM with a few thousand random weights, saved as its trainer does."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import torch
from diffusers import AutoencoderKL

from wiw.world_models.nwm.cdit import Architecture, CDiT

TINY = Architecture(depth=2, width=24, heads=1, latent_side=8)


def randomised(network: torch.nn.Module) -> torch.nn.Module:
    """Weights that leave nothing at zero."""
    generator = torch.Generator().manual_seed(0)
    for parameter in network.parameters():
        parameter.data = 0.2 * torch.randn(parameter.shape, generator=generator)
    return network.eval().requires_grad_(False)


class TinyNWM:
    """A training checkpoint and the codec beside it."""

    def save_pretrained(self, folder: Path) -> None:
        codec = AutoencoderKL(
            down_block_types=("DownEncoderBlock2D",) * 2,
            up_block_types=("UpDecoderBlock2D",) * 2,
            block_out_channels=(8, 8),
            norm_num_groups=4,
            sample_size=16,
        )
        codec.save_pretrained(folder / "vae")
        state = randomised(CDiT(TINY)).state_dict()
        torch.save({"ema": state, "model": {}, "args": Namespace(config="x"), "epoch": 1}, folder / "0100000.pth.tar")
