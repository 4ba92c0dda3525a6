# SPDX-License-Identifier: Apache-2.0
"""Navigation World Models (Bar et al., CVPR 2025): a diffusion transformer steered by camera motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.networks import memory_guard, resolve_device
from wiw.types import Conditioning, Control
from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.nwm.context import context_images
from wiw.world_models.nwm.motion import SHIFT, motions
from wiw.world_models.video.loading import versions
from wiw.world_models.video.model import require_no_nan

if TYPE_CHECKING:
    from torch import Tensor

    from wiw.world_models.nwm.cdit import CDiT

HUB = "facebook/nwm"


@dataclass(kw_only=True, eq=False)
class NWM(WorldModel):
    """Navigation World Models: frame by frame, each from the last four and the motion to it (Bar et al. 2025).

    It sees the middle of the front view in 4:3; the rest of its frames is black. The first context is taken from
    `observations.history` at the spacing of its own frames (`context.py`); without one it is the observation repeated.
    Each row has a generator of its own, seeded with the row's seed.

    Args:
        weights: a checkpoint (`.pth.tar` with the key "ema", or `.safetensors`), its folder, or a hub repository.
        file: name of the checkpoint in the folder or repository.
        revision: branch, tag or commit of the repository.
        vae: folder or hub repository of the image codec (`AutoencoderKL`); by default the folder `vae` beside
            the checkpoint, if there is one, else stabilityai/sd-vae-ft-ema.
        vae_revision: branch, tag or commit of that.
        device: of torch; "cuda" if there is one, else "cpu".
        precision: of the computation; bfloat16 on a GPU, float32 on the CPU. Weights stay float32.
        steps: of diffusion, for each frame.
        spacing: metres between waypoints of the training data that is likest to the agent's world: 0.25 recon, 0.38
            scand, 0.72 tartan drive, 0.255 sacson, 0.12 go stanford.
        rollout_convention: steer as the published rollout script does, instead of as in training; see `motion.py`.
        batch: rows in one call.

    Raises:
        DependencyError: torch or diffusers is not installed.
        WeightsError: the weights cannot be had or are another model's; says what to do.
        DeviceMemoryError: they do not fit on the GPU.
        ArgumentError: an option out of range, or a device that torch does not have.
    """

    accepts = accepts(
        control="trajectory", view="perspective", size=(480, 480), cacheable=True, needs=("history",), history=4
    )
    version = "1"
    immaterial = ("weights", "file", "revision", "vae", "vae_revision", "batch")
    requires = Requirements(("torch", "diffusers", "safetensors"), "diffusers", HUB, gpu=True)

    weights: str = HUB
    file: str = "0100000.pth.tar"
    revision: str | None = None
    vae: str | None = None
    vae_revision: str | None = None
    device: str | None = None
    precision: Literal["float32", "bfloat16", "float16"] | None = None
    steps: int = 250
    spacing: float = 0.25
    rollout_convention: bool = False
    batch: int = 8

    def __post_init__(self) -> None:
        if not 2 <= self.steps <= 1000 or not self.spacing > 0 or self.batch < 1:
            raise ArgumentError(
                f"NWM: expected 2 to 1000 steps, a spacing above 0 and a batch of at least 1, got steps={self.steps}, "
                f"spacing={self.spacing}, batch={self.batch}"
            )
        if self.precision not in (None, "float32", "bfloat16", "float16"):
            raise ArgumentError(f"NWM: precision is '{self.precision}', expected float32, bfloat16 or float16")
        self.accepts = replace(type(self).accepts, best_batch=self.batch)
        self.requires.require()
        self.device = resolve_device(self.device)
        self.precision = self.precision or ("float32" if self.device == "cpu" else "bfloat16")
        import torch

        self._place = torch.device(self.device)
        with memory_guard("NWM", "its weights take about 4.5 GB; stop other programs that use the GPU"):
            self._network, self._codec = self._load_networks()
        self.accepts = replace(self.accepts, history=self._network.size.context)
        self._side = self._network.size.latent_side * 2 ** (len(self._codec.config.block_out_channels) - 1)

    @classmethod
    def with_networks(cls, network: CDiT, codec: Any, **options: Any) -> NWM:
        """Make the model of a network and a codec that lie on the device, instead of those in a folder.

        A pickle of it does not have these networks.
        """
        model = cls.__new__(cls)
        model._load_networks = lambda: (network, codec)  # type: ignore[method-assign]
        cls.__init__(model, **options)
        return model

    def _load_networks(self) -> tuple[CDiT, Any]:
        """Return the network and the codec, on the device."""
        from wiw.world_models.nwm import weights

        path = weights.fetch(self.weights, self.file, self.revision)
        codec = weights.load_codec(self.vae or weights.codec_beside(path), self.vae_revision)
        return weights.load_cdit(path).to(self._place), codec.to(self._place)

    def describe(self) -> dict[str, Any]:
        """Return options, what tells the weights from others, and the versions of libraries."""
        from wiw.world_models.nwm.weights import digest

        return {**super().describe(), "digest": digest(self._network, self._codec), **versions()}

    def identity(self) -> dict[str, Any]:
        """Return options, weights and versions; which GPU it is does not count."""
        return {**super().identity(), "device": self._place.type}

    def __reduce__(self) -> Any:
        """Pickle as options: another process loads the weights itself."""
        return partial(type(self), **{field.name: getattr(self, field.name) for field in fields(self)}), ()

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Imagine frames one by one; frames of padding are left black.

        Raises:
            DeviceMemoryError: the GPU's memory is full.
            ContractError: the networks gave NaN.
        """
        import torch

        steps = np.stack([motions(c.trajectory, self.spacing, self.rollout_convention) for c in controls])
        with (
            torch.inference_mode(),
            self._use_precision(),
            memory_guard(f"NWM with batch={self.batch}", "lower batch"),
        ):
            motion = torch.from_numpy(steps).float().to(self._place)
            return self._roll_out(observations, motion, np.array([c.length for c in controls]), seeds)

    def _use_precision(self) -> Any:
        """Compute products in the lower precision, if there is one."""
        import torch

        dtype = getattr(torch, str(self.precision))
        return torch.autocast(self._place.type, dtype, enabled=dtype != torch.float32)

    def _roll_out(
        self, observations: Conditioning, motion: Tensor, lengths: NDArray[Any], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        import torch

        from wiw.world_models.nwm.images import to_frames

        image = observations.image
        frames = np.zeros((len(image), 1 + motion.shape[1], *image.shape[1:]), np.uint8)
        frames[:, 0] = image
        generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
        context = self._first_context(observations)
        for k in range(max(lengths)):
            rows = np.flatnonzero(lengths > k)
            pixels = self._next(context[rows], motion[rows, k], [generators[row] for row in rows])
            frames[rows, k + 1] = to_frames(pixels, *image.shape[1:3])
            context[rows] = torch.cat([context[rows, 1:], self._encode(pixels)[:, None]], dim=1)
        return frames

    def _first_context(self, observations: Conditioning) -> Tensor:
        """Return latents [B, N, C, h, w] of what was observed before and now."""
        from wiw.world_models.nwm.images import to_network

        count = self._network.size.context
        if observations.history is None:
            images = np.repeat(observations.image[:, None], count, axis=1)
        else:
            images = context_images(observations.history, count)
        images = images.reshape(-1, *images.shape[2:])
        return self._encode(to_network(images, self._side).to(self._place)).unflatten(0, (-1, count))

    def _next(self, context: Tensor, motion: Tensor, generators: list[Any]) -> Tensor:
        """Return the frame that a motion leads to, pixels [B, 3, side, side] in [-1, 1]."""
        from wiw.world_models.nwm.diffusion import sample

        shift = motion.new_full((len(motion),), SHIFT)
        latents = sample(
            lambda noisy, time: self._network(noisy, time, motion, context, shift),
            (len(motion), *context.shape[2:]),
            generators,
            self.steps,
            self._place,
        )
        pixels = self._codec.decode(latents / self._codec.config.scaling_factor).sample
        require_no_nan(bool(pixels.isnan().any()), type(self).__name__, self.precision)
        return pixels.clamp(-1, 1)

    def _encode(self, pixels: Tensor) -> Tensor:
        """Return latents [B, C, h, w]: the codec's mean."""
        return self._codec.encode(pixels).latent_dist.mode().float() * self._codec.config.scaling_factor
