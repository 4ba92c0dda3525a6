# SPDX-License-Identifier: Apache-2.0
"""The closed loop's inside: propose, imagine, revise (paper, "Unified Strategy for Closed-Loop Online Planning")."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.loop.attempts import DEADLINE, Attempts, make_model
from wiw.loop.beam import Beams
from wiw.loop.clock import Clock
from wiw.loop.contract import (
    PLANS,
    check_answerer,
    check_depth,
    check_model,
    check_proposals,
    checked_answers,
    checked_plan,
    checked_scores,
)
from wiw.loop.fidelity import remembered, replay
from wiw.loop.imagine import Imagination, model_spec
from wiw.loop.imagine_poses import IMAGINE, PoseImagination
from wiw.loop.labels import SIMULATOR, labelled, semantics_source
from wiw.loop.placebo import PLACEBOS, Placebo, shuffled
from wiw.loop.rollout_cache import BUDGET_GB, Asking, remember
from wiw.loop.swaps import GUIDED, checked_swaps, true_plans, true_scores
from wiw.metrics import Lpips
from wiw.policies.base import Policy, Situation
from wiw.registry import POLICIES
from wiw.types import ArmObservation, Decision, Fidelity, Goal, Key, Observation, Proposal, Rollout, Space
from wiw.world_models.base import WorldModel

_CONSULT = 0x636F6E73
"""Keeps the draw whether to consult apart from all others of the decision."""


@dataclass(frozen=True)
class Query:
    """One live episode that asks for a decision."""

    observation: Observation | ArmObservation
    goal: Goal
    key: Key
    simulator: Any = None
    """Fork of the environment; only looked at when the world model declares that it needs one."""
    stranger: Query | None = None
    """First moment of another episode; only looked at by an agent with placebo="swapped"."""
    guide: Any = None
    """What plans are truly worth; only looked at by an agent with swaps."""
    semantic: NDArray[np.uint32] | None = None
    """uint32 [H, W]: what the panorama's pixels truly are; only looked at by an agent with semantics="simulator"."""


@dataclass(frozen=True)
class _Future:
    """What one episode has to choose from."""

    proposals: Sequence[Proposal]
    rollouts: Sequence[Rollout] | None
    """None where nothing was imagined."""
    scores: NDArray[np.float64]
    calls: Mapping[str, int]
    fidelity: Fidelity | None = None


@dataclass
class _Life:
    """What is kept of one live episode."""

    proposer: Any
    """Memory of the proposing policy; the reviser's too where one policy is both."""
    reviser: Any
    executed: list[Any]
    """Actions of all decisions so far, as far as they were to be carried out."""


class Agent:
    """A policy with or without a world model.

    Args:
        policy: base and proposal policy (name or instance).
        model: world model (name or instance); None runs the same loop with imagination left out.
        revision: policy that scores imagined futures; None means the policy itself, or its default reviser.
        candidates: plans per decision (M); None means the number of the task that the agent is evaluated on, else 3.
        horizon: primitives per plan (L); None means the task's own number, else 5.
        execute: primitives carried out before the next decision; None means the task's own number, or L - 2, as in the
            paper's ImageNav, where `horizon` is given. 0 carries out all of the plan; a negative number leaves that
            many of the plan's first `horizon` undone, but carries out at least one.
        depth: levels of the beam search. At 1, the paper's, the proposals are what is chosen from; each further level
            extends the best plans by `horizon` primitives, as `Policy.extend` proposes from their imagined ends.
            Without a model nothing is imagined, and there is one level.
        width: plans of an episode that are kept and extended; None means `candidates`.
        deadline: seconds that a call of the world model, or its constructor, may take before it counts as failed
            (`wiw.loop.attempts`).
        cache: "auto" keeps the rollouts of models that declare themselves `cacheable` in `~/.cache/wiw/rollouts`, a
            folder keeps those of any model with a `version` there, "off" keeps none (`wiw.loop.rollout_cache`).
        cache_gb: most gigabytes of that folder; what was not used for longest goes first.
        pool: plans that are proposed, of which the first `candidates` are kept, so that the sets of agents that differ
            in `candidates` alone are nested; None proposes as many as are kept.
        imagine_fraction: share of decisions for which the model is consulted; for the others the proposer's own
            preference decides. Drawn by the decision's key: what a smaller share consults, a larger one does too.
        fidelity: whether every plan is also replayed in the simulator, to tell how true imagination was
            (`wiw.loop.fidelity`); changes no decision, and needs a simulator with every query.
        lpips: folder of the weights of LPIPS ("auto": `~/.cache/wiw/weights`), to measure fidelity by it as well.
        placebo: "shuffled" or "swapped" lets the model imagine something else than the plans (`wiw.loop.placebo`).
        swaps: stages that are told the truth, of "imagination", "scoring" and "proposals" (`wiw.loop.swaps`).
        semantics: what tells world models that need it what each pixel is: "simulator", "rednet" or another source
            (`wiw.perception.semantics`); left alone where the model needs none.
        space: what plans are made of, "discrete" primitives or "pose7" poses of a gripper, for a policy that can make
            both; None means the task's own, else the policy's.

    Raises:
        ConstructionError: the constructor of a model or policy raised; a model's did not return by the deadline.
        WeightsError: those of LPIPS are not there.
        ArgumentError: a number out of range; a policy that makes plans of another kind; a model that would not be given
            what it needs; with depth > 1, a model that shows no panorama or a policy that needs depth, which no
            imagined place has, and does not say how to extend.
    """

    def __init__(
        self,
        policy: Any,
        model: Any = None,
        revision: Any = None,
        candidates: int | None = None,
        horizon: int | None = None,
        execute: int | None = None,
        depth: int = 1,
        width: int | None = None,
        deadline: float = DEADLINE,
        cache: str | Path = "auto",
        cache_gb: float = BUDGET_GB,
        fidelity: bool = False,
        lpips: str | Path | None = None,
        placebo: Placebo | None = None,
        pool: int | None = None,
        imagine_fraction: float = 1.0,
        swaps: Collection[str] = (),
        semantics: Any = None,
        space: Space | None = None,
    ) -> None:
        self.swaps = checked_swaps(swaps)
        if "imagination" in self.swaps:
            model, placebo = "oracle", None
        numbers = {"candidates": candidates, "horizon": horizon, "execute": execute, "depth": depth, "width": width}
        self.given = {name: value for name, value in numbers.items() if value is not None}
        """The numbers that were not left to the task."""
        self._given_space = space
        self.policy: Policy = _of_space(POLICIES.make(policy), space)
        made = None if model is None else make_model(model, deadline)
        self.model: WorldModel | None = None if made is None else made.for_space(self.policy.space)
        self._given_revision = revision
        self.revision: Policy = self._reviser(revision)
        if self.revision.space != self.policy.space:
            raise ArgumentError(
                f"Agent: {type(self.policy).__name__} plans in {PLANS[self.policy.space]}, but the reviser "
                f"{type(self.revision).__name__} in {PLANS[self.revision.space]}"
            )
        self.candidates = 3 if candidates is None else candidates
        self.horizon = 5 if horizon is None else horizon
        self.execute = max(1, self.horizon - 2) if execute is None else execute
        self.depth, self.width = depth, self.candidates if width is None else width
        if min(self.candidates, self.depth, self.width) < 1 or self.horizon < 1 or abs(self.execute) > self.horizon:
            raise ArgumentError(
                f"Agent: expected candidates, depth and width >= 1 and execute from -horizon to horizon, got "
                f"candidates={self.candidates}, horizon={self.horizon}, execute={self.execute}, depth={depth}, "
                f"width={self.width}"
            )
        self.pool, self.imagine_fraction = self.candidates if pool is None else pool, imagine_fraction
        self._given_pool = pool
        if self.pool < self.candidates or not 0 <= imagine_fraction <= 1:
            raise ArgumentError(
                f"Agent: expected a pool of at least candidates={self.candidates} and an imagine_fraction from 0 to 1, "
                f"got pool={pool}, imagine_fraction={imagine_fraction}"
            )
        self.placebo = placebo
        if placebo is not None and (placebo not in PLACEBOS or self.model is None):
            raise ArgumentError(
                f"Agent: expected placebo {' or '.join(PLACEBOS)}, with a world model, got '{placebo}' and {self.model}"
            )
        self._limits: dict[str, Any] = {"deadline": deadline, "cache": cache, "cache_gb": cache_gb}
        self._limits |= {"fidelity": fidelity, "lpips": lpips}
        self.fidelity = (fidelity or lpips is not None) and self.model is not None
        self._lpips = None if lpips is None or not self.fidelity else Lpips(lpips)
        if placebo == "shuffled" and self.policy.space == "pose7":
            raise ArgumentError("Agent: placebo='shuffled' deals primitives anew, and poses are none; use 'swapped'")
        self.semantics = semantics_source(semantics)
        self._ask: Asking | None = None
        if self.model is not None:
            self._ask = remember(Attempts(self.model, deadline), cache, cache_gb)
            check_model(self.model, self.horizon * self.depth, self.policy.space, self.semantics is not None)
            if self.depth > 1:
                self._check_depth(self.model)
        self._lives: dict[tuple[int, int], _Life] = {}

    @property
    def needs(self) -> tuple[str, ...]:
        """What queries must carry beyond images: "depth", "semantic", "simulator", "guide"."""
        model = set() if self.model is None else set(self.model.accepts.needs)
        if "semantic" in model and self.semantics != SIMULATOR:
            model = (model - {"semantic"}) | set(getattr(self.semantics, "needs", ()))
        replays = ("simulator",) if self.fidelity else ()
        truth = ("guide",) if GUIDED & set(self.swaps) else ()
        return tuple(sorted({*self.policy.needs, *self.revision.needs, *model, *replays, *truth}))

    def decide(self, observation: Any, goal: Goal, key: Key, simulator: Any = None) -> Decision:
        """One decision for one episode; `observation` is an Observation or the environment's dict.

        Raises:
            ArgumentError: a dict whose images have boxes drawn on them, which no world model is to see, or a
                manipulator's, which lacks what policies are told.
        """
        if isinstance(observation, dict):
            if "pose" in observation:
                raise ArgumentError("decide: this dict does not say where things are; pass env.unwrapped.observation")
            if "panorama_box" in observation:
                raise ArgumentError("decide: these images have the target's box drawn on them; pass env.observation")
            observation = Observation(**observation)
        return self.decide_batch([Query(observation, goal, key, simulator)])[0]

    def decide_batch(self, queries: Sequence[Query]) -> list[Decision]:
        """One decision for each live episode; model and reviser see all candidates of all of them at once."""
        check_depth(self.needs, [query.observation for query in queries])
        clock, meter = Clock(), self.meter()
        proposing, revising = self._situations(queries)
        with clock("propose"):
            self.policy.observe(proposing)
            if self.revision is not self.policy:
                self.revision.observe(revising)
            proposals = self.policy.propose(proposing, self.pool, self.horizon)
            check_proposals(self.policy, proposals, len(queries), self.pool, self.horizon)
            proposals = [plans[: self.candidates] for plans in proposals]
        if "proposals" in self.swaps:
            proposals = true_plans(queries, proposals, self.candidates, self.horizon)
        futures = self._futures(queries, proposing, revising, proposals, clock)
        with clock("revise"):
            shown = [future.proposals for future in futures], [future.rollouts for future in futures]
            answers = checked_answers(self.revision, self.revision.answer(revising, *shown), revising)
        spent = {name: (count - meter[name]) / len(queries) for name, count in self.meter().items()}
        costs = {"seconds": clock.share(len(queries)), "spent": spent}
        return [
            self._decision(query, situation, future, answer, costs)
            for query, situation, future, answer in zip(queries, revising, futures, answers, strict=True)
        ]

    def forget(self, key: Key) -> None:
        """Drops the memory of an episode that has ended."""
        self._lives.pop((key.seed, key.episode), None)

    def but(self, **changes: Any) -> Agent:
        """The same agent with other parts or numbers, e.g. `agent.but(model="oracle")`; what is open stays open."""
        parts = {"policy": self.policy, "model": self.model, "revision": self._given_revision}
        parts |= {"placebo": self.placebo, "pool": self._given_pool, "imagine_fraction": self.imagine_fraction}
        parts |= {"swaps": self.swaps, "semantics": self.semantics, "space": self._given_space}
        return Agent(**{**parts, **self._limits, **self.given, **changes})

    def settled(self, defaults: Mapping[str, Any]) -> Agent:
        """The same agent with a task's numbers where it was given none.

        The task's reviser, if it names one, stands in for the default reviser of a policy that only proposes.
        """
        numbers = {name: value for name, value in defaults.items() if name != "revision"}
        changes: dict[str, Any] = settled_numbers(self.given, numbers)
        if "revision" in defaults and self._given_revision is None and self.policy.default_revision is not None:
            changes["revision"] = defaults["revision"]
        return self.but(**changes)

    def describe(self) -> dict[str, Any]:
        """JSON-able identity for the run's manifest."""
        return {
            "policy": self.policy.describe(),
            "revision": self.revision.describe(),
            "model": None if self.model is None else self.model.describe(),
            "candidates": self.candidates,
            "horizon": self.horizon,
            "execute": self.execute,
            "depth": self.depth,
            "width": self.width,
            **({} if self.placebo is None else {"placebo": self.placebo}),
            **({} if self._given_pool is None else {"pool": self.pool}),
            **({} if self.imagine_fraction == 1 else {"imagine_fraction": self.imagine_fraction}),
            **({} if not self.swaps else {"swaps": list(self.swaps)}),
            **({} if self.semantics is None else {"semantics": _described(self.semantics)}),
        }

    @property
    def _policies(self) -> list[Policy]:
        return [self.policy] if self.revision is self.policy else [self.policy, self.revision]

    def meter(self) -> Counter[str]:
        """What the agent's model and policies have been asked for so far."""
        counts: Counter[str] = Counter()
        for policy in self._policies:
            counts.update(policy.spent)
        if self._ask is not None:
            counts.update(self._ask.tally)
        if (charged := getattr(self.model, "credits", None)) is not None:
            counts["credits"] = charged
        return counts

    def _futures(
        self,
        queries: Sequence[Query],
        proposing: Sequence[Situation],
        revising: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        clock: Clock,
    ) -> list[_Future]:
        """What each episode has to choose from: imagined and scored, or with the proposer's own preference."""
        futures = [_Future(plans, None, np.array([plan.prior for plan in plans]), {}) for plans in proposals]
        asking = [place for place, situation in enumerate(proposing) if situation.imagines]
        if self._ask is not None and asking:
            imagined = self._imagined(
                self._ask,
                [queries[place] for place in asking],
                [proposing[place] for place in asking],
                [revising[place] for place in asking],
                [proposals[place] for place in asking],
                clock,
            )
            for place, future in zip(asking, imagined, strict=True):
                futures[place] = future
        return self._judged(queries, futures) if "scoring" in self.swaps else futures

    def _judged(self, queries: Sequence[Query], futures: list[_Future]) -> list[_Future]:
        """The same with true scores where nothing was imagined either."""
        alone = [place for place, future in enumerate(futures) if future.rollouts is None]
        scores = true_scores([queries[place] for place in alone], [futures[place].proposals for place in alone])
        for place, score in zip(alone, scores, strict=True):
            futures[place] = replace(futures[place], scores=score)
        return futures

    def _imagined(
        self,
        ask: Asking,
        queries: Sequence[Query],
        proposing: Sequence[Situation],
        revising: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        clock: Clock,
    ) -> list[_Future]:
        """What each episode has to choose from after looking ahead."""
        beams = Beams(proposing, proposals, self.width, self.depth)
        while True:
            last = beams.level == self.depth
            before = remembered(revising) if self.fidelity and last else []
            imagined, scores = self._look_ahead(ask, queries, revising, beams, clock)
            if last:
                break
            assert isinstance(imagined, Imagination)  # of poses there is one level
            with clock("propose"):
                beams.extend(self.policy, imagined, scores, self.candidates, self.horizon)
        found: list[Fidelity | None] = [None] * len(queries)
        if self.fidelity:
            with clock("replay"):
                found = [*replay(self.revision, queries, before, beams.proposals, imagined, scores, self._lpips)]
        rows = zip(beams.proposals, imagined.rollouts, scores, beams.calls, found, strict=True)
        return [_Future(plans, rollouts, score, dict(calls), true) for plans, rollouts, score, calls, true in rows]

    def _look_ahead(
        self,
        ask: Asking,
        queries: Sequence[Query],
        revising: Sequence[Situation],
        beams: Beams,
        clock: Clock,
    ) -> tuple[Imagination | PoseImagination, list[NDArray[np.float64]]]:
        """Imagines and scores the plans of one level."""
        plans: Sequence[Sequence[Proposal]] = beams.proposals
        if self.placebo == "shuffled":
            spec = model_spec(ask.model.accepts)
            plans = [shuffled(own, query.key, spec) for own, query in zip(plans, queries, strict=True)]
        seen = [_stranger(query) for query in queries] if self.placebo == "swapped" else None
        if "semantic" in ask.model.accepts.needs:
            with clock("platform"):
                seen = labelled(self.semantics, queries if seen is None else seen)
        imagined = IMAGINE[self.policy.space](ask, queries, plans, beams.origins, self.revision.frames, clock, seen)
        beams.spend(imagined.calls)
        with clock("revise"):
            scores = self.revision.score(revising, beams.proposals, imagined.rollouts)
            found = checked_scores(self.revision, scores, beams.proposals)
        return imagined, true_scores(queries, beams.proposals) if "scoring" in self.swaps else found

    def _check_depth(self, model: WorldModel) -> None:
        if self.policy.space == "pose7":
            raise ArgumentError(f"Agent: depth={self.depth} proposes from imagined places, and a gripper sees none")
        if model.accepts.view != "panorama":
            raise ArgumentError(
                f"Agent: depth={self.depth} proposes from imagined panoramas, but {type(model).__name__} imagines the "
                "front view alone; use depth=1, or a panorama model"
            )
        if not self.policy.can_extend:
            raise ArgumentError(
                f"Agent: with depth={self.depth} plans are proposed from imagined places, which have no depth, but "
                f"{type(self.policy).__name__} needs it; write its `extend`, or propose with another policy and give "
                "this one as revision="
            )

    def _reviser(self, revision: Any) -> Policy:
        if revision is not None:
            return POLICIES.make(revision).for_space(self.policy.space)
        if self.policy.can_revise or self.model is None:
            return self.policy
        if self.policy.default_revision is None:
            raise ArgumentError(
                f"Agent: policy {type(self.policy).__name__} only proposes; give `revision=` a policy that scores"
            )
        return POLICIES.make(self.policy.default_revision).for_space(self.policy.space)

    def _situations(self, queries: Sequence[Query]) -> tuple[list[Situation], list[Situation]]:
        """Each episode as its proposer and as its reviser know it; the same object where one policy is both."""
        proposing, revising = [], []
        for query in queries:
            life = self._begin_or_continue(query)
            imagines = self._ask is not None and consults(query.key, self.imagine_fraction)
            known = query.observation, query.goal, query.key
            proposing.append(Situation(*known, life.proposer, tuple(life.executed), imagines))
            revising.append(Situation(*known, life.reviser, tuple(life.executed), imagines))
        return proposing, revising

    def _begin_or_continue(self, query: Query) -> _Life:
        """What is kept of an episode: once a decision, for its first begins anew."""
        name = query.key.seed, query.key.episode
        if query.key.decision == 0 or name not in self._lives:
            check_answerer(self.revision, query.goal)
            memory = self.policy.begin(query.goal, query.key)
            same = self.revision is self.policy
            self._lives[name] = _Life(memory, memory if same else self.revision.begin(query.goal, query.key), [])
        return self._lives[name]

    def _decision(
        self,
        query: Query,
        situation: Situation,
        future: _Future,
        answer: Any,
        costs: Mapping[str, Any],
    ) -> Decision:
        actions, chosen = self.revision.revise(situation, future.proposals, future.scores)
        if "scoring" in self.swaps:  # where the reviser would write a plan of its own, too
            chosen = int(np.argmax(future.scores))
            actions = future.proposals[chosen].actions
        actions = checked_plan(self.revision, actions, self.horizon * self.depth)
        execute = self._segment(len(actions))
        self._lives[query.key.seed, query.key.episode].executed += actions[:execute].tolist()
        exchanges = tuple(each for policy in self._policies for each in policy.exchanges(query.key))
        return Decision(
            actions=actions,
            execute=execute,
            proposals=tuple(future.proposals),
            rollouts=None if future.rollouts is None else tuple(future.rollouts),
            scores=np.asarray(future.scores, np.float64),
            chosen=chosen,
            answer=answer,
            observation=query.observation,
            goal=query.goal,
            key=query.key,
            calls=future.calls,
            note="; ".join(f"{each.purpose}: {each.problem}, {each.instead}" for each in exchanges if each.problem),
            fidelity=future.fidelity,
            exchanges=exchanges,
            **costs,
        )

    def _segment(self, length: int) -> int:
        """How many primitives of a plan are carried out."""
        if self.execute > 0:
            return min(self.execute, length)
        return max(1, min(length, self.horizon) + self.execute)


def consults(key: Key, fraction: float) -> bool:
    """Whether a world model that is consulted for a share of all decisions is consulted for this one."""
    return bool(core.uniform(core.fold_key([key.seed, key.episode, key.decision, _CONSULT]), 1)[0] < fraction)


def _of_space(policy: Policy, space: Space | None) -> Policy:
    """The policy for plans of the kind that is asked for, if any is."""
    if space is None:
        return policy
    made = policy.for_space(space)
    if made.space != space:
        raise ArgumentError(
            f"Agent: plans are asked for in {PLANS[space]}, but policy {type(policy).__name__} makes them of "
            f"{PLANS[made.space]}"
        )
    return made


def _described(semantics: Any) -> Any:
    return semantics if isinstance(semantics, str) else semantics.describe()


def _stranger(query: Query) -> Query:
    if query.stranger is None:
        raise ArgumentError(
            "placebo='swapped' imagines from the first observation of another episode, which a run hands over: use "
            "wiw.evaluate, or decide_batch([Query(..., stranger=Query(...))])"
        )
    return query.stranger


def settled_numbers(given: Mapping[str, int], defaults: Mapping[str, int]) -> dict[str, int]:
    """A task's numbers where none is given; several primitives carried out belong to the horizon chosen for them."""
    if "horizon" in given and defaults.get("execute", 0) > 1:
        defaults = {name: value for name, value in defaults.items() if name != "execute"}
    return {**defaults, **given}
