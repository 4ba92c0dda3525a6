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
    """The tables of episodes, their success condition, and the remaining expert actions."""

    seed: int
    robot: Robot
    """The arm."""
    complete_progress: float = 0.0
    """Progress with which an episode has ended, whatever a plan would do afterwards."""

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
        """Return the progress at the present state of a fork of a table, the higher the better."""

    @abstractmethod
    def plan_expert(self, table: Table, bench: Workbench) -> NDArray[np.float64]:
        """Return the remaining poses of an expert that knows the target, float64 [K, 7]; empty if nothing helps."""
