# SPDX-License-Identifier: Apache-2.0
"""Generate clips with networks in training, as the world model will: by the generator's own pipeline and sampler."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from wiw import action
from wiw.training.held_out_clips import Frames, make_control
from wiw.training.post_training.trainer import PostTrainer
from wiw.world_models.video.actions.conditioning import ActionConditioning


class TrainingSampler:
    """Imagine frames with the networks of a trainer; see `wiw.training.held_out_clips.Imagine`.

    Training goes on as if nothing had been imagined: modes, random states, the scheduler and where networks lie are as
    before.
    """

    def __init__(self, trainer: PostTrainer) -> None:
        self._trainer, self._generator = trainer, trainer.objective.generator
        self._conditioning = ActionConditioning(
            trainer.encoders, trainer.objective.pipeline, str(trainer.objective.device)
        )

    def __call__(
        self, images: Frames, plans: NDArray[np.int8], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Return the frames [B, S, H, W, 3] after some numbers of actions of each plan."""
        length = self._generator.frames - 1
        controls = [make_control(plan, length, int(own.max())) for plan, own in zip(plans, wanted, strict=True)]
        clips = []
        with self._evaluating(), torch.inference_mode():
            for rows in self._generator.batches(len(images)):
                actions = np.stack(
                    [self._trainer.action_ids[action.with_null(each.actions)] for each in controls[rows]]
                )
                with self._trainer.objective.autocast(), self._conditioning.apply(actions):
                    clips.append(self._generator.make_clips(images[rows], controls[rows], seeds[rows]))
        frames = np.rint(np.concatenate(clips) * 255).astype(np.uint8)
        return frames[np.arange(len(images))[:, None], wanted]

    @contextmanager
    def _evaluating(self) -> Iterator[None]:
        """Put all networks into evaluation mode, on the device, as long as the context lasts."""
        pipeline, device = self._trainer.objective.pipeline, self._trainer.objective.device
        parts = [each for each in pipeline.components.values() if isinstance(each, nn.Module)]
        networks = [each for each in parts if next(each.parameters(), None) is not None]
        modes = {id(layer): layer.training for network in networks for layer in network.modules()}
        places = [next(network.parameters()).device for network in networks]
        scheduler = pipeline.scheduler
        pipeline.scheduler = deepcopy(scheduler)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            try:
                for network in networks:
                    network.eval().to(device)
                yield
            finally:
                pipeline.scheduler = scheduler
                for network, place in zip(networks, places, strict=True):
                    network.to(place)
                    for layer in network.modules():
                        layer.training = modes[id(layer)]
