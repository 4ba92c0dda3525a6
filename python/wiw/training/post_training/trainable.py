# SPDX-License-Identifier: Apache-2.0
"""A model as the trainer sees it: what is trained of it, its loss, and how it is written."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from wiw.training.held_out_clips import Frames, HeldOutClips
from wiw.training.post_training.clips import ClipBatch
from wiw.training.post_training.corpora import Corpus
from wiw.types import Conditioning

Encoded = Mapping[str, Tensor]
"""Clips as the networks see them, a row a clip."""


class TrainableModel(ABC):
    """A model in post-training. Its networks are trained one after the other, each at its *place*."""

    places: tuple[str, ...]
    """Names of the networks that are trained."""
    device: torch.device

    @abstractmethod
    def list_trained(self, place: str) -> dict[str, nn.Parameter]:
        """Return what is trained at a place, by name, with names that no other place has."""

    @abstractmethod
    def list_units(self, place: str) -> Sequence[nn.Module]:
        """Return the modules whose parameters are sharded one by one, parts before the whole."""

    @abstractmethod
    def encode(self, batch: ClipBatch) -> Encoded:
        """Return all that the frozen networks say of clips, a function of the clips alone; without gradients."""

    @abstractmethod
    def describe_latents(self) -> dict[str, Any]:
        """Return what `encode` depends on beside the clips, as JSON values."""

    @abstractmethod
    def compute_losses(self, place: str, encoded: Encoded, actions: Tensor, random: torch.Generator) -> Tensor:
        """Return the loss of each clip, float32 [B], for the network at a place.

        Args:
            place: of the network.
            encoded: what `encode` returned.
            actions: int64 [B, N] or float64 [B, N, 7], as in `ClipBatch`.
            random: on the CPU, so that draws are the same on all devices.
        """

    @abstractmethod
    def list_networks(self) -> Sequence[nn.Module]:
        """Return all networks that imagine, those that are not trained as well."""

    @abstractmethod
    def imagine(
        self, observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        """Imagine as the world model does, with the networks as they are; see `wiw.training.held_out_clips.Imagine`.

        They are in evaluation mode and on the device.
        """

    @abstractmethod
    def select_clips(self, held_out: Corpus) -> HeldOutClips[Any]:
        """Select the clips that it is validated on, as many as the recipe says, with all that it is shown of them.

        Raises:
            ArgumentError: there is none.
            FileError: a picture is damaged.
        """

    @abstractmethod
    def write(self, folder: Path) -> None:
        """Write the files that the world model loads into an empty folder."""

    @abstractmethod
    def activate(self, place: str) -> None:
        """Keep on the device what the training of a place needs; called before each step."""
