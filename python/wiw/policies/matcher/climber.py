# SPDX-License-Identifier: Apache-2.0
"""The matcher with a memory of similarities: it climbs their slope over the places it has really visited."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw.policies.matcher.policy import HEADINGS, Matcher, Memory

NEIGHBOURHOOD = 1.5
"""Metres within which remembered places inform about the slope here."""
RIDGE = 0.3
"""Ridge penalty, which keeps the slope small where few places are remembered."""


class Climber(Matcher):
    """Estimates from real observations what a world model would imagine: the direction in which the match improves.

    Its score without a world model is the fair baseline for the question whether imagination was needed at all.
    """

    def _judge_headings(
        self, memory: Memory, odometry: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        prior, runs = super()._judge_headings(memory, odometry)
        azimuth = odometry[2] + np.arange(HEADINGS) * 2 * np.pi / HEADINGS
        directions = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        gain = directions @ similarity_slope(memory, odometry[:2]) * np.minimum(runs, 1.0)
        weight = self.options.imagined * (1 + self.options.near * memory.gate)
        return prior + weight * gain, runs


def similarity_slope(memory: Memory, here: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slope of the similarity per metre at `here`, by ridge regression over nearby places: float64 [2]."""
    points = np.array([place[:2] for place, _ in memory.places])
    values = np.array([value for _, value in memory.places])
    near = np.linalg.norm(points - here, axis=1) < NEIGHBOURHOOD
    offsets, rises = points[near] - here, values[near] - memory.similarity
    return np.linalg.solve(offsets.T @ offsets + RIDGE * np.eye(2), offsets.T @ rises)
