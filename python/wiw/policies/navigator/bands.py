# SPDX-License-Identifier: Apache-2.0
"""Inputs of the navigator's network: the middle rows of small panoramas, and goal views projected to such rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.policies.matcher import appearance

PANORAMA = appearance.PANORAMA
"""Pixels of the panoramas that bands are cut from."""
BAND_ROWS = appearance.ROWS
"""Latitudes within 45 degrees."""
WIDTH, GOAL_WIDTH = appearance.COLUMNS, appearance.WINDOW
GOAL_COLUMNS = appearance.MIDDLE


def resize_panoramas(panoramas: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return panoramas uint8 [N, H, W, 3] as uint8 [N, 64, 128, 3]."""
    return panoramas if panoramas.shape[1:3] == PANORAMA else np.asarray(panorama.resize(panoramas, PANORAMA))


def project_goal(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a goal view uint8 [S, S, 3] of 90 degrees as a band, uint8 [32, 32, 3]; 0 outside of the view."""
    wide, mask = appearance.project_front(image)
    return np.ascontiguousarray((wide[BAND_ROWS] * mask[..., None])[:, GOAL_COLUMNS])


def get_goal_mask() -> NDArray[np.bool_]:
    """Return which pixels of a goal's band its view shows: bool [32, 32]."""
    return appearance.project_front(np.zeros((64, 64, 3), np.uint8))[1][:, GOAL_COLUMNS]
