# SPDX-License-Identifier: Apache-2.0
"""Common parts of the world models of `wiw train`: weights shipped with wiw or from a file, and their identity."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from wiw.errors import ArgumentError
from wiw.world_models.base import Requirements, WorldModel

if TYPE_CHECKING:
    from torch import nn

T = TypeVar("T", bound="Trained")


class Trained(WorldModel):
    """A small network that runs on the CPU, in eval mode, with the card of how it was made and measured.

    Args:
        weights: a file of `wiw train NAME`; None means those shipped with wiw.

    Raises:
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    version = "1"
    immaterial = ("weights",)
    requires = Requirements(("torch", "safetensors"), "torch")
    size: tuple[int, int] | None = None
    """(height, width) that was chosen for what it sees and draws; None if the declared one was left as it is."""
    _network: Any

    def __init__(self, weights: str | Path | None = None) -> None:
        self.requires.require()
        self.weights = None if weights is None else str(weights)
        self._network, self.card = self._load(weights)

    @staticmethod
    @abstractmethod
    def _load(weights: str | Path | None) -> tuple[nn.Module, dict[str, Any]]:
        """Return network and card of a file, or of the built-in one. Imports torch."""

    @classmethod
    def of(cls: type[T], network: nn.Module) -> T:
        """Make the world model of a network at hand, such as one in training."""
        model = cls.__new__(cls)
        model.weights, model._network, model.card = None, network.eval(), {}
        return model

    def choose_size(self, size: tuple[int, int]) -> None:
        """Choose the (height, width) of what the model sees and draws; its network computes in a smaller one.

        Raises:
            ArgumentError: it is smaller than that of the network.
        """
        smallest = self._network.size
        if len(size) != 2 or any(given < least for given, least in zip(size, smallest, strict=True)):
            raise ArgumentError(
                f"{type(self).__name__.lower()}: expected a size (height, width) of at least {tuple(smallest)}, in "
                f"which the network computes, got {tuple(size)}"
            )
        height, width = map(int, size)
        self.size, self.accepts = size, replace(self.accepts, size=(height, width))

    def describe(self) -> dict[str, Any]:
        """Return the weights' file, a digest of them, torch's version, and the size if one was chosen."""
        import torch

        found = {
            "name": type(self).__name__,
            "weights": self.weights,
            "digest": self._digest(),
            "torch": torch.__version__,
        }
        return found if self.size is None else {**found, "size": list(self.size)}

    def _digest(self) -> str:
        digest = blake2b(digest_size=8)
        for name, value in self._network.state_dict().items():
            digest.update(name.encode() + value.numpy().tobytes())
        return digest.hexdigest()
