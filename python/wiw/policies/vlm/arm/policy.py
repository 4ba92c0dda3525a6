# SPDX-License-Identifier: Apache-2.0
"""A vision-language model as the policy of a robot arm (paper, appendix "Robotic Manipulation")."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from wiw._core import core
from wiw.policies.base import FrameSpec, Situation
from wiw.policies.vlm.arm import plans, prompt_images
from wiw.policies.vlm.arm.plans import GRID
from wiw.policies.vlm.policy import (
    FALLBACK_NOTE,
    FALLBACK_SEED,
    MAX_PLAN_TOKENS,
    REVISION_SEED,
    VLM,
    derive_seed,
    shorten,
)
from wiw.tabletop.base import PALETTE
from wiw.types import GRIPPER_POSES, Proposal, Rollout
from wiw.vlm import Reply, Request, user
from wiw.vlm.messages import Part

if TYPE_CHECKING:
    from pydantic import BaseModel


class ArmVLM(VLM):
    """Policy `vlm` where plans are poses: whole numbers as in `wiw.action.PoseGrid`.

    The prompt has the instruction, the objects' positions by their indices, which are marked in the front view, and an
    example of the same task. With a world model a second question shows what each plan is imagined to lead to; the
    answer is one of these plans or another. Plans of other policies, which are not made of whole numbers, are selected
    from as with revision="select".
    """

    space = GRIPPER_POSES
    frames = FrameSpec("front", (384, 384))
    tasks = ("manipulation",)
    tracks = False
    shows_front = False
    fallback_action = "a pose was drawn"

    def _build_plan_prompt(self, situation: Situation, horizon: int) -> list[Part]:
        examples = self._render_prompt(situation, "examples", horizon)
        return [
            self._render_prompt(situation, "planner", horizon),
            *([examples] if examples else []),
            *self._describe_situation(situation, horizon),
        ]

    def _describe_situation(self, situation: Situation, horizon: int) -> list[Part]:
        return [
            self._render_prompt(situation, "situation", horizon),
            prompt_images.render_observation(situation.observation),
        ]

    def _get_plan_schema(self, situation: Situation, longest: int, count: int = 1) -> type[BaseModel]:
        return plans.plan_schema(longest, count)

    def _parse_plans(self, value: Any) -> list[Proposal]:
        return [replace(plan, note=shorten(plan.note), text=shorten(plan.text)) for plan in plans.parse_plans(value)]

    def _draw_fallback(self, situation: Situation) -> Proposal:
        key = situation.key
        draws = core.uniform(core.fold_key([key.seed, key.episode, key.decision, FALLBACK_SEED]), 7)
        numbers = np.floor(draws * ([GRID.bins] * 3 + [GRID.turns] * 3 + [2])).astype(np.int64)
        return Proposal(GRID.decode(numbers[None]), note=FALLBACK_NOTE)

    def _selects(self, proposals: Sequence[Proposal]) -> bool:
        return super()._selects(proposals) or not all(plans.is_on_grid(plan.actions) for plan in proposals)

    def _build_revision_request(
        self, situation: Situation, proposals: Sequence[Proposal], rollouts: Sequence[Rollout]
    ) -> Request:
        selects = self._selects(proposals)
        horizon = max(situation.memory.horizon, *(len(plan.actions) for plan in proposals))
        parts = [self._render_prompt(situation, "planner", horizon), *self._describe_situation(situation, horizon)]
        parts.append(self._render_prompt(situation, "chooser" if selects else "planner_imagined", horizon))
        for number, (plan, rollout) in enumerate(zip(proposals, rollouts, strict=True), 1):
            parts += [
                f"Plan {number}: {_describe_plan(plan, whole=not selects)}",
                prompt_images.render_plan_strip(plan, rollout),
            ]
        options: dict[str, Any] = {"seed": derive_seed(situation.key, REVISION_SEED), "tries": self.tries}
        if selects:
            choices = tuple(f"plan {number}" for number in range(1, len(proposals) + 1))
            return Request((user(*parts),), choices=choices, **options)
        parts.append(self._render_prompt(situation, "output", horizon))
        options |= {"max_tokens": MAX_PLAN_TOKENS, "temperature": self.revision_temperature}
        return Request((user(*parts),), schema=self._get_plan_schema(situation, horizon), **options)

    def _render_prompt(self, situation: Situation, name: str, horizon: int, count: int = 1) -> str:
        observation = situation.observation
        return self.prompts.render(
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
            objects=plans.encode_objects(observation.places),
            gripper=GRID.encode(observation.pose).tolist(),
            executed=[GRID.encode(pose).tolist() for pose in situation.executed],
        )

    def _describe_reading(self, reply: Reply) -> dict[str, Any]:
        outside = 0 if reply.value is None else plans.count_out_of_range(reply.value)
        return {**super()._describe_reading(reply), "out_of_range": outside}


def _describe_plan(plan: Proposal, whole: bool) -> str:
    """Return a plan in words, if it has any, and in whole numbers: all of its poses, or those shown of it."""
    words, count = plan.text.removeprefix(plans.SCENE_WORDS), len(plan.actions)
    places = np.arange(count) if whole else plans.select_shown(count)
    head = f"{len(places)} of {count} actions: " if len(places) < count else "Actions: " if words else ""
    return (f"{words}\n" if words else "") + head + plans.format_poses(plan.actions[places])
