# SPDX-License-Identifier: Apache-2.0
"""Ground truth about plans of gripper poses: how good a plan is, and which plan leads to the goal."""

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
    """Ground truth about plans from the present state of a table."""

    task: ManipulationSpec
    table: Table
    bench: Workbench
    """A fork of the table's."""

    def evaluate_plan(self, plan: NDArray[np.float64]) -> float:
        """Return the task's progress at a plan's end, or at the first pose that gets all the way."""
        probe, found = self.bench.fork(), -np.inf
        for pose in plan:
            probe.move_to(pose)
            found = self.task.measure_progress(self.table, probe)
            if found >= self.task.complete_progress:
                break
        return found

    def suggest_plan(self, length: int) -> NDArray[np.float64]:
        """Return the expert's next poses, float64 [K, 7], 1 <= K <= length; `idle_action` where nothing helps."""
        plan = self.task.plan_expert(self.table, self.bench)[:length]
        return plan if len(plan) else self.bench.idle_action[None]
