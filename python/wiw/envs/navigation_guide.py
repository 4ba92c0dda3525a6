# SPDX-License-Identifier: Apache-2.0
"""Ground truth about navigation plans: how good a plan is, and which plan leads to the goal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.envs.base import Guide
from wiw.envs.episode_state import EpisodeState, NavigationSpec

STRIDE, TURN = ActionSpace().forward_m, ActionSpace().turn_rad
HALF_CIRCLE = round(np.pi / TURN)
LONGEST = 25
"""Steps of a straight run that are looked at."""
LEAST_GAIN = 0.02
"""Metres nearer that are worth a run."""


class ShortestPath:
    """The shortest path to a destination, from anywhere in the scene."""

    def __init__(self, navmesh: Any, destination: NDArray[np.float64]) -> None:
        self._navmesh, self.destination = navmesh, np.asarray(destination, np.float64)
        on_mesh = navmesh.snap(self.destination)
        self._field = navmesh.distances_from(on_mesh) if np.isfinite(on_mesh).all() else None

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the metres from points [N, 3] on, float64 [N]; in a straight line if there is no path."""
        straight = np.linalg.norm(points - self.destination, axis=1)
        if self._field is None:
            return straight
        walked = np.asarray(self._field(points), np.float64)
        return np.where(np.isfinite(walked), walked, straight)

    def count_primitives(self, fork: Any) -> float:
        """Return the primitives from where a fork of the simulator stands: strides, and turns towards the first."""
        metres = float(self.distances(fork.position[None])[0])
        if metres < STRIDE / 2:
            return metres / STRIDE
        ahead = self._find_first_stride(fork.position) - fork.position
        off = np.arctan2(-ahead[0], -ahead[2]) - fork.yaw
        return metres / STRIDE + abs(float(np.remainder(off + np.pi, 2 * np.pi) - np.pi)) / TURN

    def find_plan(self, fork: Any, length: int) -> NDArray[np.int8]:
        """Return the path as primitives, int8 [length], straight run by straight run; at its end turns on the spot."""
        here, plan = fork.fork(), list[int]()
        while len(plan) < length:
            run = self._find_best_run(here) or [int(TURN_LEFT)]
            for action in run:
                here.step(action)
            plan += run
        return np.array(plan[:length], np.int8)

    def _find_first_stride(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the path is a stride from its beginning."""
        if self._field is None or not np.isfinite(self._field(position[None])[0]):
            return self.destination
        bends = np.asarray(self._navmesh.shortest_path(position, self.destination), np.float64)
        walked = np.concatenate([[0.0], np.hypot(*np.diff(bends[:, [0, 2]], axis=0).T).cumsum()])
        return np.array([np.interp(STRIDE, walked, bends[:, axis]) for axis in range(3)])

    def _find_best_run(self, fork: Any) -> list[int]:
        """Return the turns and steps after them that gain most metres per primitive; nothing where none gain."""
        runs, ends = [], []
        for turns in range(1 - HALF_CIRCLE, HALF_CIRCLE + 1):
            turned = [int(TURN_LEFT if turns > 0 else TURN_RIGHT)] * abs(turns)
            probe = fork.fork()
            for action in turned:
                probe.step(action)
            for steps in range(1, LONGEST + 1):
                if not probe.step(int(FORWARD)):
                    break
                runs.append([*turned, *[int(FORWARD)] * steps])
                ends.append(probe.position)
        if not runs:
            return []
        gains = self.distances(fork.position[None])[0] - self.distances(np.stack(ends))
        best = int(np.argmax(gains / [len(run) for run in runs]))
        return runs[best] if gains[best] > LEAST_GAIN else []


@dataclass(frozen=True)
class NavigationGuide(Guide):
    """Ground truth about plans of primitives."""

    task: NavigationSpec
    state: EpisodeState
    fork: Any
    """Fork of the simulator."""
    path: ShortestPath

    def evaluate_plan(self, plan: Sequence[int] | NDArray[np.int8]) -> float:
        """Return the task's progress at a plan's end, at a stop, or at the first primitive that gets all the way."""
        probe, found = self.fork.fork(), -np.inf
        for action in plan:
            probe.step(int(action))
            found = self.task.measure_progress(self.state, probe, self.path.count_primitives(probe))
            if action == STOP or found >= self.task.complete_progress:
                break
        return found

    def suggest_plan(self, length: int) -> NDArray[np.int8]:
        """Return the plan of an agent that knows the scene, int8 [length]."""
        return self.path.find_plan(self.fork, length)
