# SPDX-License-Identifier: Apache-2.0
"""A vision-language model that tells a robot arm where to go (paper, appendix "Robotic Manipulation")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from wiw._core import core
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.policies.vlm import DRAW, DRAWN, REVISE, TOKENS, VLM, cut, seed_of
from wiw.policies.vlm.arm import looks, plans
from wiw.policies.vlm.arm.plans import GRID
from wiw.tabletop.base import PALETTE
from wiw.types import Proposal, Rollout, Space
from wiw.vlm import Reply, Request, user
from wiw.vlm.base import Part

if TYPE_CHECKING:
    from pydantic import BaseModel


class ArmVLM(VLM):
    """Policy `vlm` where plans are poses: whole numbers as `wiw.action.PoseGrid` has them.

    It is told the instruction and the objects' places by their indices, which are marked in the front view, and shown
    an example of the same sort of task. With a world model a second question shows what each plan is imagined to lead
    to; the answer is one of these plans or another. Plans of other policies, which are not made of whole numbers, are
    chosen among as with revision="select".

    Args:
        policy: the client, prompts and options to ask with.
    """

    space: Space = "pose7"
    frames = FrameSpec("front", (384, 384))
    tasks = ("manipulation",)
    drawn = "a pose was drawn"

    def __init__(self, policy: VLM) -> None:
        self.__dict__.update(vars(policy))
        self.needs = ()
        self._walking = policy

    def for_space(self, space: Space) -> Policy:
        """The same model asked for primitives."""
        return self if space == "pose7" else self._walking

    def describe(self) -> dict[str, Any]:
        """With the model and a digest of the prompts."""
        return {name: value for name, value in super().describe().items() if name != "tracker"}

    def _before(self, situation: Situation, horizon: int) -> list[Part]:
        examples = self._words(situation, "examples", horizon)
        return [self._words(situation, "planner", horizon), examples, *self._now(situation, horizon)]

    def _now(self, situation: Situation, horizon: int) -> list[Part]:
        return [self._words(situation, "situation", horizon), looks.now(situation.observation)]

    def _schema(self, longest: int, count: int = 1) -> type[BaseModel]:
        return plans.plan_schema(longest, count)

    def _plans_in(self, value: Any) -> list[Proposal]:
        return [replace(plan, note=cut(plan.note), text=cut(plan.text)) for plan in plans.plans_in(value)]

    def _drawn(self, situation: Situation) -> Proposal:
        key = situation.key
        draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, DRAW]), 7)
        numbers = np.floor(draws * ([GRID.bins] * 3 + [GRID.turns] * 3 + [2])).astype(np.int64)
        return Proposal(GRID.decode(numbers[None]), note=DRAWN)

    def _selects(self, proposals: Sequence[Proposal]) -> bool:
        return super()._selects(proposals) or not all(plans.on_grid(plan.actions) for plan in proposals)

    def _revising(self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]) -> Request:
        selects = self._selects(proposals)
        horizon = max(situation.memory.horizon, *(len(plan.actions) for plan in proposals))
        parts = [self._words(situation, "planner", horizon), *self._now(situation, horizon)]
        parts.append(self._words(situation, "chooser" if selects else "planner_imagined", horizon))
        for number, (plan, rollout) in enumerate(zip(proposals, rollouts, strict=True), 1):
            parts += [f"Plan {number}: {_told(plan, whole=not selects)}", looks.plan_strip(plan, rollout)]
        options: dict[str, Any] = {"seed": seed_of(situation.key, REVISE), "tries": self.tries}
        if selects:
            choices = tuple(f"plan {number}" for number in range(1, len(proposals) + 1))
            return Request((user(*parts),), choices=choices, **options)
        parts.append(self._words(situation, "output", horizon))
        return Request((user(*parts),), schema=self._schema(horizon), max_tokens=TOKENS, **options)

    def _words(self, situation: Situation, name: str, horizon: int, count: int = 1) -> str:
        observation = situation.observation
        return self.prompts.text(
            situation.goal.task,
            name,
            look_ahead_action_num=horizon,
            plan_num=count,
            position_bins=GRID.bins,
            rotation_bins=GRID.turns,
            rotation_degrees=360 // GRID.turns,
            table_height=plans.SURFACE,
            colours=list(PALETTE),
            instruction=situation.goal.text,
            objects=plans.dictionary(observation.places),
            gripper=GRID.encode(observation.pose).tolist(),
            executed=[GRID.encode(pose).tolist() for pose in situation.executed],
        )

    def _read(self, reply: Reply) -> dict[str, Any]:
        outside = 0 if reply.value is None else plans.out_of_range(reply.value)
        return {**super()._read(reply), "out_of_range": outside}


def _told(plan: Proposal, whole: bool) -> str:
    """A plan in words, where it has any, and in whole numbers: all of its poses, or those that are shown of it."""
    words, count = plan.text.removeprefix(plans.SCENE), len(plan.actions)
    places = np.arange(count) if whole else plans.shown(count)
    head = f"{len(places)} of {count} actions: " if len(places) < count else "Actions: " if words else ""
    return (f"{words}\n" if words else "") + head + plans.named(plan.actions[places])
