# SPDX-License-Identifier: Apache-2.0
"""Construct decisions in scenes: an observation, plans that lead apart from it, and a goal in sight.

The goal lies straight ahead of a free path, so that it is seen from the observation; plans turn to one of 16 headings
and go ahead as far as it is free and as their length allows. Which way the agent faces is random.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.datasets.cameras import camera_pose
from wiw.datasets.decisions import Decisions, join_decisions
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.scenes import resolve
from wiw.training.walks import OVERSAMPLING, StraightPath, find_straight_paths
from wiw.types import check_seed

HEADINGS, STEP = 16, 0.2
SMALL = 144
"""Rows up to which panoramas are rendered larger and shrunk, so that they are as smooth as shrunk large ones."""


@dataclass(frozen=True)
class DecisionRules:
    """Rules for constructing decisions. Lengths in metres.

    Raises:
        ArgumentError: a number is out of range.
    """

    plans: int = 6
    """Plans of a decision."""
    actions: int = 13
    """Maximum number of actions in a plan: those of a clip of 14 frames."""
    least_steps: int = 2
    """Minimum number of steps ahead in a plan."""
    goal_shortest: float = 0.8
    goal_longest: float = 2.2
    size: tuple[int, int] = (64, 128)
    """Height and width of the panoramas."""

    def __post_init__(self) -> None:
        if not 2 <= self.plans <= HEADINGS or self.least_steps < 1 or self.actions < HEADINGS // 2 + self.least_steps:
            raise ArgumentError(
                f"decisions: expected 2 to {HEADINGS} plans, least_steps of 1 or more, and at least "
                f"{HEADINGS // 2} actions more than least_steps, so that any heading can be turned to; got "
                f"{self.plans} plans, least_steps {self.least_steps} and {self.actions} actions"
            )
        if not 0 < self.goal_shortest < self.goal_longest or min(self.size) < 16:
            raise ArgumentError(
                "decisions: expected 0 < goal_shortest < goal_longest, and panoramas of at least 16 rows and columns, "
                f"got {self.goal_shortest}, {self.goal_longest} and {self.size[0]} x {self.size[1]}"
            )


def collect_decisions(
    specs: str,
    per_scene: int,
    seed: int = 0,
    rules: DecisionRules = DecisionRules(),
    progress: Callable[[str, int, int], None] = lambda scene, done, total: None,
) -> Decisions:
    """Construct up to `per_scene` decisions in each of some scenes.

    Args:
        specs: the scenes, such as "apartments:val:20".
        per_scene: decisions of each; fewer where there is not enough room.
        seed: with scenes and rules, it determines the decisions.
        rules: see `DecisionRules`.
        progress: called after each scene with its name, and how many of how many are done.

    Raises:
        ArgumentError: nowhere is there room, or `per_scene` or the seed is out of range.
        FileError: the scene does not exist.
    """
    if per_scene < 1:
        raise ArgumentError(f"decisions: expected per_scene of at least 1, got {per_scene}")
    check_seed(seed)
    names, parts = resolve(specs), []
    for done, name in enumerate(names, 1):
        parts.append(construct_decisions(world(name), per_scene, seed, rules))
        progress(name, done, len(names))
    if not any(map(len, parts)):
        raise ArgumentError(f"decisions: {specs} has no place with {rules.plans} free directions; choose other scenes")
    return join_decisions([part for part in parts if len(part)])


def construct_decisions(world: World, count: int, seed: int, rules: DecisionRules = DecisionRules()) -> Decisions:
    """Construct up to `count` decisions in a scene; a function of (scene, seed, rules)."""
    key = core.fold_key([seed, 0xDEC1])
    paths = find_straight_paths(world, 2 * count, key, rules.goal_shortest, rules.goal_longest)
    draws = np.random.default_rng((seed, 0xDEC1, count))
    made = [decision for path in paths if (decision := _construct(world, path, draws, rules)) is not None]
    return _render(world, made[:count], rules)


@dataclass(frozen=True)
class _Decision:
    spots: NDArray[np.float64]
    """[M + 2, 3]: of the observation, the goal, and the ends of the plans."""
    yaw: float
    plans: NDArray[np.int8]


def _construct(world: World, path: StraightPath, draws: np.random.Generator, rules: DecisionRules) -> _Decision | None:
    """Return plans and places of a decision towards the end of a path; None if too few paths are free."""
    length = draws.uniform(rules.goal_shortest, max(path.length, rules.goal_shortest))
    yaw = path.heading + draws.uniform(0, 2 * np.pi)
    turns = draws.permutation(np.arange(-HEADINGS // 2 + 1, HEADINGS // 2 + 1))
    plans: list[NDArray[np.int8]] = []
    ends: list[NDArray[np.float64]] = []
    for turn in turns:
        steps = _count_free_steps(world, path.start, yaw + turn * 2 * np.pi / HEADINGS, rules.actions - abs(turn))
        if steps >= rules.least_steps and len(plans) < rules.plans:
            ahead = int(draws.integers(rules.least_steps, steps + 1))
            plans.append(_write_plan(int(turn), ahead, rules.actions))
            ends.append(_go(path.start, yaw + turn * 2 * np.pi / HEADINGS, ahead * STEP))
    if len(plans) < rules.plans:
        return None
    goal = _go(path.start, path.heading, length)
    return _Decision(np.stack([path.start, goal, *ends]), yaw, np.stack(plans))


def _count_free_steps(world: World, start: NDArray[np.float64], heading: float, most: int) -> int:
    """Return how many steps ahead are free, probing twice a step."""
    probes = np.stack([_go(start, heading, share * STEP / 2) for share in range(1, 2 * most + 1)])
    free = world.navmesh.is_navigable(probes)
    return int(most if free.all() else free.argmin() // 2)


def _write_plan(turn: int, ahead: int, actions: int) -> NDArray[np.int8]:
    """Return turns, then steps ahead, then null."""
    plan = np.zeros(actions, np.int8)
    plan[: abs(turn)] = int(TURN_LEFT if turn > 0 else TURN_RIGHT)
    plan[abs(turn) : abs(turn) + ahead] = int(FORWARD)
    return plan


def _go(start: NDArray[np.float64], heading: float, metres: float) -> NDArray[np.float64]:
    return np.asarray(start + metres * np.array([-np.sin(heading), 0, -np.cos(heading)]), np.float64)


def _render(world: World, decisions: Iterable[_Decision], rules: DecisionRules) -> Decisions:
    """Render what is seen from each place of the decisions, in the heading of the observation."""
    height, width = rules.size
    factor = OVERSAMPLING if height <= SMALL else 1
    pictures, plans, distances = [], [], []
    for each in decisions:
        spots = world.ground.put_down(each.spots).astype(np.float64)
        poses = np.stack([camera_pose(spot, each.yaw) for spot in spots])
        fine = world.renderer.panorama(poses, (factor * height, factor * width), outputs=("color",))["color"]
        pictures.append([cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in fine])
        plans.append(each.plans)
        distances.append(np.linalg.norm(each.spots[2:] - each.spots[1], axis=-1))
    seen = np.array(pictures, np.uint8).reshape(len(plans), rules.plans + 2, height, width, 3)
    return Decisions(
        (world.name,) * len(plans),
        seen[:, 0],
        seen[:, 1],
        np.array(plans, np.int8).reshape(len(plans), rules.plans, rules.actions),
        seen[:, 2:],
        np.array(distances, np.float64).reshape(len(plans), rules.plans),
    )
