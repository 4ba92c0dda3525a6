# SPDX-License-Identifier: Apache-2.0
"""Policy-guided beam search, level by level (paper, "Unified Strategy for Closed-Loop Online Planning").

The first level's candidates are the proposals. Deeper ones extend the best of them from where imagination says that
they end. Every level imagines whole plans from the real observation, so a model needs nothing of an imagined frame,
neither depth nor a simulator, and errors do not add up over cuts; the common beginnings of a causal model's plans are
imagined once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core, planner
from wiw.action import STOP, to_trajectory
from wiw.loop.contract import check_proposals
from wiw.loop.imagine import Imagination
from wiw.policies.base import Policy, Situation
from wiw.types import Key, Observation, Proposal

NOTHING = Proposal(np.zeros(0, np.int8))
"""The continuation of a plan that ends by stopping, or that the policy does not go on with."""


class Beams:
    """Candidate plans of all live episodes at the present level."""

    def __init__(
        self, situations: Sequence[Situation], proposals: Sequence[Sequence[Proposal]], width: int, depth: int
    ) -> None:
        self.proposals = [list(plans) for plans in proposals]
        self.origins = [list(range(len(plans))) for plans in proposals]
        """First-level proposal that each plan began as; it lends its seed, so that a plan keeps its future."""
        self.calls: list[Counter[str]] = [Counter() for _ in proposals]
        """What all levels so far have cost each episode."""
        self._situations = situations
        self._search = None if depth == 1 else planner.BeamSearch(width, depth)
        if self._search is not None:
            self._search.ask([[plan.actions for plan in plans] for plans in proposals])

    @property
    def level(self) -> int:
        """The present level, from 1."""
        return 1 if self._search is None else int(self._search.level) + 1

    def spend(self, calls: Sequence[Mapping[str, int]]) -> None:
        """Adds what a level has cost each episode."""
        for total, more in zip(self.calls, calls, strict=True):
            total.update(more)

    def extend(
        self, policy: Policy, imagined: Imagination, scores: Sequence[Any], candidates: int, horizon: int
    ) -> None:
        """Keeps the best `width` plans of each episode and lets the policy go on from their imagined ends.

        The prior of a longer plan is the sum of its parts'.
        """
        assert self._search is not None  # one level is not extended
        kept = [[int(c) for c in order] for order in self._search.tell(scores)]
        going = [(e, c) for e, order in enumerate(kept) for c in order if STOP not in self.proposals[e][c].actions]
        more = policy.extend(self._at_ends(imagined, going), candidates, horizon) if going else []
        check_proposals(policy, [plans for plans in more if plans], sum(map(bool, more)), candidates, horizon)
        found = dict(zip(going, more, strict=True))
        pairs = [[(c, p) for c in order for p in found.get((e, c)) or [NOTHING]] for e, order in enumerate(kept)]
        plans = self._search.ask(
            [[[p.actions for own, p in row if own == c] for c in order] for row, order in zip(pairs, kept, strict=True)]
        )
        self.proposals = [
            [_joined(old[c], p, plan) for (c, p), plan in zip(row, longer, strict=True)]
            for old, row, longer in zip(self.proposals, pairs, plans, strict=True)
        ]
        self.origins = [[old[c] for c, _ in row] for old, row in zip(self.origins, pairs, strict=True)]

    def _at_ends(self, imagined: Imagination, chosen: Sequence[tuple[int, int]]) -> list[Situation]:
        """The episodes as they would stand at the ends of the chosen (episode, candidate) plans."""
        first = np.cumsum([0, *map(len, self.proposals)])
        panoramas, fronts = imagined.ends([first[e] + c for e, c in chosen])
        there = []
        for (e, c), panorama, front in zip(chosen, panoramas, fronts, strict=True):
            here = self._situations[e]
            actions = self.proposals[e][c].actions
            odometry = moved(here.observation.odometry, actions)
            seed = core.fold_key([here.key.seed, self.level - 1, c])
            key = Key(seed, here.key.episode, here.key.decision)
            executed = (*here.executed, *actions.tolist())
            there.append(Situation(Observation(panorama, front, odometry), here.goal, key, here.memory, executed))
        return there


def moved(odometry: NDArray[np.float64], actions: NDArray[np.int8]) -> NDArray[np.float64]:
    """float64 [3]: odometry after a plan of which no step is refused; azimuth in [-pi, pi]."""
    forward, left, turned = to_trajectory(actions)[-1]
    x, y, azimuth = odometry
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    angle = np.remainder(azimuth + turned + np.pi, 2 * np.pi) - np.pi
    return np.array([x + cos * forward - sin * left, y + sin * forward + cos * left, angle])


def _joined(plan: Proposal, more: Proposal, actions: NDArray[np.int8]) -> Proposal:
    return Proposal(actions, plan.prior + more.prior, more.note or plan.note)
