# SPDX-License-Identifier: Apache-2.0
"""A vision-language model as the paper's policy: it proposes, inspects what is imagined, answers and decides."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError, DependencyError
from wiw.perception.tracking import Track, Tracker, get_target, track_rollouts
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.vlm import plans, presets, prompt_images
from wiw.policies.vlm.prompts.templates import Prompts
from wiw.registry import TRACKERS
from wiw.types import Answer, Exchange, Goal, Key, Observation, Proposal, Rollout, TextAnswer
from wiw.vlm import Reply, Request, connect, user
from wiw.vlm.cache import open_reply_cache
from wiw.vlm.messages import Part
from wiw.vlm.prices import Prices

if TYPE_CHECKING:
    from pydantic import BaseModel

OBSERVATION_WORDS = "front view (90 degrees wide) and panorama (360 degrees)"
"""Value of the slot `obs_key`."""
TARGET_WORDS = "view centred on one thing (90 degrees wide)"
"""Its value in the question for the category, where that is the view shown."""
OUT_OF_SIGHT = "the target is neither in sight nor in an imagined view, nothing was asked"
FALLBACK_SEED, _ANSWER_SEED, _MOVE_SEED, REVISION_SEED = 0x64726177, 0x616E7377, 0x6D6F7665, 0x72657669
"""Separate the seeds of a decision's questions."""
FALLBACK_NOTE = "drawn: no answer could be used"
MAX_PLAN_TOKENS = 1024
"""Maximum number of tokens of a plan."""
ROLES = ("propose", "revise", "answer")
"""Sorts of questions that may go to different models."""
MOVES = list(plans.PRIMITIVES.values())


@dataclass
class Memory:
    """The memory of one episode."""

    horizon: int = 1
    """Maximum number of primitives, or poses, of a plan."""
    belief: NDArray[np.float64] | None = None
    """The last answer, as probabilities that sum to 1 ..."""
    raw_belief: NDArray[np.float64] | None = None
    """... and as the model gave them."""
    decision: tuple[Key, NDArray[Any]] | None = None
    """The plan written, or the primitive chosen, at the latest decision."""
    tracks: tuple[Any, list[Track]] | None = None
    """The target's tracks in the plans imagined last, with the key of these plans."""


class VLM(Policy):
    """Asks a vision-language model (paper, appendices "Policies in Embodied Tasks" and "Prompt Templates").

    Image-Goal Navigation: plans are written from front view, panorama and goal image; with a world model a second
    question shows the goal image and what each plan is imagined to lead to. Active Recognition: two multiple-choice
    questions a decision, for the category and for the next primitive, from front view and panorama with the target
    boxed, and imagined views. Robotic Manipulation, where plans are poses: `wiw.policies.vlm.arm`.

    An answer that cannot be used after `tries` is an outcome of the policy: a plan is left out; where none is left, a
    primitive is drawn; a category is the last one, else none is preferred. Note and `exchanges` of the decision say so.
    A model that cannot be asked at all raises `VlmError`, and the episode fails for infrastructure.

    Args:
        vlm: see `wiw.vlm.connect`.
        model: its name there, or a preset (`wiw/configs/vlm`).
        prompts: a shipped set, "default" or "minimal", or a folder of templates; see `wiw.policies.vlm.prompts`.
        proposals: "sampled", one question for each plan, or "listed", one question for all of them.
        revision: "write" lets it write the plan to follow after it has seen the futures, as the paper's prompt does;
            "select" lets it choose one of the proposals, with the probabilities as scores. Not for recognition.
        temperature: of sampled plans.
        revision_temperature: of the plan that is written after futures were seen; choices are read from
            log-probabilities, which no temperature changes.
        view_size: pixels a side of the real front view and the goal image in navigation and recognition; None shows
            them as observed. Imagined frames have 384.
        tries: times a question is put before its answer counts as unusable.
        tracker: finds the target in imagined frames (`wiw list trackers`); name or instance, None for a task that
            points nothing out.
        tracker_options: what a tracker given by name is made with, such as {"weights": "sam2.1-hiera-large"}.
        answer_view: what the category is asked from: "observation", front view and panorama, as in the paper, or
            "target", one view centred on the target.
        rounds: whether more categories than the server lists tokens are asked about in rounds, rather than in one
            question with all of them.
        shown: whether what a plan is imagined to lead to is shown as a "strip", one image with all of its frames, or as
            "frames", an image of each.
        captions: whether a bar above each imagined frame says which action it follows.
        roles: who is asked the questions of a role, where it is not `model` at `vlm`: {"revise": {"vlm": URL, "model":
            NAME}}. Roles are "propose" (plans, before anything is imagined), "revise" (which plan, or primitive, to
            follow) and "answer" (the category, or the answer to a question). A role may have a `key` of its own; a
            `vlm` of its own is never sent that of the main one.
        cache: where answers are kept, so that none is paid for twice: "auto" (`~/.cache/wiw/replies`), a folder, "off".
        prices: YAML file of `model: [read, written]`, dollars per million tokens.
        client: further options of the client, such as `dialect`, `concurrency` and `key`. At a role's own `vlm`, the
            preset of the role's model comes before them.

    Raises:
        ArgumentError: an option out of range, or one that the client does not take.
        DependencyError: `wiw[vlm]` is not installed.
        PromptError: see `Prompts`.
    """

    frames = FrameSpec("panorama", (576, 1024))
    tasks: tuple[str, ...] = ("ar", "imagenav")
    """Tasks that it has prompts for."""
    tracks: bool = True
    """Whether there are tasks among them that point something out."""
    shows_front = True
    """Whether it is only shown the agent's front view, rather than its own views."""
    fallback_action = "a primitive was drawn"
    """Description of the fallback where no plan can be used."""

    def __init__(
        self,
        vlm: Any = "http://localhost:8000/v1",
        model: str | None = None,
        prompts: str | Path | None = None,
        proposals: Literal["sampled", "listed"] = "sampled",
        revision: Literal["write", "select"] = "write",
        temperature: float = 1.0,
        tries: int = 3,
        tracker: Any = "frames",
        tracker_options: Mapping[str, Any] | None = None,
        answer_view: Literal["observation", "target"] = "observation",
        rounds: bool = False,
        cache: str | Path = "auto",
        prices: str | Path | None = None,
        revision_temperature: float = 0.0,
        view_size: int | None = None,
        shown: Literal["strip", "frames"] = "strip",
        captions: bool = True,
        roles: Mapping[str, Mapping[str, Any]] | None = None,
        **client: Any,
    ) -> None:
        if (
            proposals not in ("sampled", "listed")
            or revision not in ("write", "select")
            or answer_view not in ("observation", "target")
            or min(temperature, revision_temperature) < 0
            or tries < 1
        ):
            raise ArgumentError(
                "policy vlm: expected proposals sampled or listed, revision write or select, answer_view observation "
                f"or target, temperatures >= 0 and tries >= 1, got {proposals}, {revision}, {answer_view}, "
                f"{temperature}, {revision_temperature}, {tries}"
            )
        if view_size is not None and (view_size < 1 or not self.shows_front):
            raise ArgumentError(
                f"policy vlm: expected view_size of at least 1, for tasks {', '.join(VLM.tasks)}, got {view_size}"
            )
        if shown not in ("strip", "frames") or ((shown, captions) != ("strip", True) and not self.shows_front):
            raise ArgumentError(
                "policy vlm: expected shown strip or frames, and these or captions=False only for tasks "
                f"{', '.join(VLM.tasks)}, got shown={shown}, captions={captions}"
            )
        if not self.tracks:
            refuse_tracking(tracker, tracker_options, rounds, answer_view)
        _require_packages()
        self.prompts = Prompts(prompts)
        table = None if prices is None else Prices.load(prices)
        kept = {"cache": open_reply_cache(cache), "prices": table} if isinstance(vlm, str) else {}
        self.client = connect(vlm, **{**kept, **presets.get_client_options(model), **client})
        self.roles = {
            role: connect(own.get("vlm") or vlm, **{**kept, **_get_role_options(own, vlm, client)})
            for role, own in _check_roles(roles or {}, model).items()
        }
        self.shown, self.captions = shown, captions
        self.proposals, self.revision, self.temperature, self.tries = proposals, revision, temperature, tries
        self.answer_view, self.rounds = answer_view, rounds
        self.revision_temperature, self.view_size = revision_temperature, view_size
        self.tracker = TRACKERS.make(tracker, **(tracker_options or {})) if tracker and self.tracks else None
        self.needs = () if self.tracker is None else tuple(self.tracker.needs)
        self._journal: dict[tuple[int, int], list[Exchange]] = {}

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with the model and a digest of the prompts."""
        return {
            "policy": type(self).__name__,
            **self.client.describe(),
            "prompts": self.prompts.digest,
            "proposals": self.proposals,
            "revision": self.revision,
            "temperature": self.temperature,
            "tries": self.tries,
            **({} if self.tracker is None else self._describe_recognition(self.tracker)),
            **({"revision_temperature": self.revision_temperature} if self.revision_temperature else {}),
            **({"view_size": self.view_size} if self.view_size else {}),
            **({} if self.shown == "strip" else {"shown": self.shown}),
            **({} if self.captions else {"captions": False}),
            **({"roles": {role: own.describe() for role, own in self.roles.items()}} if self.roles else {}),
        }

    def _describe_recognition(self, tracker: Tracker) -> dict[str, Any]:
        return {"tracker": tracker.describe(), "answer_view": self.answer_view, "rounds": self.rounds}

    @property
    def spent(self) -> Mapping[str, float]:
        """Questions and tokens so far, of all models; see `wiw.vlm.Client.spent`."""
        found: Counter[str] = Counter({"vlm_tokens": 0.0})
        for client in (self.client, *self.roles.values()):
            found.update(client.spent)
        return dict(found)

    def exchanges(self, key: Key) -> tuple[Exchange, ...]:
        """Return the exchanges of a decision, once."""
        return tuple(self._journal.pop((key.episode, key.decision), ()))

    def begin(self, goal: Goal, key: Key) -> Memory:
        """Return a memory without any belief.

        Raises:
            ArgumentError: a task without prompts.
        """
        if goal.task not in self.tasks:
            hint = f"; create it with task='{goal.task}'" if goal.question else ""
            raise ArgumentError(f"policy vlm: expected a task among {', '.join(self.tasks)}, got '{goal.task}'{hint}")
        return Memory()

    def observe(self, situations: Sequence[Situation]) -> None:
        """Start the record of a decision anew, with the horizon of a policy that only revises."""
        for situation in situations:
            situation.memory.horizon = situation.horizon or 1
            self._journal.pop((situation.key.episode, situation.key.decision), None)

    # -- plans ---------------------------------------------------------------------------------------------------------

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the model's plans; only one where none will be imagined, and then for recognition one primitive."""
        wanted = [self._build_requests(situation, candidates, horizon) for situation in situations]
        replies = self._ask_each([requests for _, requests in wanted])
        return [
            self._build_proposals(situation, purpose, own, horizon)
            for situation, (purpose, _), own in zip(situations, wanted, replies, strict=True)
        ]

    def extend(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Propose from imagined places."""
        there = [replace(situation, memory=deepcopy(situation.memory)) for situation in situations]
        return self.propose(there, candidates, horizon)

    def _build_requests(self, situation: Situation, candidates: int, horizon: int) -> tuple[str, list[Request]]:
        if not situation.imagines and situation.goal.choices:
            return "move", [self._build_move_request(situation, [])]
        situation.memory.horizon = horizon
        count = candidates if situation.imagines else 1
        shared = count if self.proposals == "listed" else 1
        asked = user(
            *self._build_plan_prompt(situation, horizon), self._render_prompt(situation, "output", horizon, shared)
        )
        options: dict[str, Any] = {
            "schema": self._get_plan_schema(situation, horizon, shared),
            "temperature": self.temperature,
            "max_tokens": MAX_PLAN_TOKENS * shared,
            "tries": self.tries,
        }
        seeds = [derive_seed(situation.key, number) for number in range(count if shared == 1 else 1)]
        return "propose", [Request((asked,), seed=seed, **options) for seed in seeds]

    def _build_plan_prompt(self, situation: Situation, horizon: int) -> list[Part]:
        """Return the text and images before the request for plans."""
        front, panorama = prompt_images.render_observation(situation.observation, self.view_size)
        words = self._render_prompt(situation, "planner", horizon)
        parts: list[Part] = [words, "Front view:", front, "Panorama:", panorama]
        return parts if situation.goal.image is None else [*parts, "Goal image:", self._render_goal(situation.goal)]

    def _render_goal(self, goal: Goal) -> prompt_images.Image:
        assert goal.image is not None
        return prompt_images.resize_view(goal.image, self.view_size)

    def _get_plan_schema(self, situation: Situation, longest: int, count: int = 1) -> type[BaseModel]:
        return plans.plan_schema(longest, count)

    def _parse_plans(self, value: Any) -> list[Proposal]:
        """Return the plans of a validated answer."""
        return [Proposal(actions, note=shorten(reason)) for actions, reason in plans.parse_plans(value)]

    def _build_proposals(
        self, situation: Situation, purpose: str, replies: Sequence[Reply], horizon: int
    ) -> list[Proposal]:
        """Return the different plans of an episode, in the order in which they were written."""
        if purpose == "move":
            probabilities = self._read_move_probabilities(situation, replies[0], self.fallback_action)
            if probabilities is None:
                return [self._draw_fallback(situation)]
            best = int(probabilities.argmax())
            return [Proposal(np.array([MOVES[best]], np.int8), prior=float(probabilities[best]))]
        usable = [reply for reply in replies if reply.problem is None]
        instead = "the plan was left out" if usable else self.fallback_action
        found: dict[bytes, Proposal] = {}
        for number, reply in enumerate(replies):
            self._record_exchange(situation.key, f"propose/{number}", reply, instead)
            for plan in [] if reply.problem else self._parse_plans(reply.value):
                found.setdefault(plan.actions.tobytes(), replace(plan, prior=float(-len(found))))
        return list(found.values()) or [self._draw_fallback(situation)]

    def _draw_fallback(self, situation: Situation) -> Proposal:
        key = situation.key
        draw = core.uniform(core.fold_key([key.seed, key.episode, key.decision, FALLBACK_SEED]), 1)[0]
        return Proposal(np.array([MOVES[int(draw * len(MOVES))]], np.int8), note=FALLBACK_NOTE)

    # -- judging futures -----------------------------------------------------------------------------------------------

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the score of each plan.

        Recognition: probability of each plan's first primitive. Navigation: probability of each plan ("select"), or
        the share of each that agrees from its beginning with the plan written by the model ("write").
        """
        rows = list(zip(situations, proposals, rollouts, strict=True))
        replies = self._ask_each([self._build_scoring_requests(*row) for row in rows], "revise")
        return [
            self._read_scores(situation, proposed, *own) if own else np.ones(1)
            for (situation, proposed, _), own in zip(rows, replies, strict=True)
        ]

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """Return the decided plan, and the first proposal that begins with it, if there is one."""
        decided = situation.memory.decision
        if decided is None or decided[0] != situation.key:
            return super().revise(situation, proposals, scores)
        actions = decided[1]
        for index, plan in enumerate(proposals):
            if np.array_equal(plan.actions[: len(actions)], actions) and (
                situation.goal.choices or len(plan.actions) == len(actions)
            ):
                return plan.actions, index
        return actions, None

    def _build_scoring_requests(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> list[Request]:
        """Return the question that ranks the plans; none where there is nothing to choose."""
        if situation.goal.choices:
            tracks = self._track_target(situation, proposals, rollouts)
            return [self._build_move_request(situation, self._show_plans(proposals, rollouts, tracks))]
        if self._selects(proposals) and len(proposals) == 1:
            return []
        return [self._build_revision_request(situation, proposals, rollouts)]

    def _selects(self, proposals: Sequence[Proposal]) -> bool:
        """Return whether the model selects one of the proposals, rather than writing a plan."""
        return self.revision == "select"

    def _build_revision_request(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> Request:
        """Ask which of the proposals to follow, or for another plan."""
        horizon = max(situation.memory.horizon, *(len(plan.actions) for plan in proposals))
        name = "chooser" if self.revision == "select" else "planner_imagined"
        parts: list[Part] = [
            self._render_prompt(situation, name, horizon),
            "Goal image:",
            self._render_goal(situation.goal),
        ]
        parts += self._show_plans(proposals, rollouts)
        seed = derive_seed(situation.key, REVISION_SEED)
        if self.revision == "select":
            choices = tuple(
                f"plan {k + 1}: {', '.join(plans.name_actions(p.actions))}" for k, p in enumerate(proposals)
            )
            return Request((user(*parts),), choices=choices, seed=seed, tries=self.tries)
        parts.append(self._render_prompt(situation, "output", horizon))
        schema = plans.plan_schema(horizon)
        return Request(
            (user(*parts),), schema=schema, seed=seed, tries=self.tries, temperature=self.revision_temperature
        )

    def _show_plans(
        self, proposals: Sequence[Proposal], rollouts: Sequence[Rollout], tracks: Sequence[Track | None] | None = None
    ) -> list[Part]:
        """Return each plan in words, followed by its imagined outcome."""
        parts: list[Part] = []
        rows = zip(proposals, rollouts, tracks or [None] * len(proposals), strict=True)
        for number, (plan, rollout, track) in enumerate(rows, 1):
            frames, titles = prompt_images.render_plan_frames(plan, rollout, track)
            images = prompt_images.arrange_frames(frames, titles if self.captions else None, self.shown == "strip")
            parts += [f"Plan {number}: {plans.name_actions(plan.actions)}", *images]
        return parts

    def _read_scores(self, situation: Situation, proposals: Sequence[Proposal], reply: Reply) -> NDArray[np.float64]:
        memory: Memory = situation.memory
        if situation.goal.choices:
            found = self._read_move_probabilities(situation, reply, "the first plan was taken")
            if found is None:
                return self._rate_plans(situation, proposals, reply, None)
            memory.decision = situation.key, np.array([MOVES[int(found.argmax())]], np.int8)
            return np.array(
                [found[MOVES.index(plan.actions[0])] if plan.actions[0] in MOVES else 0.0 for plan in proposals]
            )
        self._record_exchange(situation.key, "revise", reply, "the first plan was taken")
        written = None if reply.value is None else self._parse_plans(reply.value)[0].actions
        return self._rate_plans(situation, proposals, reply, written)

    def _rate_plans(
        self, situation: Situation, proposals: Sequence[Proposal], reply: Reply, written: NDArray[Any] | None
    ) -> NDArray[np.float64]:
        """Return the plans' scores by the reply to a revision, and remember the plan that it has written."""
        situation.memory.decision = None if written is None else (situation.key, written)
        if written is not None:
            return np.array([_measure_agreement(plan.actions, written) for plan in proposals])
        return -np.arange(len(proposals), dtype=np.float64) if reply.probabilities is None else reply.probabilities

    def _build_move_request(self, situation: Situation, imagined: Sequence[Part]) -> Request:
        """Ask for the next primitive."""
        front, panorama = prompt_images.render_observation(situation.observation, self.view_size)
        parts: list[Part] = [self._render_prompt(situation, "planner", 1), "Front view:", front, "Panorama:", panorama]
        if imagined:
            parts += [self._render_prompt(situation, "planner_imagined", 1), *imagined]
        choices = tuple(plans.MEANINGS.values())
        return Request((user(*parts),), choices=choices, seed=derive_seed(situation.key, _MOVE_SEED), tries=self.tries)

    def _read_move_probabilities(self, situation: Situation, reply: Reply, instead: str) -> NDArray[np.float64] | None:
        self._record_exchange(situation.key, "move", reply, instead)
        return reply.probabilities

    # -- recognition ---------------------------------------------------------------------------------------------------

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> Sequence[Answer | TextAnswer | None]:
        """Return the category, by what is really seen of the boxed target and what is imagined of it for each plan."""
        rows = list(zip(situations, proposals, rollouts, strict=True))
        asked = [self._build_answer_requests(*row) if row[0].goal.choices else [] for row in rows]
        replies = self._ask_each(asked, "answer")
        return [
            self._build_answer(situation, *own) if situation.goal.choices else None
            for situation, own in zip(situations, replies, strict=True)
        ]

    def _build_answer_requests(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout] | None
    ) -> list[Request]:
        """Ask for the category; nothing where the target is in no view."""
        real = self._show_target(situation.observation)
        imagined: list[Part] = []
        if rollouts is not None:
            tracks = self._track_target(situation, proposals, rollouts)
            for number, (rollout, track) in enumerate(zip(rollouts, tracks, strict=True), 1):
                imagined += self._show_target_frames(number, rollout, track)
        if not real and not imagined:
            return []
        task, words = situation.goal.task, OBSERVATION_WORDS if self.answer_view == "observation" else TARGET_WORDS
        parts: list[Part] = [self._fill_template(task, "answerer", words), *real]
        if rollouts is not None and imagined:
            centred = rollouts[0].view == "panorama"  # the tracker takes no plans in different views
            parts += [self._fill_template(task, "answerer_imagined", OBSERVATION_WORDS, centred=centred), *imagined]
        seed = derive_seed(situation.key, _ANSWER_SEED)
        choices = situation.goal.choices
        return [Request((user(*parts),), choices=choices, rounds=self.rounds, seed=seed, tries=self.tries)]

    def _show_target_frames(self, number: int, rollout: Rollout, track: Track) -> list[Part]:
        """Return a plan's imagined views of the target, and how many of its imagined frames have lost it."""
        frames, titles = prompt_images.render_target_frames(rollout, track)
        if not len(frames):
            return []
        imagined = ~rollout.real
        lost, count = int((imagined & ~track.visible).sum()), int(imagined.sum())
        said = f"; in {lost} of {count} the thing was lost, and they are left out" if lost else ""
        images = prompt_images.arrange_frames(frames, titles if self.captions else None, self.shown == "strip")
        return [f"Imagined views {number}{said}:", *images]

    def _show_target(self, observation: Observation) -> list[Part]:
        """Return what is really seen of the target; nothing where it is out of sight."""
        if self.answer_view == "target":
            view = prompt_images.render_target(observation)
            return [] if view is None else [view]
        target = get_target(observation)
        if target.panorama_box is None and target.front_box is None:
            return []
        front, panorama = prompt_images.render_observation(observation, self.view_size)
        return ["Front view:", front, "Panorama:", panorama]

    def _build_answer(self, situation: Situation, reply: Reply | None = None) -> Answer:
        memory, choices = situation.memory, situation.goal.choices
        instead = "no choice was preferred" if memory.belief is None else "the last answer was kept"
        if reply is None:
            lost = Exchange(
                "answer", self.roles.get("answer", self.client).model, (), problem=OUT_OF_SIGHT, instead=instead
            )
            self._journal.setdefault((situation.key.episode, situation.key.decision), []).append(lost)
        else:
            self._record_exchange(situation.key, "answer", reply, instead)
            if reply.probabilities is not None:
                memory.belief, memory.raw_belief = reply.probabilities, reply.raw
        believed = _make_uniform_belief(situation.key, len(choices)) if memory.belief is None else memory.belief
        return Answer(choices, believed, memory.raw_belief)

    def _track_target(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> list[Track]:
        """Return the target's tracks in the plans' frames, computed once per decision."""
        memory: Memory = situation.memory
        name = situation.key, tuple(plan.actions.tobytes() for plan in proposals), id(rollouts[0].frames)
        if memory.tracks is None or memory.tracks[0] != name:
            if self.tracker is None:
                raise ArgumentError(
                    "policy vlm: recognition needs a tracker, but this policy was created with tracker=None"
                )
            (tracks,) = track_rollouts(self.tracker, [situation.observation], [proposals], [rollouts])
            memory.tracks = name, tracks
        return memory.tracks[1]

    # ------------------------------------------------------------------------------------------------------------------

    def _ask_each(self, requests: Sequence[Sequence[Request]], role: str = "propose") -> list[list[Reply]]:
        """Ask who has a role the questions of all episodes at once; return the replies of each."""
        client = self.roles.get(role, self.client)
        found = client.ask([request for own in requests for request in own])
        replies = iter([replace(reply, model=client.model) for reply in found])
        return [list(islice(replies, len(own))) for own in requests]

    def _render_prompt(self, situation: Situation, name: str, horizon: int, count: int = 1) -> str:
        return self._fill_template(situation.goal.task, name, OBSERVATION_WORDS, horizon, count)

    def _fill_template(
        self, task: str, name: str, words: str, horizon: int = 1, count: int = 1, centred: bool = False
    ) -> str:
        """Return a question about an observation in `words`, and imagined views that may be `centred`."""
        return self.prompts.render(
            task,
            name,
            obs_key=words,
            look_ahead_action_num=horizon,
            plan_num=count,
            actions=plans.MEANINGS,
            shown=self.shown,
            captions=self.captions,
            centred=centred,
        )

    def _describe_reading(self, reply: Reply) -> dict[str, Any]:
        """Return how an answer was read, without empty entries."""
        choice = {"by": reply.by, "mass": reply.mass, "doubtful": reply.doubtful}
        return {**choice, "repaired": reply.repaired, "adapted": reply.adapted}

    def _record_exchange(self, key: Key, purpose: str, reply: Reply, instead: str) -> None:
        """Record a question's outcome."""
        exchange = Exchange(
            purpose,
            reply.model,
            tuple({"call": each.call, **each.completion.to_json()} for each in reply.completions),
            {name: value for name, value in self._describe_reading(reply).items() if value},
            "" if reply.problem is None else str(reply.problem),
            "" if reply.problem is None else instead,
        )
        self._journal.setdefault((key.episode, key.decision), []).append(exchange)


def _require_packages() -> None:
    missing = [name for name in ("pydantic", "json_repair") if find_spec(name) is None]
    if missing:
        raise DependencyError(f"policy vlm needs {', '.join(missing)}: pip install 'wiw[vlm]'")


def _check_roles(roles: Mapping[str, Mapping[str, Any]], model: str | None) -> Mapping[str, Mapping[str, Any]]:
    """Return the roles as they are.

    Raises:
        ArgumentError: another role, other options than vlm, model and key, or a model without a name.
    """
    fits = all(role in ROLES and "model" in own and set(own) <= {"vlm", "model", "key"} for role, own in roles.items())
    if not fits or (roles and model is None):
        raise ArgumentError(
            f"policy vlm: expected roles among {', '.join(ROLES)}, each with a model and optionally its own vlm and "
            "key, and the model's name for all others (model=, --vlm-model), got "
            f"roles={ {role: _leave_out_key(own) for role, own in roles.items()} }, model={model}"
        )
    return roles


def _leave_out_key(options: Any) -> Any:
    """Return the options of a server without its key; anything else as it is."""
    return {name: options[name] for name in options if name != "key"} if isinstance(options, Mapping) else options


def _get_role_options(own: Mapping[str, Any], vlm: Any, client: Mapping[str, Any]) -> dict[str, Any]:
    """Return the client's options for a role, where `client` are those given for the main `vlm`."""
    preset, key = presets.get_client_options(own["model"]), {} if own.get("key") is None else {"key": own["key"]}
    if (own.get("vlm") or vlm) == vlm:
        return {**preset, **client, **key}
    # what was given describes the main server, and its key is for nobody else
    return {**_leave_out_key(client), **preset, **key}


def refuse_tracking(
    tracker: Any = None,
    tracker_options: Mapping[str, Any] | None = None,
    rounds: bool = False,
    answer_view: str = "observation",
) -> None:
    """Refuse options of a policy that are of no use without a target.

    Raises:
        ArgumentError: one of them is given.
    """
    if tracker not in (None, "frames") or tracker_options or rounds or answer_view != "observation":
        raise ArgumentError(
            "policy vlm: tracker, tracker_options, rounds and answer_view are only for tasks that point a target "
            "out in the view, such as ar; leave them out"
        )


def derive_seed(key: Key, number: int) -> int:
    return int(core.fold_key([key.seed, key.episode, key.decision, number]))


def _measure_agreement(plan: NDArray[Any], written: NDArray[Any]) -> float:
    """Return the share of the longer plan's actions that both begin with."""
    same = 0
    while same < min(len(plan), len(written)) and np.array_equal(plan[same], written[same]):
        same += 1
    return same / max(len(plan), len(written))


def _make_uniform_belief(key: Key, count: int) -> NDArray[np.float64]:
    """Return equal probabilities, up to random differences below a millionth, so that no choice is always first."""
    weights = 1 + 1e-7 * np.asarray(
        core.uniform(core.fold_key([key.seed, key.episode, key.decision, _ANSWER_SEED]), count)
    )
    return np.asarray(weights / weights.sum(), np.float64)


def shorten(reason: str, most: int = 300) -> str:
    text = " ".join(reason.encode("utf-8", "replace").decode().split())
    return text if len(text) <= most else text[: most - 1] + "…"
