# SPDX-License-Identifier: Apache-2.0
"""A world model that costs nothing, whose frames depend on all that it is told: another question, another answer."""

from __future__ import annotations

from typing import Any

import numpy as np

import wiw


class Mock(wiw.WorldModel):
    """Darkens what is seen, the more the further the plan leads, and each row by its seed."""

    accepts, version = wiw.accepts(control="trajectory", view="perspective", size=(48, 48)), "1"

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        shades = np.stack([0.7 / (1 + np.abs(control.trajectory[:, 0])) for control in controls])
        shades += (seeds % np.uint64(100))[:, None] / 500
        frames = np.repeat(observations.image[:, None], 1 + shades.shape[1], axis=1)
        frames[:, 1:] = frames[:, 1:] * shades[:, :, None, None, None]
        return frames
