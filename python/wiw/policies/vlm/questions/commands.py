# SPDX-License-Identifier: Apache-2.0
"""The two languages of question answering: commands of the high-level planner, walks of the low-level planner.

A command names a landmark or a view and says in words what to do there; it may come with an answer. A walk is a few
primitives, each several times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.landmarks import Landmark
from wiw.mapping.marks import MarkedViews
from wiw.mapping.views import VIEW_NAMES
from wiw.policies.vlm.answer_models import create_answer_model, make_name_type, read_null, read_text
from wiw.policies.vlm.plans import PRIMITIVES, allow_several, list_plans
from wiw.policies.vlm.policy import shorten

if TYPE_CHECKING:
    from pydantic import BaseModel

WALK_ACTIONS, WALK_TIMES = 4, 4
"""Maximum number of different actions in a walk, and of repetitions of each, as in the published code."""
STOP = "stop"
WALK_NAMES = (*PRIMITIVES, STOP)
LONGEST_ANSWER = 300
"""Characters of an answer."""


@dataclass(frozen=True)
class Command:
    """A command of the high-level planner."""

    plan: str
    """In its words."""
    view: int
    """Number of the view to continue in."""
    mark: int | None = None
    """Number of the landmark in the pictures; None if the words alone say what to do."""
    landmark: Landmark | None = None
    answer: str = ""
    """Answer to the question; empty if it cannot be answered yet."""

    def to_prompt(self) -> dict[str, Any]:
        """Return the command as models write it, for later prompts."""
        return {"action_plan": self.plan, "chosen_view": VIEW_NAMES[self.view], "chosen_landmark": self.mark}


@lru_cache(maxsize=256)
def command_schema(marks: tuple[int, ...], count: int = 1, answers: bool = True) -> type[BaseModel]:
    """Return the schema of a command, in the paper's fields; {plans: [...]} of up to `count` of them where count > 1.

    Args:
        marks: numbers of the landmarks that may be chosen.
        count: how many commands are requested.
        answers: whether a command comes with an answer; not where imagined views are shown.
    """
    from pydantic import Field, field_validator

    landmark: Any = Literal[marks] | None if marks else None
    fields: dict[str, Any] = {
        "reason": (str, ...),
        "action_plan": (str, Field(min_length=1)),
        "chosen_view": (make_name_type(VIEW_NAMES), ...),
        "chosen_landmark": (landmark, ...),
    }
    if answers:
        fields["answer"] = (str | None, Field(max_length=LONGEST_ANSWER))
    loose = {
        "read_landmark": field_validator("chosen_landmark", mode="before")(_read_number),
        "read_answer": field_validator("answer", mode="before", check_fields=False)(read_text),
    }
    refused = () if answers else ("answer",)
    command = create_answer_model("Command", reasons=("reason",), refused=refused, validators=loose, **fields)
    return allow_several(command, count)


@lru_cache(maxsize=1)
def answer_schema() -> type[BaseModel]:
    """Return the schema {reason, answer}."""
    from pydantic import Field, field_validator

    loose = {"read_answer": field_validator("answer", mode="before")(read_text)}
    answer: Any = (str | None, Field(max_length=LONGEST_ANSWER))
    return create_answer_model("Answer", reasons=("reason",), validators=loose, reason=(str, ...), answer=answer)


@lru_cache(maxsize=1)
def walk_schema() -> type[BaseModel]:
    """Return the schema {reason, actions: [{action, times}]} of a walk."""
    from pydantic import Field

    times: Any = (int, Field(ge=1, le=WALK_TIMES))
    step = create_answer_model("Step", action=(make_name_type(WALK_NAMES), ...), times=times)
    actions: Any = (list[step], Field(min_length=1, max_length=WALK_ACTIONS))  # type: ignore[valid-type]
    return create_answer_model("Walk", reasons=("reason",), reason=(str, ...), actions=actions)


def parse_commands(value: Any, marked: MarkedViews) -> list[Command]:
    """Return the commands of a validated answer.

    A landmark has one number in all views, so that it counts where another view was named beside it.
    """
    return [_parse_command(each, marked) for each in list_plans(value)]


def parse_walk(value: Any) -> NDArray[np.int8]:
    """Return the primitives of a validated walk, up to where it stops."""
    actions: list[int] = []
    for step in value.actions:
        if step.action == STOP:
            break
        actions += [PRIMITIVES[step.action]] * step.times
    return np.array(actions, np.int8)


def parse_answer(value: Any) -> str:
    """Return the answer of a validated reply; empty if there is none."""
    return shorten(getattr(value, "answer", None) or "")


def list_marks(marked: MarkedViews) -> tuple[int, ...]:
    """Return the numbers that stand in the pictures."""
    return tuple(sorted({number for names in marked.names.values() for number in names}))


def name_marks(marked: MarkedViews) -> dict[str, dict[int, str]]:
    """Return what the numbers mean, by the name of the view and the number."""
    return {VIEW_NAMES[view]: dict(names) for view, names in sorted(marked.names.items())}


def _parse_command(value: Any, marked: MarkedViews) -> Command:
    mark, view = value.chosen_landmark, VIEW_NAMES.index(value.chosen_view)
    landmark = None if mark is None else marked.landmarks[mark]
    if landmark is not None and view not in landmark.masks:
        view = landmark.view
    return Command(shorten(value.action_plan), view, mark, landmark, parse_answer(value))


def _read_number(value: Any) -> Any:
    """Read a number in quotes as a number, and words for nothing as null."""
    return int(value) if isinstance(value, str) and value.strip().isdecimal() else read_null(value)
