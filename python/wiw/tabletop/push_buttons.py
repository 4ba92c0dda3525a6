# SPDX-License-Identifier: Apache-2.0
"""Push one to three buttons in the order that is asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.physics import Articulation, Cylinder, place
from wiw.tabletop.colours import alike, pixels_at
from wiw.tabletop.kind import PALETTE, Kind, Setup, above, chosen, colours_in, key_of, raised, scattered
from wiw.tabletop.workbench import LAMPS, TABLE, WOOD, Pose, Thing, Workbench
from wiw.types import ArmObservation

BUTTONS = 3
SPRING = 4.0
"""Newtons."""
TOP = 0.038
"""Metres from the table to the plate's top."""
RING, HIGH = 0.056, 0.016
"""Metres of the dark ring around the plate: its radius, wide enough to be seen from the front, and its height."""
LAMP = Cylinder(RING + 0.0005, HIGH + 0.001)
"""Over the ring when it is lit."""
DARK = (0.2, 0.2, 0.22)
"""Of the ring that is not lit."""
PLAIN = 0.3
"""Likeness of all rings together to those of a stage, below which they show another push; three may be hidden."""
DOUBT = 0.1
"""Squared likeness of a pixel to what is expected nowhere, so that the hand before a ring says nothing."""
SURE = 0.3
"""Share of a ring that has to be seen to be sure of it."""
UNSEEN = 0.7
"""What a ring counts that the hand hides, where a seen one counts 1."""
COLOURS = [name for name in PALETTE if name not in (*LAMPS, "yellow")]
"""Of plates; none is that of a lamp, or near."""
PHRASES = ("push the {0} button", "press the {0} button", "push down the button that is {0}")
AND_THEN = (", then push the {0} one", ", then press the {0} one", ", and after it the {0} one")


class PushButtons(Kind):
    """Three buttons on springs, the first so many of which are to be pushed, and no other before or between them."""

    name = "push_buttons"
    noun = "button"
    variations = 50

    def setup(self, seed: int, variation: int) -> Setup:
        """Variation v asks for 1 + v mod 3 pushes."""
        colours = chosen(key_of(seed, variation, 1), COLOURS, BUTTONS)
        places = scattered(key_of(seed, variation, 2), BUTTONS, 0.13)
        asked = tuple(colours[: 1 + variation % BUTTONS])
        instruction = self.say(asked, variation // BUTTONS)
        things = tuple(
            (Thing(colour, mechanism=_button(PALETTE[colour]), lamp=LAMP), place(x, y, TABLE + HIGH / 2))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        return Setup(things, instruction, asked, dict.fromkeys(colours, SPRING), tuple(colours))

    def say(self, target: Any, wording: int = 0) -> str:
        """E.g. "push the navy button, then push the teal one"."""
        words = wording % len(PHRASES)
        return PHRASES[words].format(target[0]) + "".join(AND_THEN[words].format(name) for name in target[1:])

    def target_of(self, text: str) -> tuple[str, ...]:
        """The colours that an instruction names, in their order.

        Raises:
            ArgumentError: none, more than there are buttons, or one twice.
        """
        found = tuple(colours_in(text))
        if not 1 <= len(found) <= BUTTONS or len(set(found)) < len(found):
            raise ArgumentError(
                f"push_buttons: expected an instruction that names 1 to {BUTTONS} colours, got {text!r}"
            )
        return found

    def alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """As many pushes, of others or in another order."""
        return [order for order in permutations(objects, len(target)) if order != tuple(target)]

    def left(self, seen: ArmObservation, target: Any) -> Any:
        """The pushes to come, by the rings that are lit; None also where they show another push."""
        alike = _stages(seen.front, seen.places, target)
        pushed = int(np.argmax(alike))
        return tuple(target[pushed:]) if alike[pushed] > PLAIN and pushed < len(target) else None

    def succeeded(self, bench: Workbench, setup: Setup) -> bool:
        """The pushes so far are those that are asked for."""
        return bench.pressed == setup.target

    def expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Down and up again over each, with shut fingers."""
        plan = raised(hand, TOP + 0.083, 0.0)
        for name in target:
            x, y, _ = places[name][:3, 3]
            plan += [above(x, y, TOP + h, 0.0) for h in (0.083, -0.01, 0.083)]
        return np.array(plan)

    def looks_done(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """The share of the pushes, in their turn, that the rings show; less for rings that do not fit."""
        alike = _stages(front, places, target)
        return float((alike * np.arange(len(alike))).max() / len(target))


def _stages(front: NDArray[np.uint8], places: Mapping[str, Pose], target: Sequence[str]) -> NDArray[np.float64]:
    """float64 [n + 1] from 0 to 1: how much all rings look as they do after the first 0 to n pushes of a target."""
    lit = {name: _lights(front, place) for name, place in places.items()}
    turns = {name: turn for turn, name in enumerate(target, 1)}
    stages = []
    for pushed in range(len(target) + 1):
        wanted = {name: turn if (turn := turns.get(name, 0)) <= pushed else 0 for name in places}
        stages.append(np.prod([lit[name][turn] + UNSEEN * (1 - lit[name].sum()) for name, turn in wanted.items()]))
    return np.array(stages)


def _lights(front: NDArray[np.uint8], button: Pose) -> NDArray[np.float64]:
    """float64 [1 + 3]: how much a ring looks dark, or lit by the first, second or third push; less than 1 in all where
    the hand hides it.
    """
    pixels = pixels_at(front, button[:3, 3] + _VISIBLE)
    likeness = np.stack([alike(pixels, colour) ** 2 for colour in (WOOD, DARK, *LAMPS.values())])
    shares = (likeness / (likeness.sum(axis=0) + DOUBT)).mean(axis=1)
    lights = np.clip(shares[1:] / SURE, 0, 1)
    return lights / max(1.0, lights.sum())


def _button(colour: tuple[float, float, float]) -> Articulation:
    """A plate on a spring in a dark ring."""
    rgba = " ".join(f"{value}" for value in (*colour, 1.0))
    return Articulation.from_text(_URDF.format(rgba=rgba, dark=" ".join(map(str, DARK)), ring=RING, high=HIGH))


_ANGLES, _RADII = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.7, 1.7, 35), [0.041, 0.046, 0.051]))
_VISIBLE = np.stack(
    [_RADII * np.cos(_ANGLES), _RADII * np.sin(_ANGLES), np.full(_RADII.shape, HIGH / 2 + 0.001)], axis=1
)
"""[N, 3] points on a ring, from its middle, that the plate does not hide from the front."""

_URDF = """<robot name="button">
  <link name="base">
    <visual><geometry><cylinder radius="{ring}" length="{high}"/></geometry>
      <material name="ring"><color rgba="{dark} 1"/></material></visual>
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
