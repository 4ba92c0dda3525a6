# SPDX-License-Identifier: Apache-2.0
"""Add vectors to a denoiser's time embedding, frame by frame, through hooks on diffusers' own modules.

Denoisers stay as they are: without vectors the hooks do nothing, and `remove` takes them away.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from wiw.errors import ArgumentError


class Injection:
    """Hook into one denoiser.

    Raises:
        ArgumentError: a denoiser of another class than those in `HOOKS`.
    """

    def __init__(self, denoiser: Any) -> None:
        kind = type(denoiser).__name__
        if kind not in HOOKS:
            raise ArgumentError(f"a {kind} cannot be conditioned on actions; expected one of {', '.join(HOOKS)}")
        self._vectors: Tensor | None = None
        self._handles: Sequence[Any] = HOOKS[kind](denoiser, self)

    @contextmanager
    def inject(self, vectors: Tensor) -> Iterator[None]:
        """Add `vectors` [B, L, D], one per row and latent frame, as long as the context lasts."""
        self._vectors = vectors
        try:
            yield
        finally:
            self._vectors = None

    def remove(self) -> None:
        """Take the hooks away; the denoiser is unchanged."""
        for handle in self._handles:
            handle.remove()
        self._handles = ()

    @property
    def idle(self) -> bool:
        """Whether there is nothing to add."""
        return self._vectors is None

    def spread(self, rows: int, places: int, like: Tensor) -> Tensor:
        """Return the vectors for `rows` rows with `places` places in time and space each: [rows, places, D].

        Guidance stacks its passes, [B, B, ...], so the vectors are repeated; places of one latent frame lie together.

        Raises:
            ArgumentError: rows or places that are not a multiple of the vectors'.
        """
        assert self._vectors is not None
        batch, frames = self._vectors.shape[:2]
        if rows % batch or places % frames:
            raise ArgumentError(
                f"actions for {batch} rows of {frames} latent frames do not fit a call with {rows} rows of {places} "
                "places; give one action per frame, and a clip of the model's own frames"
            )
        repeated = self._vectors.to(like).repeat(rows // batch, 1, 1)
        return repeated.repeat_interleave(places // frames, dim=1)


def hook_svd(denoiser: Any, injection: Injection) -> list[Any]:
    """Add to the time embedding that every block is given, [B F, D]."""

    def add_actions(_: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if injection.idle:
            return None
        time, video = kwargs["temb"], kwargs["image_only_indicator"]
        return args, {**kwargs, "temb": time + injection.spread(video.shape[0], video.shape[1], time).flatten(0, 1)}

    blocks = [*denoiser.down_blocks, denoiser.mid_block, *denoiser.up_blocks]
    return [block.register_forward_pre_hook(add_actions, with_kwargs=True) for block in blocks]


def hook_wan(denoiser: Any, injection: Injection) -> list[Any]:
    """Embed the time for each token, as Wan 2.2 5B has it, and make embedding and projection of both."""

    def repeat_time(_: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        time = kwargs["timestep"]
        if injection.idle or time.ndim == 2:
            return None
        video = kwargs["hidden_states"].shape[2:]
        tokens = 1
        for side, patch in zip(video, denoiser.config.patch_size, strict=True):
            tokens *= side // patch
        return args, {**kwargs, "timestep": time[:, None].expand(-1, tokens)}

    def add_actions(embedder: Any, _: Any, output: tuple[Any, ...]) -> Any:
        if injection.idle:
            return None
        rows, tokens = output[0].shape[:2]
        time = output[0] + injection.spread(rows, tokens, output[0])
        return time, embedder.time_proj(embedder.act_fn(time)), *output[2:]

    return [
        denoiser.register_forward_pre_hook(repeat_time, with_kwargs=True),
        denoiser.condition_embedder.register_forward_hook(add_actions),
    ]


def hook_ltx(denoiser: Any, injection: Injection) -> list[Any]:
    """Add to the time's embedding, token by token, [B P, D], before it is projected for the blocks."""

    def add_actions(embedder: Any, _: Any, kwargs: dict[str, Any], output: tuple[Any, ...]) -> Any:
        if injection.idle:
            return None
        rows = kwargs["batch_size"]
        time = output[1] + injection.spread(rows, len(output[1]) // rows, output[1]).flatten(0, 1)
        return embedder.linear(embedder.silu(time)), time

    return [denoiser.time_embed.register_forward_hook(add_actions, with_kwargs=True)]


def hook_cosmos(denoiser: Any, injection: Injection) -> list[Any]:
    """Add to the time's embedding of each latent frame, [B T, D]; the low-rank part of the modulation stays."""

    def add_actions(_: Any, args: tuple[Any, ...], output: tuple[Any, ...]) -> Any:
        if injection.idle:
            return None
        rows = len(args[0])
        time = output[1] + injection.spread(rows, len(output[1]) // rows, output[1]).flatten(0, 1)
        return output[0], time

    return [denoiser.time_embed.register_forward_hook(add_actions)]


HOOKS: dict[str, Callable[[Any, Injection], list[Any]]] = {
    "UNetSpatioTemporalConditionModel": hook_svd,
    "WanTransformer3DModel": hook_wan,
    "LTXVideoTransformer3DModel": hook_ltx,
    "CosmosTransformer3DModel": hook_cosmos,
}
"""Denoiser classes of diffusers that can be conditioned."""


def embedding_width(denoiser: Any) -> int:
    """Return the width of the time embedding that vectors are added to."""
    config = denoiser.config
    if type(denoiser).__name__ == "UNetSpatioTemporalConditionModel":
        return int(4 * config.block_out_channels[0])
    return int(config.num_attention_heads * config.attention_head_dim)
