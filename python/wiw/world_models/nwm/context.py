# SPDX-License-Identifier: Apache-2.0
"""Which frames of a history make NWM's context.

The network was trained on context frames one step apart, and so are its own predictions, which become context in turn.
An action is one step, but an agent observes once per decision, after a varying number of actions. So for each step back
the frame is taken that was observed nearest to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.types import History


def context_images(history: History, count: int) -> NDArray[np.uint8]:
    """Return the context of each row, uint8 [B, count, H, W, 3], oldest first."""
    places = nearest_frames(history.lengths, count)
    return np.asarray(np.take_along_axis(history.images, places[:, :, None, None, None], axis=1))


def nearest_frames(lengths: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the places in a history of the frames nearest to count - 1, ..., 1, 0 actions ago, int64 [B, count].

    `lengths` int64 [B, N - 1] are actions between neighbours. Of two frames as near, the older one is taken.
    """
    last = np.zeros((len(lengths), 1), np.int64)
    ages = np.concatenate([np.cumsum(lengths[:, ::-1], axis=1)[:, ::-1], last], axis=1)
    wanted = np.arange(count)[::-1]
    return np.argmin(np.abs(ages[:, None] - wanted[:, None]), axis=2)
