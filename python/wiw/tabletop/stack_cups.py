# SPDX-License-Identifier: Apache-2.0
"""Stack the other cups into the cup of the requested colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import ConvexHull, place
from wiw.tabletop.base import (
    PALETTE,
    TableSetup,
    TabletopTask,
    choose_names,
    derive_key,
    is_holding,
    make_action,
    plan_lift,
    scatter_places,
)
from wiw.tabletop.colours import compare_colour_at
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

CUPS = 3
LOW, HIGH, TALL = 0.026, 0.038, 0.075
"""Metres: outer radius at the bottom and at the rim, and height."""
WALL, FLOOR = 0.004, 0.006
"""Metres: thickness of the wall and of the floor."""
GRIP_HEIGHT = TALL - 0.022
"""Metres above the table at which the gripper holds a cup's wall."""
CARRY_HEIGHT = TALL + 0.13
"""Metres above the table of the finger tips while they carry a cup."""
GRIP_RADIUS = LOW + (HIGH - LOW) * GRIP_HEIGHT / TALL - WALL / 2
"""Metres from a cup's axis to the middle of its wall at the grip."""
NESTED_RISE = 0.025
"""Metres by which a cup stands higher inside another once it has come to rest."""
CERTAIN_SIMILARITY, HANGING_SCORE = 0.4, 0.6
"""Similarity from which on a cup counts as fully seen; score of a cup that hangs over the target."""
UNMOVED_PENALTY = 0.5
"""Deduction for a cup that is still seen in its old place."""
TARGET_SHIFTS = np.array([(x, y, 0.0) for x in (-0.015, 0.0, 0.015) for y in (-0.015, 0.0, 0.015)])
"""Metres by which the target may have been pushed; each of these shifts is tried."""
MAX_NESTED_RISE = 0.035
"""Metres by which a cup stands higher inside another, at most."""
SIDES = 8
PHRASES = (
    "stack the other cups on top of the {0} cup",
    "place two of the cups into the {0} cup",
    "put the remaining cups into the {0} one",
    "pick up the other cups and stack them on the {0} one",
    "create a stack of cups with the {0} cup as its base",
    "keep the {0} cup on the table and stack the other two into it",
)


class StackCups(TabletopTask):
    """Three tapered cups."""

    name = "stack_cups"
    noun = "cup"
    variations = 20

    def create_setup(self, seed: int, variation: int) -> TableSetup:
        """Create the table; the first of the sampled colours is the target's."""
        colours = choose_names(derive_key(seed, variation, 1), list(PALETTE), CUPS)
        places = scatter_places(derive_key(seed, variation, 2), CUPS, 0.15)
        things = tuple(
            (Thing(colour, tuple(_build_cup()), PALETTE[colour], mass=0.06, friction=0.4), place(x, y, TABLE))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        return TableSetup(things, self.phrase_instruction(colours[0], variation), colours[0], objects=tuple(colours))

    def phrase_instruction(self, target: Any, wording: int = 0) -> str:
        """Return, e.g., "stack the other cups on top of the green cup"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def list_alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """Return the other cups as a base."""
        return [name for name in objects if name != target]

    def is_success(self, bench: Workbench, setup: TableSetup) -> bool:
        """Return whether the others stand upright in the target, it stands on the table, and nothing is held."""
        base = bench.get_pose(setup.target)
        others = [bench.get_pose(name) for name in setup.objects if name != setup.target]
        inside = all(_is_nested(cup, base, 0.015) and cup[2, 2] > 0.95 for cup in others)
        return bool(inside and bench.held_object is None and base[2, 2] > 0.95 and base[2, 3] < TABLE + 0.01)

    def plan_expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Grasp each cup by its rim, carry it over the target, lower and release it; skip those inside already."""
        base = places[target]
        others = [name for name in places if name != target]
        todo = [name for name in others if not _is_nested(places[name], base)]
        todo.sort(key=lambda name: (not is_holding(hand, places[name]), -places[name][2, 3]))
        plan = [] if todo and is_holding(hand, places[todo[0]]) else plan_lift(hand, CARRY_HEIGHT, 1)
        for level, name in enumerate(todo, len(others) - len(todo) + 1):
            cup, grip = places[name], np.array([0, GRIP_RADIUS])
            if not plan and hand is not None and is_holding(hand, cup):
                grip = hand[:2] - cup[:2, 3]
                plan += plan_lift(hand, CARRY_HEIGHT, 0)
            else:
                x, y = cup[:2, 3] + grip
                plan += [
                    make_action(x, y, h, g)
                    for h, g in ((CARRY_HEIGHT, 1), (cup[2, 3] - TABLE + GRIP_HEIGHT, 0), (CARRY_HEIGHT, 0))
                ]
            u, v = base[:2, 3] + grip
            plan += [
                make_action(u, v, h, g)
                for h, g in ((CARRY_HEIGHT, 0), (GRIP_HEIGHT + level * MAX_NESTED_RISE + 0.01, 1), (CARRY_HEIGHT, 1))
            ]
        return np.array(plan or [make_action(base[0, 3], base[1, 3], CARRY_HEIGHT, 1)])

    def estimate_completion(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """Compare the pixels above the target's rim with the other cups' colours, in any order; a hanging cup counts
        less.

        A cup that is still seen in its old place counts half: some cups have nearly the same colour. The target may
        have been pushed a little.
        """
        base = places[target]
        counts = {
            name: 1 - UNMOVED_PENALTY * _score_unmoved(front, name, cup, base)
            for name, cup in places.items()
            if name != target
        }
        return max(_score_stack(front, base[:3, 3] + shift, target, counts) for shift in TARGET_SHIFTS)


def _score_stack(
    front: NDArray[np.uint8], base: NDArray[np.float64], target: str, counts: Mapping[str, float]
) -> float:
    """Score the stack with the target at a place [3]; `counts` is the most that each of the other cups can score."""
    stands = min(1.0, compare_colour_at(front, base + _WALL_POINTS, PALETTE[target]) / CERTAIN_SIMILARITY)
    levels = [_RIM_POINTS + base + np.array([0, 0, level * NESTED_RISE]) for level in range(1, len(counts) + 1)]
    seen = {
        name: [min(1.0, compare_colour_at(front, rim, PALETTE[name]) / CERTAIN_SIMILARITY) for rim in levels]
        for name in counts
    }
    over = _WALL_POINTS + base + np.array([0, 0, CARRY_HEIGHT - GRIP_HEIGHT])
    hung = {name: HANGING_SCORE * compare_colour_at(front, over, PALETTE[name]) for name in counts}
    best = max(
        sum(counts[name] * max(seen[name][level], hung[name]) for level, name in enumerate(order))
        for order in permutations(counts)
    )
    return (0.5 + 0.5 * stands) * best / len(counts)


def _score_unmoved(front: NDArray[np.uint8], name: str, before: Pose, base: Pose) -> float:
    """Return how clearly a cup is seen in its old place; 0 for one that was in the target already."""
    if _is_nested(before, base):
        return 0.0
    return min(1.0, compare_colour_at(front, before[:3, 3] + _WALL_POINTS, PALETTE[name]) / CERTAIN_SIMILARITY)


def _is_nested(cup: Pose, base: Pose, off_axis: float = 0.03) -> bool:
    """Return whether a cup stands inside another, with their axes at most `off_axis` metres apart."""
    off = cup[:3, 3] - base[:3, 3]
    return bool(np.linalg.norm(off[:2]) < off_axis and 0.01 < off[2] < CUPS * NESTED_RISE)


def _wall_points(heights: Sequence[float]) -> NDArray[np.float64]:
    """Return points [N, 3] on the front of a cup's wall at some heights, relative to the middle of its bottom."""
    angle, height = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.1, 1.1, 13), heights))
    radius = LOW + (HIGH - LOW) * height / TALL
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _build_cup() -> list[tuple[ConvexHull, Pose]]:
    """Build a ring of slanted plates and a floor; the frame is in the middle of the bottom."""
    angles = (np.arange(SIDES + 1) - 0.5) * 2 * np.pi / SIDES
    corner = np.stack([np.cos(angles), np.sin(angles)], axis=1) / np.cos(np.pi / SIDES)
    parts = []
    for one, other in pairwise(corner):
        points = [
            [*(direction * (radius - inward)), height]
            for direction in (one, other)
            for radius, height in ((LOW, 0.0), (HIGH, TALL))
            for inward in (0.0, WALL)
        ]
        parts.append((ConvexHull(np.array(points)), np.eye(4)))
    floor = [[*(direction * (LOW - WALL / 2)), height] for direction in corner[:-1] for height in (0.0, FLOOR)]
    return [*parts, (ConvexHull(np.array(floor)), np.eye(4))]


_RIM_POINTS, _WALL_POINTS = _wall_points([TALL - 0.019, TALL - 0.012, TALL - 0.006]), _wall_points([0.015, 0.03, 0.045])
