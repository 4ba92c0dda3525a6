# SPDX-License-Identifier: Apache-2.0
"""Adds vectors to a denoiser's time embedding, frame by frame, through hooks on diffusers' own modules.

Denoisers stay as they are: without vectors the hooks do nothing, and `remove` takes them away.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import Tensor

from wiw.errors import ArgumentError


class Injection:
    """Hooks on one denoiser.

    Raises:
        ArgumentError: a denoiser of another class than those in `HOOKS`.
    """

    def __init__(self, denoiser: Any) -> None:
        kind = type(denoiser).__name__
        if kind not in HOOKS:
            raise ArgumentError(f"no way is known to tell a {kind} of actions; known: {', '.join(HOOKS)}")
        self._vectors: Tensor | None = None
        self._handles: Sequence[Any] = HOOKS[kind](denoiser, self)

    @contextmanager
    def telling(self, vectors: Tensor) -> Iterator[None]:
        """While this lasts, the denoiser is told `vectors` [B, L, D]: of each row and latent frame."""
        self._vectors = vectors
        try:
            yield
        finally:
            self._vectors = None

    def remove(self) -> None:
        """Takes the hooks away; the denoiser is what it was."""
        for handle in self._handles:
            handle.remove()
        self._handles = ()

    @property
    def silent(self) -> bool:
        """Whether there is nothing to tell."""
        return self._vectors is None

    def at(self, rows: int, places: int, like: Tensor) -> Tensor:
        """The vectors for `rows` rows with `places` places in time and space each: [rows, places, D].

        Guidance stacks its passes, [B, B, ...], so the vectors are repeated; places of one latent frame lie together.

        Raises:
            ArgumentError: rows or places that are no multiple of the vectors'.
        """
        assert self._vectors is not None
        batch, frames = self._vectors.shape[:2]
        if rows % batch or places % frames:
            raise ArgumentError(
                f"actions for {batch} rows of {frames} latent frames do not fit a call with {rows} rows of {places} "
                "places; give one action a frame, and a clip of the model's own frames"
            )
        spread = self._vectors.to(like).repeat(rows // batch, 1, 1)
        return spread.repeat_interleave(places // frames, dim=1)


def svd(denoiser: Any, injection: Injection) -> list[Any]:
    """Every block is handed the time embedding, [B F, D]."""

    def told(_: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        if injection.silent:
            return None
        time, video = kwargs["temb"], kwargs["image_only_indicator"]
        return args, {**kwargs, "temb": time + injection.at(video.shape[0], video.shape[1], time).flatten(0, 1)}

    blocks = [*denoiser.down_blocks, denoiser.mid_block, *denoiser.up_blocks]
    return [block.register_forward_pre_hook(told, with_kwargs=True) for block in blocks]


def wan(denoiser: Any, injection: Injection) -> list[Any]:
    """The time is given to each token, as Wan 2.2 5B has it, and its embedding and projection are made of both."""

    def each_token(_: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        time = kwargs["timestep"]
        if injection.silent or time.ndim == 2:
            return None
        video = kwargs["hidden_states"].shape[2:]
        tokens = 1
        for side, patch in zip(video, denoiser.config.patch_size, strict=True):
            tokens *= side // patch
        return args, {**kwargs, "timestep": time[:, None].expand(-1, tokens)}

    def told(embedder: Any, _: Any, output: tuple[Any, ...]) -> Any:
        if injection.silent:
            return None
        rows, tokens = output[0].shape[:2]
        time = output[0] + injection.at(rows, tokens, output[0])
        return time, embedder.time_proj(embedder.act_fn(time)), *output[2:]

    return [
        denoiser.register_forward_pre_hook(each_token, with_kwargs=True),
        denoiser.condition_embedder.register_forward_hook(told),
    ]


def ltx(denoiser: Any, injection: Injection) -> list[Any]:
    """The time is embedded token by token, [B P, D], and projected for the blocks."""

    def told(embedder: Any, _: Any, kwargs: dict[str, Any], output: tuple[Any, ...]) -> Any:
        if injection.silent:
            return None
        rows = kwargs["batch_size"]
        time = output[1] + injection.at(rows, len(output[1]) // rows, output[1]).flatten(0, 1)
        return embedder.linear(embedder.silu(time)), time

    return [denoiser.time_embed.register_forward_hook(told, with_kwargs=True)]


def cosmos(denoiser: Any, injection: Injection) -> list[Any]:
    """The time is embedded for each latent frame, [B T, D]; the low-rank part of the modulation stays."""

    def told(_: Any, args: tuple[Any, ...], output: tuple[Any, ...]) -> Any:
        if injection.silent:
            return None
        rows = len(args[0])
        time = output[1] + injection.at(rows, len(output[1]) // rows, output[1]).flatten(0, 1)
        return output[0], time

    return [denoiser.time_embed.register_forward_hook(told)]


HOOKS: dict[str, Callable[[Any, Injection], list[Any]]] = {
    "UNetSpatioTemporalConditionModel": svd,
    "WanTransformer3DModel": wan,
    "LTXVideoTransformer3DModel": ltx,
    "CosmosTransformer3DModel": cosmos,
}
"""Denoiser classes of diffusers that can be told."""


def width_of(denoiser: Any) -> int:
    """Width of the time embedding that vectors are added to."""
    config = denoiser.config
    if type(denoiser).__name__ == "UNetSpatioTemporalConditionModel":
        return int(4 * config.block_out_channels[0])
    return int(config.num_attention_heads * config.attention_head_dim)
