# SPDX-License-Identifier: Apache-2.0
"""Plans of gripper poses that a language model writes: whole numbers of `wiw.action.PoseGrid`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import PoseGrid
from wiw.policies.vlm.answer_models import create_answer_model
from wiw.policies.vlm.plans import allow_several, list_plans
from wiw.tabletop.workbench import TABLE
from wiw.types import Proposal

if TYPE_CHECKING:
    from pydantic import BaseModel

GRID = PoseGrid()
SURFACE = int(GRID.encode([0, 0, TABLE, 0, 0, 0, 0])[2])
"""Z of the table's top."""
NUMBER_LIMIT = 1_000_000
"""Numbers beyond it are not off by a bin or two, but nonsense."""
MAX_SHOWN = 5
"""Maximum number of poses of a plan that are shown."""
SCENE_WORDS = "A robot arm works at a table. "
"""Text that world models read before a plan in words."""


@lru_cache(maxsize=32)
def plan_schema(longest: int, count: int = 1) -> type[BaseModel]:
    """Return the schema of the paper's four fields with 1 to `longest` actions; {plans: [...]} where count > 1.

    Servers receive the range of the numbers; numbers outside are read as `PoseGrid` does.
    """
    from pydantic import Field, WithJsonSchema

    sent = WithJsonSchema({"type": "integer", "minimum": 0, "maximum": max(GRID.bins, GRID.turns)})
    number = Annotated[int, Field(ge=-NUMBER_LIMIT, le=NUMBER_LIMIT), sent]
    numbers: Any = (list[number], Field(min_length=7, max_length=7))
    step = create_answer_model("Step", action=numbers)
    steps: Any = (list[step], Field(min_length=1, max_length=longest))  # type: ignore[valid-type]
    plan = create_answer_model(
        "Plan",
        reasons=("reasoning_and_reflection",),
        visual_state_description=(str, ...),
        reasoning_and_reflection=(str, ...),
        language_plan=(str, ...),
        executable_plan=steps,
    )
    return allow_several(plan, count)


def parse_plans(value: Any) -> list[Proposal]:
    """Return the plans of a validated answer, with their reasons and words."""
    return [
        Proposal(
            GRID.decode(_to_numbers(plan)), note=plan.reasoning_and_reflection, text=SCENE_WORDS + plan.language_plan
        )
        for plan in list_plans(value)
    ]


def count_out_of_range(value: Any) -> int:
    """Return how many numbers of a validated answer were clamped or wrapped."""
    written = [_to_numbers(plan) for plan in list_plans(value)]
    most = np.array([GRID.bins] * 3 + [GRID.turns] * 3 + [1])
    return sum(int(((numbers < 0) | (numbers > most)).sum()) for numbers in written)


def is_on_grid(poses: NDArray[np.float64]) -> bool:
    """Return whether poses [K, 7] can be written in whole numbers."""
    return np.array_equal(GRID.decode(GRID.encode(poses)), poses)


def format_poses(poses: NDArray[np.float64]) -> str:
    """Return poses [K, 7] as they are written."""
    return str(GRID.encode(poses).tolist())


def select_shown(count: int) -> NDArray[np.int64]:
    """Return the indices of a plan's shown poses: all of a short plan, else the ends of equal parts."""
    parts = min(count, MAX_SHOWN)
    return np.arange(1, parts + 1) * count // parts - 1


def index_objects(places: Mapping[str, NDArray[np.float64]]) -> dict[int, NDArray[np.float64]]:
    """Return positions [3] by the objects' indices from 1.

    Indices follow the alphabetical order of names: a task may list the requested object first.
    """
    return {index: places[name][:3, 3] for index, name in enumerate(sorted(places), 1)}


def encode_objects(places: Mapping[str, NDArray[np.float64]]) -> dict[int, list[int]]:
    """Return whole numbers [X, Y, Z] by the objects' indices."""
    return {index: GRID.encode([*spot, 0, 0, 0, 0])[:3].tolist() for index, spot in index_objects(places).items()}


def _to_numbers(plan: Any) -> NDArray[np.int64]:
    return np.array([step.action for step in plan.executable_plan], np.int64)
