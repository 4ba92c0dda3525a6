# SPDX-License-Identifier: Apache-2.0
"""The small video generator that is trained here: from one panorama to what is seen along a plan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.networks import single_thread
from wiw.types import Conditioning, Control
from wiw.world_models.base import accepts
from wiw.world_models.trained import Trained
from wiw.world_models.warpnet.model import STILL, shrink_panorama, to_network, turn_panorama

if TYPE_CHECKING:
    from torch import Tensor

    from wiw.world_models.pocket.network import Denoiser

BUILT_IN = Path(__file__).with_name("weights.safetensors")
STEPS = 1
"""Steps of the sampler, unless the user says otherwise."""


class Pocket(Trained):
    """Generate all views of a plan jointly with a diffusion model over small panoramas.

    The model receives the place of each view. It draws views that face where the observation does; turns are rolls of
    them, exact to a column. Views from the agent's present place are the observation itself. The model says how warps
    of the observation through simple rooms are blended, and what to add; both are carried out in full size.

    Args:
        weights: a file of `wiw train pocket`; None means those shipped with wiw.
        steps: of the sampler: 1 gives the mean of what may be seen, more draw one
            of them, with blotches where it is uncertain.
        size: (height, width) of panoramas in and out; 576x1024 if not given. 144x256 is all that the matcher reads.
            Results differ a little between sizes.

    Raises:
        DependencyError: torch or safetensors is not installed.
        WeightsError: no such file, damaged, or of another version.
        ArgumentError: fewer than one step, or the size is too small.
    """

    steps = STEPS
    accepts = accepts(control="trajectory", view="panorama", best_batch=16, cacheable=True)

    def __init__(
        self, weights: str | Path | None = None, steps: int = STEPS, size: tuple[int, int] | None = None
    ) -> None:
        if steps < 1:
            raise ArgumentError(f"pocket: expected 1 step of the sampler or more, got {steps}")
        super().__init__(weights)
        self.steps = steps
        if size is not None:
            self.choose_size(size)

    @staticmethod
    def _load(weights: str | Path | None) -> tuple[Denoiser, dict[str, Any]]:
        from wiw.world_models.pocket.weights import load

        return load(weights or BUILT_IN)

    def describe(self) -> dict[str, Any]:
        """Return the weights' file, a digest of them, steps, torch's version, and the size if one was chosen."""
        return {**super().describe(), "steps": self.steps}

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return panoramas; frames of padding are left unwritten."""
        frames = np.empty((len(controls), 1 + len(controls[0].actions), *observations.image.shape[1:]), np.uint8)
        frames[:, 0] = observations.image
        with single_thread():
            for image, control, seed, future in zip(observations.image, controls, seeds, frames, strict=True):
                future[1 : 1 + control.length] = self.imagine_trajectory(
                    image, control.trajectory[: control.length], int(seed)
                )
        return frames

    def imagine_trajectory(
        self, image: NDArray[np.uint8], trajectory: NDArray[np.float64], seed: int
    ) -> NDArray[np.uint8]:
        """Return what is seen from each pose of a trajectory, uint8 [K, H, W, 3].

        Args:
            image: the observation, uint8 [H, W, 3], of any size.
            trajectory: [K, 3], forward and left in metres, azimuth in radians.
            seed: of the noise.
        """
        owners, places = find_places(trajectory[:, :2])
        views = self._imagine_places(image, places, seed)
        seen = [image if owner < 0 else views[owner] for owner in owners]
        return np.stack([turn_panorama(each, azimuth) for each, azimuth in zip(seen, trajectory[:, 2], strict=True)])

    def _imagine_places(self, image: NDArray[np.uint8], places: NDArray[np.float64], seed: int) -> NDArray[np.uint8]:
        """Return what is seen from places [F, 2] (forward, left), headed as before: uint8 [F, H, W, 3]."""
        if not len(places):
            return np.empty((0, *image.shape), np.uint8)
        import torch

        from wiw.world_models.pocket.network import Views
        from wiw.world_models.pocket.sampler import draw_noise, sample_views

        moved = torch.from_numpy(np.stack([-places[:, 1], places[:, 0]], axis=1).astype(np.float32))[None]
        with torch.inference_mode():
            small = Views.around(to_network(shrink_panorama(image, self._network.size)[None]), moved)
            estimate = sample_views(self._network, small, draw_noise(small, [seed]), self.steps)
            size = image.shape[:2]
            return np.stack(
                [
                    self._show(image, estimate.pick(row).enlarge(*size), moved[:, row : row + 1])
                    for row in range(len(places))
                ]
            )

    @staticmethod
    def _show(image: NDArray[np.uint8], estimate: Any, place: Tensor) -> NDArray[np.uint8]:
        from wiw.world_models.pocket.network import Views

        colours = Views.around(to_network(image[None]), place).blend(estimate)[0, 0].permute(1, 2, 0)
        return np.asarray((colours * 127.5 + 127.5).round().clamp(0, 255).byte().numpy())


def find_places(positions: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the distinct places of a path, and which of them each pose is at.

    Args:
        positions: [K, 2], metres from where the path starts.

    Returns:
        int64 [K], -1 where the agent stands where it started, and float64 [F, 2].
    """
    places, owners = [np.zeros(2)], []
    for position in positions:
        here = [np.abs(position - place).max() <= STILL for place in places]
        if not any(here):
            places.append(position)
            here.append(True)
        owners.append(here.index(True) - 1)
    return np.array(owners, np.int64), np.array(places[1:], np.float64).reshape(-1, 2)
