# SPDX-License-Identifier: Apache-2.0
"""World models for tests that serve them from a process of its own: `served_models.py:Fading`."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np

import wiw


class Fading(wiw.WorldModel):
    """Takes its time; what it shows depends on plan and seed, so a run tells whether it was asked the same."""

    accepts = wiw.accepts("trajectory", view="perspective", size=(48, 48), frames=6, best_batch=4)

    def rollout(self, observations, controls, seeds):
        """Notes in the file $CALLS that it was called, then sleeps, so that it can be killed at its work."""
        with Path(os.environ["CALLS"]).open("a") as calls:
            calls.write(f"{len(controls)}\n")
        time.sleep(0.2)
        ahead = np.stack([control.trajectory[:, 0] for control in controls])
        shade = 1 / (1 + ahead) * (0.7 + (seeds % np.uint64(100)) / 300)[:, None]
        frames = np.repeat(observations.image[:, None], 6, 1)
        frames[:, 1:] = frames[:, 1:] * shade[:, :, None, None, None]
        return frames
