# SPDX-License-Identifier: Apache-2.0
"""Robotic Manipulation: four tasks of an arm at a table (paper, appendix "Robotic Manipulation")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from wiw.envs.manipulation import ManipulationEnv
from wiw.errors import ArgumentError
from wiw.tabletop.kind import Kind, Setup, key_of
from wiw.tabletop.kinds import KINDS
from wiw.types import Episode, Goal, Wording


class Manipulation:
    """Push buttons, slide a block, put a ring on a peg, stack cups; told in words, done by gripper poses.

    Args:
        tasks: "all", or names of `KINDS`; episodes take them in turn.
        seed: of the episodes and of the run.
        actions: K, poses an episode may take.
    """

    name = "manipulation"
    metrics = ("success", "mean_trajectory")
    wording = Wording(succeeded="did what it was told", won="done", lost="not done", goal="what is left", asked="Told")

    def __init__(self, tasks: str | Sequence[str] = "all", seed: int = 0, actions: int = 15) -> None:
        names = tuple(KINDS) if tasks == "all" else tuple(tasks.split(",") if isinstance(tasks, str) else tasks)
        if unknown := [name for name in names if name not in KINDS]:
            raise ArgumentError(f"manipulation: expected tasks among {', '.join(KINDS)}, got {', '.join(unknown)}")
        if actions < 1:
            raise ArgumentError(f"manipulation: expected at least one action an episode, got {actions}")
        self.tasks, self.seed, self.actions = names, seed, actions
        self.defaults = {"candidates": 5, "horizon": 5, "execute": 5}

    def describe(self) -> dict[str, Any]:
        """JSON-able identity for the run's manifest."""
        return {"task": self.name, "tasks": list(self.tasks), "seed": self.seed, "actions": self.actions}

    def environment(self, depth: bool = False) -> ManipulationEnv:
        """An environment for the task's episodes."""
        return ManipulationEnv(self, depth)

    def episodes(self, count: int) -> list[Episode]:
        """The first so many."""
        return [self.episode(index) for index in range(count)]

    def episode(self, index: int) -> Episode:
        """A table of its own for each; variations are drawn by the seed."""
        name = self.tasks[index % len(self.tasks)]
        seed = key_of(self.seed, index, 0) % 2**31
        variation = index // len(self.tasks) % KINDS[name].variations
        here = (0.0, 0.0, 0.0)
        info = {"task": name, "seed": seed, "variation": variation}
        return Episode(f"{index:04d}", f"{name}/{seed}", here, 0.0, here, 0.0, float("nan"), info)

    def table(self, episode: Episode) -> Table:
        """An episode's table, at rest."""
        kind = KINDS[episode.info["task"]]
        return Table(kind, kind.setup(int(episode.info["seed"]), int(episode.info["variation"])))


class Table:
    """One episode's table in the course of time."""

    def __init__(self, kind: Kind, setup: Setup) -> None:
        self.kind, self.setup = kind, setup
        self.bench = setup.bench()
        self.goal = Goal(Manipulation.name, text=setup.instruction)
        self.objects = setup.objects

    def succeeded(self) -> bool:
        """Whether what is asked for is done."""
        return self.kind.succeeded(self.bench, self.setup)
