# SPDX-License-Identifier: Apache-2.0
"""What a plan of poses is truly worth, and which one truly leads on, as `wiw.envs.guide` tells for agents that walk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw.tabletop.workbench import Workbench


class Judged(Protocol):
    """What a guide asks of its task."""

    def progress(self, table: Any, bench: Workbench) -> float: ...

    def expert(self, table: Any, bench: Workbench) -> NDArray[np.float64]: ...


@dataclass(frozen=True)
class TableGuide:
    """The truth about plans from where a table stands."""

    task: Judged
    table: Any
    bench: Workbench
    """A fork of the table's."""

    def worth(self, poses: NDArray[np.float64]) -> float:
        """The furthest that a plan gets, by the task's `progress` after each of its poses."""
        probe, found = self.bench.fork(), []
        for pose in poses:
            probe.move_to(pose)
            found.append(self.task.progress(self.table, probe))
        return max(found)

    def plan(self, length: int) -> NDArray[np.float64]:
        """float64 [K, 7], 1 <= K <= length: what an expert would do next; to stay where nothing helps any more."""
        plan = self.task.expert(self.table, self.bench)[:length]
        return plan if len(plan) else self.bench.pose[None]
