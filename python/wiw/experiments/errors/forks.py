# SPDX-License-Identifier: Apache-2.0
"""Forks of the simulator that errors change: they know their world, so that a camera can go anywhere in it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import ActionSpace
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import World

LONGEST = ActionSpace().forward_m
"""Metres of one step; longer ways are gone in several, so that none leads through a wall."""


@dataclass(frozen=True)
class WorldFork:
    """A fork of the simulator together with the world that it is in."""

    core: Any
    """`wiw._core.env.NavigationEnv`."""
    world: World
    slides: bool
    """Whether blocked moves slide along what blocks them."""

    @property
    def renderer(self) -> Any:
        """The compiled renderer, shared by all forks."""
        return self.core.renderer

    def fork(self) -> WorldFork:
        """Return a copy that moves on its own."""
        return WorldFork(self.core.fork(), self.world, self.slides)

    def step(self, action: int) -> bool:
        """Carry out one primitive; return whether the pose changed."""
        return bool(self.core.step(action))

    def camera_poses_after(self, actions: NDArray[np.int8]) -> NDArray[np.float64]:
        """Return the cameras after each primitive, float64 [K, 4, 4]; nothing moves."""
        return np.asarray(self.core.camera_poses_after(actions))


class Walker:
    """A camera that goes ways of any length and direction from where a fork stands, as the simulator moves an agent.

    Args:
        fork: of the simulator; it does not move.
    """

    def __init__(self, fork: WorldFork) -> None:
        self._navmesh, self._ground, self._slides = fork.world.navmesh, fork.world.ground, fork.slides
        self._yaw = float(fork.core.yaw)
        self._place = np.asarray(self._navmesh.snap(fork.core.position), np.float64)

    def move(self, forward: float, left: float, turn: float, passes: bool = False) -> NDArray[np.float64]:
        """Go metres forward and to the left, then turn by radians to the left; return the camera, float64 [4, 4].

        A way that is blocked is gone as far as it is free, or all the same where it `passes`.
        """
        steps = math.ceil(math.hypot(forward, left) / LONGEST - 1e-9)
        for _ in range(steps):
            if not self._go(forward / steps, left / steps, passes):
                break
        self._yaw += turn
        return camera_pose(np.asarray(self._ground.put_down(self._place), np.float64), self._yaw)

    def _go(self, forward: float, left: float, passes: bool) -> bool:
        """Go one step as the simulator does; return whether it led all the way."""
        sin, cos = math.sin(self._yaw), math.cos(self._yaw)
        end = self._place + np.array([-sin * forward - cos * left, 0.0, -cos * forward + sin * left])
        if bool(self._navmesh.is_navigable(end)):
            self._place = np.asarray(self._navmesh.snap(end), np.float64)
            return True
        if passes:
            self._place = end
            return True
        if self._slides:
            self._place = np.asarray(self._navmesh.try_step(self._place, end, True), np.float64)
        return False
