# SPDX-License-Identifier: Apache-2.0
"""The images of a table shown to a language model: numbered objects with axes, and strips of imagined views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from wiw import annotate
from wiw.policies.vlm.arm.plans import GRID, index_objects, select_shown
from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.types import ArmObservation, Proposal, Rollout

Image = NDArray[np.uint8]
AXIS = 0.15
"""Length of the arrows in metres."""
DOT, GAP = 3, 18
"""Pixels: radius of an object's point, and gap between it and its index, so that the index hides nothing."""
PLATE = 8
"""Pixels from the near edge of an index to its middle."""


def render_observation(observation: ArmObservation) -> Image:
    """Return the front view with a point and an index on each object, and the axes of the grid."""
    image = observation.front
    size = (image.shape[0], image.shape[1])
    origin = np.array([*GRID.low[:2], TABLE])
    corner, *ends = CAMERAS["front"].project_points(origin + np.vstack([np.zeros(3), AXIS * np.eye(3)]), size)
    image = annotate.axes(image, corner, ends)
    spots = index_objects(observation.places)
    points = CAMERAS["front"].project_points(np.array([*spots.values()]).reshape(-1, 3), size)
    for index, at, side in zip(spots, points, choose_sides(points), strict=True):
        image = annotate.mark(image, at, str(index), radius=DOT, gap=side * GAP)
    return image


def choose_sides(points: NDArray[np.float64]) -> list[int]:
    """Return the side of each point's index, right (1) or left (-1): the one farther from all others, for points [N,
    2].
    """
    taken, sides = list(points), []
    for at in points:
        ends = {side: at + side * np.array([DOT + GAP + PLATE, 0]) for side in (1, -1)}
        room = {side: min(np.linalg.norm(end - other) for other in taken) for side, end in ends.items()}
        sides.append(max(room, key=room.__getitem__))
        taken.append(ends[sides[-1]])
    return sides


def render_plan_strip(plan: Proposal, rollout: Rollout) -> Image:
    """Return what was imagined after each shown pose of a plan, side by side."""
    places = select_shown(len(plan.actions))
    titles = [f"Imagined after action {k + 1}: {GRID.encode(plan.actions[k]).tolist()}" for k in places]
    return annotate.strip(rollout.frames[places], titles)
