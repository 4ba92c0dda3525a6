# SPDX-License-Identifier: Apache-2.0
"""A vision-language model that answers questions about a home (paper, appendix "A-EQA")."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.mapping.views import HFOV_DEG, VIEW_NAMES, cut_views
from wiw.perception.scene_labels import Labeller, SceneLabels
from wiw.policies.base import FrameSpec, Situation
from wiw.policies.vlm import plans
from wiw.policies.vlm.policy import MAX_PLAN_TOKENS, REVISION_SEED, VLM, Memory, derive_seed
from wiw.policies.vlm.questions import commands, prompt_images, steering
from wiw.policies.vlm.questions.commands import Command
from wiw.policies.vlm.questions.home_map import HomeMap, Sight
from wiw.registry import LABELLERS
from wiw.types import Goal, Key, Proposal, Rollout, TextAnswer
from wiw.vlm import Reply, Request, user
from wiw.vlm.messages import Part

if TYPE_CHECKING:
    from pydantic import BaseModel

VIEWS_WORDS = f"{', '.join(VIEW_NAMES)} view, each {HFOV_DEG:g} degrees wide, side by side in one picture"
"""Value of the slot `obs_key`."""
ORDERS = ("marked_first", "plain_first")
IMAGINED = ("plan", "straight")
STRAIGHT_END = "Imagined views after the turn it begins with and some steps straight on"
WALK_SEED, ANSWER_SEED = 0x77616C6B, 0x73617973
"""Separate the seeds of a decision's questions."""
NO_WALK = "the robot only turns to the view"


@dataclass(frozen=True)
class PlannedCommand:
    """A command of the high-level planner, and the primitives that it became."""

    command: Command
    plan: Proposal
    """The plan as it is imagined."""
    way: NDArray[np.int8]
    """Primitives to carry out: the plan's, unless a route goes on or other steps are imagined."""


@dataclass(kw_only=True)
class QuestionMemory(Memory):
    """The memory of one episode."""

    home: HomeMap
    sight: Sight | None = None
    """View of the present decision."""
    planned: dict[bytes, PlannedCommand] = field(default_factory=dict)
    """Commands of the present decision by the primitives of their plans."""
    answer: tuple[Key, str] | None = None
    """The planner's latest answer, empty if it gave none, and at which decision."""
    executed: int = 0
    """Primitives that had been executed at the latest observation."""
    history: list[str] = field(default_factory=list)
    """The commands that were carried out, in words."""


class QuestionVLM(VLM):
    """Policy `vlm` where the goal is a question: two levels of control, and an answer in words.

    At each decision the *high-level planner* sees the question and four real views, with landmarks marked and without.
    It commands to go to a landmark or in the direction of a view, and answers if it can. The *low-level planner* makes
    primitives of commands: a route to a landmark over floor that depth has shown; for words, a walk that the model
    writes. With a world model each of M commands is imagined, and a question with the views at their ends selects the
    command to follow. Answers come from the planner, who is only shown real views.

    Args:
        args, options: as of `VLM`.
        perception: finds the landmarks: "learned", "detector" (a detector and a segmenter), or a `Labeller`.
        history: number of its latest commands that the planner is told; 0: it has no memory of them.
        order: which picture of the real views comes first, "marked_first" or "plain_first".
        imagined: what the world model imagines of a command: "plan", or, as in the published code, "straight", the turn
            to its landmark or view and then steps forward alone.
        longest_route: primitives after which a route to a landmark is cut; it is carried out as far as the task lets a
            decision go (`execute`), however little of it is imagined. None: a route is a plan like any other.

    Raises:
        ArgumentError: see `VLM`; perception that needs the simulator's instance ids.
        DependencyError: the learned labeller without torch.
    """

    frames = FrameSpec("panorama", (432, 768), ends=True)
    tasks = ("aeqa",)
    tracks = False
    shows_front = False

    def __init__(
        self,
        *args: Any,
        perception: Any = "learned",
        history: int = 5,
        order: Literal["marked_first", "plain_first"] = "marked_first",
        imagined: Literal["plan", "straight"] = "plan",
        longest_route: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(*args, **options)
        if history < 0 or order not in ORDERS:
            raise ArgumentError(
                f"policy vlm: expected history >= 0 and order {' or '.join(ORDERS)}, got {history}, {order}"
            )
        if imagined not in IMAGINED or (longest_route is not None and longest_route < 1):
            raise ArgumentError(
                f"policy vlm: expected imagined {' or '.join(IMAGINED)} and longest_route of at least 1, got "
                f"{imagined}, {longest_route}"
            )
        self.labeller: Labeller = LABELLERS.make(perception)
        if "ids" in self.labeller.needs:
            raise ArgumentError(
                f"policy vlm: {type(self.labeller).__name__} needs the simulator's instance ids, which agents never "
                "see; expected perception that uses only images, such as learned"
            )
        self.history, self.order = history, order
        self.imagined, self.longest_decision = imagined, longest_route
        self.needs = ("depth",)

    @property
    def can_extend(self) -> bool:
        """No: landmarks are found by depth, which imagined places lack."""
        return False

    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity, with the model, a digest of the prompts, and the perception."""
        own = {"perception": self.labeller.describe(), "history": self.history, "order": self.order}
        longer = {} if self.longest_decision is None else {"longest_route": self.longest_decision}
        straight = {} if self.imagined == "plan" else {"imagined": self.imagined}
        return {**super().describe(), **own, **longer, **straight}

    def begin(self, goal: Goal, key: Key) -> QuestionMemory:
        """Return an empty map."""
        super().begin(goal, key)
        return QuestionMemory(home=HomeMap(self.labeller.categories))

    # -- real views ----------------------------------------------------------------------------------------------------

    def observe(self, situations: Sequence[Situation]) -> None:
        """Add the real views to the maps, labelled in one batch, and mark the landmarks in them."""
        super().observe(situations)
        observations = [situation.observation for situation in situations]
        cut = [cut_views(own.panorama, own.depth, own.odometry) for own in observations]
        images, depth = (
            np.concatenate(own) for own in zip(*((views.images, views.depth) for views in cut), strict=True)
        )
        labels = self.labeller.label(images, HFOV_DEG, depth=depth)
        for number, (situation, views) in enumerate(zip(situations, cut, strict=True)):
            memory, rows = situation.memory, slice(4 * number, 4 * number + 4)
            own = SceneLabels(labels.category[rows], labels.confidence[rows], labels.state[rows])
            waits = memory.answer is not None and memory.answer[1]  # the task may have asked again at once
            executed = np.array([] if waits else situation.executed[memory.executed :], np.int8)
            memory.sight = memory.home.add(situation.observation, views, own, situation.goal.text or "", executed)
            memory.executed, memory.planned = len(situation.executed), {}

    # -- plans ---------------------------------------------------------------------------------------------------------

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return the plans that commands become; with an answer a single short one, for a second look."""
        wanted = [self._build_requests(situation, candidates, horizon)[1] for situation in situations]
        replies = self._ask_each(wanted)
        found = [self._read_commands(situation, own) for situation, own in zip(situations, replies, strict=True)]
        planned = self._plan_commands(list(zip(situations, found, strict=True)))
        for situation, own in zip(situations, planned, strict=True):
            for each in own:  # of commands that are imagined alike, the first
                situation.memory.planned.setdefault(each.plan.actions.tobytes(), each)
        return [
            _drop_equal([each.plan for each in own]) or [self._draw_fallback(situation)]
            for situation, own in zip(situations, planned, strict=True)
        ]

    def _build_plan_prompt(self, situation: Situation, horizon: int) -> list[Part]:
        return [self._render_prompt(situation, "planner", horizon), *self._show_views(situation)]

    def _show_views(self, situation: Situation) -> list[Part]:
        """Return the real views, with marks and without."""
        sight = situation.memory.sight
        marked: list[Part] = ["Real views, marked:", prompt_images.render_marked_views(sight)]
        plain: list[Part] = ["The same real views, without marks:", prompt_images.render_plain_views(sight)]
        return [*marked, *plain] if self.order == "marked_first" else [*plain, *marked]

    def _get_plan_schema(self, situation: Situation, longest: int, count: int = 1) -> type[BaseModel]:
        return commands.command_schema(commands.list_marks(situation.memory.sight.marked), count)

    def _read_commands(self, situation: Situation, replies: Sequence[Reply]) -> list[Command]:
        """Return the commands of usable replies; the first one alone if it comes with an answer."""
        memory: QuestionMemory = situation.memory
        usable = [reply for reply in replies if reply.problem is None]
        instead = "the plan was left out" if usable else self.fallback_action
        for number, reply in enumerate(replies):
            self._record_exchange(situation.key, f"propose/{number}", reply, instead)
        assert memory.sight is not None
        found = [each for reply in usable for each in commands.parse_commands(reply.value, memory.sight.marked)]
        memory.answer = situation.key, found[0].answer if found else ""
        return found[:1] if memory.answer[1] else [replace(each, answer="") for each in found]

    # -- the low level -------------------------------------------------------------------------------------------------

    def _plan_commands(self, wanted: Sequence[tuple[Situation, Sequence[Command]]]) -> list[list[PlannedCommand]]:
        """Return the plans of each episode's commands; all walks that they need are asked for at once."""
        requests = [
            [self._build_walk_request(situation, command) for command in own if command.landmark is None]
            for situation, own in wanted
        ]
        replies = self._ask_each(requests)
        return [
            [self._plan_command(situation, command, walks) for command in own]
            for (situation, own), walks in zip(wanted, map(iter, replies), strict=True)
        ]

    def _plan_command(self, situation: Situation, command: Command, walks: Iterator[Reply]) -> PlannedCommand:
        memory: QuestionMemory = situation.memory
        pose, horizon = situation.observation.odometry, memory.horizon
        if command.landmark is not None:
            route = steering.find_route(memory.home.grid, pose, command.landmark)
            turn, way = steering.turn_to_landmark(pose, command.landmark), steering.cut_plan(route, horizon)
            way = route[: self.longest_decision] if self.longest_decision is not None and len(route) else way
        else:
            reply = next(walks)
            self._record_exchange(situation.key, "walk", reply, NO_WALK)
            walk = np.zeros(0, np.int8) if reply.problem else commands.parse_walk(reply.value)
            turn, way = steering.turn_to_view(command.view), steering.walk_in_view(command.view, walk, horizon)
        if command.answer:
            way = plan = way[: min(steering.LOOK, horizon)]
        elif situation.imagines and self.imagined == "straight":
            plan = steering.go_straight(turn, horizon)
        else:
            plan = steering.cut_plan(way, horizon)
        return PlannedCommand(command, Proposal(plan, note=command.plan), way)

    def _build_walk_request(self, situation: Situation, command: Command) -> Request:
        words = self._render_prompt(situation, "low_level_planner", commands.WALK_ACTIONS, command=command)
        message = user(words, prompt_images.render_view(situation.memory.sight, command.view))
        seed = derive_seed(situation.key, WALK_SEED)
        return Request((message,), schema=commands.walk_schema(), seed=seed, tries=self.tries)

    # -- imagined views ------------------------------------------------------------------------------------------------

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return the probability of each plan ("select"), or its agreement with that of the command that is written."""
        rows = list(zip(situations, proposals, rollouts, strict=True))
        replies = self._ask_each([self._build_scoring_requests(*row) for row in rows], "revise")
        written = [self._read_revision(situation, own) for situation, own in zip(situations, replies, strict=True)]
        planned = self._plan_commands(list(zip(situations, written, strict=True)))
        return [
            self._rate_commands(situation, proposed, own[0], plans) if own else np.ones(1)
            for (situation, proposed, _), own, plans in zip(rows, replies, planned, strict=True)
        ]

    def _rate_commands(
        self, situation: Situation, proposals: Sequence[Proposal], reply: Reply, written: Sequence[PlannedCommand]
    ) -> NDArray[np.float64]:
        """Return the plans' scores; the command that was written takes the place of one that is imagined alike."""
        for each in written:
            situation.memory.planned[each.plan.actions.tobytes()] = each
        return self._rate_plans(situation, proposals, reply, written[0].plan.actions if written else None)

    def _build_scoring_requests(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> list[Request]:
        """Return the question that ranks the plans; none where the agent has an answer and only looks again."""
        memory: QuestionMemory = situation.memory
        memory.horizon = max(memory.horizon, *(len(plan.actions) for plan in proposals))
        looks_again = len(proposals) == 1 and _get_answer(situation)
        return [] if looks_again else super()._build_scoring_requests(situation, proposals, rollouts)

    def _build_revision_request(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> Request:
        memory: QuestionMemory = situation.memory
        selects = self._selects(proposals)
        parts = self._build_plan_prompt(situation, memory.horizon)
        parts.append(self._render_prompt(situation, "chooser" if selects else "planner_imagined", memory.horizon))
        for number, (plan, rollout) in enumerate(zip(proposals, rollouts, strict=True), 1):
            is_straight = self.imagined == "straight" and plan.actions.tobytes() in memory.planned
            end = STRAIGHT_END if is_straight else prompt_images.describe_end(rollout)
            words = f"Plan {number}: {_describe_plan(memory, plan)}\n{end}:"
            parts += [words, prompt_images.render_end(rollout)]
        options: dict[str, Any] = {"seed": derive_seed(situation.key, REVISION_SEED), "tries": self.tries}
        if selects:
            choices = tuple(f"plan {number}" for number in range(1, len(proposals) + 1))
            return Request((user(*parts),), choices=choices, **options)
        assert memory.sight is not None
        parts.append(self._render_prompt(situation, "output_imagined", memory.horizon))
        schema = commands.command_schema(commands.list_marks(memory.sight.marked), answers=False)
        options |= {"max_tokens": MAX_PLAN_TOKENS, "temperature": self.revision_temperature}
        return Request((user(*parts),), schema=schema, **options)

    def _read_revision(self, situation: Situation, replies: Sequence[Reply]) -> list[Command]:
        """Return the command that a revision has written, if it was asked for one."""
        for reply in replies:
            self._record_exchange(situation.key, "revise", reply, "the first plan was taken")
        marked = situation.memory.sight.marked
        return [
            each
            for reply in replies
            if reply.value is not None
            for each in commands.parse_commands(reply.value, marked)
        ]

    def revise(
        self, situation: Situation, proposals: Sequence[Proposal], scores: NDArray[np.float64]
    ) -> tuple[NDArray[Any], int | None]:
        """Return the decided plan, and remember its command for later prompts."""
        actions, chosen = super().revise(situation, proposals, scores)
        memory: QuestionMemory = situation.memory
        planned = memory.planned.get(actions.tobytes())
        if planned is None:
            return actions, chosen
        if not planned.command.answer:
            memory.history.append(f"after {len(situation.executed)} actions: {planned.command.plan}")
        follows = np.array_equal(planned.way[: len(actions)], actions)  # else other steps were imagined
        return planned.way, chosen if follows else None

    # -- answers -------------------------------------------------------------------------------------------------------

    def answer(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout] | None],
    ) -> list[TextAnswer]:
        """Return the planner's answers, as final ones; where another policy has proposed, the question is asked now."""
        replies = self._ask_each(
            [[] if _get_answer(each) is not None else [self._build_question(each)] for each in situations], "answer"
        )
        for situation, own in zip(situations, replies, strict=True):
            for reply in own:
                self._record_exchange(situation.key, "answer", reply, "no answer was given")
                situation.memory.answer = situation.key, commands.parse_answer(reply.value)
        return [_make_answer(_get_answer(situation) or "") for situation in situations]

    def _build_question(self, situation: Situation) -> Request:
        message = user(self._render_prompt(situation, "answerer", 1), *self._show_views(situation))
        seed = derive_seed(situation.key, ANSWER_SEED)
        return Request((message,), schema=commands.answer_schema(), seed=seed, tries=self.tries)

    # ------------------------------------------------------------------------------------------------------------------

    def _render_prompt(
        self, situation: Situation, name: str, horizon: int, count: int = 1, command: Command | None = None
    ) -> str:
        memory: QuestionMemory = situation.memory
        assert memory.sight is not None
        return self.prompts.render(
            situation.goal.task,
            name,
            obs_key=VIEWS_WORDS,
            question=situation.goal.text,
            detected_objs=commands.name_marks(memory.sight.marked),
            history=memory.history[-self.history :] if self.history else [],
            look_ahead_action_num=horizon,
            plan_num=count,
            actions={**plans.MEANINGS, commands.STOP: "end here"},
            action_times=commands.WALK_TIMES,
            high_level_plan={} if command is None else command.to_prompt(),
        )


def _get_answer(situation: Situation) -> str | None:
    """Return the answer of this decision's planner, empty if it has none; None if it was not asked."""
    latest = situation.memory.answer
    return None if latest is None or latest[0] != situation.key else latest[1]


def _make_answer(text: str) -> TextAnswer:
    return TextAnswer(text, 1.0, final=True) if text else TextAnswer()


def _drop_equal(proposals: Sequence[Proposal]) -> list[Proposal]:
    """Return the plans that differ, in the order in which they were written."""
    found: dict[bytes, Proposal] = {}
    for plan in proposals:
        found.setdefault(plan.actions.tobytes(), replace(plan, prior=float(-len(found))))
    return list(found.values())


def _describe_plan(memory: QuestionMemory, plan: Proposal) -> str:
    """Return the command behind a plan; of another policy's plan its note and primitives."""
    planned = memory.planned.get(plan.actions.tobytes())
    if planned is not None:
        return json.dumps(planned.command.to_prompt(), ensure_ascii=False)
    return f"{plan.note or 'in primitives'}: {', '.join(plans.name_actions(plan.actions))}"
