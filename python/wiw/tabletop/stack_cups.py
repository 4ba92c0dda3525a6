# SPDX-License-Identifier: Apache-2.0
"""Stack the other cups into the one of the colour that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import ConvexHull, place
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, key_of, scattered
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

CUPS = 3
LOW, HIGH, TALL = 0.026, 0.038, 0.075
"""Metres of the outer radius at the bottom and at the rim, and of the height."""
WALL, FLOOR = 0.004, 0.006
"""Metres."""
GRIP = TALL - 0.022
"""Metres above the table at which a cup is held by its wall."""
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
    variations = 20

    def setup(self, seed: int, variation: int) -> Setup:
        """The first of the drawn colours is the target's."""
        colours = chosen(key_of(seed, variation, 1), list(PALETTE), CUPS)
        places = scattered(key_of(seed, variation, 2), CUPS, 0.15)
        things = tuple(
            (Thing(colour, tuple(_cup()), PALETTE[colour], mass=0.06, friction=0.4), place(x, y, TABLE))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        instruction = PHRASES[variation % len(PHRASES)].format(colours[0])
        return Setup(things, instruction, colours[0], objects=tuple(colours))

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The others stand upright in the target, and nothing is held."""
        base = bench.place_of(setup.target)
        others = [bench.place_of(name) for name in setup.objects if name != setup.target]
        inside = all(
            np.linalg.norm(cup[:2, 3] - base[:2, 3]) < 0.015 and cup[2, 2] > 0.95 and cup[2, 3] > TABLE + 0.01
            for cup in others
        )
        return bool(inside and bench.held is None and base[2, 2] > 0.95)

    def expert(self, places: Mapping[str, Pose], target: Any) -> NDArray[np.float64]:
        """Each by its rim, over the target, down, and let go."""
        rim = LOW + (HIGH - LOW) * GRIP / TALL - WALL / 2
        u, v = places[target][:2, 3] + (0, rim)
        plan = []
        for level, name in enumerate((name for name in places if name != target), 1):
            x, y = places[name][:2, 3] + (0, rim)
            carry = TALL + 0.13
            plan += [
                above(x, y, carry, 1),
                above(x, y, GRIP, 0),
                above(x, y, carry, 0),
                above(u, v, carry, 0),
                above(u, v, GRIP + level * NEST + 0.01, 1),
                above(u, v, carry, 1),
            ]
        return np.array(plan)


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
