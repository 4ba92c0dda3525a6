# SPDX-License-Identifier: Apache-2.0
"""The truth about plans of poses: what one is worth, and which one leads on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw.envs.base import Guide
from wiw.envs.manipulation_spec import ManipulationSpec
from wiw.tabletop.table import Table
from wiw.tabletop.workbench import Workbench


@dataclass(frozen=True)
class TableGuide(Guide):
    """The truth about plans from where a table stands."""

    task: ManipulationSpec
    table: Table
    bench: Workbench
    """A fork of the table's."""

    def worth(self, plan: NDArray[np.float64]) -> float:
        """Return the furthest that a plan gets, by the task's progress after each of its poses."""
        probe, found = self.bench.fork(), []
        for pose in plan:
            probe.move_to(pose)
            found.append(self.task.measure_progress(self.table, probe))
        return max(found)

    def plan(self, length: int) -> NDArray[np.float64]:
        """Return what an expert would do next, float64 [K, 7], 1 <= K <= length; to stay where nothing helps."""
        plan = self.task.plan_expert(self.table, self.bench)[:length]
        return plan if len(plan) else self.bench.pose[None]
