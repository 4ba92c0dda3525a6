# SPDX-License-Identifier: Apache-2.0
"""A world model in one file: it imagines that everything seen is painted on a sphere around the agent.

wiw check-model docs/examples/flat_world.py:FlatWorld
wiw run imagenav --arms none,copy,docs/examples/flat_world.py:FlatWorld,oracle
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

import wiw
from wiw.types import Conditioning, Control

SIZE = 240


class FlatWorld(wiw.WorldModel):
    """Reprojects the front view as if everything were `distance` metres away.

    Args:
        distance: radius of the sphere in metres, above 0.2, the length of a step.
    """

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(SIZE, SIZE), causal=True)
    version = "1"  # raise it when the answers change: cached rollouts are named by it

    def __init__(self, distance: float = 3.0) -> None:
        self.distance = distance
        centres = (np.arange(SIZE) + 0.5) / (SIZE / 2) - 1  # HFOV 90 degrees: the focal length is half the width
        x, y = np.meshgrid(centres, centres)
        rays = np.stack([x, y, np.ones_like(x)], -1)  # right, down, ahead
        self._rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return uint8 [B, actions + 1, 240, 240, 3]: frame 0 is the observation, frame k follows action k."""
        return np.stack(
            [
                np.stack([image, *(self._look(image, pose) for pose in control.trajectory)])
                for image, control in zip(observations.image, controls, strict=True)
            ]
        )

    def _look(self, image: NDArray[np.uint8], pose: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the view from a pose: x forward and y left in metres, azimuth to the left in radians."""
        forward, left, azimuth = pose
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        turn = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])  # of the new camera in the old one
        place = np.array([-left, 0, forward])
        rays = self._rays @ turn.T
        along = rays @ place  # where each ray leaves the sphere around the old camera
        reach = np.sqrt(np.maximum(along**2 + self.distance**2 - place @ place, 0)) - along
        points = place + reach[..., None] * rays
        ahead = np.maximum(points[..., 2], 1e-6)
        pixels = ((points[..., :2] / ahead[..., None] + 1) * (SIZE / 2) - 0.5).astype(np.float32)
        seen = points[..., 2:] > 0
        frame = cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.where(seen, frame, image.mean((0, 1)).astype(np.uint8))
