# SPDX-License-Identifier: Apache-2.0
"""The built-in learned world model: from one colour panorama to any place near by, with no depth given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.networks import single_thread
from wiw.types import Conditioning, Control
from wiw.world_models.base import accepts
from wiw.world_models.trained import Trained

if TYPE_CHECKING:
    from wiw.world_models.warpnet.network import Network

BUILT_IN = Path(__file__).with_name("weights.safetensors")
STILL = 1e-4
"""Metres: who has moved less stands where it stood."""


class WarpNet(Trained):
    """Predict the depth of the new panorama, warp the present one by it, and inpaint what the warp cannot know.

    Where a plan leads is one jump (turn towards the place, go straight, turn back), however many primitives it takes,
    so errors do not add up. Turns are rolls of the panorama, exact to a column. Colours come from the panorama in full
    size; distances and painting are the network's, in a small one.

    Args:
        weights: a file of `wiw train warpnet`; None means those shipped with wiw.
        size: (height, width) of panoramas in and out; 576x1024 if not given. 144x256, all that the matcher reads, takes
            a third of the time. Results differ a little between sizes.

    Raises:
        ArgumentError: the size is too small.
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
    """

    accepts = accepts(control="trajectory", view="panorama", causal=True, best_batch=16, cacheable=True, seeded=False)

    def __init__(self, weights: str | Path | None = None, size: tuple[int, int] | None = None) -> None:
        super().__init__(weights)
        if size is not None:
            self.choose_size(size)

    @staticmethod
    def _load(weights: str | Path | None) -> tuple[Network, dict[str, Any]]:
        from wiw.world_models.warpnet.weights import load

        return load(weights or BUILT_IN)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return panoramas; frames that another row answers and frames of padding are left unwritten."""
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        with single_thread():
            for image, control, future in zip(observations.image, controls, frames, strict=True):
                wanted = slice(control.shared, control.length)
                self._write_views(image, control.trajectory[wanted], future[1 + control.shared :])
        return frames

    def _write_views(self, image: NDArray[np.uint8], trajectory: NDArray[np.float64], out: NDArray[np.uint8]) -> None:
        """Write the view from each pose; where the agent only turns, its last view is turned."""
        place, seen = np.zeros(2), image
        for (*to, azimuth), frame in zip(trajectory, out, strict=False):
            if np.abs(np.subtract(to, place)).max() > STILL:
                place, seen = np.array(to), self.imagine_move(image, to[0], to[1])
            frame[:] = turn_panorama(seen, azimuth)

    def imagine_move(self, image: NDArray[np.uint8], forward: float, left: float) -> NDArray[np.uint8]:
        """Return what a panorama shows, uint8 [H, W, 3], from that many metres away, headed as before."""
        ahead = float(np.hypot(forward, left))
        if ahead < STILL:
            return image
        heading = float(np.arctan2(left, forward))
        return turn_panorama(self._imagine_ahead(np.ascontiguousarray(turn_panorama(image, heading)), ahead), -heading)

    def _imagine_ahead(self, image: NDArray[np.uint8], metres: float) -> NDArray[np.uint8]:
        import torch

        from wiw.world_models.warpnet.network import blend, enlarge_panorama, warp

        with torch.inference_mode():
            ahead = torch.tensor([metres])
            found = self._network(to_network(shrink_panorama(image, self._network.size)[None]), ahead)
            guess = enlarge_panorama(
                torch.cat([found.log_distance, found.painted, found.mask], dim=1), *image.shape[:2]
            )
            sharp = warp(to_network(image[None]), guess[:, :1], ahead)
            colours = blend(sharp, guess[:, 1:4], guess[:, 4:])[0].permute(1, 2, 0)
            return (colours * 127.5 + 127.5).round().clamp(0, 255).byte().numpy()


def turn_panorama(image: NDArray[Any], azimuth: float) -> NDArray[Any]:
    """Turn a panorama [H, W, ...] left by so many radians, rounded to a column."""
    return np.roll(image, round(azimuth / (2 * np.pi) * image.shape[1]), axis=1)


def shrink_panorama(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Shrink a panorama to another size, by means over areas."""
    return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA))


def to_network(images: NDArray[np.uint8]) -> Any:
    """Convert uint8 [B, H, W, 3] to float [B, 3, H, W] in [-1, 1]."""
    import torch

    return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 127.5 - 1
