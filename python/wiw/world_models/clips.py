# SPDX-License-Identifier: Apache-2.0
"""Choose the frames of a rollout from the clip of a video generator."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw import action


def frames_after_actions(length: int, clip: int, frames: int) -> NDArray[np.int64]:
    """Return which frame of a clip each frame of a rollout is, where the clip shows a plan evenly.

    Args:
        length: actions of the plan; the frames after it repeat the clip's last.
        clip: frames of the clip.
        frames: frames of the rollout, the observation included.

    Returns:
        int64 [frames].
    """
    indices = np.full(frames, clip - 1)
    indices[0] = 0
    indices[1 : 1 + length] = action.frames_of_actions(length, clip, "resample")[:, 1]
    return indices
