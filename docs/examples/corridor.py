# SPDX-License-Identifier: Apache-2.0
"""A task of one's own in one file: walk down a corridor to the red door at its end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.envs import Segment
from wiw.types import Answer, Episode, Goal, Observation, Truth

STEP, TURN, NEAR = 0.2, np.pi / 8, 0.5


class CorridorEnv(wiw.Env):
    """A straight line; the agent sees how far away the door is by how wide it looks."""

    def __init__(self, task: Corridor, depth: bool) -> None:
        self.task, self.depth = task, depth

    def begin(self, episode: Episode) -> Observation:
        self.length, self.x, self.yaw, self.actions = episode.geodesic, 0.0, 0.0, 0
        return self.observation

    def run(self, plan: Sequence[int], answer: Answer | None = None) -> Segment:
        executed, path = [], [self._position()]
        for action in plan:
            self.yaw += TURN * ((action == TURN_LEFT) - int(action == TURN_RIGHT))
            self.x += STEP * np.cos(self.yaw) * (action == FORWARD)
            executed.append(action)
            path.append(self._position())
            if self._reached():
                break
        self.actions += len(executed)
        truncated = not self._reached() and self.actions >= self.task.budget
        return Segment(self.observation, np.array(executed), np.array(path), self._reached(), truncated)

    @property
    def goal(self) -> Goal:
        return Goal(self.task.name, image=np.full((480, 480, 3), (200, 30, 30), np.uint8))

    @property
    def observation(self) -> Observation:
        panorama = np.full((576, 1024, 3), 200, np.uint8)
        middle, half = int(512 + self.yaw / (2 * np.pi) * 1024) % 1024, int(80 / max(self._left(), 0.2))
        columns = (np.arange(-half, half) + middle) % 1024
        panorama[188:388, columns] = (200, 30, 30)
        front = wiw.panorama.to_perspective(panorama, 90.0, (480, 480))
        depth = np.full((576, 1024), self._left(), np.float32) if self.depth else None
        return Observation(panorama, front, np.array([self.x, 0.0, self.yaw]), depth)

    def truth(self) -> Truth:
        return Truth(self._position(), self.yaw, self._left(), self._left())

    def result(self) -> dict[str, float]:
        return {"success": float(self._reached()), "actions": float(self.actions)}

    def _left(self) -> float:
        return abs(self.length - self.x)

    def _reached(self) -> bool:
        return self._left() < NEAR

    def _position(self) -> np.ndarray:
        return np.array([self.x, 0.0, 0.0])


class Corridor(wiw.Task):
    """Corridors of 1 to 3 metres."""

    name = "corridor"
    default_policy = "heuristic"

    def __init__(self, seed: int = 0, budget: int = 30) -> None:
        self.seed, self.budget = seed, budget

    def describe(self) -> dict[str, Any]:
        return {"task": self.name, "seed": self.seed, "budget": self.budget}

    def environment(self, depth: bool = False) -> CorridorEnv:
        return CorridorEnv(self, depth)

    def episodes(self, count: int) -> list[Episode]:
        lengths = np.random.default_rng(self.seed).uniform(1, 3, count)
        start = (0.0, 0.0, 0.0)
        return [
            Episode(f"{i:04d}", "corridor", start, 0.0, (length, 0.0, 0.0), 0.0, length)
            for i, length in enumerate(lengths.tolist())
        ]
