# SPDX-License-Identifier: Apache-2.0
"""The built-in labeller: a small U-Net trained on apartments; it labels real and imagined views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import DependencyError
from wiw.networks import single_thread
from wiw.perception.scene_labels import STATES, Labeller, SceneLabels

if TYPE_CHECKING:
    from wiw.perception.labelling_network import InputSize, Network

WEIGHTS = Path(__file__).parent / "labeller.safetensors"


class LearnedLabeller(Labeller):
    """A trained network. Views are processed one at a time, so that labels do not depend on the other views of a batch.

    Args:
        weights: a file of `wiw train perception`; None means those shipped with wiw.

    Raises:
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    least_confidence = 0.7
    """Along outlines labels are less sure than this, and depth may be that of what is behind."""

    def __init__(self, weights: str | Path | None = None) -> None:
        require_torch()
        from wiw.perception.labeller_weights import load

        self.weights = None if weights is None else str(weights)
        self._use_network(*load(WEIGHTS if weights is None else weights))

    @classmethod
    def of(cls, network: Network, card: Mapping[str, Any]) -> LearnedLabeller:
        """Make the labeller of a network at hand, such as one in training.

        Args:
            network: without batch normalisation.
            card: with `categories` and, by category, its possible `states`.
        """
        labeller = cls.__new__(cls)
        labeller.weights = None
        labeller._use_network(network, card)
        return labeller

    def _use_network(self, network: Network, card: Mapping[str, Any]) -> None:
        import torch

        self.card = dict(card)
        self.categories = tuple(self.card["categories"])
        self._network = network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._impossible = find_impossible_states(self.categories, self.card["states"])

    def describe(self) -> dict[str, Any]:
        """Return the weights' file, a digest of them, and torch's version."""
        import torch

        from wiw.weight_file import digest

        return {
            **super().describe(),
            "weights": self.weights,
            "digest": digest(self._network.state_dict()),
            "torch": torch.__version__,
        }

    def compute_labels(
        self,
        images: NDArray[np.uint8],
        hfov_deg: float,
        ids: NDArray[np.uint32] | None,
        depth: NDArray[np.float32] | None,
    ) -> SceneLabels:
        """Run the network on each view."""
        size = (images.shape[1], images.shape[2])
        labels = SceneLabels(
            np.empty((len(images), *size), np.uint8),
            np.empty((len(images), *size), np.float32),
            np.empty((len(images), *size), np.uint8),
        )
        input_size, tangents = _plan_input(size, hfov_deg)
        rows, columns = (
            _map_pixels(pixels, side) for pixels, side in zip(size, (input_size.height, input_size.width), strict=True)
        )
        for view, image in enumerate(images):
            distances = None if depth is None else depth[view]
            category, confidence, state = self._label_view(image, distances, input_size, tangents)
            labels.category[view] = category[rows[:, None], columns]
            labels.confidence[view] = confidence[rows[:, None], columns]
            labels.state[view] = state[rows[:, None], columns]
        return labels

    def _label_view(
        self,
        image: NDArray[np.uint8],
        depth: NDArray[np.float32] | None,
        input_size: InputSize,
        tangents: NDArray[np.float32],
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
        """Return category, confidence and state of the cells of one view."""
        import torch

        from wiw.perception.labelling_network import resize_view, sample_cells, to_network_input

        shown = resize_view(np.ascontiguousarray(image), input_size)
        distances = None if depth is None else sample_cells(depth, input_size)[None]
        with torch.inference_mode(), single_thread():
            category_logits, state_logits = self._network(to_network_input(shown[None], tangents[None], distances))
            confidence, category = category_logits[0].permute(1, 2, 0).softmax(dim=2).max(dim=2)
            places = category.numpy()
            states = state_logits[0].permute(1, 2, 0).numpy()
        state = np.where(self._impossible[places], -np.inf, states).argmax(axis=2)
        return places.astype(np.uint8), confidence.numpy(), state.astype(np.uint8)


def find_impossible_states(categories: Sequence[str], states: Mapping[str, Sequence[str]]) -> NDArray[np.bool_]:
    """Return which states each category cannot have, bool [categories, states]; without any listed, all but ""."""
    impossible = np.ones((len(categories), len(STATES)), bool)
    for row, name in enumerate(categories):
        for state in states.get(name) or ("",):
            impossible[row, STATES.index(state)] = False
    return impossible


@lru_cache(maxsize=16)
def _plan_input(size: tuple[int, int], hfov_deg: float) -> tuple[InputSize, NDArray[np.float32]]:
    from wiw.perception.labelling_network import InputSize, compute_tangents

    found = InputSize.of(size, hfov_deg)
    return found, compute_tangents(size, found)


def _map_pixels(pixels: int, cells: int) -> NDArray[np.intp]:
    """Return the index of each pixel's cell, along one side of a view."""
    return (np.arange(pixels) * cells // pixels).astype(np.intp)


def require_torch() -> None:
    """Check that torch and safetensors are installed.

    Raises:
        DependencyError: saying how to install them.
    """
    try:
        import safetensors  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise DependencyError(
            f"the learned labeller needs torch and safetensors ({error}): pip install 'wiw[torch]', or for CPU only "
            "pip install torch safetensors --extra-index-url https://download.pytorch.org/whl/cpu"
        ) from error
