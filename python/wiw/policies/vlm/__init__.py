# SPDX-License-Identifier: Apache-2.0
"""A vision-language model as the paper's policy: it proposes, looks at what is imagined, answers and decides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError, DependencyError
from wiw.perception.tracking import Track, track_rollouts
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.vlm import looks, plans, presets
from wiw.policies.vlm.prompts import Prompts
from wiw.registry import TRACKERS
from wiw.types import Answer, Exchange, Goal, Key, Proposal, Rollout
from wiw.vlm import Reply, Request, connect, user
from wiw.vlm.base import Part
from wiw.vlm.cache import reply_cache
from wiw.vlm.prices import Prices

if TYPE_CHECKING:
    from pydantic import BaseModel

SEEN = "front view (90 degrees wide) and panorama (360 degrees)"
"""Slot `obs_key`."""
OUT_OF_SIGHT = "the target is neither in sight nor in an imagined view, nothing was asked"
DRAW, _ANSWER, _MOVE, REVISE = 0x64726177, 0x616E7377, 0x6D6F7665, 0x72657669
"""Keep the seeds of a decision's questions apart."""
DRAWN = "drawn: no answer could be used"
TOKENS = 1024
"""Of a plan at most."""
MOVES = list(plans.PRIMITIVES.values())


@dataclass
class Memory:
    """What is kept of one episode."""

    horizon: int = 1
    """Primitives, or poses, that a plan may have."""
    believed: NDArray[np.float64] | None = None
    """The last answer."""
    decided: tuple[Key, NDArray[Any]] | None = None
    """The plan written, or the primitive chosen, at the latest decision."""
    tracks: tuple[Any, list[Track]] | None = None
    """Where the target is in the plans imagined last, under their name."""


class VLM(Policy):
    """Asks a vision-language model (paper, appendices "Policies in Embodied Tasks" and "Prompt Templates").

    Image-Goal Navigation: plans are written from front view, panorama and goal image; with a world model a second
    question shows the goal image and what each plan is imagined to lead to. Active Recognition: two multiple-choice
    questions a decision, for the category, from views centred on the boxed target, and for the next primitive. Robotic
    Manipulation, where plans are poses: `wiw.policies.vlm.arm`.

    An answer that cannot be used after `tries` is an outcome of the policy: a plan is left out; where none is left, a
    primitive is drawn; a category is the last one, else none is preferred. Note and `exchanges` of the decision say so.
    A model that cannot be asked at all raises `VlmError`, and the episode fails for infrastructure.

    Args:
        vlm: see `wiw.vlm.connect`.
        model: its name there, or a preset (`wiw/configs/vlm`).
        prompts: folder of templates that replace the shipped ones; see `wiw.policies.vlm.prompts`.
        proposals: "sampled", one question for each plan, or "listed", one question for all of them.
        revision: "write" lets it write the plan to follow after it has seen the futures, as the paper's prompt does;
            "select" lets it choose one of the proposals, with the probabilities as scores. Not for recognition.
        temperature: of sampled plans; everything else is asked at 0.
        tries: times a question is put before its answer counts as unusable.
        tracker: finds the target in imagined frames; name or instance.
        cache: where answers are kept, so that none is paid for twice: "auto" (`~/.cache/wiw/replies`), a folder, "off".
        prices: YAML file of `model: [read, written]`, dollars per million tokens.
        client: further options of the client, such as `dialect` and `concurrency`.

    Raises:
        ArgumentError: an option out of range, or one that the client does not take.
        DependencyError: `wiw[vlm]` is not installed.
        PromptError: see `Prompts`.
    """

    frames = FrameSpec("panorama", (576, 1024))
    tasks: tuple[str, ...] = ("ar", "imagenav")
    """That it has prompts for."""
    drawn = "a primitive was drawn"
    """What is done where no plan can be used."""

    def __init__(
        self,
        vlm: Any = "http://localhost:8000/v1",
        model: str | None = None,
        prompts: str | Path | None = None,
        proposals: Literal["sampled", "listed"] = "sampled",
        revision: Literal["write", "select"] = "write",
        temperature: float = 1.0,
        tries: int = 3,
        tracker: Any = "reprojection",
        cache: str | Path = "auto",
        prices: str | Path | None = None,
        **client: Any,
    ) -> None:
        if (
            proposals not in ("sampled", "listed")
            or revision not in ("write", "select")
            or temperature < 0
            or tries < 1
        ):
            raise ArgumentError(
                "policy vlm: expected proposals sampled or listed, revision write or select, temperature >= 0 and "
                f"tries >= 1, got {proposals}, {revision}, {temperature}, {tries}"
            )
        _require_packages()
        self.prompts = Prompts(prompts)
        table = None if prices is None else Prices.load(prices)
        kept = {"cache": reply_cache(cache), "prices": table} if isinstance(vlm, str) else {}
        self.client = connect(vlm, **{**kept, **presets.client_options(model), **client})
        self.proposals, self.revision, self.temperature, self.tries = proposals, revision, temperature, tries
        self.tracker = TRACKERS.make(tracker)
        self.needs = tuple(self.tracker.needs)
        self._journal: dict[tuple[int, int], list[Exchange]] = {}

    def describe(self) -> dict[str, Any]:
        """With the model and a digest of the prompts."""
        return {
            "policy": type(self).__name__,
            **self.client.describe(),
            "prompts": self.prompts.digest,
            "proposals": self.proposals,
            "revision": self.revision,
            "temperature": self.temperature,
            "tries": self.tries,
            "tracker": type(self.tracker).__name__,
        }

    @property
    def spent(self) -> Mapping[str, float]:
        """Questions and tokens so far; see `wiw.vlm.Client.spent`."""
        return {"vlm_tokens": 0.0, **self.client.spent}

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """What was said for a decision, handed over once."""
        return tuple(self._journal.pop((key.episode, key.decision), ()))

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Nothing believed yet.

        Raises:
            ArgumentError: a task that there are no prompts for.
        """
        if goal.task not in self.tasks:
            raise ArgumentError(f"policy vlm: expected a task among {', '.join(self.tasks)}, got '{goal.task}'")
        return Memory()

    def observe(self, situations: Sequence[Situation]) -> None:
        """Begins the record of a decision anew."""
        for situation in situations:
            self._journal.pop((situation.key.episode, situation.key.decision), None)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Plans as the model writes them; one where none will be imagined, and then for recognition one primitive."""
        wanted = [self._questions(situation, candidates, horizon) for situation in situations]
        replies = iter(self.client.ask([request for _, requests in wanted for request in requests]))
        return [
            self._proposed(situation, purpose, [next(replies) for _ in requests], horizon)
            for situation, (purpose, requests) in zip(situations, wanted, strict=True)
        ]

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """As `propose`, from imagined places."""
        there = [replace(situation, memory=deepcopy(situation.memory)) for situation in situations]
        return self.propose(there, candidates, horizon)

    def _questions(self, situation: Situation, candidates: int, horizon: int) -> tuple[str, list[Request]]:
        if not situation.imagines and situation.goal.choices:
            return "move", [self._move_request(situation, [])]
        situation.memory.horizon = horizon
        count = candidates if situation.imagines else 1
        shared = count if self.proposals == "listed" else 1
        asked = user(*self._before(situation, horizon), self._words(situation, "output", horizon, shared))
        options: dict[str, Any] = {
            "schema": self._schema(horizon, shared),
            "temperature": self.temperature,
            "max_tokens": TOKENS * shared,
            "tries": self.tries,
        }
        seeds = [seed_of(situation.key, number) for number in range(count if shared == 1 else 1)]
        return "propose", [Request((asked,), seed=seed, **options) for seed in seeds]

    def _before(self, situation: Situation, horizon: int) -> list[Part]:
        """What is told and shown before plans are asked for."""
        front, panorama = looks.now(situation.observation)
        words = self._words(situation, "planner", horizon)
        parts: list[Part] = [words, "Front view:", front, "Panorama:", panorama]
        return parts if situation.goal.image is None else [*parts, "Goal image:", situation.goal.image]

    def _schema(self, longest: int, count: int = 1) -> type[BaseModel]:
        return plans.plan_schema(longest, count)

    def _plans_in(self, value: Any) -> list[Proposal]:
        """The plans of a validated answer."""
        return [Proposal(actions, note=cut(reason)) for actions, reason in plans.plans_in(value)]

    def _proposed(self, situation: Situation, purpose: str, replies: Sequence[Reply], horizon: int) -> list[Proposal]:
        """Different plans of an episode, in the order in which they were written."""
        if purpose == "move":
            probabilities = self._move_probabilities(situation, replies[0], self.drawn)
            if probabilities is None:
                return [self._drawn(situation)]
            best = int(probabilities.argmax())
            return [Proposal(np.array([MOVES[best]], np.int8), prior=float(probabilities[best]))]
        usable = [reply for reply in replies if reply.problem is None]
        instead = "the plan was left out" if usable else self.drawn
        found: dict[bytes, Proposal] = {}
        for number, reply in enumerate(replies):
            self._note(situation.key, f"propose/{number}", reply, instead)
            for plan in [] if reply.problem else self._plans_in(reply.value):
                found.setdefault(plan.actions.tobytes(), replace(plan, prior=float(-len(found))))
        return list(found.values()) or [self._drawn(situation)]

    def _drawn(self, situation: Situation) -> Proposal:
        key = situation.key
        draw = core.uniform(core.fold_key([key.seed, key.episode, key.decision, DRAW]), 1)[0]
        return Proposal(np.array([MOVES[int(draw * len(MOVES))]], np.int8), note=DRAWN)

    # -- judging futures -----------------------------------------------------------------------------------------------

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Recognition: probability of each plan's first primitive. Navigation: probability of each plan ("select"), or
        how much of each agrees with the plan that was written, from its beginning ("write").
        """
        rows = list(zip(situations, proposals, rollouts, strict=True))
        requests = [self._judging(*row) for row in rows]
        asked = [request for request in requests if request is not None]
        replies = iter(self.client.ask(asked))
        return [
            np.ones(1) if request is None else self._judged(situation, proposed, next(replies))
            for (situation, proposed, _), request in zip(rows, requests, strict=True)
        ]

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """What was decided on; the first proposal that begins so, if one does."""
        decided = situation.memory.decided
        if decided is None or decided[0] != situation.key:
            return super().revise(situation, proposals, scores)
        actions = decided[1]
        for index, plan in enumerate(proposals):
            if np.array_equal(plan.actions[: len(actions)], actions) and (
                situation.goal.choices or len(plan.actions) == len(actions)
            ):
                return plan.actions, index
        return actions, None

    def _judging(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> Request | None:
        if situation.goal.choices:
            tracks = self._tracked(situation, proposals, rollouts)
            strips = [looks.plan_strip(*row) for row in zip(proposals, rollouts, tracks, strict=True)]
            return self._move_request(situation, _captioned(proposals, strips))
        if self._selects(proposals) and len(proposals) == 1:
            return None
        return self._revising(situation, proposals, rollouts)

    def _selects(self, proposals: Sequence[Proposal]) -> bool:
        """Whether one of the proposals is chosen, rather than a plan written."""
        return self.revision == "select"

    def _revising(self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]) -> Request:
        """Which of the proposals is to be followed, or what else."""
        assert situation.goal.image is not None
        strips = [looks.plan_strip(plan, rollout) for plan, rollout in zip(proposals, rollouts, strict=True)]
        horizon = max(situation.memory.horizon, *(len(plan.actions) for plan in proposals))
        name = "chooser" if self.revision == "select" else "planner_imagined"
        parts: list[Part] = [self._words(situation, name, horizon), "Goal image:", situation.goal.image]
        parts += _captioned(proposals, strips)
        seed = seed_of(situation.key, REVISE)
        if self.revision == "select":
            choices = tuple(f"plan {k + 1}: {', '.join(plans.named(p.actions))}" for k, p in enumerate(proposals))
            return Request((user(*parts),), choices=choices, seed=seed, tries=self.tries)
        parts.append(self._words(situation, "output", horizon))
        return Request((user(*parts),), schema=plans.plan_schema(horizon), seed=seed, tries=self.tries)

    def _judged(self, situation: Situation, proposals: Sequence[Proposal], reply: Reply) -> NDArray[np.float64]:
        fallback = -np.arange(len(proposals), dtype=np.float64)
        memory: Memory = situation.memory
        if situation.goal.choices:
            found = self._move_probabilities(situation, reply, "the first plan was taken")
            if found is None:
                memory.decided = None
                return fallback
            memory.decided = situation.key, np.array([MOVES[int(found.argmax())]], np.int8)
            return np.array(
                [found[MOVES.index(plan.actions[0])] if plan.actions[0] in MOVES else 0.0 for plan in proposals]
            )
        self._note(situation.key, "revise", reply, "the first plan was taken")
        memory.decided = None
        if reply.problem is not None:
            return fallback
        if reply.probabilities is not None:
            return reply.probabilities
        (written,) = self._plans_in(reply.value)
        memory.decided = situation.key, written.actions
        return np.array([_agreement(plan.actions, written.actions) for plan in proposals])

    def _move_request(self, situation: Situation, imagined: Sequence[Part]) -> Request:
        """Which primitive comes next."""
        front, panorama = looks.now(situation.observation)
        parts: list[Part] = [self._words(situation, "planner", 1), "Front view:", front, "Panorama:", panorama]
        if imagined:
            parts += [self._words(situation, "planner_imagined", 1), *imagined]
        choices = tuple(plans.MEANINGS.values())
        return Request((user(*parts),), choices=choices, seed=seed_of(situation.key, _MOVE), tries=self.tries)

    def _move_probabilities(self, situation: Situation, reply: Reply, instead: str) -> NDArray[np.float64] | None:
        self._note(situation.key, "move", reply, instead)
        return reply.probabilities

    # -- recognition ---------------------------------------------------------------------------------------------------

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[Answer | None]:
        """The category, from views centred on the boxed target: the real one, and those imagined for each plan."""
        rows = list(zip(situations, proposals, rollouts, strict=True))
        requests = [self._answer_request(*row) if row[0].goal.choices else None for row in rows]
        replies = iter(self.client.ask([request for request in requests if request is not None]))
        return [
            self._answered(situation, None if request is None else next(replies)) if situation.goal.choices else None
            for situation, request in zip(situations, requests, strict=True)
        ]

    def _answer_request(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout] | None
    ) -> Request | None:
        """None where the target is nowhere to be seen."""
        real = looks.target_now(situation.observation)
        strips: list[looks.Image] = []
        if rollouts is not None:
            tracks = self._tracked(situation, proposals, rollouts)
            found = [looks.target_strip(rollout, track) for rollout, track in zip(rollouts, tracks, strict=True)]
            strips = [strip for strip in found if strip is not None]
        if real is None and not strips:
            return None
        parts: list[Part] = [self._words(situation, "answerer", 1)]
        parts += [] if real is None else [real]
        if strips:
            parts += [self._words(situation, "answerer_imagined", 1), *strips]
        choices = situation.goal.choices
        return Request((user(*parts),), choices=choices, seed=seed_of(situation.key, _ANSWER), tries=self.tries)

    def _answered(self, situation: Situation, reply: Reply | None) -> Answer:
        memory, choices = situation.memory, situation.goal.choices
        instead = "no choice was preferred" if memory.believed is None else "the last answer was kept"
        if reply is None:
            lost = Exchange("answer", self.client.model, (), problem=OUT_OF_SIGHT, instead=instead)
            self._journal.setdefault((situation.key.episode, situation.key.decision), []).append(lost)
        else:
            self._note(situation.key, "answer", reply, instead)
            if reply.probabilities is not None:
                memory.believed = reply.probabilities
        believed = _no_belief(situation.key, len(choices)) if memory.believed is None else memory.believed
        return Answer(choices, believed)

    def _tracked(self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]) -> list[Track]:
        """Where the target is in the plans' frames; looked for once a decision."""
        memory: Memory = situation.memory
        name = situation.key, tuple(plan.actions.tobytes() for plan in proposals), id(rollouts[0].frames)
        if memory.tracks is None or memory.tracks[0] != name:
            (tracks,) = track_rollouts(self.tracker, [situation.observation], [proposals], [rollouts])
            memory.tracks = name, tracks
        return memory.tracks[1]

    # ------------------------------------------------------------------------------------------------------------------

    def _words(self, situation: Situation, name: str, horizon: int, count: int = 1) -> str:
        return self.prompts.text(
            situation.goal.task,
            name,
            obs_key=SEEN,
            look_ahead_action_num=horizon,
            plan_num=count,
            actions=plans.MEANINGS,
        )

    def _read(self, reply: Reply) -> dict[str, Any]:
        """How an answer was read; what is empty is left out."""
        return {"by": reply.by, "mass": reply.mass, "doubtful": reply.doubtful, "repaired": reply.repaired}

    def _note(self, key: Key, purpose: str, reply: Reply, instead: str) -> None:
        """Writes down what came of a question."""
        exchange = Exchange(
            purpose,
            self.client.model,
            tuple({"call": said.call, **said.completion.to_json()} for said in reply.said),
            {name: value for name, value in self._read(reply).items() if value},
            "" if reply.problem is None else str(reply.problem),
            "" if reply.problem is None else instead,
        )
        self._journal.setdefault((key.episode, key.decision), []).append(exchange)


def _require_packages() -> None:
    missing = [name for name in ("pydantic", "json_repair") if find_spec(name) is None]
    if missing:
        raise DependencyError(f"policy vlm needs {', '.join(missing)}: pip install 'wiw[vlm]'")


def seed_of(key: Key, number: int) -> int:
    return int(core.fold_key([key.seed, key.episode, key.decision, number]))


def _captioned(proposals: Sequence[Proposal], strips: Sequence[looks.Image]) -> list[Part]:
    """Each plan in words before its strip."""
    parts: list[Part] = []
    for number, (plan, strip) in enumerate(zip(proposals, strips, strict=True), 1):
        parts += [f"Plan {number}: {plans.named(plan.actions)}", strip]
    return parts


def _agreement(plan: NDArray[Any], written: NDArray[Any]) -> float:
    """Share of the longer one's actions that both begin with."""
    same = 0
    while same < min(len(plan), len(written)) and np.array_equal(plan[same], written[same]):
        same += 1
    return same / max(len(plan), len(written))


def _no_belief(key: Key, count: int) -> NDArray[np.float64]:
    """All choices as probable as each other, but for less than a millionth that is drawn: no choice is always first."""
    weights = 1 + 1e-7 * np.asarray(core.uniform(core.fold_key([key.seed, key.episode, key.decision, _ANSWER]), count))
    return np.asarray(weights / weights.sum(), np.float64)


def cut(reason: str, most: int = 300) -> str:
    text = " ".join(reason.encode("utf-8", "replace").decode().split())
    return text if len(text) <= most else text[: most - 1] + "…"
