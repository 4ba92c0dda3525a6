# SPDX-License-Identifier: Apache-2.0
"""What one of the manipulation tasks is: things on a table, words, when it is done, and who can do it."""

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
"""Least and greatest x and y of where things are put, within easy reach of the arm."""

GRASPED = (0.02, 0.5)
"""How open a gripper is that has shut on a wall of something, between shut on nothing and not shut."""


@dataclass(frozen=True)
class Setup:
    """One episode's table."""

    things: tuple[tuple[Thing, Pose], ...]
    instruction: str
    target: Any
    """What is asked for, as the kind of task understands it."""
    springs: Mapping[str, float] = field(default_factory=dict)
    """Newtons by mechanism."""
    objects: tuple[str, ...] = ()
    """Names of what a policy is told the place of, by their index from 1."""

    def bench(self, backend: Literal["auto", "cpu", "gpu"] = "auto", robot: Robot | None = None) -> Workbench:
        """The table with everything on it, at rest, its pictures drawn by a renderer; the own Panda if no robot."""
        bench = Workbench(self.things, backend, robot)
        for name, force in self.springs.items():
            bench.set_spring(name, force)
        bench.settle(60)
        return bench


class Kind(ABC):
    """One manipulation task."""

    name: str
    noun: str
    """What its instructions speak of, and those of no other kind."""
    variations: int
    """How many combinations of colours, numbers and targets there are."""

    @abstractmethod
    def setup(self, seed: int, variation: int) -> Setup:
        """The table of a seed: where things are, and in which of their colours."""

    @abstractmethod
    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """Whether what the instruction asks for is done."""

    @abstractmethod
    def say(self, target: Any, wording: int = 0) -> str:
        """An instruction that asks for a target."""

    def target_of(self, text: str) -> Any:
        """The target that an instruction asks for: the one colour that it names.

        Raises:
            ArgumentError: it names none, or several.
        """
        found = colours_in(text)
        if len(found) != 1:
            raise ArgumentError(f"{self.name}: expected an instruction that names one colour, got {text!r}")
        return found[0]

    @abstractmethod
    def alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """What might be asked for instead with the same objects."""

    def left(self, seen: ArmObservation, target: Any) -> Any:
        """What remains to be done of a target as things stand; None where nothing is left, or nothing helps."""
        return target

    @abstractmethod
    def expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """float64 [K, 7]: actions that bring about a target (of any setup), by one who knows where objects are.

        `hand` is where the gripper is, float64 [7], to go on from there with what it holds; None: high up and empty.
        """

    @abstractmethod
    def looks_done(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """How much a front view, uint8 [H, W, 3] of any size, looks as if a target were reached, from 0 to 1.

        It may be imagined and blurred; what is on the way to the target lies between. `places` are those before the
        plan whose end is looked at.
        """


def colours_in(text: str) -> list[str]:
    """Colours by the names of `PALETTE`, in the order in which a text names them."""
    return [word for word in re.findall("[a-z]+", text.lower()) if word in PALETTE]


def key_of(seed: int, variation: int, purpose: int) -> int:
    """A key for draws of one purpose."""
    return int(core.fold_key([seed, variation, purpose]))


def scattered(key: int, count: int, apart: float, tries: int = 1000) -> NDArray[np.float64]:
    """float64 [count, 2]: places in reach, at least so many metres apart.

    Raises:
        ArgumentError: there is no room for so many.
    """
    (left, near), (right, far) = REACH
    draws = core.uniform(key, 2 * tries).reshape(tries, 2) * (right - left, far - near) + (left, near)
    found: list[NDArray[np.float64]] = []
    for place in draws:
        if all(np.linalg.norm(place - other) >= apart for other in found):
            found.append(place)
        if len(found) == count:
            return np.stack(found)
    raise ArgumentError(f"scattered: expected room for {count} things {apart} m apart, there is for {len(found)}")


def chosen(key: int, names: Sequence[str], count: int) -> list[str]:
    """So many different names, in an order that the key draws."""
    order = np.argsort(core.uniform(key, len(names)), kind="stable")
    return [names[i] for i in order[:count]]


def above(x: float, y: float, height: float, gripper: float, yaw: float = 0.0) -> list[float]:
    """An action: the hand points down, its finger tips so many metres above the table."""
    return [x, y, TABLE + height, DOWN[0], DOWN[1], yaw, gripper]


def raised(hand: NDArray[np.float64] | None, height: float, gripper: float) -> list[list[float]]:
    """No action, or one where the hand is lower than so many metres above the table: straight up."""
    if hand is None or hand[2] > TABLE + height - 0.02:
        return []
    return [[float(hand[0]), float(hand[1]), TABLE + height, *map(float, hand[3:6]), gripper]]


def holds(hand: NDArray[np.float64] | None, thing: Pose) -> bool:
    """Whether a thing is in the gripper, as far as that can be told from where both are and how far it is shut."""
    if hand is None or not GRASPED[0] < hand[6] < GRASPED[1]:
        return False
    off = hand[:3] - thing[:3, 3]
    return bool(np.linalg.norm(off[:2]) < 0.05 and -0.02 < off[2] < 0.08)
