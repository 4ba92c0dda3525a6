# SPDX-License-Identifier: Apache-2.0
"""One episode's table in the course of time."""

from __future__ import annotations

from typing import Literal

from wiw.tabletop.base import TableSetup, TabletopTask
from wiw.tabletop.robot import Robot
from wiw.types import Goal


class Table:
    """An arm and things on a table, and what is asked of the arm.

    Args:
        kind: the kind of task that judges it.
        setup: the objects' poses, and the instruction.
        backend: renderer, "auto", "cpu" or "gpu".
        robot: the arm; None means the project's own.
        task: name of the task that the goal is of.
    """

    def __init__(
        self,
        kind: TabletopTask,
        setup: TableSetup,
        backend: Literal["auto", "cpu", "gpu"] = "auto",
        robot: Robot | None = None,
        task: str = "manipulation",
    ) -> None:
        self.kind, self.setup = kind, setup
        self.bench = setup.build_workbench(backend, robot)
        self.goal = Goal(task, text=setup.instruction)
        self.objects = tuple(sorted(setup.objects))  # a task may name the requested one first
        """Names of the objects whose positions agents know, in the order of their indices from 1."""

    def is_success(self) -> bool:
        """Return whether what is asked for is done."""
        return self.kind.is_success(self.bench, self.setup)
