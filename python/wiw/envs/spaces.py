# SPDX-License-Identifier: Apache-2.0
"""Gymnasium's spaces of the environments in which an agent walks.

Spaces are shared by all environments of a kind: the bounds of a `Box` are arrays as large as what it describes, 15 MB
for what one agent sees.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from wiw.action import FORWARD, STOP
from wiw.errors import ArgumentError
from wiw.types import Answer

FIRST_ACTION, LAST_PRIMITIVE = int(FORWARD), int(STOP)
"""The primitives, as `wiw.action` numbers them; final answers, where a task asks for any, follow."""


def action_space(choices: tuple[str, ...]) -> gymnasium.spaces.Discrete:
    """Return the primitives, numbered as in `wiw.action`, and a final answer for each choice after them."""
    return gymnasium.spaces.Discrete(LAST_PRIMITIVE + 1 - FIRST_ACTION + len(choices), start=FIRST_ACTION)


def answer_of(action: int, choices: tuple[str, ...]) -> Answer | None:
    """Return the final answer that an action stands for; None for a primitive."""
    choice = action - LAST_PRIMITIVE - 1
    return None if choice < 0 else Answer(choices, np.eye(len(choices))[choice])


def check_primitives(plan: ArrayLike) -> NDArray[np.int8]:
    """Return a plan of primitives as int8 [K]; K may be 0.

    Raises:
        ArgumentError: another shape, or something else than the primitives from 1 to 4.
    """
    given = np.asarray(plan)
    whole = given.size == 0 or given.dtype.kind in "iu"
    if given.ndim != 1 or not whole or ((given < FIRST_ACTION) | (given > LAST_PRIMITIVE)).any():
        raise ArgumentError(
            f"run: expected primitives [K] from {FIRST_ACTION} to {LAST_PRIMITIVE}, as wiw.action has them, got "
            f"{plan!r}"
        )
    return given.astype(np.int8)


@cache
def observation_space(depth: bool, target: bool) -> gymnasium.spaces.Dict:
    """Return what an environment shows, in the shapes that `wiw.types.Observation` documents.

    Args:
        depth: whether observations carry it.
        target: whether the task points something out.
    """
    box = gymnasium.spaces.Box
    spaces: dict[str, gymnasium.Space[Any]] = {
        "panorama": box(0, 255, (576, 1024, 3), np.uint8),
        "front": box(0, 255, (480, 480, 3), np.uint8),
        "odometry": box(-1e4, 1e4, (3,), np.float64),
    }
    if depth:
        spaces["depth"] = box(0, 1e4, (576, 1024), np.float32)
    if target:
        spaces["panorama_box"] = box(-1, 1024, (4,), np.float32)
        spaces["front_box"] = box(-1, 480, (4,), np.float32)
    return gymnasium.spaces.Dict(spaces)


@cache
def batched_observation_space(depth: bool, target: bool, num_envs: int) -> gymnasium.Space[Any]:
    """Return `observation_space` with [N] in front."""
    return batch_space(observation_space(depth, target), num_envs)
