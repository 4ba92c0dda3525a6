# SPDX-License-Identifier: Apache-2.0
"""Push one to three buttons in the requested order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.physics import Articulation, Cylinder, place
from wiw.tabletop.base import (
    PALETTE,
    TableSetup,
    TabletopTask,
    choose_names,
    derive_key,
    find_colours,
    make_action,
    plan_lift,
    scatter_places,
)
from wiw.tabletop.colours import compare_colour, sample_pixels
from wiw.tabletop.workbench import LAMPS, TABLE, WOOD, Pose, Thing, Workbench
from wiw.types import ArmObservation

BUTTONS = 3
SPRING = 4.0
"""Newtons."""
TOP = 0.038
"""Metres from the table to the plate's top."""
RING, HIGH = 0.056, 0.016
"""Metres: radius and height of the dark ring around the plate; wide enough to be visible from the front."""
LAMP = Cylinder(RING + 0.0005, HIGH + 0.001)
"""The shape that covers the ring when it is lit."""
UNLIT_COLOUR = (0.2, 0.2, 0.22)
"""Colour of the ring when it is not lit."""
MIN_STAGE_SCORE = 0.3
"""Score of a stage below which the rings show another sequence of pushes; three of them may be hidden."""
BACKGROUND_WEIGHT = 0.1
"""Squared similarity to a colour that occurs nowhere, so that a hand in front of a ring counts for nothing."""
CERTAIN_SHARE = 0.3
"""Share of a ring that must be visible for certainty about its lamp."""
HIDDEN_SCORE = 0.7
"""Score of a ring that the hand hides; a visible one scores up to 1."""
COLOURS = [name for name in PALETTE if name not in (*LAMPS, "yellow")]
"""Colours of plates; none resembles a lamp's."""
PHRASES = ("push the {0} button", "press the {0} button", "push down the button that is {0}")
AND_THEN = (", then push the {0} one", ", then press the {0} one", ", and after it the {0} one")


class PushButtons(TabletopTask):
    """Three buttons on springs; the first one, two or three are to be pushed, with no other push before or between."""

    name = "push_buttons"
    noun = "button"
    variations = 50

    def create_setup(self, seed: int, variation: int) -> TableSetup:
        """Create the table; variation v requests 1 + v mod 3 pushes."""
        colours = choose_names(derive_key(seed, variation, 1), COLOURS, BUTTONS)
        places = scatter_places(derive_key(seed, variation, 2), BUTTONS, 0.13)
        asked = tuple(colours[: 1 + variation % BUTTONS])
        instruction = self.phrase_instruction(asked, variation // BUTTONS)
        things = tuple(
            (Thing(colour, mechanism=_build_button(PALETTE[colour]), lamp=LAMP), place(x, y, TABLE + HIGH / 2))
            for colour, (x, y) in zip(colours, places, strict=True)
        )
        return TableSetup(things, instruction, asked, dict.fromkeys(colours, SPRING), tuple(colours))

    def phrase_instruction(self, target: Any, wording: int = 0) -> str:
        """Return, e.g., "push the navy button, then push the teal one"."""
        words = wording % len(PHRASES)
        return PHRASES[words].format(target[0]) + "".join(AND_THEN[words].format(name) for name in target[1:])

    def parse_target(self, text: str) -> tuple[str, ...]:
        """Return the colours that an instruction names, in order.

        Raises:
            ArgumentError: none, more than there are buttons, or one twice.
        """
        found = tuple(find_colours(text))
        if not 1 <= len(found) <= BUTTONS or len(set(found)) < len(found):
            raise ArgumentError(
                f"push_buttons: expected an instruction that names 1 to {BUTTONS} colours, got {text!r}"
            )
        return found

    def list_alternatives(self, objects: Sequence[str], target: Any) -> list[Any]:
        """Return the other sequences of as many pushes."""
        return [order for order in permutations(objects, len(target)) if order != tuple(target)]

    def find_remaining_target(self, observation: ArmObservation, target: Any) -> Any:
        """Return the remaining pushes, by the lamps that are lit; None also where they show a wrong push."""
        alike = _score_stages(observation.front, observation.places, target)
        pushed = int(np.argmax(alike))
        return tuple(target[pushed:]) if alike[pushed] > MIN_STAGE_SCORE and pushed < len(target) else None

    def is_success(self, bench: Workbench, setup: TableSetup) -> bool:
        """Return whether the pushes so far are the requested ones."""
        return bench.pressed_buttons == setup.target

    def plan_expert(
        self, places: Mapping[str, Pose], target: Any, hand: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Move down and up again over each button, with closed fingers."""
        plan = plan_lift(hand, TOP + 0.083, 0.0)
        for name in target:
            x, y, _ = places[name][:3, 3]
            plan += [make_action(x, y, TOP + h, 0.0) for h in (0.083, -0.01, 0.083)]
        return np.array(plan)

    def estimate_completion(self, front: NDArray[np.uint8], places: Mapping[str, Pose], target: Any) -> float:
        """Return the share of the pushes, in order, that the lamps show; less if other lamps are lit."""
        alike = _score_stages(front, places, target)
        return float((alike * np.arange(len(alike))).max() / len(target))


def _score_stages(front: NDArray[np.uint8], places: Mapping[str, Pose], target: Sequence[str]) -> NDArray[np.float64]:
    """Return how well all rings match their look after the first 0 to n pushes of a target: float64 [n + 1], 0 to 1."""
    lit = {name: _score_lamps(front, place) for name, place in places.items()}
    turns = {name: turn for turn, name in enumerate(target, 1)}
    stages = []
    for pushed in range(len(target) + 1):
        wanted = {name: turn if (turn := turns.get(name, 0)) <= pushed else 0 for name in places}
        stages.append(
            np.prod([lit[name][turn] + HIDDEN_SCORE * (1 - lit[name].sum()) for name, turn in wanted.items()])
        )
    return np.array(stages)


def _score_lamps(front: NDArray[np.uint8], button: Pose) -> NDArray[np.float64]:
    """Return how likely a ring is dark, or lit by the first, second or third push: float64 [1 + 3]; the sum is below 1
    where the hand hides it.
    """
    pixels = sample_pixels(front, button[:3, 3] + _VISIBLE_RING_POINTS)
    likeness = np.stack([compare_colour(pixels, colour) ** 2 for colour in (WOOD, UNLIT_COLOUR, *LAMPS.values())])
    shares = (likeness / (likeness.sum(axis=0) + BACKGROUND_WEIGHT)).mean(axis=1)
    lights = np.clip(shares[1:] / CERTAIN_SHARE, 0, 1)
    return lights / max(1.0, lights.sum())


@cache
def _build_button(colour: tuple[float, float, float]) -> Articulation:
    """Build a plate on a spring in a dark ring; buttons of one colour share it, and with it its meshes."""
    rgba = " ".join(f"{value}" for value in (*colour, 1.0))
    return Articulation.from_text(_URDF.format(rgba=rgba, dark=" ".join(map(str, UNLIT_COLOUR)), ring=RING, high=HIGH))


_ANGLES, _RADII = (grid.ravel() for grid in np.meshgrid(np.linspace(-1.7, 1.7, 35), [0.041, 0.046, 0.051]))
_VISIBLE_RING_POINTS = np.stack(
    [_RADII * np.cos(_ANGLES), _RADII * np.sin(_ANGLES), np.full(_RADII.shape, HIGH / 2 + 0.001)], axis=1
)
"""[N, 3] points on a ring, from its middle, that the plate does not hide from the front camera."""

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
