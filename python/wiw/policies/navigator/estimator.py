# SPDX-License-Identifier: Apache-2.0
"""The trained network as the policy asks it: distance, bearing and visibility of the goal from places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import DependencyError
from wiw.networks import single_thread
from wiw.policies.matcher import appearance
from wiw.policies.navigator.bands import BAND_ROWS, get_goal_mask, resize_panoramas

if TYPE_CHECKING:
    from wiw.policies.navigator.network import Features, Network

LEAST_SHARE = 0.003
"""Added to probabilities, so that none is taken for certain."""


@dataclass(frozen=True)
class PlaceEstimates:
    """Estimates for N places."""

    bearings: NDArray[np.float64]
    """float64 [N, 32]: probability of each heading, by column of the panorama from its left edge on."""
    distances: NDArray[np.float64]
    """float64 [N, 9]: probability of each class of distance."""
    metres: NDArray[np.float64]
    """float64 [N]: expected metres of the path to the goal."""
    visible: NDArray[np.float64]
    """float64 [N]: probability that the goal's camera is in sight."""

    @staticmethod
    def join(parts: Sequence[PlaceEstimates]) -> PlaceEstimates:
        """Concatenate estimates."""
        names = ("bearings", "distances", "metres", "visible")
        return PlaceEstimates(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def find_bearings(self) -> NDArray[np.float64]:
        """Return the likeliest azimuth of each place, from the panorama's front, left positive: float64 [N]."""
        width = self.bearings.shape[1]
        return np.pi - (self.bearings.argmax(axis=1) + 0.5) * 2 * np.pi / width


class GoalEstimator:
    """A network, applied to one place at a time, so that no estimate depends on the other places of a batch.

    Args:
        network: the trained network.
        card: has what `wiw.training.navigator.measure_prior` returns.
    """

    def __init__(self, network: Network, card: Mapping[str, Any]) -> None:
        from wiw.policies.navigator.network import CENTRES

        self._network = network.eval()
        self.centres = np.array(CENTRES)
        """float64 [9]: metres in the middle of each class of distance."""
        self._shares = np.array(card["shares"], np.float64)
        self._means, self._spreads = np.array(card["similarity"], np.float64).T

    def encode_goal(self, band: NDArray[np.uint8]) -> Features:
        """Encode a goal's band uint8 [32, 32, 3]."""
        import torch

        from wiw.policies.navigator.network import to_input

        with torch.inference_mode(), single_thread():
            return self._network.encode(to_input(torch.from_numpy(band[None]), torch.from_numpy(get_goal_mask())))

    def estimate(
        self, goal: Features, bands: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
    ) -> PlaceEstimates:
        """Estimate for N places, uint8 [N, 32, 128, 3], of which `mask` [32, 128] is shown; None means all."""
        import torch

        from wiw.policies.navigator.network import to_input

        rows, shown = [], None if mask is None else torch.from_numpy(mask)
        with torch.inference_mode(), single_thread():
            for band in bands:
                place = self._network.encode(to_input(torch.from_numpy(band[None]), shown))
                found = self._network.compare(place, goal)
                rows.append((found.bearings.softmax(1), found.distances.softmax(1), found.visible.sigmoid()))
        bearings, distances, visible = (torch.cat(column).double().numpy() for column in zip(*rows, strict=True))
        return PlaceEstimates(bearings, distances, distances @ self.centres, visible)

    def rate(
        self,
        goal: Features,
        template: appearance.GoalTemplate,
        frame: NDArray[np.uint8],
        view: str,
        similarity: float,
        likeness: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return what a view says of the goal: the probability of each heading, float64 [32], and the logarithm of the
        likelihood ratio of each class of distance, float64 [9].

        Args:
            goal: encoded.
            template: the matcher's features of the goal.
            frame: uint8 [H, W, 3]: a panorama, or a front view with HFOV 90.
            view: "panorama", else it is a front view.
            similarity: weight of the matcher's similarity in the distance; it is known of panoramas alone, as is
            likeness: weight of the likeness of colours in the bearing: towards the goal much looks like it.
        """
        if view != "panorama":
            wide, mask = appearance.project_front(frame)
            found = self.estimate(goal, wide[None, BAND_ROWS], mask)
            return found.bearings[0], self._compare_with_prior(found.distances[0])
        small = resize_panoramas(frame[None])
        found = self.estimate(goal, small[:, BAND_ROWS])
        features = appearance.extract_features(small)
        value = float(np.clip(appearance.similarity(features, template).max(), 0, appearance.HIGHEST))
        closeness = self._compare_with_prior(found.distances[0]) + similarity * self._rate_similarity(value)
        colors = appearance.histogram_similarity(features, template)[0].reshape(len(found.bearings[0]), -1).mean(axis=1)
        bearings = (found.bearings[0] + LEAST_SHARE) * np.exp(likeness * colors)
        return bearings / bearings.sum(), closeness

    def _compare_with_prior(self, distances: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.log((distances + LEAST_SHARE) / (self._shares + LEAST_SHARE))

    def _rate_similarity(self, value: float) -> NDArray[np.float64]:
        """Return the logarithm of the likelihood ratio of each class of distance, given the similarity: float64 [9]."""
        likely = np.exp(-0.5 * ((value - self._means) / self._spreads) ** 2) / self._spreads + LEAST_SHARE
        return np.log(likely / (likely @ self._shares))


def require_torch() -> None:
    """Check that torch and safetensors are installed.

    Raises:
        DependencyError: saying how to install them.
    """
    try:
        import safetensors  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise DependencyError(f"navigator needs torch and safetensors ({error}): pip install 'wiw[torch]'") from error
