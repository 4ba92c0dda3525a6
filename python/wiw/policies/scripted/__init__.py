# SPDX-License-Identifier: Apache-2.0
"""A manipulator without a language model: an expert that errs, so that choosing among its plans matters.

It reads the instruction, is told where objects are as the paper's policies are, and plans as the expert of the task
does; but it may take one target for another, and it never knows places quite as they are. Imagined ends are scored by
what the instruction asks to be seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from wiw._core import core
from wiw.physics import place
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.tabletop.base import TabletopTask
from wiw.tabletop.tasks import find_task
from wiw.types import ArmObservation, Proposal, Rollout

MISTAKEN = 0.55
"""Chance that a plan is made for another target; high, because what went wrong is often put right by the next plan."""
ASTRAY = 0.007
"""Metres, standard deviation along x and y of where an object is thought to be; a ring and its peg bear 4 mm, a cup a
centimetre, a button three."""
TURNED = 0.05
"""Radians, the same of how it is thought to be turned."""
PURPOSE = 0x73637269
"""Keeps these draws apart from all others of the decision."""


class Scripted(Policy):
    """Plans with errors, and scores by what has to be seen at the end.

    The rates of errors are fixed so that the first plan alone does what is told in 40 to 50 of 100 episodes of the four
    manipulation tasks (`docs/results.md`): there is as much to win as to lose by choosing.
    """

    space = "pose7"
    frames = FrameSpec("front", (240, 240))

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Plans that go on from where things stand, each with errors of its own; equally good as far as it knows."""
        return [
            [_plan(situation, number, horizon) for number in range(candidates if situation.imagines else 1)]
            for situation in situations
        ]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """How much each plan's last frame looks as if the instruction were followed, from 0 to 1."""
        scores = []
        for situation, plans in zip(situations, rollouts, strict=True):
            task, target = _asked(situation)
            places = situation.observation.places
            scores.append(np.array([task.estimate_completion(plan.frames[-1], places, target) for plan in plans]))
        return scores


def _asked(situation: Situation) -> tuple[TabletopTask, Any]:
    """The kind of task and the target that an instruction asks for."""
    text = situation.goal.text or ""
    task = find_task(text)
    return task, task.parse_target(text)


def _plan(situation: Situation, number: int, horizon: int) -> Proposal:
    """One plan, or staying where nothing is left to do."""
    (task, target), key = _asked(situation), situation.key
    seen: ArmObservation = situation.observation
    whether, which, *draws = core.uniform(
        core.fold_key([key.seed, key.episode, key.decision, number, PURPOSE]), 2 + 3 * len(seen.places)
    )
    left = task.find_remaining_target(seen, target)
    if left is None:
        return Proposal(np.tile(seen.pose, (horizon, 1)), text="keep still", note="nothing left to do")
    rests = [task.find_remaining_target(seen, other) for other in task.list_alternatives(list(seen.places), target)]
    others = [rest for rest in rests if rest is not None]
    mistaken = bool(others) and whether < MISTAKEN
    if mistaken:
        left = others[int(which * len(others))]
    believed = _believed(seen.places, np.array(draws).reshape(-1, 3))
    plan = task.plan_expert(believed, left, seen.pose)[:horizon]
    return Proposal(plan, text=task.phrase_instruction(left), note="another target" if mistaken else "")


def _believed(places: Mapping[str, NDArray[np.float64]], draws: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Places as the policy takes them to be; draws [N, 3] from 0 to 1."""
    found = {}
    for (name, pose), errors in zip(places.items(), ndtri(np.clip(draws, 1e-6, 1 - 1e-6)), strict=True):
        found[name] = pose @ place(rpy=(0, 0, TURNED * errors[2]))
        found[name][:2, 3] += ASTRAY * errors[:2]
    return found
