# SPDX-License-Identifier: Apache-2.0
"""Contract checks of policies and world models; `wiw.loop.attempts` checks frames."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError, ContractError
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.types import Answer, ArmObservation, Goal, Proposal, TextAnswer
from wiw.world_models.base import WorldModel
from wiw.world_models.oracle import Oracle

OBSERVED = ("depth", "wrist")
"""Names of what a policy can need of an observation besides images and odometry."""


class PlanChecker(Protocol):
    """The part of a plan space that the checks need."""

    def check_plan(self, source: str, actions: Any, longest: int) -> NDArray[Any]:
        """See `wiw.loop.plan_space.PlanSpace.check_plan`."""


def check_observations(needs: Collection[str], observations: Sequence[Any]) -> None:
    """Check that observations have the depth and the wrist camera's view where an agent with these `needs` reads them.

    Raises:
        ArgumentError: an observation lacks one of them.
    """
    if "wrist" in needs and not all(isinstance(each, ArmObservation) and each.wrist for each in observations):
        raise ArgumentError(
            "this agent needs the wrist camera's view, but got an observation without one: create the manipulation "
            "environment with cameras=('wrist',)"
        )
    if "depth" in needs and any(observation.depth is None for observation in observations):
        raise ArgumentError(
            "this agent needs observations with depth, but got one without: create the environment with depth=True"
        )


def check_plan_space(model: WorldModel, space: str, words: str) -> None:
    """Check that an action-conditioned model takes the actions that plans are made of.

    Raises:
        ArgumentError: it follows others.
    """
    accepts = model.accepts
    if accepts.control not in ("image", "text") and accepts.space != space:  # those know no actions
        raise ArgumentError(
            f"{type(model.unwrapped).__name__} takes space='{accepts.space}', but this agent plans in {words}"
        )


def check_needs(model: WorldModel) -> None:
    """Check that no model but the oracle needs the simulator.

    Raises:
        ArgumentError: another model requires it.
    """
    if "simulator" in model.accepts.needs and not isinstance(model.unwrapped, Oracle):
        raise ArgumentError(
            f"{type(model.unwrapped).__name__} needs the simulator, which only the oracle is given, because it knows "
            "where the agent truly is. Declare what the model sees of the world instead (needs=('depth',)), or derive "
            "it from wiw's Oracle"
        )


def check_proposals(policy: Policy, space: PlanChecker, proposals: Any, episodes: int, most: int, horizon: int) -> None:
    """Check that `propose` returned 1 to `most` plans of 1 to `horizon` actions for each episode.

    Raises:
        ContractError: another count, length or action.
    """
    _check_plans(f"{type(policy.unwrapped).__name__}.propose", space, proposals, episodes, (1, most), horizon)


def check_continuations(
    policy: Policy, space: PlanChecker, continuations: Any, places: int, most: int, horizon: int
) -> None:
    """Check that `extend` returned up to `most` plans of 1 to `horizon` actions per place; no plans leave one as it is.

    Raises:
        ContractError: another count, length or action.
    """
    _check_plans(f"{type(policy.unwrapped).__name__}.extend", space, continuations, places, (0, most), horizon)


def _check_plans(name: str, space: PlanChecker, made: Any, lists: int, count: tuple[int, int], horizon: int) -> None:
    if not isinstance(made, Sequence) or len(made) != lists:
        raise ContractError(f"{name}: expected a list of proposals for each of {lists} episodes, got {made!r}")
    for plans in made:
        if not isinstance(plans, Sequence):
            raise ContractError(
                f"{name}: expected a list for each episode, each a list of proposals, such as [[a, b], [c]] for two "
                f"episodes, got a list of {type(plans).__name__}"
            )
        if not count[0] <= len(plans) <= count[1]:
            raise ContractError(f"{name}: expected {count[0]} to {count[1]} plans for an episode, got {len(plans)}")
        for plan in plans:
            if not isinstance(plan, Proposal):
                raise ContractError(f"{name}: expected wiw.types.Proposal, got {type(plan).__name__}")
            space.check_plan(name, plan.actions, horizon)


def check_declaration(policy: Policy) -> None:
    """Check what a policy declares of itself.

    Raises:
        ContractError: its `needs` are not a sequence of names that observations know, or `frames` is no `FrameSpec`.
    """
    name, needs = type(policy.unwrapped).__name__, policy.needs
    if not isinstance(needs, Sequence) or isinstance(needs, str) or not set(needs) <= set(OBSERVED):
        raise ContractError(
            f"{name}.needs: expected any of {', '.join(map(repr, OBSERVED))} in a tuple, such as "
            f"needs = ('depth',), got {needs!r}"
        )
    if not isinstance(policy.frames, FrameSpec):
        raise ContractError(f"{name}.frames: expected wiw.policies.base.FrameSpec(view, size), got {policy.frames!r}")


def check_scores(policy: Policy, scores: Any, proposals: Sequence[Sequence[Proposal]]) -> list[NDArray[np.float64]]:
    """Return one finite number for each plan of each episode, as float64.

    Raises:
        ContractError: another count, or NaN.
    """
    name = f"{type(policy.unwrapped).__name__}.score"
    if not isinstance(scores, Sequence) or len(scores) != len(proposals):
        raise ContractError(f"{name}: expected scores for each of {len(proposals)} episodes, got {scores!r}")
    try:
        found = [np.asarray(row, np.float64) for row in scores]
    except (TypeError, ValueError):
        raise ContractError(f"{name}: expected a list of numbers for each episode, got {scores!r}") from None
    for row, plans in zip(found, proposals, strict=True):
        if row.shape != (len(plans),) or not np.isfinite(row).all():
            raise ContractError(f"{name}: expected {len(plans)} finite numbers, one per plan, got {row.tolist()}")
    return found


def check_answerer(policy: Policy, goal: Goal) -> None:
    """Refuse a reviser that gives no answer where the goal requires one.

    Raises:
        ContractError: it has not written `answer`.
    """
    if goal.expects_answer and type(policy.unwrapped).answer is Policy.answer:
        what = f"one of {len(goal.choices)} choices" if goal.choices else "one in words"
        raise ContractError(
            f"{type(policy.unwrapped).__name__} gives no answer, but task '{goal.task}' asks for {what} at every "
            "decision; implement its `answer`, or give the agent a policy that answers (reviser=)"
        )


def check_answers(policy: Policy, answers: Any, situations: Sequence[Situation]) -> list[Answer | TextAnswer | None]:
    """Return an answer for each episode whose goal expects one, None for the others.

    That is a distribution over the goal's choices, or a text where the goal is a question.

    Raises:
        ContractError: another kind of answer, other choices, or numbers that are not probabilities.
    """
    name = f"{type(policy.unwrapped).__name__}.answer"
    if not isinstance(answers, Sequence) or len(answers) != len(situations):
        raise ContractError(f"{name}: expected one answer for each of {len(situations)} episodes, got {answers!r}")
    for answer, situation in zip(answers, situations, strict=True):
        if situation.goal.question:
            _check_text_answer(name, answer)
        elif situation.goal.choices or answer is not None:
            _check_choice(name, answer, situation.goal.choices)
    return list(answers)


def check_pictures(policy: Policy, pictures: Any) -> dict[str, NDArray[np.uint8]]:
    """Return the pictures of a policy, uint8 [H, W, 3] by name.

    Raises:
        ContractError: an array of another shape, or a name that is not an identifier.
    """
    name = f"{type(policy.unwrapped).__name__}.draw"
    if not isinstance(pictures, Mapping):
        raise ContractError(f"{name}: expected a mapping from names to images, got {type(pictures).__name__}")
    for title, picture in pictures.items():
        if not isinstance(title, str) or not title.isidentifier():
            raise ContractError(f"{name}: expected names of letters, digits and underscores, got {title!r}")
        image = np.asarray(picture)
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            raise ContractError(f"{name}: expected '{title}' as uint8 [H, W, 3], got {image.dtype} {list(image.shape)}")
    return dict(pictures)


def _check_choice(name: str, answer: Any, choices: tuple[str, ...]) -> None:
    if not isinstance(answer, Answer) or answer.choices != choices:
        raise ContractError(f"{name}: expected an Answer over {list(choices)}, got {answer!r}")
    p = np.asarray(answer.probabilities, np.float64)
    if p.shape != (len(choices),) or not (p >= 0).all() or abs(p.sum() - 1) > 1e-3:
        raise ContractError(f"{name}: expected {len(choices)} probabilities that sum to 1, got {p.tolist()}")
    raw = p if answer.raw is None else np.asarray(answer.raw, np.float64)
    if raw.shape != p.shape or not (raw >= 0).all() or raw.sum() > 1 + 1e-3:
        raise ContractError(f"{name}: expected {len(choices)} raw probabilities, sum at most 1, got {raw.tolist()}")


def _check_text_answer(name: str, answer: Any) -> None:
    if not isinstance(answer, TextAnswer) or not isinstance(answer.text, str):
        raise ContractError(f"{name}: expected a TextAnswer, as the goal is a question, got {answer!r}")
    if not 0 <= answer.confidence <= 1:
        raise ContractError(f"{name}: expected a confidence from 0 to 1, got {answer.confidence!r}")
    if answer.final and not answer.text.strip():
        raise ContractError(f"{name}: expected a text in a final answer, got {answer!r}")
