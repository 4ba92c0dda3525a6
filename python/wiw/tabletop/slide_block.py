# SPDX-License-Identifier: Apache-2.0
"""Slide a block onto the square of the requested colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.physics import Box, place
from wiw.tabletop.base import PALETTE, TableSetup, TabletopTask, derive_key, make_action, plan_lift
from wiw.tabletop.colours import measure_offset
from wiw.tabletop.workbench import TABLE, Pose, Thing, Workbench

SIDE, SQUARE = 0.06, 0.11
"""Metres: the side of the block, and that of the squares."""
LIFTED = 0.01
"""Metres above the table from which the block is held up rather than slid."""
SQUARE_DISTANCE = 0.15
"""Metres from the middle to each square."""
BLOCK = (0.5, 0.2, 0.72)
"""Colour of the block, which nothing else has."""
COLOURS = ("green", "blue", "rose", "yellow")
PHRASES = (
    "slide the block to the {0} square",
    "slide the block onto {0}",
    "push the block until it stands on the {0} square",
    "move the block towards the {0} square by sliding it",
    "cover the {0} square with the block",
)


class SlideBlock(TabletopTask):
    """Four squares around a block; the block's middle must end over the right one."""

    name = "slide_block"
    noun = "block"
    variations = 4

    def create_setup(self, seed: int, variation: int) -> TableSetup:
        """Create the table; variation v requests colour v; the block is rotated, and up to 2 cm off the middle."""
        draws = core.uniform(derive_key(seed, variation, 1), 5)
        middle = np.array([0.17, 0.0]) + 0.03 * (draws[:2] - 0.5)
        start = middle + 0.03 * (draws[2:4] - 0.5)
        things = [
            (
                Thing(colour, ((Box([SQUARE, SQUARE, 0.002]), np.eye(4)),), PALETTE[colour], has_body=False),
                _pose_on_table(middle + SQUARE_DISTANCE * _side_direction(i), 0.0011),
            )
            for i, colour in enumerate(COLOURS)
        ]
        block = Thing("block", ((Box([SIDE] * 3), np.eye(4)),), BLOCK, mass=0.25, friction=0.4)
        things.append((block, _pose_on_table(start, SIDE / 2, 0.4 * (draws[4] - 0.5))))
        colour = COLOURS[variation % len(COLOURS)]
        words = int(core.uniform(derive_key(seed, variation, 2), 1)[0] * len(PHRASES))
        return TableSetup(tuple(things), self.phrase_instruction(colour, words), colour, objects=("block", *COLOURS))

    def phrase_instruction(self, target: Any, wording: int = 0) -> str:
        """Return, e.g., "slide the block to the green square"."""
        return PHRASES[wording % len(PHRASES)].format(target)

    def list_alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """Return the other squares."""
        return [name for name in objects if name not in ("block", target)]

    def is_success(self, bench: Workbench, setup: TableSetup) -> bool:
        """Return whether the block lies on the square, its middle well within it; one that is held up does not."""
        block = bench.get_pose("block")[:3, 3]
        off = block[:2] - bench.get_pose(setup.target)[:2, 3]
        return bool(np.abs(off).max() < SQUARE / 2 - 0.02 and abs(block[2] - (TABLE + SIDE / 2)) < LIFTED)

    def plan_expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Move down behind the block, on the side away from the square, and push straight ahead."""
        block, square = (places[name][:2, 3] for name in ("block", target))
        ahead = (square - block) / np.linalg.norm(square - block)
        yaw = float(np.arctan2(ahead[1], ahead[0]))
        yaw = (yaw + np.pi / 2) % np.pi - np.pi / 2  # a hand turned by half a turn is the same
        behind, end = block - (SIDE / 2 + 0.045) * ahead, square - (SIDE / 2 + 0.03) * ahead
        return np.array(
            [
                *plan_lift(hand, 0.12, 0.0),
                make_action(behind[0], behind[1], 0.12, 0.0, yaw),
                make_action(behind[0], behind[1], 0.025, 0.0, yaw),
                make_action(end[0], end[1], 0.025, 0.0, yaw),
                make_action(end[0], end[1], 0.12, 0.0, yaw),
            ]
        )

    def estimate_completion(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """Rate the distance between the mean position of the block's pixels and the square."""
        off = measure_offset(front, BLOCK, (*places[target][:2, 3], TABLE + SIDE / 2))
        return float(np.interp(off, (0.02, 0.05, 2 * SQUARE_DISTANCE), (1, 0.5, 0)))


def _pose_on_table(spot: NDArray[np.float64], height: float, turn: float = 0.0) -> Pose:
    """Return a pose [4, 4] `height` metres above a spot [2] of the table."""
    return place(float(spot[0]), float(spot[1]), TABLE + height, rpy=(0, 0, turn))


def _side_direction(index: int) -> NDArray[np.float64]:
    """Return the unit vector to one of four sides: ahead, left, back, right."""
    angle = index * np.pi / 2
    return np.array([np.cos(angle), np.sin(angle)])
