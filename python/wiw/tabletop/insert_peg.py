# SPDX-License-Identifier: Apache-2.0
"""Put a square ring on the square peg of the requested colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.physics import Box, place
from wiw.tabletop.base import (
    PALETTE,
    TableSetup,
    TabletopTask,
    choose_names,
    derive_key,
    is_holding,
    make_action,
    plan_lift,
)
from wiw.tabletop.colours import compare_colour_at, linear_falloff, measure_offset
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

PEGS = 3
PEG, TALL = 0.048, 0.075
"""Metres: the side of a peg, and its height."""
CLEARANCE = 0.004
"""Metres between peg and ring on each side."""
WALL, THICK = 0.014, 0.024
"""Metres: the thickness of the ring's walls across, and their height."""
HOLE = PEG + 2 * CLEARANCE
GRIP = (HOLE + WALL) / 2
"""Metres from the ring's middle to that of a wall."""
RING = (0.95, 0.42, 0.05)
"""The ring's colour, which no peg has."""
CERTAIN_SIMILARITY = 0.5
"""Similarity of the pixels around a peg's foot from which on the ring counts as seen there."""
PHRASES = ("put the ring on the {0} spoke", "slide the ring onto the {0} spoke", "place the ring over the {0} spoke")


class InsertPeg(TabletopTask):
    """Three pegs in a row, a ring in front of them."""

    name = "insert_peg"
    noun = "ring"
    variations = 20

    def create_setup(self, seed: int, variation: int) -> TableSetup:
        """Shift the row, order the pegs randomly, and place the ring anywhere in front of them, slightly rotated."""
        draws = core.uniform(derive_key(seed, variation, 1), 6)
        colours = choose_names(derive_key(seed, variation, 2), list(PALETTE), PEGS)
        row = 0.06 + 0.05 * draws[0]
        shift = 0.06 * (draws[1] - 0.5)
        pegs = [
            (
                Thing(colour, ((Box([PEG, PEG, TALL]), np.eye(4)),), PALETTE[colour]),
                place(row, shift + 0.17 * (i - 1), TABLE + TALL / 2),
            )
            for i, colour in enumerate(colours)
        ]
        ring = Thing("ring", tuple(_build_walls()), RING, mass=0.08, friction=0.6)
        turn = 0.6 * (draws[4] - 0.5)
        lying = place(0.24 + 0.06 * draws[2], 0.3 * (draws[3] - 0.5), TABLE + THICK / 2, rpy=(0, 0, turn))
        target = colours[int(draws[5] * PEGS)]
        return TableSetup(
            (*pegs, (ring, lying)), self.phrase_instruction(target, variation), target, objects=("ring", *colours)
        )

    def phrase_instruction(self, target: Any, wording: int = 0) -> str:
        """Return, e.g., "put the ring on the green spoke"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def list_alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """Return the other pegs."""
        return [name for name in objects if name not in ("ring", target)]

    def is_success(self, bench: Workbench, setup: TableSetup) -> bool:
        """Return whether the ring is around the peg, below its top."""
        ring, peg = bench.get_pose("ring"), bench.get_pose(setup.target)
        off = np.abs(ring[:2, 3] - peg[:2, 3]).max()
        return bool(off < 2 * CLEARANCE and ring[2, 3] < TABLE + TALL - THICK / 2 and ring[2, 2] > 0.95)

    def plan_expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Grasp the ring by its wall, lift it, turn it parallel to the pegs over the target, lower and release it."""
        ring, peg, high = places["ring"], places[target], TALL + 0.06
        if hand is not None and is_holding(hand, ring):
            yaw = -_ring_yaw(ring, float(hand[5]))
            grip = _rotate(hand[:2] - ring[:2, 3], yaw - float(hand[5]))
            plan = plan_lift(hand, high, 0)
        else:
            yaw, grip, slant = 0.0, np.array([0, GRIP]), _ring_yaw(ring)
            x, y = ring[:2, 3] + _rotate(grip, slant)
            wall = ring[2, 3] - TABLE
            plan = plan_lift(hand, high, 1)
            plan += [make_action(x, y, height, gripper, slant) for height, gripper in ((0.12, 1), (wall, 0), (high, 0))]
        u, v = peg[:2, 3] + grip
        plan += [
            make_action(u, v, height, gripper, yaw) for height, gripper in ((high, 0), (TALL - 0.02, 1), (high, 1))
        ]
        return np.array(plan)

    def estimate_completion(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """Compare the pixels around the peg's foot, and in front of it, with the ring's colour; a ring nearby counts a
        little.
        """
        peg = np.append(places[target][:2, 3], TABLE)
        around = min(1.0, compare_colour_at(front, peg + _FRONT_WALL_POINTS, RING) / CERTAIN_SIMILARITY)
        before = compare_colour_at(front, peg + _FRONT_WALL_POINTS + (0.055, 0, 0), RING)
        off = measure_offset(front, RING, (*peg[:2], TABLE + THICK / 2))
        return 0.75 * around * (1 - before) + 0.25 * linear_falloff(off, 0.0, 0.3)


def _ring_yaw(ring: Pose, hand: float = 0.0) -> float:
    """Return the ring's yaw relative to a hand's, within an eighth of a turn: all four walls are alike."""
    yaw = float(np.arctan2(ring[1, 0], ring[0, 0])) - hand
    return (yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _rotate(offset: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Rotate an offset [2] counterclockwise."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ offset


_FRONT_WALL_POINTS = np.stack(
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
"""[N, 3] points on the top and the face of the ring's front wall, relative to the foot of the peg it is on."""


def _build_walls() -> list[tuple[Box, NDArray[np.float64]]]:
    """Return two walls as long as the ring is wide, and two between them."""
    wide = HOLE + 2 * WALL
    return [
        *((Box([wide, WALL, THICK]), place(y=sign * GRIP)) for sign in (-1, 1)),
        *((Box([WALL, HOLE, THICK]), place(x=sign * GRIP)) for sign in (-1, 1)),
    ]
