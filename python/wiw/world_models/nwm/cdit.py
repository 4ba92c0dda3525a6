# SPDX-License-Identifier: Apache-2.0
"""The conditional diffusion transformer of Navigation World Models (Bar et al., CVPR 2025, section 3.2).

Written from the paper's description. Parameters have the names and shapes of the published checkpoints, so those load
strictly: `tests/python/world_models/test_nwm.py` has them spelt out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from diffusers.models.embeddings import get_timestep_embedding
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

FREQUENCIES = 256
"""Sines and cosines that a number is embedded as."""


@dataclass(frozen=True)
class Architecture:
    """Sizes of a CDiT. `latent_side` is the side of the square latents, `context` the number of past frames."""

    depth: int
    width: int
    heads: int
    patch: int = 2
    latent_side: int = 28
    latent_channels: int = 4
    context: int = 4

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> Architecture:
        """Return the architecture whose parameters these are. Heads are those of the published size of that width.

        Raises:
            KeyError: `pos_embed` or `x_embedder.proj.weight` is missing.
        """
        times, patches, width = state["pos_embed"].shape
        _, channels, patch, _ = state["x_embedder.proj.weight"].shape
        depth = len({name.split(".")[1] for name in state if name.startswith("blocks.")})
        heads = {size.width: size.heads for size in SIZES.values()}.get(width, max(1, width // 64))
        return cls(depth, width, heads, patch, round(patches**0.5) * patch, channels, times - 1)


SIZES = {
    "S": Architecture(12, 384, 6),
    "B": Architecture(12, 768, 12),
    "L": Architecture(24, 1024, 16),
    "XL": Architecture(28, 1152, 16),
}
"""The published sizes; the released weights are XL."""


class CDiT(nn.Module):
    """Predicts the noise in the latent of one future frame, and how to interpolate its variance.

    Patches of the noisy latent attend to each other; those of the context are only attended to, so the cost grows
    linearly with the context. Diffusion time, motion and time shift are one vector that modulates every block.
    """

    checkpointing = False
    """Whether training computes the activations of each block again in the backward pass, which takes less memory."""

    def __init__(self, size: Architecture) -> None:
        super().__init__()
        self.size = size
        self.x_embedder = Patches(size)
        self.t_embedder = NumberEmbedder(size.width)
        self.y_embedder = MotionEmbedder(size.width)
        self.time_embedder = NumberEmbedder(size.width)
        patches = (size.latent_side // size.patch) ** 2
        self.pos_embed = nn.Parameter(torch.zeros(size.context + 1, patches, size.width))
        self.blocks = nn.ModuleList(Block(size.width, size.heads) for _ in range(size.depth))
        self.final_layer = FinalLayer(size.width, size.patch**2 * 2 * size.latent_channels)

    def forward(self, noisy: Tensor, time: Tensor, motion: Tensor, context: Tensor, shift: Tensor) -> Tensor:
        """Return noise and variance weights, [B, 2 C, H, W].

        Args:
            noisy: [B, C, H, W], the latent of the future frame at diffusion time `time`.
            time: [B], 0 to 999.
            motion: [B, 3], from the last context frame to the future one; see `motion.py`.
            context: [B, N, C, H, W], latents of the past frames, the latest last.
            shift: [B], how far ahead the future frame lies.
        """
        past = self.size.context
        x = self.x_embedder(noisy) + self.pos_embed[past]
        seen = (self.x_embedder(context.flatten(0, 1)).unflatten(0, context.shape[:2]) + self.pos_embed[:past]).flatten(
            1, 2
        )
        condition = self.t_embedder(time) + self.y_embedder(motion) + self.time_embedder(shift)
        for block in self.blocks:
            if self.checkpointing and self.training:
                x = checkpoint(block, x, seen, condition, use_reentrant=False)
            else:
                x = block(x, seen, condition)
        return self._image(self.final_layer(x, condition))

    def _image(self, x: Tensor) -> Tensor:
        """Return patches [B, rows * columns, patch * patch * channels] put side by side."""
        side, patch = self.size.latent_side // self.size.patch, self.size.patch
        x = x.unflatten(2, (patch, patch, -1)).unflatten(1, (side, side))
        return x.permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)


class Block(nn.Module):
    """adaLN-zero: each branch sees its normalised input shifted and scaled, and is added through a gate."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2, self.norm3, self.norm_cond = (_norm(width) for _ in range(4))
        self.attn = SelfAttention(width, heads)
        self.cttn = nn.MultiheadAttention(width, heads, add_bias_kv=True, batch_first=True)
        self.mlp = FeedForward(width)
        self.adaLN_modulation = _modulation(width, 11)

    def forward(self, x: Tensor, seen: Tensor, condition: Tensor) -> Tensor:
        """Return patches [B, P, D] after self-attention, a look at the context [B, N P, D] and a feed-forward layer."""
        own, past, ask, mlp = self.adaLN_modulation(condition)[:, None].split(
            [size * x.shape[-1] for size in (3, 2, 3, 3)], dim=-1
        )
        shift, scale, gate = own.chunk(3, dim=-1)
        x = x + gate * self.attn(modulate(self.norm1(x), shift, scale))
        past = modulate(self.norm_cond(seen), *past.chunk(2, dim=-1))
        shift, scale, gate = ask.chunk(3, dim=-1)
        x = x + gate * self.cttn(modulate(self.norm2(x), shift, scale), past, past, need_weights=False)[0]
        shift, scale, gate = mlp.chunk(3, dim=-1)
        return x + gate * self.mlp(modulate(self.norm3(x), shift, scale))


class SelfAttention(nn.Module):
    """Multi-head attention with one projection for queries, keys and values."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[B, P, D] -> [B, P, D]."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        return self.proj(functional.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2))


class FeedForward(nn.Module):
    """Two layers, four times as wide in between."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, 4 * width)
        self.fc2 = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """[B, P, D] -> [B, P, D]."""
        return self.fc2(functional.gelu(self.fc1(x), approximate="tanh"))


class FinalLayer(nn.Module):
    """Patches to numbers, modulated like a block."""

    def __init__(self, width: int, out: int) -> None:
        super().__init__()
        self.norm_final = _norm(width)
        self.linear = nn.Linear(width, out)
        self.adaLN_modulation = _modulation(width, 2)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """[B, P, D] -> [B, P, out]."""
        shift, scale = self.adaLN_modulation(condition)[:, None].chunk(2, dim=-1)
        return self.linear(modulate(self.norm_final(x), shift, scale))


class Patches(nn.Module):
    """Latents [B, C, H, W] as patches [B, P, D], row by row."""

    def __init__(self, size: Architecture) -> None:
        super().__init__()
        self.proj = nn.Conv2d(size.latent_channels, size.width, size.patch, size.patch)

    def forward(self, latents: Tensor) -> Tensor:
        """[B, C, H, W] -> [B, P, D]."""
        return self.proj(latents).flatten(2).transpose(1, 2)


class NumberEmbedder(nn.Module):
    """One number a row, as waves of falling frequency and two layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(FREQUENCIES, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, number: Tensor) -> Tensor:
        """[B] -> [B, D]."""
        return self.mlp(get_timestep_embedding(number, FREQUENCIES, flip_sin_to_cos=True, downscale_freq_shift=0))


class MotionEmbedder(nn.Module):
    """Forward, left and turn, each embedded on its own third of the width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        third = width // 3
        self.x_emb = NumberEmbedder(third)
        self.y_emb = NumberEmbedder(third)
        self.angle_emb = NumberEmbedder(width - 2 * third)

    def forward(self, motion: Tensor) -> Tensor:
        """[B, 3] -> [B, D]."""
        x, y, angle = motion.unbind(1)
        return torch.cat([self.x_emb(x), self.y_emb(y), self.angle_emb(angle)], dim=-1)


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """Shift and scale; at zero it is unchanged."""
    return x * (1 + scale) + shift


def _norm(width: int) -> nn.LayerNorm:
    return nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)


def _modulation(width: int, vectors: int) -> nn.Sequential:
    """Return shifts, scales and gates from the condition; zero at first, so that a new block changes nothing."""
    last = nn.Linear(width, vectors * width)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.SiLU(), last)
