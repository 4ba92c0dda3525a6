# SPDX-License-Identifier: Apache-2.0
"""Generate clips with networks in training, as the world model will: by the generator's own pipeline and sampler."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from copy import deepcopy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from wiw import action
from wiw.errors import ArgumentError
from wiw.training.held_out_clips import Frames, make_control
from wiw.training.post_training.conditioned_generator import ConditionedGenerator
from wiw.training.post_training.trainer import PostTrainer
from wiw.world_models.video.actions.conditioning import ActionConditioning


def create_sampler(trainer: PostTrainer) -> TrainingSampler:
    """Return a sampler with the networks of a trainer.

    Raises:
        ArgumentError: its model does not follow primitives.
    """
    model = trainer.model
    if not isinstance(model, ConditionedGenerator) or model.action_ids is None:
        raise ArgumentError(f"expected a video generator in training to follow primitives, got {type(model).__name__}")
    return TrainingSampler(model, model.action_ids.cpu().numpy(), trainer.use_averages)


class TrainingSampler:
    """Imagine frames with networks in training; see `wiw.training.held_out_clips.Imagine`.

    Training goes on as if nothing had been imagined: weights, modes, random states, the scheduler and where networks
    lie are as before.

    Args:
        model: in training.
        action_ids: int64 [A], the encoder's id of each primitive.
        use_averages: a context in which the networks have their averaged weights.
    """

    def __init__(
        self,
        model: ConditionedGenerator,
        action_ids: NDArray[np.int64],
        use_averages: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._objective, self._generator = model.objective, model.objective.generator
        self._action_ids, self._use_averages = action_ids, use_averages
        self._conditioning = ActionConditioning(model.encoders, model.objective.pipeline, str(model.device))

    def __call__(
        self, images: Frames, plans: NDArray[np.int8], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Return the frames [B, S, H, W, 3] after some numbers of actions of each plan."""
        length = self._generator.frames - 1
        controls = [make_control(plan, length, int(own.max())) for plan, own in zip(plans, wanted, strict=True)]
        clips = []
        with self._use_averages(), self._evaluating(), torch.inference_mode():
            for rows in self._generator.batches(len(images)):
                actions = np.stack([self._action_ids[action.with_null(each.actions)] for each in controls[rows]])
                with self._objective.autocast(), self._conditioning.apply(actions):
                    clips.append(self._generator.make_clips(images[rows], controls[rows], seeds[rows]))
        frames = np.rint(np.concatenate(clips) * 255).astype(np.uint8)
        return frames[np.arange(len(images))[:, None], wanted]

    @contextmanager
    def _evaluating(self) -> Iterator[None]:
        """Put all networks into evaluation mode, on the device, as long as the context lasts."""
        pipeline, device = self._objective.pipeline, self._objective.device
        parts = [each for each in pipeline.components.values() if isinstance(each, nn.Module)]
        networks = [each for each in parts if next(each.parameters(), None) is not None]
        modes = {id(layer): layer.training for network in networks for layer in network.modules()}
        places = [next(network.parameters()).device for network in networks]
        scheduler = pipeline.scheduler
        pipeline.scheduler = deepcopy(scheduler)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            try:
                for network in networks:
                    _move(network.eval(), device)
                yield
            finally:
                pipeline.scheduler = scheduler
                for network, place in zip(networks, places, strict=True):
                    _move(network, place)
                    for layer in network.modules():
                        layer.training = modes[id(layer)]


def _move(network: nn.Module, device: torch.device) -> None:
    """Move a network to a device unless it is there: a sharded one, which always is, is not to be touched."""
    if next(network.parameters()).device.type != device.type:
        network.to(device)
