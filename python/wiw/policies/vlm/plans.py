# SPDX-License-Identifier: Apache-2.0
"""Parsing plans of primitives that a language model writes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.policies.vlm.answer_models import create_answer_model, make_name_type

if TYPE_CHECKING:
    from pydantic import BaseModel

PRIMITIVES: dict[str, int] = {"forward": int(FORWARD), "turn_left": int(TURN_LEFT), "turn_right": int(TURN_RIGHT)}
MEANINGS = {
    "forward": "go straight for 0.20 m",
    "turn_left": "turn left by 22.5 degrees",
    "turn_right": "turn right by 22.5 degrees",
}
_MEANING_OF = {PRIMITIVES[name]: meaning for name, meaning in MEANINGS.items()}


@lru_cache(maxsize=32)
def plan_schema(longest: int, count: int = 1) -> type[BaseModel]:
    """Return the schema {reason, actions} with 1 to `longest` primitives; {plans: [...]} of up to `count` of them where
    count > 1.
    """
    from pydantic import Field

    primitive: Any = make_name_type(tuple(PRIMITIVES))
    actions: Any = (list[primitive], Field(min_length=1, max_length=longest))
    plan = create_answer_model("Plan", reasons=("reason",), reason=(str, ...), actions=actions)
    return allow_several(plan, count)


def allow_several(plan: type[BaseModel], count: int) -> type[BaseModel]:
    """Return the schema {plans: [...]} of up to `count` plans; that of a single plan where count is 1."""
    from pydantic import Field

    if count == 1:
        return plan
    plans: Any = (list[plan], Field(min_length=1, max_length=count))  # type: ignore[valid-type]
    return create_answer_model(f"{plan.__name__}s", plans=plans)


def list_plans(value: Any) -> list[Any]:
    """Return the plans of an answer that is valid by a schema of `allow_several`."""
    return list(value.plans) if "plans" in type(value).model_fields else [value]


def parse_plans(value: Any) -> list[tuple[NDArray[np.int8], str]]:
    """Return primitives and reasons of a validated answer."""
    return [(np.array([PRIMITIVES[name] for name in plan.actions], np.int8), plan.reason) for plan in list_plans(value)]


def describe_actions(actions: Sequence[int] | NDArray[np.int8]) -> list[str]:
    """Return what each primitive does; "stop" for what ends a plan."""
    return [_MEANING_OF.get(int(action), "stop") for action in actions]


def name_actions(actions: Sequence[int] | NDArray[np.int8]) -> list[str]:
    """Return the primitives' names, as plans are written."""
    names = {primitive: name for name, primitive in PRIMITIVES.items()}
    return [names.get(int(action), "stop") for action in actions]
