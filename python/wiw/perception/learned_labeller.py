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
    from torch import Tensor

    from wiw.perception.labelling_network import InputSize, Network

WEIGHTS = Path(__file__).parent / "labeller.safetensors"
ROWS_AT_ONCE = 8
"""Rows of groups of cells whose probabilities are computed at once: 1 MB, so that memory is reused and cached."""


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
        input_size, tangents, cells = _plan_input(size, hfov_deg)
        for view, image in enumerate(images):
            distances = None if depth is None else depth[view]
            category, confidence, state = self._label_view(image, distances, input_size, tangents)
            labels.category[view] = category.take(cells)
            labels.confidence[view] = confidence.take(cells)
            labels.state[view] = state.take(cells)
        return labels

    def _label_view(
        self,
        image: NDArray[np.uint8],
        depth: NDArray[np.float32] | None,
        input_size: InputSize,
        tangents: NDArray[np.float32],
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
        """Return category, confidence and state of the cells of one view in groups, [H/2, W/2, FINE_CELLS].

        What is chosen is small; to put the logits of all cells in the order of the view would take longer.
        """
        import torch

        from wiw.perception.labelling_network import resize_view, sample_cells, to_network_input

        shown = resize_view(np.ascontiguousarray(image), input_size)
        distances = None if depth is None else sample_cells(depth, input_size)[None]
        with torch.inference_mode(), single_thread():
            features = self._network.compute_features(to_network_input(shown[None], tangents[None], distances))
            category_logits, state_logits = self._network.compute_logits(features[-1])
            found = [choose_categories(rows) for rows in category_logits[0].split(ROWS_AT_ONCE)]
        category, confidence = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return category, confidence, choose_states(category, state_logits[0].numpy(), self._impossible)


def find_impossible_states(categories: Sequence[str], states: Mapping[str, Sequence[str]]) -> NDArray[np.bool_]:
    """Return which states each category cannot have, bool [categories, states]; without any listed, all but ""."""
    impossible = np.ones((len(categories), len(STATES)), bool)
    for row, name in enumerate(categories):
        for state in states.get(name) or ("",):
            impossible[row, STATES.index(state)] = False
    return impossible


def choose_categories(logits: Tensor) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the likeliest category of each cell and its probability, [...], from logits [..., categories]."""
    probabilities = logits.softmax(dim=-1).numpy()
    category = probabilities.argmax(axis=-1)
    confidence = np.take_along_axis(probabilities, category[..., None], axis=-1)[..., 0]
    return category.astype(np.uint8), confidence


def choose_states(
    category: NDArray[np.uint8], logits: NDArray[np.float32], impossible: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    """Return the likeliest of the states that each cell's category can have: uint8 [...], as `category`.

    Most categories have a single one, and their logits need not be looked at.

    Args:
        category: [...].
        logits: float32 [..., states].
        impossible: of `find_impossible_states`.
    """
    state = impossible.argmin(axis=1).astype(np.uint8)[category]
    several = ((~impossible).sum(axis=1) > 1)[category]
    state[several] = np.where(impossible[category[several]], -np.inf, logits[several]).argmax(axis=-1)
    return state


@lru_cache(maxsize=16)
def _plan_input(size: tuple[int, int], hfov_deg: float) -> tuple[InputSize, NDArray[np.float32], NDArray[np.intp]]:
    """Return the input's size and tangents, and which of all cells in groups each pixel is in, [H, W]."""
    import torch

    from wiw.perception.labelling_network import InputSize, compute_tangents, group_cells, ungroup_cells

    found = InputSize.of(size, hfov_deg)
    cells = torch.arange(found.height * found.width).reshape(1, found.height, found.width)
    places = ungroup_cells(cells.reshape(group_cells(cells).shape))[0].numpy()
    rows, columns = _map_pixels(size[0], found.height), _map_pixels(size[1], found.width)
    return found, compute_tangents(size, found), places[rows[:, None], columns].astype(np.intp)


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
