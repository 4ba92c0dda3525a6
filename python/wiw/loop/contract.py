# SPDX-License-Identifier: Apache-2.0
"""What the loop holds policies and world models to; `Attempts` does the same for frames."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError, ContractError
from wiw.policies.base import Policy, Situation
from wiw.types import Answer, Goal, Proposal, Space
from wiw.world_models.base import Accepts, WorldModel
from wiw.world_models.oracle import Oracle

PRIMITIVES = frozenset(map(int, (FORWARD, TURN_LEFT, TURN_RIGHT, STOP)))
GIVEN = ("depth", "simulator")
"""What the loop can give a world model beyond the image; semantics too where the agent has a source of them."""
PLANS = {"discrete": "discrete primitives", "pose7": "poses of a gripper"}
"""By space, in words."""


def check_depth(needs: Collection[str], observations: Sequence[Any]) -> None:
    """Hold observations to the depth that an agent with these `needs` reads.

    Raises:
        ArgumentError: an observation has none.
    """
    if "depth" in needs and any(getattr(observation, "depth", None) is None for observation in observations):
        raise ArgumentError(
            "this agent needs observations with depth, and got one without: make the environment with depth=True"
        )


def check_model(model: WorldModel, longest: int, space: Space = "discrete", semantics: bool = False) -> None:
    """Refuses a world model that asks for what it would not be given; plans have up to `longest` actions of a space.

    `semantics` is whether the agent has a source of them.

    Raises:
        ArgumentError: poses instead of primitives or the other way round, panoramas where there are none, needs that
            nobody meets, the simulator for another than `Oracle`, or too few frames for a model that cannot go on from
            an imagined one.
    """
    accepts, name = model.accepts, type(model).__name__
    follows = accepts.control not in ("image", "text")  # those know nothing of primitives or poses
    if follows and accepts.space != space:
        raise ArgumentError(f"{name} takes space='{accepts.space}', but this agent plans in {PLANS[space]}")
    if space == "pose7":
        _check_front(accepts, name)
    if "semantic" in accepts.needs and not semantics and space == "discrete":
        raise ArgumentError(
            f"{name} needs semantics: choose a source of them, --semantics simulator or --semantics rednet "
            "(wiw.Agent(semantics=...)); see docs/perception.md"
        )
    given = (*GIVEN, "semantic") if space == "discrete" else GIVEN
    if missing := [need for need in accepts.needs if need not in given]:
        raise ArgumentError(f"{name} needs {', '.join(missing)}, but a model can be given {', '.join(given)}")
    if "simulator" in accepts.needs and not isinstance(model, Oracle):
        raise ArgumentError(
            f"{name} needs the simulator, which is handed to the oracle alone: it knows where the agent truly is. "
            "Declare what the model sees of the world instead (needs=('depth',)), or derive it from wiw's Oracle"
        )
    if space == "discrete" and accepts.needs and accepts.frames and longest > accepts.frames - 1:
        raise ArgumentError(
            f"{name} imagines {accepts.frames - 1} primitives at a time and needs {', '.join(accepts.needs)}, which an "
            f"imagined frame does not have, but plans have up to {longest}; lower horizon or depth, or raise frames"
        )


def _check_front(accepts: Accepts, name: str) -> None:
    """Poses are planned before one fixed camera."""
    if accepts.control not in ("image", "text", "action"):
        raise ArgumentError(f"{name} follows a {accepts.control} of the camera, but poses of a gripper move none")
    if accepts.view != "perspective":
        raise ArgumentError(f"{name} imagines panoramas, but what a gripper does is seen in a front view")


def check_proposals(policy: Any, proposals: Any, episodes: int, most: int, horizon: int) -> None:
    """Holds `propose` and `extend` to at most `most` plans of 1 to `horizon` actions for each episode.

    Raises:
        ContractError: another count, length or action.
    """
    name = f"{type(policy).__name__}.propose"
    if not isinstance(proposals, Sequence) or len(proposals) != episodes:
        raise ContractError(f"{name}: expected a list of proposals for each of {episodes} episodes, got {proposals!r}")
    for plans in proposals:
        if not 1 <= len(plans) <= most:
            raise ContractError(f"{name}: expected 1 to {most} plans for an episode, got {len(plans)}")
        for plan in plans:
            if not isinstance(plan, Proposal):
                raise ContractError(f"{name}: expected wiw.types.Proposal, got {type(plan).__name__}")
            _check_plan(name, plan.actions, horizon, policy.space)


def checked_plan(policy: Any, actions: Any, longest: int) -> NDArray[Any]:
    """The plan that `revise` decided for, int8 [K] or float64 [K, 7].

    Raises:
        ContractError: no actions, more than `longest`, or unknown ones.
    """
    plan = np.asarray(actions)
    _check_plan(f"{type(policy).__name__}.revise", plan, longest, policy.space)
    return plan.astype(np.int8 if policy.space == "discrete" else np.float64)


def _check_plan(name: str, actions: NDArray[Any], horizon: int, space: Space) -> None:
    if space == "pose7":
        _check_poses(name, actions, horizon)
        return
    if actions.ndim != 1 or not 1 <= len(actions) <= horizon:
        raise ContractError(f"{name}: expected plans of 1 to {horizon} primitives, got shape {actions.shape}")
    if unknown := set(actions.tolist()) - PRIMITIVES:
        raise ContractError(f"{name}: expected primitives among {sorted(PRIMITIVES)}, got {sorted(unknown)}")


def _check_poses(name: str, poses: NDArray[Any], horizon: int) -> None:
    if poses.ndim != 2 or poses.shape[1] != 7 or not 1 <= len(poses) <= horizon:
        raise ContractError(f"{name}: expected plans of 1 to {horizon} poses, float [K, 7], got shape {poses.shape}")
    if not np.isfinite(poses).all() or not ((poses[:, 6] >= 0) & (poses[:, 6] <= 1)).all():
        raise ContractError(f"{name}: expected finite poses with a gripper from 0 to 1, got {poses.tolist()}")


def checked_scores(policy: Any, scores: Any, proposals: Sequence[Sequence[Proposal]]) -> list[NDArray[np.float64]]:
    """One finite number for each plan of each episode, as float64.

    Raises:
        ContractError: another count, or NaN.
    """
    name = f"{type(policy).__name__}.score"
    if not isinstance(scores, Sequence) or len(scores) != len(proposals):
        raise ContractError(f"{name}: expected scores for each of {len(proposals)} episodes, got {scores!r}")
    found = [np.asarray(row, np.float64) for row in scores]
    for row, plans in zip(found, proposals, strict=True):
        if row.shape != (len(plans),) or not np.isfinite(row).all():
            raise ContractError(f"{name}: expected {len(plans)} finite numbers, one a plan, got {row.tolist()}")
    return found


def check_answerer(policy: Policy, goal: Goal) -> None:
    """Refuses a reviser that gives no answer where the goal asks for one.

    Raises:
        ContractError: it has not written `answer`.
    """
    if goal.choices and type(policy).answer is Policy.answer:
        raise ContractError(
            f"{type(policy).__name__} gives no answer, but task '{goal.task}' asks for one of {len(goal.choices)} "
            "choices at every decision; write its `answer`, or give the agent a policy that answers (revision=)"
        )


def checked_answers(policy: Any, answers: Any, situations: Sequence[Situation]) -> list[Answer | None]:
    """A distribution over the goal's choices for each episode whose goal has some, None for the others.

    Raises:
        ContractError: other choices, or numbers that are no distribution.
    """
    name = f"{type(policy).__name__}.answer"
    if not isinstance(answers, Sequence) or len(answers) != len(situations):
        raise ContractError(f"{name}: expected one answer for each of {len(situations)} episodes, got {answers!r}")
    for answer, situation in zip(answers, situations, strict=True):
        choices = situation.goal.choices
        if answer is None and not choices:
            continue
        if not isinstance(answer, Answer) or answer.choices != choices:
            raise ContractError(f"{name}: expected an Answer over {list(choices)}, got {answer!r}")
        p = np.asarray(answer.probabilities, np.float64)
        if p.shape != (len(choices),) or not (p >= 0).all() or abs(p.sum() - 1) > 1e-3:
            raise ContractError(f"{name}: expected {len(choices)} probabilities that sum to 1, got {p.tolist()}")
    return list(answers)
