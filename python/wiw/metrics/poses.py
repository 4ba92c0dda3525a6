# SPDX-License-Identifier: Apache-2.0
"""Distances between poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw._core import metrics as _core


def pose_error(a: ArrayLike, b: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distance in metres and rotation angle in radians (0 to pi) between poses.

    Args:
        a: rigid transforms float [4, 4] or [B, 4, 4].
        b: as many.

    Returns:
        Two float64 [B].

    Raises:
        ArgumentError: a matrix that is not a rigid transform, or batches of different lengths.
    """
    errors = np.asarray(_core.pose_error(np.asarray(a, np.float64), np.asarray(b, np.float64)))
    return errors[:, 0], errors[:, 1]
