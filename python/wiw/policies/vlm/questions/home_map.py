# SPDX-License-Identifier: Apache-2.0
"""The agent's map of a home: objects, floor, and the landmarks that are within sight now."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.landmarks import Landmark, LandmarkFinder
from wiw.mapping.marks import MarkedViews, draw_marks
from wiw.mapping.object_map import BACKGROUND, ObjectMap
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.routes import STEP, find_refused
from wiw.mapping.views import Views
from wiw.perception.scene_labels import STATES, SceneLabels
from wiw.types import Observation

UNMARKED = (*BACKGROUND, "opening")
"""Categories that are not landmarks. Openings are found by depth, which is surer than labels."""
MOVED = 0.05
"""Metres below which a walk has led nowhere."""


@dataclass(frozen=True)
class Sight:
    """The present views, with the landmarks marked."""

    views: Views
    marked: MarkedViews


@dataclass
class HomeMap:
    """Objects and floor of a home, from real views alone."""

    categories: tuple[str, ...]
    """Categories of the labeller."""
    objects: ObjectMap = field(init=False)
    grid: OccupancyGrid = field(default_factory=OccupancyGrid)
    finder: LandmarkFinder = field(default_factory=LandmarkFinder)
    _pose: NDArray[np.float64] | None = None
    """Place of the latest observation."""

    def __post_init__(self) -> None:
        self.objects = ObjectMap(self.categories, STATES, UNMARKED)

    def add(
        self,
        observation: Observation,
        views: Views,
        labels: SceneLabels,
        question: str,
        executed: NDArray[np.int8],
    ) -> Sight:
        """Add an observation with depth; return its views, in which numbers keep off what the question names.

        `executed` has the primitives since the observation before, refused ones too.
        """
        assert observation.depth is not None
        self.grid.add(observation.depth, observation.odometry)
        self._mark_refusal(observation.odometry, executed)
        owners = self.objects.add(views, labels)
        landmarks = self.finder.find(views, owners, self.objects, self.grid.openings)
        return Sight(views, draw_marks(views.images, landmarks, find_named(landmarks, question)))

    def _mark_refusal(self, pose: NDArray[np.float64], executed: NDArray[np.int8]) -> None:
        """Mark what has refused all steps ahead, where depth shows no obstacle."""
        before, self._pose = self._pose, pose.copy()
        if before is None or np.linalg.norm(pose[:2] - before[:2]) > MOVED:
            return
        blocked = find_refused(before, executed, pose)
        if blocked is not None:
            self.grid.mark_blocked(blocked, STEP)


def find_named(landmarks: Sequence[Landmark], question: str) -> list[int]:
    """Return the ids of the landmarks whose category is mentioned in a question."""
    words = question.casefold()
    return [mark.id for mark in landmarks if mark.category.casefold() in words]
