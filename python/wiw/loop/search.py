# SPDX-License-Identifier: Apache-2.0
"""Policy-guided beam search, level by level (paper, "Unified Strategy for Closed-Loop Online Planning").

The first level's candidates are the proposals. Deeper ones extend the best of them from where imagination says that
they end. Every level imagines whole plans from the real observation, so a model never has to continue from an imagined
frame, which has neither depth nor a simulator, and errors do not add up over cuts; the common beginnings of a causal
model's plans are imagined once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.action import STOP, to_trajectory
from wiw.loop.config import AgentConfig
from wiw.loop.contract import check_continuations
from wiw.loop.imagination import Imagination
from wiw.loop.plan_space import PlanSpace
from wiw.policies.base import Policy, Situation
from wiw.types import Key, Observation, Proposal

_NO_MORE = Proposal(np.zeros(0, np.int8))
"""The continuation of a plan that ends by stopping, or that the policy does not continue."""


class Search:
    """Candidate plans of all live episodes at the present level.

    Attributes:
        plans: [episode][candidate].
        origins: number of the first-level proposal that each plan began as; it lends its seed, so that a plan keeps
            its future.
    """

    def __init__(self, plans: Sequence[Sequence[Proposal]], space: PlanSpace, config: AgentConfig) -> None:
        self.plans = [list(own) for own in plans]
        self.origins = [list(range(len(own))) for own in plans]
        self.level = 1
        self.costs: list[Counter[str]] = [Counter() for _ in plans]
        """What all levels so far have cost each episode."""
        self._space, self._config = space, config

    def add_costs(self, costs: Sequence[Mapping[str, int]]) -> None:
        """Add what a level has cost each episode."""
        for total, more in zip(self.costs, costs, strict=True):
            total.update(more)

    def extend(
        self,
        policy: Policy,
        situations: Sequence[Situation],
        futures: Imagination,
        scores: Sequence[NDArray[np.float64]],
    ) -> None:
        """Keep the best `width` plans of each episode and let the policy continue them from their imagined ends.

        The prior of a longer plan is the sum of its parts'. Episodes of which nothing was imagined keep their plans.
        """
        kept = [_choose_best(own, self._config.width) if futures.rollouts[e] else [] for e, own in enumerate(scores)]
        going = [(e, c) for e, order in enumerate(kept) for c in order if STOP not in self.plans[e][c].actions]
        more = self._propose_continuations(policy, situations, futures, going)
        for episode, order in enumerate(kept):
            if order:
                self._replace(episode, [(c, plan) for c in order for plan in more.get((episode, c)) or [_NO_MORE]])
        self.level += 1

    def _propose_continuations(
        self, policy: Policy, situations: Sequence[Situation], futures: Imagination, going: list[tuple[int, int]]
    ) -> dict[tuple[int, int], Sequence[Proposal]]:
        """Return what the policy proposes at the ends of the (episode, candidate) plans `going`."""
        if not going:
            return {}
        candidates, horizon = self._config.candidates or 1, self._config.horizon or 1
        found = policy.extend(self._move_to_ends(situations, futures, going), candidates, horizon)
        check_continuations(policy, self._space, found, len(going), candidates, horizon)
        return dict(zip(going, found, strict=True))

    def _replace(self, episode: int, pairs: Sequence[tuple[int, Proposal]]) -> None:
        old, origins = self.plans[episode], self.origins[episode]
        self.plans[episode] = [_join(old[c], more) for c, more in pairs]
        self.origins[episode] = [origins[c] for c, _ in pairs]

    def _move_to_ends(
        self, situations: Sequence[Situation], futures: Imagination, going: Sequence[tuple[int, int]]
    ) -> list[Situation]:
        """Return the episodes' situations at the ends of the (episode, candidate) plans `going`."""
        panoramas, fronts = futures.ends(going)
        ends = []
        for (episode, candidate), panorama, front in zip(going, panoramas, fronts, strict=True):
            here, actions = situations[episode], self.plans[episode][candidate].actions
            seed = core.fold_key([here.key.seed, self.level, candidate])
            key = Key(seed, here.key.episode, here.key.decision)
            observation = Observation(panorama, front, move(here.observation.odometry, actions))
            executed = (*here.executed, *actions.tolist())
            ends.append(replace(here, observation=observation, key=key, executed=executed))
        return ends


def _choose_best(scores: NDArray[np.float64], width: int | None) -> list[int]:
    """Return the candidates with the highest scores, best first; equal scores keep their order."""
    return [int(c) for c in np.argsort(-scores, kind="stable")[:width]]


def _join(plan: Proposal, more: Proposal) -> Proposal:
    actions = np.concatenate([plan.actions, more.actions])
    return Proposal(actions, plan.prior + more.prior, more.note or plan.note)


def move(odometry: NDArray[np.float64], actions: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return the odometry after a plan of which no action is refused, float64 [3]; azimuth in [-pi, pi]."""
    forward, left, turned = to_trajectory(actions)[-1]
    x, y, azimuth = odometry
    cos, sin = np.cos(azimuth), np.sin(azimuth)
    angle = np.remainder(azimuth + turned + np.pi, 2 * np.pi) - np.pi
    return np.array([x + cos * forward - sin * left, y + sin * forward + cos * left, angle])
