# SPDX-License-Identifier: Apache-2.0
"""The side of a manipulation task that its environments use."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from wiw.tabletop.robot import Robot
from wiw.tabletop.table import Table
from wiw.tabletop.workbench import Workbench
from wiw.types import Episode


class ManipulationSpec(ABC):
    """Tables, when what is asked for is done, and what is left to do."""

    seed: int
    robot: Robot
    """The arm."""

    @property
    @abstractmethod
    def actions(self) -> int:
        """K: poses that an episode may take."""

    @abstractmethod
    def episode(self, index: int) -> Episode:
        """Return an episode by its number."""

    @abstractmethod
    def set_table(self, episode: Episode) -> Table:
        """Return an episode's table, as it begins."""

    @abstractmethod
    def measure_progress(self, table: Table, bench: Workbench) -> float:
        """Return how good it would be if a table stood as a fork of it does, the higher the better."""

    @abstractmethod
    def plan_expert(self, table: Table, bench: Workbench) -> NDArray[np.float64]:
        """Return what is left to do for who knows what is asked, float64 [K, 7]; nothing where nothing helps."""
