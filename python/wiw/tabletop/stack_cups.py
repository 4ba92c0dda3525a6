# SPDX-License-Identifier: Apache-2.0
"""Stack the other cups into the one of the colour that is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import ConvexHull, place
from wiw.tabletop.colours import alike_at
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, holds, key_of, raised, scattered
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

CUPS = 3
LOW, HIGH, TALL = 0.026, 0.038, 0.075
"""Metres of the outer radius at the bottom and at the rim, and of the height."""
WALL, FLOOR = 0.004, 0.006
"""Metres."""
GRIP = TALL - 0.022
"""Metres above the table at which a cup is held by its wall."""
CARRY = TALL + 0.13
"""Metres above the table of the finger tips while a cup is carried."""
RIM = LOW + (HIGH - LOW) * GRIP / TALL - WALL / 2
"""Metres from a cup's middle to that of its wall where it is held."""
RISE = 0.025
"""Metres by which a cup stands higher in another once it has come to rest."""
SURE, HUNG = 0.4, 0.6
"""Likeness of what is seen of a cup that is enough; what a cup counts that hangs over the target."""
STILL = 0.5
"""By how much less a cup counts that is seen where it was."""
SHIFTS = np.array([(x, y, 0.0) for x in (-0.015, 0.0, 0.015) for y in (-0.015, 0.0, 0.015)])
"""Metres by which the target may have been pushed where it is looked for."""
NEST = 0.035
"""Metres that a cup stands higher in another, at most."""
SIDES = 8
PHRASES = (
    "stack the other cups on top of the {0} cup",
    "place two of the cups into the {0} cup",
    "put the remaining cups into the {0} one",
    "pick up the other cups and stack them on the {0} one",
    "create a stack of cups with the {0} cup as its base",
    "keep the {0} cup on the table and stack the other two into it",
)


class StackCups(Kind):
    """Three tapered cups."""

    name = "stack_cups"
    noun = "cup"
    variations = 20

    def setup(self, seed: int, variation: int) -> Setup:
        """The first of the drawn colours is the target's."""
        colours = chosen(key_of(seed, variation, 1), list(PALETTE), CUPS)
        places = scattered(key_of(seed, variation, 2), CUPS, 0.15)
        things = tuple(
            (Thing(colour, tuple(_cup()), PALETTE[colour], mass=0.06, friction=0.4), place(x, y, TABLE))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        return Setup(things, self.say(colours[0], variation), colours[0], objects=tuple(colours))

    def say(self, target: Any, wording: int = 0) -> str:
        """E.g. "stack the other cups on top of the green cup"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """The other cups as a base."""
        return [name for name in objects if name != target]

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The others stand upright in the target, that on the table, and nothing is held."""
        base = bench.place_of(setup.target)
        others = [bench.place_of(name) for name in setup.objects if name != setup.target]
        inside = all(_inside(cup, base, 0.015) and cup[2, 2] > 0.95 for cup in others)
        return bool(inside and bench.held is None and base[2, 2] > 0.95 and base[2, 3] < TABLE + 0.01)

    def expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Each by its rim, over the target, down, and let go; what is in it already stays. With all in it, up."""
        base = places[target]
        others = [name for name in places if name != target]
        todo = [name for name in others if not _inside(places[name], base)]
        todo.sort(key=lambda name: (not holds(hand, places[name]), -places[name][2, 3]))
        plan = [] if todo and holds(hand, places[todo[0]]) else raised(hand, CARRY, 1)
        for level, name in enumerate(todo, len(others) - len(todo) + 1):
            cup, grip = places[name], np.array([0, RIM])
            if not plan and hand is not None and holds(hand, cup):
                grip = hand[:2] - cup[:2, 3]
                plan += raised(hand, CARRY, 0)
            else:
                x, y = cup[:2, 3] + grip
                plan += [above(x, y, h, g) for h, g in ((CARRY, 1), (cup[2, 3] - TABLE + GRIP, 0), (CARRY, 0))]
            u, v = base[:2, 3] + grip
            plan += [above(u, v, h, g) for h, g in ((CARRY, 0), (GRIP + level * NEST + 0.01, 1), (CARRY, 1))]
        return np.array(plan or [above(base[0, 3], base[1, 3], CARRY, 1)])

    def looks_done(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """The others' colours are seen stacked above the target's rim, in any order; less where one hangs over it.

        What is still seen where it was counts half: there are cups of nearly the same colour. The target may have been
        pushed a little.
        """
        base = places[target]
        counts = {name: 1 - STILL * _stays(front, name, cup, base) for name, cup in places.items() if name != target}
        return max(_stacked(front, base[:3, 3] + shift, target, counts) for shift in SHIFTS)


def _stacked(front: NDArray[np.uint8], base: NDArray[np.float64], target: str, counts: Mapping[str, float]) -> float:
    """The same with the target at a place [3], and what each of the others counts at most."""
    stands = min(1.0, alike_at(front, base + _WALL, PALETTE[target]) / SURE)
    levels = [_RIM + base + np.array([0, 0, level * RISE]) for level in range(1, len(counts) + 1)]
    seen = {name: [min(1.0, alike_at(front, rim, PALETTE[name]) / SURE) for rim in levels] for name in counts}
    over = _WALL + base + np.array([0, 0, CARRY - GRIP])
    hung = {name: HUNG * alike_at(front, over, PALETTE[name]) for name in counts}
    best = max(
        sum(counts[name] * max(seen[name][level], hung[name]) for level, name in enumerate(order))
        for order in permutations(counts)
    )
    return (0.5 + 0.5 * stands) * best / len(counts)


def _stays(front: NDArray[np.uint8], name: str, before: Pose, base: Pose) -> float:
    """How much a cup is seen where it was; 0 for one that was in the target already."""
    if _inside(before, base):
        return 0.0
    return min(1.0, alike_at(front, before[:3, 3] + _WALL, PALETTE[name]) / SURE)


def _inside(cup: Pose, base: Pose, off_axis: float = 0.03) -> bool:
    """Whether a cup stands in another, their axes at most so many metres apart."""
    off = cup[:3, 3] - base[:3, 3]
    return bool(np.linalg.norm(off[:2]) < off_axis and 0.01 < off[2] < CUPS * RISE)


def _outside(heights: Sequence[float]) -> NDArray[np.float64]:
    """[N, 3]: points on the front of a cup's wall at some heights, from the middle of its bottom."""
    angle, height = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.1, 1.1, 13), heights))
    radius = LOW + (HIGH - LOW) * height / TALL
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _cup() -> list[tuple[ConvexHull, Pose]]:
    """A ring of slanted plates and a floor; the frame is in the middle of the bottom."""
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


_RIM, _WALL = _outside([TALL - 0.019, TALL - 0.012, TALL - 0.006]), _outside([0.015, 0.03, 0.045])
