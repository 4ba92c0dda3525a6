# SPDX-License-Identifier: Apache-2.0
"""An explorer's memory of an episode: its map, its beliefs, and the places it has tried to reach."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.questions import ParsedQuestion
from wiw.mapping.alignment import find_wall_azimuth, turn_odometry
from wiw.mapping.object_map import ObjectMap
from wiw.mapping.occupancy import OccupancyGrid
from wiw.policies.explorer.answering import Belief, list_wanted
from wiw.policies.explorer.destinations import Destination, Rate, choose_destinations
from wiw.policies.explorer.home import Surface

PATIENCE = 6
"""Decisions after which a place that could not be reached is given up; six lead up to 18 m."""


@dataclass(frozen=True)
class Look:
    """A real look around."""

    panorama: NDArray[np.uint8]
    depth: NDArray[np.float32]
    """Distances along the ray in metres."""
    odometry: NDArray[np.float64]
    ids: NDArray[np.uint32] | None = None
    """The simulator's instance of each pixel, for explorers that are given the truth."""


@dataclass
class Memory:
    """The memory of one episode."""

    question: ParsedQuestion | None
    """None if the text is not in the generator's language: then only the blind answer is left."""
    objects: ObjectMap
    grid: OccupancyGrid = field(default_factory=OccupancyGrid)
    surfaces: list[Surface] = field(default_factory=list)
    belief: Belief = field(default_factory=lambda: Belief("", 0.0))
    home: Any = None
    azimuth: float | None = None
    """Azimuth of the walls in the frame of the start; the map's x axis points along it."""
    pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """x, y, azimuth in the map at the last decision."""
    executed: int = 0
    """Primitives until then ..."""
    spent: int = 0
    """... as far as they count towards the budget."""
    destinations: list[Destination] = field(default_factory=list)
    """Places worth going to from there, the most worth first."""
    tries: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Decisions in which a place, in half metres, was the most worth going to."""

    def choose_destinations(self, rate: Rate) -> None:
        """Choose where to go from here; places that were the best for long, and never reached, are given up."""
        found = choose_destinations(self.grid, self.pose, self.belief.things, rate)
        cells = [(round(2 * place.position[0]), round(2 * place.position[1])) for place in found]
        self.destinations = [place for place, cell in zip(found, cells, strict=True) if self.tries[cell] < PATIENCE]
        self.tries.update(next(([cell] for cell in cells if self.tries[cell] < PATIENCE), []))

    def align(self, look: Look) -> NDArray[np.float64]:
        """Return x, y, azimuth of a look in the map."""
        if self.azimuth is None:
            self.azimuth = find_wall_azimuth(look.depth, look.odometry)
        return turn_odometry(look.odometry, self.azimuth)

    @cached_property
    def wanted_categories(self) -> tuple[str, ...]:
        """Categories to look for, the one that is asked about first."""
        return list_wanted(self.question)
