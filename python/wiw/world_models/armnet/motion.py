# SPDX-License-Identifier: Apache-2.0
"""What the network reads of a gripper's way from one pose to the next."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.world_models.armnet.network import FRONT, WINDOW, Motion

METRE = 5.0
"""What a metre counts as: ways are about 0.2 m long."""


def motion(before: NDArray[np.float64], after: NDArray[np.float64]) -> Motion:
    """Return the motions from poses [B, 7] to others."""
    numbers = np.concatenate(
        [
            before[:, 6:],
            after[:, 6:],
            METRE * (before[:, 2:3] - TABLE),
            METRE * (after[:, 2:3] - TABLE),
            METRE * (after[:, :3] - before[:, :3]),
            np.sin(after[:, 5:6]),
            np.cos(after[:, 5:6]),
        ],
        axis=1,
    )
    under = after[:, :3] * (1, 1, 0) + (0, 0, TABLE)
    return Motion(_tips(before[:, :3]), _tips(after[:, :3]), _float(numbers), _tips(under)[:, :2])


def _tips(points: NDArray[np.float64]) -> Tensor:
    """Return pixels in the window, and metres along the camera's axis, [B, 3] of points [B, 3]."""
    front = CAMERAS["front"]
    pixels = front.project_points(points, FRONT) - (WINDOW[1].start, WINDOW[0].start)
    depth = (points - front.eye) @ -front.pose[:3, 2]
    return _float(np.concatenate([pixels, depth[:, None]], axis=1))


def _float(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))
