# SPDX-License-Identifier: Apache-2.0
"""A policy in one file: it walks to where the view has the colours of the goal image.

wiw run imagenav --policy docs/examples/colour_seeker.py:ColourSeeker --arms none,copy,warp,oracle
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.types import Goal, Key, Proposal, Rollout


class ColourSeeker(Policy):
    """Proposes to walk on, or to turn and then walk; scores a plan by the colours of what is imagined.

    Args:
        bins: of the colour histogram, per channel.
    """

    frames = FrameSpec("front", (96, 96))  # the view and size in which it looks at imagined frames

    def __init__(self, bins: int = 4) -> None:
        self.bins = bins

    def begin(self, goal: Goal, key: Key) -> Any:
        """Return the memory of a new episode: the colours to look for."""
        assert goal.image is not None
        return self._histogram(goal.image)

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return, for each episode, plans that turn ever further; without a world model the first is executed."""
        return [[self._make_plan(index, horizon) for index in range(candidates)] for _ in situations]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the similarity of each plan's best frame to the goal, higher is better."""
        return [
            np.array([self._similarity(situation.memory, rollout.frames) for rollout in own])
            for situation, own in zip(situations, rollouts, strict=True)
        ]

    def _make_plan(self, index: int, horizon: int) -> Proposal:
        turns = min((index + 1) // 2, horizon)
        turn = TURN_LEFT if index % 2 else TURN_RIGHT
        actions = np.array([turn] * turns + [FORWARD] * (horizon - turns), np.int8)
        return Proposal(actions, prior=-float(index))

    def _similarity(self, wanted: NDArray[np.float64], frames: NDArray[np.uint8]) -> float:
        return max(float(np.minimum(wanted, self._histogram(frame)).sum()) for frame in frames)

    def _histogram(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        counts, _ = np.histogramdd(image.reshape(-1, 3), bins=self.bins, range=[(0, 256)] * 3)
        return np.asarray(counts / counts.sum(), np.float64)
