# SPDX-License-Identifier: Apache-2.0
"""Put a square ring on the square peg of the colour that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from wiw._core import core
from wiw.physics import Box, place
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, key_of
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
PHRASES = ("put the ring on the {0} spoke", "slide the ring onto the {0} spoke", "place the ring over the {0} spoke")


class InsertPeg(Kind):
    """Three pegs in a row, a ring in front of them."""

    name = "insert_peg"
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
        ring = Thing("ring", tuple(_walls()), (0.75, 0.4, 0.15), mass=0.08, friction=0.6)
        turn = 0.6 * (draws[4] - 0.5)
        lying = place(0.24 + 0.06 * draws[2], 0.3 * (draws[3] - 0.5), TABLE + THICK / 2, rpy=(0, 0, turn))
        target = colours[int(draws[5] * PEGS)]
        instruction = PHRASES[variation % len(PHRASES)].format(target)
        return Setup((*pegs, (ring, lying)), instruction, target, objects=("ring", *colours))

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The ring is around the peg, below its top."""
        ring, peg = bench.place_of("ring"), bench.place_of(setup.target)
        off = np.abs(ring[:2, 3] - peg[:2, 3]).max()
        return bool(off < 2 * CLEARANCE and ring[2, 3] < TABLE + TALL - THICK / 2 and ring[2, 2] > 0.95)

    def expert(self, places: Mapping[str, Pose], target: Any) -> NDArray[np.float64]:
        """By the wall, up, over the peg with the hand turned as the pegs stand, down, and let go."""
        ring, peg = places["ring"], places[target]
        turn = float(Rotation.from_matrix(ring[:3, :3]).as_euler("xyz")[2])
        x, y = (ring @ (0, GRIP, 0, 1))[:2]
        u, v = peg[:2, 3] + (0, GRIP)
        low, high = THICK / 2, TALL + 0.06
        return np.array(
            [
                above(x, y, 0.12, 1, turn),
                above(x, y, low, 0, turn),
                above(x, y, high, 0, turn),
                above(u, v, high, 0),
                above(u, v, TALL - 0.02, 1),
                above(u, v, high, 1),
            ]
        )


def _walls() -> list[tuple[Box, NDArray[np.float64]]]:
    """Two walls as long as the ring is wide, and two between them."""
    wide = HOLE + 2 * WALL
    return [
        *((Box([wide, WALL, THICK]), place(y=sign * GRIP)) for sign in (-1, 1)),
        *((Box([WALL, HOLE, THICK]), place(x=sign * GRIP)) for sign in (-1, 1)),
    ]
