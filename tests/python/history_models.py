# SPDX-License-Identifier: Apache-2.0
"""World models with a memory, for tests of runs in several processes: `history_models.py:Recalling`."""

from __future__ import annotations

import zlib

import numpy as np

import wiw


def digest(history, row):
    """A number that changes with all that a row's history says, but not with the padding of its actions."""
    own = history.rows([row])
    arrays = own.images, own.poses.round(9) + 0.0, own.actions, own.lengths, own.count
    return zlib.crc32(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays))


class Recalling(wiw.WorldModel):
    """Its frames are as grey as a digest of the history, the seed and the place that the plan leads to."""

    accepts = wiw.accepts("trajectory", view="perspective", size=(24, 32), best_batch=4, needs=("history",), history=3)

    def rollout(self, observations, controls, seeds):
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        for row, control in enumerate(controls):
            said = digest(observations.history, row) + int(seeds[row]) % 251
            ahead = np.arange(len(control.actions)) * 7 + (100 * control.trajectory[:, 0]).astype(int)
            frames[row, 1:] = ((said + ahead) % 256).astype(np.uint8)[:, None, None, None]
        return frames
