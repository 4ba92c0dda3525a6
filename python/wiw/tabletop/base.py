# SPDX-License-Identifier: Apache-2.0
"""The interface of a manipulation task: its table, instructions, success condition and expert."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.tabletop.robot import Robot
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench
from wiw.types import ArmObservation

PALETTE: Mapping[str, tuple[float, float, float]] = {
    "red": (0.85, 0.12, 0.12),
    "maroon": (0.5, 0.05, 0.1),
    "lime": (0.45, 0.9, 0.2),
    "green": (0.1, 0.55, 0.2),
    "blue": (0.15, 0.3, 0.85),
    "navy": (0.05, 0.1, 0.4),
    "yellow": (0.95, 0.85, 0.15),
    "cyan": (0.2, 0.85, 0.9),
    "magenta": (0.9, 0.2, 0.75),
    "silver": (0.78, 0.79, 0.8),
    "gray": (0.45, 0.45, 0.46),
    "olive": (0.5, 0.5, 0.1),
    "purple": (0.45, 0.15, 0.6),
    "teal": (0.05, 0.5, 0.5),
    "azure": (0.25, 0.6, 0.95),
    "violet": (0.6, 0.4, 0.9),
    "rose": (0.95, 0.35, 0.5),
    "black": (0.08, 0.08, 0.09),
    "white": (0.95, 0.95, 0.95),
}
"""Colours by the names that prompts list (paper, appendix "Robotic Manipulation Prompt")."""
DOWN = (np.pi, 0.0, 0.0)
"""Roll, pitch, yaw of a hand that points down."""
REACH = ((0.02, -0.28), (0.32, 0.28))
"""Minimum and maximum x and y of where things are put, within easy reach of the arm."""

GRASP_OPENING = (0.02, 0.5)
"""Range of the gripper's opening that means it holds a wall: between closed on nothing and not closed."""


@dataclass(frozen=True)
class TableSetup:
    """The table of one episode."""

    things: tuple[tuple[Thing, Pose], ...]
    instruction: str
    target: Any
    """The requested target, in the task's own terms."""
    springs: Mapping[str, float] = field(default_factory=dict)
    """Spring force in newtons, by mechanism."""
    objects: tuple[str, ...] = ()
    """Names of the objects whose poses a policy knows, in any order: a policy gets them sorted."""

    def build_workbench(self, backend: Literal["auto", "cpu", "gpu"] = "auto", robot: Robot | None = None) -> Workbench:
        """Build the workbench and let everything come to rest; with the project's own Panda if no robot is given."""
        bench = Workbench(self.things, backend, robot)
        for name, force in self.springs.items():
            bench.set_spring(name, force)
        bench.settle(60)
        return bench


class TabletopTask(ABC):
    """One manipulation task."""

    name: str
    noun: str
    """A noun that occurs in every instruction of this task, and of no other."""
    variations: int
    """Number of combinations of colours, counts and targets."""

    @abstractmethod
    def create_setup(self, seed: int, variation: int) -> TableSetup:
        """Return the table of a seed: the objects' poses, and their colours."""

    @abstractmethod
    def is_success(self, bench: Workbench, setup: TableSetup) -> bool:
        """Return whether the instruction has been carried out."""

    @abstractmethod
    def phrase_instruction(self, target: Any, wording: int = 0) -> str:
        """Return an instruction for a target, in one of several wordings."""

    def parse_target(self, text: str) -> Any:
        """Return the target of an instruction: its only colour word.

        Raises:
            ArgumentError: it names none, or several.
        """
        found = find_colours(text)
        if len(found) != 1:
            raise ArgumentError(f"{self.name}: expected an instruction that names one colour, got {text!r}")
        return found[0]

    @abstractmethod
    def list_alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """Return the other targets that the same objects allow."""

    def find_remaining_target(self, observation: ArmObservation, target: Any) -> Any:
        """Return what remains to be done of a target; None if nothing remains, or nothing helps."""
        return target

    @abstractmethod
    def plan_expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return actions float64 [K, 7] that achieve a target (of any setup), given the true poses of the objects.

        `hand` is the gripper's pose float64 [7] to continue from, with what it holds; None: high up and empty.
        """

    @abstractmethod
    def estimate_completion(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """Return how far a front view, uint8 [H, W, 3] of any size, shows a target as achieved, from 0 to 1.

        The view may be imagined and blurred; partial progress is in between. `places` are the objects' poses before the
        plan whose end the view shows.
        """


def find_colours(text: str) -> list[str]:
    """Return the colours of `PALETTE` that a text names, in the order of the text."""
    return [word for word in re.findall("[a-z]+", text.lower()) if word in PALETTE]


def derive_key(seed: int, variation: int, purpose: int) -> int:
    """Derive the random key of one purpose."""
    return int(core.fold_key([seed, variation, purpose]))


def scatter_places(key: int, count: int, apart: float, tries: int = 1000) -> NDArray[np.float64]:
    """Sample places within reach, at least `apart` metres from each other: float64 [count, 2].

    Raises:
        ArgumentError: there is not enough room.
    """
    (left, near), (right, far) = REACH
    draws = core.uniform(key, 2 * tries).reshape(tries, 2) * (right - left, far - near) + (left, near)
    found: list[NDArray[np.float64]] = []
    for place in draws:
        if all(np.linalg.norm(place - other) >= apart for other in found):
            found.append(place)
        if len(found) == count:
            return np.stack(found)
    raise ArgumentError(f"scatter_places: expected room for {count} things {apart} m apart, got room for {len(found)}")


def choose_names(key: int, names: Sequence[str], count: int) -> list[str]:
    """Choose `count` different names in random order."""
    order = np.argsort(core.uniform(key, len(names)), kind="stable")
    return [names[i] for i in order[:count]]


def make_action(x: float, y: float, height: float, gripper: float, yaw: float = 0.0) -> list[float]:
    """Return an action with the hand pointing down and its finger tips `height` metres above the table."""
    return [x, y, TABLE + height, DOWN[0], DOWN[1], yaw, gripper]


def plan_lift(hand: NDArray[np.float64] | None, height: float, gripper: float) -> list[list[float]]:
    """Return an action straight up, if the hand is lower than `height` metres above the table; otherwise none."""
    if hand is None or hand[2] > TABLE + height - 0.02:
        return []
    return [[float(hand[0]), float(hand[1]), TABLE + height, *map(float, hand[3:6]), gripper]]


def is_holding(hand: NDArray[np.float64] | None, thing: Pose) -> bool:
    """Return whether an object is in the gripper, as inferred from both poses and the gripper's opening."""
    if hand is None or not GRASP_OPENING[0] < hand[6] < GRASP_OPENING[1]:
        return False
    off = hand[:3] - thing[:3, 3]
    return bool(np.linalg.norm(off[:2]) < 0.05 and -0.02 < off[2] < 0.08)
