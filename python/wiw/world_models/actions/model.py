# SPDX-License-Identifier: Apache-2.0
"""A video generator that was trained to follow actions, as a world model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from wiw.errors import WeightsError
from wiw.types import Control
from wiw.world_models import devices
from wiw.world_models.actions.config import ActionConfig
from wiw.world_models.video import Clips, VideoModel
from wiw.world_models.video.loading import memory_guard
from wiw.world_models.video.weights import digest

if TYPE_CHECKING:
    Base = VideoModel
else:
    Base = object


PANORAMA = (576, 1024)


@dataclass(kw_only=True, eq=False)
class FollowsActions(Base):
    """Makes a `VideoModel` follow actions: put it in front of one as a base class.

    Primitives lead through panoramas; poses of a gripper are seen in the front view, 480x480 (SVD: 448x448) as in the
    paper unless `size` says otherwise.

    Args:
        checkpoint: folder with the action encoder and the trained denoiser; see `checkpoint.py`.
        weights: of the model that was trained; by default those that the checkpoint names.
    """

    base: ClassVar[str]
    """The world model that was trained, as registered."""
    denoisers: ClassVar[tuple[str, ...]] = ("transformer",)
    """Their places in the pipeline."""
    every_frame: ClassVar[bool] = True
    front: ClassVar[tuple[int, int]] = (480, 480)
    """Size of the views in which poses are seen."""
    immaterial = (*VideoModel.immaterial, "checkpoint")

    checkpoint: str
    weights: str = ""

    def __post_init__(self) -> None:
        self.checkpoint = str(self.checkpoint)
        self._folder = Path(self.checkpoint).expanduser()
        self._actions = self._config()
        if self._actions.kind == "pose7" and self.size is PANORAMA:  # nobody has said another
            self.size = self.front
        if not self.weights:
            self.weights, self.revision = self._actions.weights, self.revision or self._actions.revision
        devices.require(self.requires)
        import diffusers

        from wiw.world_models.actions import checkpoint

        self._lora = checkpoint.has_lora(self._folder, self.denoisers, getattr(diffusers, self.pipeline))
        super().__post_init__()
        discrete = self._actions.kind == "discrete"
        declared = {"vocabulary": self._actions.ids} if discrete else {"space": "pose7", "null_first": False}
        self.accepts = replace(self.accepts, **declared, view=self.accepts.view if discrete else "perspective")
        with memory_guard(self):
            if self._lora:
                checkpoint.load_lora(self._folder, self.denoisers, self._pipeline)
            self._attach()

    def _config(self) -> ActionConfig:
        config = ActionConfig.load(self._folder)
        if config.base != self.base or config.stride != self.stride:
            raise WeightsError(
                f"{self._folder} was trained for {config.base} with {config.stride} frames a latent, but this is "
                f"{self.base} with {self.stride}; use the world model {config.base}-action",
                "unfit",
            )
        return config

    def _attach(self) -> None:
        """Encoders on the denoisers' device, and hooks that tell the denoisers what they say."""
        from wiw.world_models.actions.checkpoint import load_encoders
        from wiw.world_models.actions.injection import Injection, width_of

        self._encoders = load_encoders(self._folder, self._actions, self.denoisers)
        self._injections = {place: Injection(getattr(self._pipeline, place)) for place in self.denoisers}
        for place, encoder in self._encoders.items():
            width = width_of(getattr(self._pipeline, place))
            if width != self._actions.width:
                raise WeightsError(
                    f"{self._folder} was trained on a denoiser of width {self._actions.width}, but that of "
                    f"{self.weights} has {width}",
                    "unfit",
                )
            encoder.to(self.device)

    def components(self) -> dict[str, Any]:
        """The trained denoisers, where they are kept whole."""
        import torch

        from wiw.world_models.actions.checkpoint import load_denoisers

        rest = super().components()
        if self._lora:
            return rest
        return {**rest, **load_denoisers(self._folder, self.denoisers, getattr(torch, str(self.precision)))}

    def generate(self, images: Sequence[Any], controls: Sequence[Control], generators: Sequence[Any]) -> Clips:
        """Clips of these rows, the denoisers told of each frame's action."""
        import torch

        actions = torch.from_numpy(np.stack([np.asarray(control.ids) for control in controls])).to(self.device)
        with ExitStack() as stack, torch.inference_mode():
            for place, encoder in self._encoders.items():
                stack.enter_context(self._injections[place].telling(encoder(actions)))
            return super().generate(images, controls, generators)

    def describe(self) -> dict[str, Any]:
        """Options, and what identifies the weights and the checkpoint."""
        return {**super().describe(), "checkpoint_digest": digest(self._folder)}
