# SPDX-License-Identifier: Apache-2.0
"""Imagine with networks in training, as the world model will, so that training does not notice."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from wiw.training.held_out_clips import Frames
from wiw.training.post_training.trainable import TrainableModel
from wiw.training.post_training.trainer import PostTrainer
from wiw.types import Conditioning


def create_sampler(trainer: PostTrainer) -> TrainingSampler:
    """Return a sampler with the networks of a trainer."""
    return TrainingSampler(trainer.model, trainer.use_averages)


class TrainingSampler:
    """Imagine frames with networks in training; see `wiw.training.held_out_clips.Imagine`.

    Training continues as if nothing had been imagined: weights, modes, random states and where networks lie are as
    before.

    Args:
        model: in training.
        use_averages: a context in which the networks have their averaged weights.
    """

    def __init__(self, model: TrainableModel, use_averages: Callable[[], AbstractContextManager[None]]) -> None:
        self._model, self._use_averages = model, use_averages

    def __call__(
        self, observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Return the frames [B, S, H, W, 3] after some numbers of actions of each plan."""
        with self._use_averages(), self._evaluating(), torch.inference_mode():
            return self._model.imagine(observations, plans, seeds, wanted)

    @contextmanager
    def _evaluating(self) -> Iterator[None]:
        """Put all networks into evaluation mode, on the device, as long as the context lasts."""
        networks, device = self._model.list_networks(), self._model.device
        modes = {id(layer): layer.training for network in networks for layer in network.modules()}
        places = [next(network.parameters()).device for network in networks]
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            try:
                for network in networks:
                    _move(network.eval(), device)
                yield
            finally:
                for network, place in zip(networks, places, strict=True):
                    _move(network, place)
                    for layer in network.modules():
                        layer.training = modes[id(layer)]


def _move(network: nn.Module, device: torch.device) -> None:
    """Move a network to a device unless it is there: a sharded one, which always is, is not to be touched."""
    if next(network.parameters()).device.type != device.type:
        network.to(device)
