# SPDX-License-Identifier: Apache-2.0
"""What a plan is truly worth, and which one truly leads on: answers for the stages of the loop that are told the truth.

Only the loop hands a guide on, to an agent with `swaps`; no policy and no world model is given one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.envs.trip import Trip

STRIDE, TURN = ActionSpace().forward_m, ActionSpace().turn_rad
HALF_CIRCLE = round(np.pi / TURN)
LONGEST = 25
"""Steps of a straight run that are looked at."""
LEAST_GAIN = 0.02
"""Metres nearer that are worth a run."""


class Judged(Protocol):
    """What a guide asks of its task."""

    def progress(self, trip: Trip, fork: Any, left: float) -> float: ...


class Way:
    """The shortest way to a destination, from anywhere in the scene."""

    def __init__(self, navmesh: Any, destination: NDArray[np.float64]) -> None:
        self._navmesh, self.destination = navmesh, np.asarray(destination, np.float64)
        on_mesh = navmesh.snap(self.destination)
        self._field = navmesh.distances_from(on_mesh) if np.isfinite(on_mesh).all() else None

    def metres(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """float64 [N]: length of the way from points [N, 3]; in a straight line where there is none."""
        straight = np.linalg.norm(points - self.destination, axis=1)
        if self._field is None:
            return straight
        walked = np.asarray(self._field(points), np.float64)
        return np.where(np.isfinite(walked), walked, straight)

    def left(self, fork: Any) -> float:
        """Primitives from where a fork of the simulator stands: strides, and turns towards the first of them."""
        metres = float(self.metres(fork.position[None])[0])
        if metres < STRIDE / 2:
            return metres / STRIDE
        ahead = self._first_stride(fork.position) - fork.position
        off = np.arctan2(-ahead[0], -ahead[2]) - fork.yaw
        return metres / STRIDE + abs(float(np.remainder(off + np.pi, 2 * np.pi) - np.pi)) / TURN

    def plan(self, fork: Any, length: int) -> NDArray[np.int8]:
        """int8 [length]: the way cut into primitives, one straight run after another; at its end turns on the spot."""
        here, plan = fork.fork(), list[int]()
        while len(plan) < length:
            run = self._run(here) or [int(TURN_LEFT)]
            for action in run:
                here.step(action)
            plan += run
        return np.array(plan[:length], np.int8)

    def _first_stride(self, position: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the way is a stride from its beginning."""
        if self._field is None or not np.isfinite(self._field(position[None])[0]):
            return self.destination
        bends = np.asarray(self._navmesh.shortest_path(position, self.destination), np.float64)
        walked = np.concatenate([[0.0], np.hypot(*np.diff(bends[:, [0, 2]], axis=0).T).cumsum()])
        return np.array([np.interp(STRIDE, walked, bends[:, axis]) for axis in range(3)])

    def _run(self, fork: Any) -> list[int]:
        """Of all turns with steps after them, the one that brings most metres a primitive; nothing where none does."""
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
        gains = self.metres(fork.position[None])[0] - self.metres(np.stack(ends))
        best = int(np.argmax(gains / [len(run) for run in runs]))
        return runs[best] if gains[best] > LEAST_GAIN else []


@dataclass(frozen=True)
class Guide:
    """The truth about plans from where an environment stands."""

    task: Judged
    trip: Trip
    fork: Any
    """Of the simulator."""
    way: Way

    def worth(self, actions: Sequence[int] | NDArray[np.int8]) -> float:
        """The furthest that a plan gets, by the task's `progress` after each of its primitives."""
        probe, found = self.fork.fork(), []
        for action in actions:
            probe.step(int(action))
            found.append(self.task.progress(self.trip, probe, self.way.left(probe)))
        return max(found)

    def plan(self, length: int) -> NDArray[np.int8]:
        """int8 [length]: the plan of an agent that knows the scene."""
        return self.way.plan(self.fork, length)
