# SPDX-License-Identifier: Apache-2.0
"""Push one to three buttons in the order that is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.physics import Articulation, Cylinder, place
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, key_of, scattered
from wiw.tabletop.workbench import LAMPS, TABLE, Pose, Thing, Workbench

BUTTONS = 3
SPRING = 4.0
"""Newtons."""
TOP = 0.038
"""Metres from the table to the plate's top."""
RING, HIGH = 0.056, 0.016
"""Metres of the dark ring around the plate: its radius, wide enough to be seen from the front, and its height."""
LAMP = Cylinder(RING + 0.0005, HIGH + 0.001)
"""Over the ring when it is lit."""
COLOURS = [name for name in PALETTE if name not in (*LAMPS, "yellow")]
"""Of plates; none is that of a lamp, or near."""
PHRASES = ("push the {0} button", "press the {0} button", "push down the button that is {0}")
AND_THEN = (", then push the {0} one", ", then press the {0} one", ", and after it the {0} one")


class PushButtons(Kind):
    """Three buttons on springs, the first so many of which are to be pushed, and no other before or between them."""

    name = "push_buttons"
    variations = 50

    def setup(self, seed: int, variation: int) -> Setup:
        """Variation v asks for 1 + v mod 3 pushes."""
        colours = chosen(key_of(seed, variation, 1), COLOURS, BUTTONS)
        places = scattered(key_of(seed, variation, 2), BUTTONS, 0.13)
        asked = tuple(colours[: 1 + variation % BUTTONS])
        words = variation // BUTTONS % len(PHRASES)
        instruction = PHRASES[words].format(asked[0]) + "".join(AND_THEN[words].format(name) for name in asked[1:])
        things = tuple(
            (Thing(colour, mechanism=_button(PALETTE[colour]), lamp=LAMP), place(x, y, TABLE + HIGH / 2))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        return Setup(things, instruction, asked, dict.fromkeys(colours, SPRING), tuple(colours))

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The pushes so far are those that are asked for."""
        return bench.pressed == setup.target

    def expert(self, places: Mapping[str, Pose], target: Any) -> NDArray[np.float64]:
        """Down and up again over each, with shut fingers."""
        plan = []
        for name in target:
            x, y, _ = places[name][:3, 3]
            plan += [above(x, y, TOP + h, 0.0) for h in (0.083, -0.01, 0.083)]
        return np.array(plan)


def _button(colour: tuple[float, float, float]) -> Articulation:
    """A plate on a spring in a dark ring."""
    rgba = " ".join(f"{value}" for value in (*colour, 1.0))
    return Articulation.from_text(_URDF.format(rgba=rgba, ring=RING, high=HIGH))


_URDF = """<robot name="button">
  <link name="base">
    <visual><geometry><cylinder radius="{ring}" length="{high}"/></geometry>
      <material name="ring"><color rgba="0.2 0.2 0.22 1"/></material></visual>
    <collision><geometry><cylinder radius="{ring}" length="{high}"/></geometry></collision>
  </link>
  <link name="plate">
    <inertial><mass value="0.05"/>
      <inertia ixx="0.0001" iyy="0.0001" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.034" length="0.02"/></geometry>
      <material name="plate"><color rgba="{rgba}"/></material></visual>
    <collision><geometry><cylinder radius="0.034" length="0.02"/></geometry></collision>
  </link>
  <joint name="press" type="prismatic">
    <parent link="base"/><child link="plate"/><origin xyz="0 0 0.02"/><axis xyz="0 0 1"/>
    <limit lower="-0.016" upper="0" effort="10" velocity="1"/>
  </joint>
</robot>"""
