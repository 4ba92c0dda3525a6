# SPDX-License-Identifier: Apache-2.0
"""One pass of the loop over all live episodes: its steps, each checked against its contract and timed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.loop.config import AgentConfig
from wiw.loop.contract import (
    check_answers,
    check_observations,
    check_pictures,
    check_proposals,
    check_scores,
)
from wiw.loop.imagination import Imagination, Imaginer, ModelInput, NoImagination, Request
from wiw.loop.ledger import Ledger
from wiw.loop.memory import EpisodeMemories, Query
from wiw.loop.observers import Observer, ScoringBatch
from wiw.loop.plan_space import PlanSpace
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.loop.search import Search
from wiw.policies.base import FrameSpec, Policy, check_revision
from wiw.types import Answer, Decision, Proposal, TextAnswer


@dataclass(frozen=True)
class AgentParts:
    """The parts of an agent, built and checked."""

    policy: Policy
    imaginer: Imaginer
    reviser: Policy
    space: PlanSpace
    config: AgentConfig
    """Complete."""
    observers: Sequence[Observer]
    memories: EpisodeMemories

    @property
    def frames(self) -> FrameSpec:
        """How imagined frames are used."""
        return choose_frames(self.policy, self.reviser, self.config)

    @property
    def needs(self) -> tuple[str, ...]:
        """Inputs that observations must carry beyond images: "depth"."""
        return tuple(sorted({*self.policy.needs, *self.reviser.needs, *self.imaginer.needs}))

    def describe_model(self) -> dict[str, Any]:
        """Return a JSON-able identity of the world model, and its size where it draws in several."""
        imaginer, model = self.imaginer, self.imaginer.model
        if model is None or not model.accepts.is_scalable:
            return imaginer.describe()
        return {**imaginer.describe(), "model_size": model.accepts.fit_size(self.frames.source_size)}

    def count_spent(self) -> Counter[str]:
        """Return what model and policies have been asked for so far."""
        counts = Counter[str](self.policy.spent)
        if self.reviser.unwrapped is not self.policy.unwrapped:
            counts.update(self.reviser.spent)
        counts.update(self.imaginer.spent)
        return counts

    def grant(self, environments: LiveEnvironments) -> None:
        """Give the privileged parts the environments that episodes are run in."""
        parts = (self.policy, self.reviser, self.imaginer, *self.observers)
        for part in {id(part): part for part in parts}.values():
            if isinstance(part, Privileged):
                part.grant(environments)


def choose_frames(policy: Policy, reviser: Policy, config: AgentConfig) -> FrameSpec:
    """Return the frames that the reviser requests.

    In a search of several levels the proposer looks at imagined ends as it looks at the world: only frames that suffice
    for both suffice.
    """
    frames = reviser.frames
    sources = [frames.source_size, *([policy.frames.source_size] if (config.depth or 1) > 1 else [])]
    known = [source for source in sources if source is not None]
    if len(known) < len(sources):
        return replace(frames, source_size=None)
    height, width = (max(sides) for sides in zip(*known, strict=True))
    return replace(frames, source_size=(height, width))


class DecisionPass:
    """The steps between a batch of queries and a decision for each."""

    def __init__(self, parts: AgentParts, queries: Sequence[Query]) -> None:
        self._parts, self._queries = parts, queries
        check_observations(parts.needs, [query.observation for query in queries])
        self._ledger = Ledger(parts.count_spent, len(queries))
        self._proposing, self._revising = parts.memories.recall(queries, parts.imaginer)
        with self._ledger.clock("platform"):
            histories = parts.memories.histories.add(self._proposing)
            self._inputs = [
                ModelInput(query.observation, history=own) for query, own in zip(queries, histories, strict=True)
            ]

    def propose(self) -> Search:
        """Let the policy propose plans."""
        policy, reviser, config = self._parts.policy, self._parts.reviser, self._parts.config
        most, horizon = config.pool or 1, config.horizon or 1
        with self._ledger.clock("propose"):
            policy.observe(self._proposing)
            if reviser.unwrapped is not policy.unwrapped:
                reviser.observe(self._revising)
            plans = policy.propose(self._proposing, most, horizon)
            check_proposals(policy, self._parts.space, plans, len(self._queries), most, horizon)
        return Search([own[: config.candidates] for own in plans], self._parts.space, config)

    def extend(self, search: Search, futures: Imagination, scores: Sequence[NDArray[np.float64]]) -> None:
        """Let the policy continue the best plans from where they are imagined to end."""
        with self._ledger.clock("propose"):
            search.extend(self._parts.policy, self._proposing, futures, scores)

    def imagine(self, search: Search) -> Imagination:
        """Let the world model imagine every plan of every episode."""
        if self._parts.imaginer.model is None:
            return NoImagination(len(self._queries))
        request = Request(
            self._parts.space,
            [query.key for query in self._queries],
            [query.observation for query in self._queries],
            self._inputs,
            search.plans,
            search.origins,
            self._parts.frames,
            self._ledger.clock,
        )
        futures = self._parts.imaginer.imagine(request)
        search.add_costs(futures.costs)
        return futures

    def score(self, search: Search, futures: Imagination) -> list[NDArray[np.float64]]:
        """Let the reviser score every plan by its imagined future."""
        reviser, clock = self._parts.reviser, self._ledger.clock
        if search.level == self._parts.config.depth:
            batch = ScoringBatch(
                reviser, self._parts.space, self._queries, self._revising, search.plans, futures, clock
            )
            for observer in self._parts.observers:
                observer.watch(batch)
        with clock("revise"):
            scores = reviser.score_or_prefer(self._revising, search.plans, futures.rollouts)
            return check_scores(reviser, scores, search.plans)

    def revise(self, search: Search, futures: Imagination, scores: Sequence[NDArray[np.float64]]) -> list[Decision]:
        """Let the reviser answer and decide."""
        reviser = self._parts.reviser
        with self._ledger.clock("revise"):
            answers = reviser.answer(self._revising, search.plans, futures.rollouts)
            answers = check_answers(reviser, answers, self._revising)
        shared = self._ledger.close()
        return [
            self._decide(episode, search, futures, scores[episode], answers[episode], shared)
            for episode in range(len(self._queries))
        ]

    def _decide(
        self,
        episode: int,
        search: Search,
        futures: Imagination,
        scores: NDArray[np.float64],
        answer: Answer | TextAnswer | None,
        shared: Mapping[str, Any],
    ) -> Decision:
        """Return one episode's decision with all evidence."""
        query, plans, rollouts = self._queries[episode], search.plans[episode], futures.rollouts[episode]
        actions, chosen = self._choose(episode, plans, scores)
        execute = self._parts.config.count_executed(len(actions))
        self._parts.memories.record(query.key, actions[:execute])
        exchanges = tuple(each for policy in self._list_policies() for each in policy.exchanges(query.key))
        decision = Decision(
            actions=actions,
            execute=execute,
            proposals=tuple(plans),
            rollouts=None if rollouts is None else tuple(rollouts),
            scores=np.asarray(scores, np.float64),
            chosen=chosen,
            answer=answer,
            observation=query.observation,
            goal=query.goal,
            key=query.key,
            calls=dict(search.costs[episode]),
            note="; ".join(f"{each.purpose}: {each.problem}, {each.instead}" for each in exchanges if each.problem),
            exchanges=exchanges,
            **shared,
        )
        if query.north is not None:
            decision = self._add_pictures(episode, decision, query.north)
        for observer in self._parts.observers:  # after the policies have drawn: observers may add what is true
            decision = observer.annotate(decision)
        return decision

    def _add_pictures(self, episode: int, decision: Decision, north: float) -> Decision:
        """Let the policies draw what they believe. Of pictures of one name that of the reviser is kept."""
        pictures: dict[str, NDArray[np.uint8]] = {}
        for policy, situations in zip(self._list_policies(), (self._proposing, self._revising), strict=False):
            pictures |= check_pictures(policy, policy.draw(situations[episode], decision, north))
        return replace(decision, pictures=pictures)

    def _choose(
        self, episode: int, plans: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        reviser, config = self._parts.reviser, self._parts.config
        actions, chosen = check_revision(reviser, reviser.revise(self._revising[episode], plans, scores), len(plans))
        source = f"{type(reviser.unwrapped).__name__}.revise"
        longest = max(config.longest, reviser.longest_decision or 0)
        return self._parts.space.check_plan(source, actions, longest), chosen

    def _list_policies(self) -> list[Policy]:
        policy, reviser = self._parts.policy, self._parts.reviser
        return [policy] if reviser.unwrapped is policy.unwrapped else [policy, reviser]
