# SPDX-License-Identifier: Apache-2.0
"""A video generator that was trained to follow actions, as a world model."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from wiw.errors import WeightsError
from wiw.types import GRIPPER_POSES, Conditioning, Control
from wiw.world_models.base import WorldModel, accepts
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.loading import model_memory_guard
from wiw.world_models.video.model import VideoModel
from wiw.world_models.video.weights import digest_folder

if TYPE_CHECKING:
    from wiw.world_models.video.actions.conditioning import ActionConditioning

PANORAMA = (576, 1024)
POSES = {"space": GRIPPER_POSES, "view": "perspective", "null_first": False}
"""How the inputs of a model of poses differ from those of a model of primitives."""


class ActionConditioned(WorldModel):
    """Steer a video generator by actions, with what a checkpoint of post-training has.

    It holds the `generator`, in which the trained denoisers or their LoRA are put, and the `conditioning`, which gives
    them each frame's action. Primitives lead through panoramas; poses of a gripper are seen in the front view. Frame k
    of a clip is what follows action k.

    Args:
        checkpoint: folder with the action encoder and the trained denoiser; see `checkpoint.py`.
        weights: of the generator; by default those that the checkpoint names.
        size: (height, width) of input and output; by default 576x1024 for primitives, `front_size` for poses.
        options: the generator's others, with the `defaults` of the subclass.

    Raises:
        TypeError: an option that the generator does not have.
        WeightsError: the checkpoint cannot be loaded, or belongs to another generator; see also `VideoModel`.
    """

    accepts = accepts(control="action", null_first=True, cacheable=True)
    version = "1"
    immaterial = (*VideoModel.immaterial, "checkpoint")
    generator_class: ClassVar[type[VideoModel]]
    """The generator that was trained."""
    base: ClassVar[str]
    """Its name as registered."""
    denoisers: ClassVar[tuple[str, ...]] = ("transformer",)
    """Their places in the pipeline."""
    front_size: ClassVar[tuple[int, int]] = (480, 480)
    """(height, width) of the views in which poses are seen, unless the user says otherwise."""
    defaults: ClassVar[Mapping[str, Any]] = {"guidance": 1.0}
    """Defaults of the generator's options where they differ from its own; the length of a clip is that of `accepts`."""
    __signature__: ClassVar[inspect.Signature]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.__signature__ = _extend_signature(cls)

    def __init__(self, **options: Any) -> None:
        bound = inspect.signature(type(self)).bind(**options)
        bound.apply_defaults()
        options = bound.arguments
        self.checkpoint = str(options.pop("checkpoint"))
        self._folder = Path(self.checkpoint).expanduser()
        self._config = self._load_config()
        discrete = self._config.kind == "discrete"
        options["size"] = options["size"] or (PANORAMA if discrete else self.front_size)
        if not options["weights"]:
            options["weights"] = self._config.weights
            options["revision"] = options["revision"] or self._config.revision
        self.requires.require()
        import diffusers

        from wiw.world_models.video.actions.checkpoint import has_lora

        pipeline = getattr(diffusers, self.generator_class.pipeline_class)
        self._lora = has_lora(self._folder, self.denoisers, pipeline)
        self.generator = self.generator_class.with_networks(self._load_denoisers, **options)
        control = {"vocabulary": self._config.ids} if discrete else POSES
        clip = self.generator.accepts
        dimensions = {"size": clip.size, "frames": clip.frames, "best_batch": clip.best_batch}
        self.accepts = replace(type(self).accepts, **dimensions, **control)  # type: ignore[arg-type]
        with model_memory_guard(self.generator):
            self.conditioning = self._condition_denoisers()

    def _load_config(self) -> ActionConfig:
        config, stride = ActionConfig.load(self._folder), self.generator_class.stride
        if config.base != self.base or config.stride != stride:
            raise WeightsError(
                f"{self._folder} was trained for {config.base} with {config.stride} frames per latent, but this is "
                f"{self.base} with {stride}; use the world model {config.base}-action",
                "unfit",
            )
        return config

    def _load_denoisers(self, generator: VideoModel) -> dict[str, Any]:
        """Return the trained denoisers, unless the checkpoint has a LoRA of them."""
        import torch

        from wiw.world_models.video.actions.checkpoint import load_denoisers

        if self._lora:
            return {}
        return load_denoisers(self._folder, self.denoisers, getattr(torch, str(generator.precision)))

    def _condition_denoisers(self) -> ActionConditioning:
        """Put the LoRA, if there is one, and the encoders into the generator's pipeline."""
        from wiw.world_models.video.actions.checkpoint import load_encoders, load_lora
        from wiw.world_models.video.actions.conditioning import ActionConditioning
        from wiw.world_models.video.actions.injection import embedding_width

        pipeline = self.generator.pipeline
        if self._lora:
            load_lora(self._folder, self.denoisers, pipeline)
        encoders = load_encoders(self._folder, self._config, self.denoisers)
        for place in self.denoisers:
            width = embedding_width(getattr(pipeline, place))
            if width != self._config.width:
                raise WeightsError(
                    f"{self._folder} was trained on a denoiser of width {self._config.width}, but that of "
                    f"{self.generator.weights} has {width}",
                    "unfit",
                )
        return ActionConditioning(encoders, pipeline, self.generator.device)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return one clip per row, `batch` rows at a time, the denoisers conditioned on each frame's action.

        Raises:
            DeviceMemoryError: the GPU's memory is full.
            ContractError: the networks gave NaN or another number of frames.
        """
        frames = np.empty((len(controls), self.accepts.frames, *observations.image.shape[1:]), np.uint8)
        for rows in self.generator.batches(len(controls)):
            actions = np.stack([np.asarray(control.ids) for control in controls[rows]])
            with model_memory_guard(self.generator), self.conditioning.apply(actions):
                clips = self.generator.make_clips(observations.image[rows], controls[rows], seeds[rows])
            frames[rows] = np.rint(clips * 255)
        frames[:, 0] = observations.image
        return frames

    def describe(self) -> dict[str, Any]:
        """Return the generator's options, and what identifies its weights and the checkpoint."""
        return {
            **self.generator.describe(),
            **super().describe(),
            "checkpoint_digest": digest_folder(self._folder),
        }

    def identity(self) -> dict[str, Any]:
        """Return options, checkpoint, weights and versions; which GPU it is does not count."""
        generator = {"device": self.generator.identity()["device"], "generator_version": self.generator.version}
        return {**super().identity(), **generator}

    def __reduce__(self) -> Any:
        """Pickle the options: another process loads the weights itself."""
        own = inspect.signature(type(self)).parameters
        options = {name: value for name, value in self.generator.options.items() if name in own}
        return partial(type(self), checkpoint=self.checkpoint, **options), ()


def _extend_signature(cls: type[ActionConditioned]) -> inspect.Signature:
    """Return the generator's signature with the defaults of an action-conditioned model, and its checkpoint."""
    signature = inspect.signature(cls.generator_class)
    defaults = {"weights": "", "size": None, "frames": cls.accepts.frames, **cls.defaults}
    options = [
        option.replace(default=defaults.get(name, option.default))
        for name, option in signature.parameters.items()
        if name not in cls.generator_class.wording_options
    ]
    checkpoint = inspect.Parameter("checkpoint", inspect.Parameter.KEYWORD_ONLY, annotation="str")
    return signature.replace(parameters=[checkpoint, *options])
