# SPDX-License-Identifier: Apache-2.0
"""The floor: a world in which nothing ever moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control
from wiw.world_models.base import SMALLEST_PANORAMA, WorldModel, accepts


class Copy(WorldModel):
    """Predict that every future frame equals the present one. A model that scores no better has added nothing."""

    accepts = accepts(
        control="image", view="panorama", causal=True, best_batch=64, seeded=False, smallest=SMALLEST_PANORAMA
    )
    version = "1"

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Repeat the observation. The answer is a read-only view: no pixel is copied."""
        frames = 1 + len(controls[0].actions)
        image = observations.image
        return np.broadcast_to(image[:, None], (len(image), frames, *image.shape[1:]))


class CopyFront(Copy):
    """Repeat the front view of a manipulator's fixed camera."""

    accepts = accepts(control="image", view="perspective", causal=True, best_batch=64, seeded=False)


def make_copy(space: str = PRIMITIVES) -> Copy:
    """Predict that every future frame equals the observation: the floor for other models."""
    made = {PRIMITIVES: Copy, GRIPPER_POSES: CopyFront}.get(space)
    if made is None:
        raise ArgumentError(
            f"copy: expected plans in {PRIMITIVES} or {GRIPPER_POSES}, got '{space}'; implement a copy model for yours"
        )
    return made()
