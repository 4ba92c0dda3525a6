# SPDX-License-Identifier: Apache-2.0
"""Put a square ring on the square peg of the colour that is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.physics import Box, place
from wiw.tabletop.colours import alike_at, metres_off, nearness
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, holds, key_of, raised
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

PEGS = 3
PEG, TALL = 0.048, 0.075
"""Metres of a peg's side, and its height."""
CLEARANCE = 0.004
"""Metres between peg and ring on each side."""
WALL, THICK = 0.014, 0.024
"""Metres of the ring's walls: across, and up."""
HOLE = PEG + 2 * CLEARANCE
GRIP = (HOLE + WALL) / 2
"""Metres from the ring's middle to that of a wall."""
RING = (0.95, 0.42, 0.05)
"""The ring's colour, which no peg has."""
SURE = 0.5
"""Likeness of what is seen around the foot of a peg that is enough."""
PHRASES = ("put the ring on the {0} spoke", "slide the ring onto the {0} spoke", "place the ring over the {0} spoke")


class InsertPeg(Kind):
    """Three pegs in a row, a ring in front of them."""

    name = "insert_peg"
    noun = "ring"
    variations = 20

    def setup(self, seed: int, variation: int) -> Setup:
        """The row is shifted and the pegs are ordered by chance, the ring lies anywhere before it, turned a little."""
        draws = core.uniform(key_of(seed, variation, 1), 6)
        colours = chosen(key_of(seed, variation, 2), list(PALETTE), PEGS)
        row = 0.06 + 0.05 * draws[0]
        shift = 0.06 * (draws[1] - 0.5)
        pegs = [
            (
                Thing(colour, ((Box([PEG, PEG, TALL]), np.eye(4)),), PALETTE[colour]),
                place(row, shift + 0.17 * (i - 1), TABLE + TALL / 2),
            )
            for i, colour in enumerate(colours)
        ]
        ring = Thing("ring", tuple(_walls()), RING, mass=0.08, friction=0.6)
        turn = 0.6 * (draws[4] - 0.5)
        lying = place(0.24 + 0.06 * draws[2], 0.3 * (draws[3] - 0.5), TABLE + THICK / 2, rpy=(0, 0, turn))
        target = colours[int(draws[5] * PEGS)]
        return Setup((*pegs, (ring, lying)), self.say(target, variation), target, objects=("ring", *colours))

    def say(self, target: Any, wording: int = 0) -> str:
        """E.g. "put the ring on the green spoke"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """The other pegs."""
        return [name for name in objects if name not in ("ring", target)]

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The ring is around the peg, below its top."""
        ring, peg = bench.place_of("ring"), bench.place_of(setup.target)
        off = np.abs(ring[:2, 3] - peg[:2, 3]).max()
        return bool(off < 2 * CLEARANCE and ring[2, 3] < TABLE + TALL - THICK / 2 and ring[2, 2] > 0.95)

    def expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """By the wall, up, over the peg with the ring turned as the pegs stand, down, and let go."""
        ring, peg, high = places["ring"], places[target], TALL + 0.06
        if hand is not None and holds(hand, ring):
            yaw = -_slant(ring, float(hand[5]))
            grip = _turned(hand[:2] - ring[:2, 3], yaw - float(hand[5]))
            plan = raised(hand, high, 0)
        else:
            yaw, grip, slant = 0.0, np.array([0, GRIP]), _slant(ring)
            x, y = ring[:2, 3] + _turned(grip, slant)
            wall = ring[2, 3] - TABLE
            plan = raised(hand, high, 1)
            plan += [above(x, y, height, gripper, slant) for height, gripper in ((0.12, 1), (wall, 0), (high, 0))]
        u, v = peg[:2, 3] + grip
        plan += [above(u, v, height, gripper, yaw) for height, gripper in ((high, 0), (TALL - 0.02, 1), (high, 1))]
        return np.array(plan)

    def looks_done(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """The ring's colour is seen around the foot of the peg and not before it; a little for a ring that is near."""
        peg = np.append(places[target][:2, 3], TABLE)
        around = min(1.0, alike_at(front, peg + _FRONT, RING) / SURE)
        before = alike_at(front, peg + _FRONT + (0.055, 0, 0), RING)
        off = metres_off(front, RING, (*peg[:2], TABLE + THICK / 2))
        return 0.75 * around * (1 - before) + 0.25 * nearness(off, 0.0, 0.3)


def _slant(ring: Pose, hand: float = 0.0) -> float:
    """By how much the ring is turned from a hand's yaw, up to an eighth of a turn: all four walls are the same."""
    yaw = float(np.arctan2(ring[1, 0], ring[0, 0])) - hand
    return (yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _turned(offset: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """[2], counterclockwise."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ offset


_FRONT = np.stack(
    [
        grid.ravel()
        for grid in np.broadcast_arrays(
            np.array([HOLE / 2 + 0.5 * WALL, HOLE / 2 + WALL, HOLE / 2 + WALL, HOLE / 2 + WALL])[:, None],
            np.linspace(-HOLE / 2, HOLE / 2, 15),
            np.array([THICK, 0.8 * THICK, 0.5 * THICK, 0.3 * THICK])[:, None],
        )
    ],
    axis=1,
)
"""[N, 3] points on the ring's front wall, its top and its face, from the foot of the peg it is on."""


def _walls() -> list[tuple[Box, NDArray[np.float64]]]:
    """Two walls as long as the ring is wide, and two between them."""
    wide = HOLE + 2 * WALL
    return [
        *((Box([wide, WALL, THICK]), place(y=sign * GRIP)) for sign in (-1, 1)),
        *((Box([WALL, HOLE, THICK]), place(x=sign * GRIP)) for sign in (-1, 1)),
    ]
