# SPDX-License-Identifier: Apache-2.0
"""Manipulation without a language model: an expert with deliberate errors, so that choosing among its plans matters.

It reads the instruction, knows where objects are as the paper's policies do, and plans like the task's expert; but it
may confuse targets, and its knowledge of poses is noisy. Imagined ends are scored by how well they show the
instruction as carried out.
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
from wiw.types import GRIPPER_POSES, ArmObservation, Proposal, Rollout

MISTAKE_PROBABILITY = 0.55
"""Probability that a plan is made for another target; high, because the next plan often repairs the damage."""
POSITION_NOISE = 0.007
"""Standard deviation of object positions along x and y in metres; a ring and its peg tolerate 4 mm, a cup a centimetre,
a button three.
"""
YAW_NOISE = 0.05
"""Standard deviation of object yaws in radians."""
PURPOSE = 0x73637269
"""Separates these random draws from all others of the decision."""


class Scripted(Policy):
    """Proposes expert plans, some with deliberate mistakes, and scores plans by what their last frames show.

    The error rates are fixed so that the first plan alone succeeds in 40 to 50 of 100 episodes of the four manipulation
    tasks (`docs/results.md`): choosing can win as much as it can lose.
    """

    space = GRIPPER_POSES
    frames = FrameSpec("front", (240, 240), ends=True)

    def propose(self, situations: Sequence[Situation], candidates: int, horizon: int) -> list[list[Proposal]]:
        """Return plans that continue from the present state, each with its own errors; all equally good as far as it
        knows.
        """
        return [
            [_make_plan(situation, number, horizon) for number in range(candidates if situation.imagines else 1)]
            for situation in situations
        ]

    def score(
        self,
        situations: Sequence[Situation],
        proposals: Sequence[Sequence[Proposal]],
        rollouts: Sequence[Sequence[Rollout]],
    ) -> list[NDArray[np.float64]]:
        """Return how far each plan's last frame shows the instruction as carried out, from 0 to 1."""
        scores = []
        for situation, plans in zip(situations, rollouts, strict=True):
            task, target = _parse_goal(situation)
            places = situation.observation.places
            scores.append(np.array([task.estimate_completion(plan.frames[-1], places, target) for plan in plans]))
        return scores


def _parse_goal(situation: Situation) -> tuple[TabletopTask, Any]:
    """Return the task and the target of an instruction."""
    text = situation.goal.text or ""
    task = find_task(text)
    return task, task.parse_target(text)


def _make_plan(situation: Situation, number: int, horizon: int) -> Proposal:
    """Make one plan; it keeps still where nothing is left to do."""
    (task, target), key = _parse_goal(situation), situation.key
    seen: ArmObservation = situation.observation
    whether, which, *draws = core.uniform(
        core.fold_key([key.seed, key.episode, key.decision, number, PURPOSE]), 2 + 3 * len(seen.places)
    )
    left = task.find_remaining_target(seen, target)
    if left is None:
        return Proposal(np.tile(seen.pose, (horizon, 1)), text="keep still", note="nothing left to do")
    rests = [task.find_remaining_target(seen, other) for other in task.list_alternatives(list(seen.places), target)]
    others = [rest for rest in rests if rest is not None]
    mistaken = bool(others) and whether < MISTAKE_PROBABILITY
    if mistaken:
        left = others[int(which * len(others))]
    believed = _perturb_poses(seen.places, np.array(draws).reshape(-1, 3))
    plan = task.plan_expert(believed, left, seen.pose)[:horizon]
    return Proposal(plan, text=task.phrase_instruction(left), note="another target" if mistaken else "")


def _perturb_poses(
    places: Mapping[str, NDArray[np.float64]], draws: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return the poses with the policy's errors; draws [N, 3] from 0 to 1."""
    found = {}
    for (name, pose), errors in zip(places.items(), ndtri(np.clip(draws, 1e-6, 1 - 1e-6)), strict=True):
        found[name] = pose @ place(rpy=(0, 0, YAW_NOISE * errors[2]))
        found[name][:2, 3] += POSITION_NOISE * errors[:2]
    return found
