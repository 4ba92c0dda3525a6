# SPDX-License-Identifier: Apache-2.0
"""Point clouds from depth images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def unproject_depth(
    depth: NDArray[np.float32], hfov_deg: float, T_world_camera: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the 3D point that each pixel of a pinhole camera's depth image shows.

    Args:
        depth: float32 [H, W], planar metres; 0 where nothing is hit.
        hfov_deg: between the outer edges of the outer pixels.
        T_world_camera: [4, 4]; the camera looks along -z with +y up.

    Returns:
        float32 [H, W, 3]: places in the world's frame; the camera's own where nothing is hit.
    """
    height, width = depth.shape
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    right = ((np.arange(width) + 0.5 - width / 2) / focal).astype(np.float32)
    up = ((height / 2 - np.arange(height) - 0.5) / focal).astype(np.float32)
    seen = np.stack([depth * right, depth * up[:, None], -depth], axis=-1)
    turn, eye = T_world_camera[:3, :3].astype(np.float32), T_world_camera[:3, 3].astype(np.float32)
    return np.asarray(seen @ turn.T + eye)
