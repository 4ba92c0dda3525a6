# SPDX-License-Identifier: Apache-2.0
"""The memories of live episodes between their decisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.loop.config import AgentConfig
from wiw.loop.contract import check_answerer
from wiw.loop.history import EpisodeHistories
from wiw.loop.imagination import Imaginer
from wiw.policies.base import Policy, Situation
from wiw.types import ArmObservation, Goal, Key, Observation
from wiw.world_models.base import Accepts


@dataclass(frozen=True)
class Query:
    """One live episode that is due for a decision: what an agent may know of it."""

    observation: Observation | ArmObservation
    goal: Goal
    key: Key
    north: float | None = None
    """Azimuth, in the frame of the start, of what is up on maps of the scene. None: no pictures are kept of this
    decision. No decision depends on it: it is for `Policy.draw` alone.
    """
    executed: tuple[Any, ...] | None = None
    """Actions carried out since the episode began. None: all that were decided, where the asker does not say."""


def read_observation(observation: Any) -> Observation | ArmObservation:
    """Return an observation as agents take it, from one or from the dict of an environment.

    Raises:
        ArgumentError: a dict whose images have boxes drawn on them, which no world model is to see, or a
            manipulator's, which lacks what policies are given.
    """
    if not isinstance(observation, dict):
        return observation
    if "pose" in observation:
        raise ArgumentError("decide: this dict lacks the poses that an agent needs; pass env.unwrapped.observation")
    if "panorama_box" in observation:
        raise ArgumentError("decide: these images have the target's box drawn on them; pass env.observation")
    return Observation(**observation)


@dataclass
class EpisodeMemory:
    """Memory of one live episode."""

    proposer: Any
    """Memory of the proposing policy; the reviser's too where one policy is both."""
    reviser: Any
    executed: list[Any] = field(default_factory=list)
    """Actions carried out so far; those of the latest decision as far as they are to be."""


class EpisodeMemories:
    """Memories of all live episodes; an episode's is made with its first decision.

    Args:
        policy: that proposes.
        reviser: that scores.
        config: complete; what policies are told of the search.
        accepts: declaration of the world model, in the size requested from it; None without one.
    """

    def __init__(self, policy: Policy, reviser: Policy, config: AgentConfig, accepts: Accepts | None) -> None:
        self._policy, self._reviser = policy, reviser
        longest = max(config.longest, reviser.longest_decision or 0)
        self._limits = config.horizon, config.count_executed(longest)
        self.histories = EpisodeHistories(accepts)
        """What world models with a memory are shown."""
        self._by_episode: dict[tuple[int, int], EpisodeMemory] = {}

    def recall(self, queries: Sequence[Query], imaginer: Imaginer) -> tuple[list[Situation], list[Situation]]:
        """Return each episode as its proposer and as its reviser know it."""
        proposing, revising = [], []
        for query in queries:
            memory = self._begin_or_continue(query)
            if query.executed is not None:
                memory.executed = list(query.executed)
            known = query.observation, query.goal, query.key
            executed, imagines = tuple(memory.executed), imaginer.consults(query.key)
            proposing.append(Situation(*known, memory.proposer, executed, imagines, *self._limits))
            revising.append(Situation(*known, memory.reviser, executed, imagines, *self._limits))
        return proposing, revising

    def record(self, key: Key, actions: NDArray[Any]) -> None:
        """Record the actions that are about to be executed; the next query may know of fewer."""
        self._by_episode[key.seed, key.episode].executed += actions.tolist()

    def forget(self, key: Key) -> None:
        """Drop the memory of an episode that has ended."""
        self._by_episode.pop((key.seed, key.episode), None)
        self.histories.forget(key)

    def _begin_or_continue(self, query: Query) -> EpisodeMemory:
        """Return an episode's memory; its first decision begins anew, for a retried episode knows nothing."""
        name = query.key.seed, query.key.episode
        if query.key.decision == 0 or name not in self._by_episode:
            check_answerer(self._reviser, query.goal)
            proposer = reviser = self._policy.begin(query.goal, query.key)
            if self._reviser.unwrapped is not self._policy.unwrapped:
                reviser = self._reviser.begin(query.goal, query.key)
            self._by_episode[name] = EpisodeMemory(proposer, reviser)
        return self._by_episode[name]
