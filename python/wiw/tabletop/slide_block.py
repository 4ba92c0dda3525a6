# SPDX-License-Identifier: Apache-2.0
"""Slide a block onto the square of the colour that is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.physics import Box, place
from wiw.tabletop.colours import metres_off
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, key_of, raised
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

SIDE, SQUARE = 0.06, 0.11
"""Metres of the block, and of the squares."""
FAR = 0.15
"""Metres from the middle to each square."""
BLOCK = (0.5, 0.2, 0.72)
"""Its colour, which is that of nothing else."""
COLOURS = ("green", "blue", "rose", "yellow")
PHRASES = (
    "slide the block to the {0} square",
    "slide the block onto {0}",
    "push the block until it stands on the {0} square",
    "move the block towards the {0} square by sliding it",
    "cover the {0} square with the block",
)


class SlideBlock(Kind):
    """Four squares around a block; the block's middle has to come to lie on the right one."""

    name = "slide_block"
    noun = "block"
    variations = 4

    def setup(self, seed: int, variation: int) -> Setup:
        """Variation v asks for colour v; the block is up to 2 cm off the middle and turned."""
        draws = core.uniform(key_of(seed, variation, 1), 5)
        middle = np.array([0.17, 0.0]) + 0.03 * (draws[:2] - 0.5)
        start = middle + 0.03 * (draws[2:4] - 0.5)
        things = [
            (
                Thing(colour, ((Box([SQUARE, SQUARE, 0.002]), np.eye(4)),), PALETTE[colour], touched=False),
                _flat(middle + FAR * _towards(i), 0.0011),
            )
            for i, colour in enumerate(COLOURS)
        ]
        block = Thing("block", ((Box([SIDE] * 3), np.eye(4)),), BLOCK, mass=0.25, friction=0.4)
        things.append((block, _flat(start, SIDE / 2, 0.4 * (draws[4] - 0.5))))
        colour = COLOURS[variation % len(COLOURS)]
        words = int(core.uniform(key_of(seed, variation, 2), 1)[0] * len(PHRASES))
        return Setup(tuple(things), self.say(colour, words), colour, objects=("block", *COLOURS))

    def say(self, target: Any, wording: int = 0) -> str:
        """E.g. "slide the block to the green square"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """The other squares."""
        return [name for name in objects if name not in ("block", target)]

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The block's middle is over the square."""
        off = bench.place_of("block")[:2, 3] - bench.place_of(setup.target)[:2, 3]
        return bool(np.abs(off).max() < SQUARE / 2 - 0.02)

    def expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Down behind the block, on the side away from the square, and straight on."""
        block, square = (places[name][:2, 3] for name in ("block", target))
        ahead = (square - block) / np.linalg.norm(square - block)
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2  # a hand turned by half a turn is the same
        behind, end = block - (SIDE / 2 + 0.045) * ahead, square - (SIDE / 2 + 0.03) * ahead
        return np.array(
            [
                *raised(hand, 0.12, 0.0),
                above(behind[0], behind[1], 0.12, 0.0, yaw),
                above(behind[0], behind[1], 0.025, 0.0, yaw),
                above(end[0], end[1], 0.025, 0.0, yaw),
                above(end[0], end[1], 0.12, 0.0, yaw),
            ]
        )

    def looks_done(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """The middle of the block's pixels is over the square; less by how far it is from there."""
        off = metres_off(front, BLOCK, (*places[target][:2, 3], TABLE + SIDE / 2))
        return float(np.interp(off, (0.02, 0.05, 2 * FAR), (1, 0.5, 0)))


def _flat(spot: NDArray[np.float64], height: float, turn: float = 0.0) -> Pose:
    """A pose [4, 4] so many metres above a spot [2] of the table."""
    return place(float(spot[0]), float(spot[1]), TABLE + height, rpy=(0, 0, turn))


def _towards(index: int) -> NDArray[np.float64]:
    """Unit vectors to the four sides: ahead, left, back, right."""
    angle = index * np.pi / 2
    return np.array([np.cos(angle), np.sin(angle)])
