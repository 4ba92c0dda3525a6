# SPDX-License-Identifier: Apache-2.0
"""What a policy is: it proposes plans, scores imagined futures, and turns scores into a decision."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ContractError
from wiw.types import PRIMITIVES, Answer, Exchange, Goal, Key, Proposal, Rollout


@dataclass(frozen=True)
class FrameSpec:
    """How a policy wants imagined frames shown: the paper's 384x384 views, or the whole panorama at a size of its own.

    A perspective world model can only give its front view, whatever is asked for.
    """

    view: str = "front"
    """"front" (HFOV 90), "surround" (front, left, right, back) or "panorama"."""
    size: tuple[int, int] = (384, 384)


@dataclass(frozen=True)
class Situation:
    """One live episode at the moment of a decision, as a policy may know it."""

    observation: Any
    """`Observation`, or `ArmObservation` for a policy that plans in poses."""
    goal: Goal
    key: Key
    memory: Any
    """What `Policy.begin` returned for this episode; the policy may change it."""
    executed: tuple[Any, ...] = ()
    """Primitives, or poses, of all decisions since the episode began."""
    imagines: bool = True
    """Whether a world model is asked about the plans proposed now. Where none is, no more than one plan is of use to a
    policy that takes its first."""


class Policy(ABC):
    """Base, proposal and revision policy in one (paper, appendix "Policies in Embodied Tasks").

    All calls are batched over the live episodes. Randomness must be drawn from `situation.key` alone.
    """

    space: str = PRIMITIVES
    """What its plans are made of: a name of `wiw.loop.plan_space`."""
    needs: tuple[str, ...] = ()
    """"depth" where observations must carry it."""
    frames: FrameSpec = FrameSpec()
    default_revision: str | None = None
    """Name of the reviser that stands in where this policy only proposes."""
    tokens: int = 0
    """Tokens that the policy's language model has read and written so far; 0 without one."""

    @property
    def base(self) -> Policy:
        """The policy itself, behind everything that wraps it."""
        return self

    def begin(self, goal: Goal, key: Key) -> Any:
        """Memory for a new episode; None for a policy that keeps none."""
        return None

    def observe(self, situations: Sequence[Situation]) -> None:
        """Called once a decision, before `propose`, also on a policy that only revises. Default: nothing to keep."""
        return

    @abstractmethod
    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """At most `candidates` plans of at most `horizon` actions for each episode, best first."""
        raise NotImplementedError

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Continuations of imagined plans, one list a situation; asked for where the beam search goes deeper.

        Each situation stands at the end of a kept plan: its images are imagined, its odometry is what the plan leads to
        when no step is refused, it has no depth. `memory` is the real episode's and must not be changed. Default:
        proposes as if the agent had come there, with a copy of its memory that has observed the place. A policy that
        observes depth has to write its own.
        """
        there = [replace(situation, memory=deepcopy(situation.memory)) for situation in situations]
        self.observe(there)
        return self.propose(there, candidates, horizon)

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """One score a candidate for each episode, higher is better. One call for all live episodes."""
        raise NotImplementedError(f"{type(self).__name__} only proposes; give the agent a revision policy")

    def score_or_prefer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[NDArray[np.float64]]:
        """Score the plans of all episodes; where nothing was imagined, the proposer's own preference counts."""
        scores = [np.array([plan.prior for plan in plans], np.float64) for plans in proposals]
        shown = [(place, own) for place, own in enumerate(rollouts) if own is not None]
        if not shown:
            return scores
        places = [place for place, _ in shown]
        found = self.score(
            [situations[place] for place in places], [proposals[place] for place in places], [own for _, own in shown]
        )
        if not isinstance(found, Sequence) or len(found) != len(places):
            raise ContractError(
                f"{type(self.base).__name__}.score: expected scores for each of {len(places)} episodes, got {found!r}"
            )
        for place, score in zip(places, found, strict=True):
            scores[place] = score
        return scores

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """The plan to follow and its index among the proposals, or None for a plan written anew. Default: the best."""
        best = int(np.argmax(scores))
        return proposals[best].actions, best

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[Answer | None]:
        """What each episode's agent believes, where its goal has choices; `rollouts` are None without a world model.

        Asked of the revising policy once a decision, with what is seen and what was imagined. Default: no answer.
        """
        return [None] * len(situations)

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """What a language model was asked for this decision and said, handed over once; nothing without one."""
        return ()

    @property
    def spent(self) -> Mapping[str, float]:
        """What the policy has used up so far, for the cost ledger (`Decision.spent`)."""
        return {"vlm_tokens": self.tokens}

    @property
    def can_revise(self) -> bool:
        """Whether this policy scores imagined futures itself."""
        return type(self).score is not Policy.score

    @property
    def can_extend(self) -> bool:
        """Whether this policy can propose from an imagined place, which has no depth."""
        return type(self).extend is not Policy.extend or "depth" not in self.needs

    def describe(self) -> dict[str, Any]:
        """JSON-able identity for the run's manifest."""
        return {"policy": type(self).__name__}
