# SPDX-License-Identifier: Apache-2.0
"""A policy for tests of runs at the table: it goes down on things, and likes futures in which much has changed."""

from __future__ import annotations

from typing import Any

import numpy as np

import wiw
from wiw._core import core
from wiw.policies.base import FrameSpec
from wiw.tabletop.base import make_action
from wiw.types import Proposal


class Pressing(wiw.Policy):
    space = "pose7"
    frames = FrameSpec("front", (96, 96))

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        return [[self._plan(each, i, horizon) for i in range(candidates)] for each in situations]

    def _plan(self, situation: Any, candidate: int, horizon: int) -> Proposal:
        key, places = situation.key, situation.observation.places
        draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, candidate]), 3)
        name = list(places)[int(draws[0] * len(places))]
        x, y = places[name][:2, 3] + 0.02 * (draws[1:] - 0.5)
        down = [make_action(x, y, height, 0.0) for height in (0.12, 0.028, 0.12)]
        return Proposal(np.array(down[:horizon]), text=f"press the {name} thing")

    def score(self, situations: Any, proposals: Any, rollouts: Any) -> Any:
        return [
            np.array([float(np.ptp(plan.frames.astype(int), axis=0).mean()) for plan in plans]) for plans in rollouts
        ]
