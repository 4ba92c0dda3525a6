# SPDX-License-Identifier: Apache-2.0
"""The interface of policies: propose plans, score imagined futures, and turn scores into a decision."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ContractError
from wiw.types import PRIMITIVES, Answer, Decision, Exchange, Goal, Key, Proposal, Rollout, TextAnswer


@dataclass(frozen=True)
class FrameSpec:
    """The view and size of imagined frames that a policy requests: the paper's 384x384 views, or panoramas of any size.

    A perspective world model can only give its front view, whatever is requested.
    """

    view: str = "front"
    """"front" (HFOV 90), "surround" (front, left, right, back) or "panorama"."""
    size: tuple[int, int] = (384, 384)
    ends: bool = False
    """Whether only the last frame of each plan is needed. Models that compute frames one by one then compute no
    other."""
    source_size: tuple[int, int] | None = None
    """(height, width) of imagined panoramas that suffices for this view and size: it is requested from world models
    that support a range of sizes. None: their default size, the largest."""


@dataclass(frozen=True)
class Situation:
    """One live episode at the moment of a decision, as far as a policy may know."""

    observation: Any
    """`Observation`, or `ArmObservation` for a policy that plans in poses."""
    goal: Goal
    key: Key
    memory: Any
    """Memory of this episode, returned by `Policy.begin`; the policy may change it."""
    executed: tuple[Any, ...] = ()
    """Primitives or poses executed since the episode began."""
    imagines: bool = True
    """Whether a world model will imagine the plans proposed now. If not, a policy that always takes its first plan
    needs to propose only one.
    """
    horizon: int | None = None
    """Maximum number of actions of a proposal; None if not known."""
    execute: int | None = None
    """Maximum number of actions executed before the next decision; None if not known."""


class Policy(ABC):
    """Base, proposal and revision policy in one class (paper, appendix "Policies in Embodied Tasks").

    All calls are batched over the live episodes. All randomness must be derived from `situation.key`.
    """

    space: str = PRIMITIVES
    """Kind of actions in its plans: a name from `wiw.loop.plan_space`."""
    needs: tuple[str, ...] = ()
    """"depth" if observations must include it, "wrist" if they must include the view of an arm's wrist camera."""
    frames: FrameSpec = FrameSpec()
    default_revision: str | None = None
    """Name of the default reviser, if this policy only proposes."""
    longest_decision: int | None = None
    """Maximum number of actions in a plan that `revise` returns, where that may be more than was proposed and
    imagined. None: no more than a proposal has."""
    tokens: int = 0
    """Tokens read and written so far by the policy's language model; 0 without one."""

    @property
    def unwrapped(self) -> Policy:
        """The policy itself, without any wrappers."""
        return self

    @classmethod
    def require(cls, task: Mapping[str, Any]) -> None:
        """Check, before a run begins, that the policy suits a task with this description. Default: any task.

        Raises:
            ArgumentError: it does not.
        """
        return

    def begin(self, goal: Goal, key: Key) -> Any:
        """Return the memory of a new episode; None for a policy without memory."""
        return None

    def observe(self, situations: Sequence[Situation]) -> None:
        """Update the memory; called once per decision before `propose`, even if the policy only revises. Default:
        nothing.
        """
        return

    @abstractmethod
    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return at most `candidates` plans of at most `horizon` actions for each episode, best first."""
        raise NotImplementedError

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return continuations of imagined plans, one list per situation; called for the deeper levels of the beam
        search.

        Each situation is at the end of a plan: its images are imagined, its odometry is where the plan leads if no step
        is refused, and it has no depth. `memory` belongs to the real episode and must not be changed. Default: propose
        as if the agent were there, with a copy of its memory that has observed the place. A policy that observes depth
        must override this.
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
        """Return one score per candidate for each episode, higher is better; one call for all live episodes."""
        raise NotImplementedError(f"{type(self).__name__} only proposes; give the agent a revision policy")

    def score_or_prefer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[NDArray[np.float64]]:
        """Score the plans of all episodes; if nothing was imagined, use the proposer's own preference."""
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
                f"{type(self.unwrapped).__name__}.score: expected scores for each of {len(places)} episodes, got "
                f"{found!r}"
            )
        for place, score in zip(places, found, strict=True):
            scores[place] = score
        return scores

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """Return the plan to execute and its index among the proposals, or None for a new plan. Default: the best
        one.
        """
        best = int(np.argmax(scores))
        return proposals[best].actions, best

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> Sequence[Answer | TextAnswer | None]:
        """Return what each episode's agent believes: an `Answer` if its goal has choices, a `TextAnswer` if it is a
        question; `rollouts` are None without a world model.

        Called on the reviser once per decision, with what is observed and what was imagined. Default: no answer.
        """
        return [None] * len(situations)

    def draw(self, situation: Situation, decision: Decision, north: float) -> Mapping[str, NDArray[np.uint8]]:
        """Return images of what the policy believes, uint8 [H, W, 3] by name. Default: none.

        Called once after each decision, only in episodes whose record keeps images. It must not change the memory: a
        run must decide the same with and without images.

        Args:
            situation: as at the decision; its memory is up to date.
            decision: as made, without what observers measure, such as its fidelity.
            north: azimuth, in the frame of the episode's start, of the upward direction on maps of the scene, so that
                maps can be drawn in the same orientation. It comes from the environment, so only images may depend on
                it; a policy in a separate process gets 0, the heading at the start.
        """
        return {}

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """Return the language model's exchanges of this decision, once; empty without a language model."""
        return ()

    @property
    def spent(self) -> Mapping[str, float]:
        """Resources used so far, for the cost ledger (`Decision.spent`)."""
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
        """Return a JSON-able identity for the run's manifest."""
        return {"policy": type(self).__name__}


def check_revision(policy: Policy, revision: Any, count: int) -> tuple[Any, int | None]:
    """Return what `revise` has decided: a plan, and its number among `count` proposals or None for a new one.

    Raises:
        ContractError: it is no such pair, there is no such proposal, or its number is no whole one.
    """
    name = f"{type(policy.unwrapped).__name__}.revise"
    if not isinstance(revision, Sequence) or len(revision) != 2:
        raise ContractError(f"{name}: expected (actions, number of the proposal, or None), got {revision!r}")
    actions, chosen = revision
    if chosen is None:
        return actions, None
    if isinstance(chosen, bool) or not isinstance(chosen, int | np.integer) or not 0 <= chosen < count:
        raise ContractError(
            f"{name}: expected the number of one of {count} proposals, from 0, or None for a new plan, got {chosen!r}"
        )
    return actions, int(chosen)
