# SPDX-License-Identifier: Apache-2.0
"""Agents of which one stage fails, for tests of what failures are blamed on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

import wiw
from wiw._core import core
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.policies.base import FrameSpec
from wiw.types import Proposal

AHEAD = [FORWARD] * 5
FAN = (
    AHEAD,
    [TURN_LEFT, TURN_LEFT, *AHEAD[2:]],
    [TURN_RIGHT, TURN_RIGHT, *AHEAD[2:]],
    [TURN_LEFT, *AHEAD[1:]],
    [TURN_RIGHT, *AHEAD[1:]],
)
SPIN = ([TURN_LEFT] * 5, [TURN_RIGHT] * 5, [TURN_LEFT] * 3)


class _Fixed(wiw.Policy):
    """Always the same plans, of which the first is preferred."""

    frames = FrameSpec("front", (16, 16), source_size=(144, 256))
    plans: Any = FAN

    def propose(self, situations: Any, candidates: int, horizon: int) -> list[list[Proposal]]:
        plans = [Proposal(actions[:horizon], -float(i)) for i, actions in enumerate(self.plans[:candidates])]
        return [plans for _ in situations]

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> list[Any]:
        return [np.array([plan.prior for plan in plans]) for plans in proposals]


class Noise(_Fixed):
    """Proposes well enough, and judges by the throw of a die."""

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> list[Any]:
        keys = [core.fold_key([s.key.seed, s.key.episode, s.key.decision, 5]) for s in situations]
        return [core.uniform(key, len(plans)) for key, plans in zip(keys, proposals, strict=True)]


class Spinner(_Fixed):
    """Would know a good plan, and only ever turns on the spot."""

    plans = SPIN


class Writer(Spinner):
    """The same, and follows a plan of its own whatever it is shown."""

    def revise(self, situation: Any, proposals: Any, scores: Any) -> Any:
        return np.array([TURN_LEFT], np.int8), None


class Liar(wiw.WorldModel):
    """Shows for every plan what is behind the agent, upside down."""

    accepts = wiw.accepts(control="action", view="panorama")

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        behind = np.roll(observations.image, 512, axis=2)[:, ::-1]
        frames = np.repeat(behind[:, None], len(controls[0].actions) + 1, axis=1)
        frames[:, 0] = observations.image
        return frames


class Frail(Liar):
    """Raises while the file that the variable names is there."""

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        if Path(os.environ["WIW_TEST_FRAIL"]).exists():
            raise OSError("no server")
        return super().rollout(observations, controls, seeds)
