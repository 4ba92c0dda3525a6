# SPDX-License-Identifier: Apache-2.0
"""Errors of control: true views, but not from where the plan leads. The oracle executes a different plan in its fork.

In plans of primitives the camera is moved in the world of the episode, under its rule for blocked moves, by strides of
any length; the turns that a plan begins with are real views and stay as they are. In plans of poses the gripper is sent
to other poses.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, ActionSpace
from wiw.errors import ArgumentError
from wiw.experiments.errors.base import Degradation, make_generator, per_space
from wiw.experiments.errors.forks import Walker, WorldFork
from wiw.metrics import pose_error
from wiw.tabletop.workbench import Workbench
from wiw.types import GRIPPER_POSES, Conditioning, Control
from wiw.world_models.base import WorldModel

STRIDE, TURN = ActionSpace().forward_m, ActionSpace().turn_rad

Moves = NDArray[np.float64]
"""float64 [K, 3]: metres forward and left and radians to the left of each action of a plan."""
Poses = NDArray[np.float64]
"""float64 [K + 1, 7]: poses of a gripper, the present one first."""


class MotionDegradation(Degradation):
    """An error in the imagined motion."""

    family = "control"

    def rollout(
        self,
        model: WorldModel,
        observations: Conditioning,
        controls: Sequence[Control],
        seeds: NDArray[np.uint64],
    ) -> NDArray[np.uint8]:
        """Return what the oracle truly sees where this error takes it."""
        assert observations.simulators is not None
        if model.accepts.space == GRIPPER_POSES:
            triples = zip(controls, observations.simulators, seeds, strict=True)
            changed = [
                replace(own, ids=self._send_gripper(_make_idle(np.asarray(own.ids, np.float64), bench), int(seed)))
                for own, bench, seed in triples
            ]
            return model.rollout(observations, changed, seeds)
        forks = zip(observations.simulators, seeds, strict=True)
        errant = [_ErrantFork(fork, self, int(seed)) for fork, seed in forks]
        return model.rollout(replace(observations, simulators=errant), controls, seeds)

    def misplace(self, simulator: Any, actions: NDArray[Any], seed: int) -> NDArray[np.float64]:
        """See `Degradation.misplace`."""
        if isinstance(simulator, WorldFork):
            metres, angles = pose_error(
                simulator.camera_poses_after(actions), self.find_camera_poses(simulator, actions, seed)
            )
            return np.stack([metres, np.degrees(angles)], axis=1)
        poses = np.concatenate([simulator.pose[None], actions])
        off = np.linalg.norm(self._send_gripper(poses, seed)[1:, :3] - poses[1:, :3], axis=1)
        return np.stack([off, np.zeros(len(off))], axis=1)

    def find_camera_poses(self, fork: WorldFork, actions: NDArray[np.int8], seed: int) -> NDArray[np.float64]:
        """Return the cameras from which a plan is imagined, float64 [K, 4, 4]."""
        if not len(actions):
            return np.empty((0, 4, 4))
        walker = Walker(fork)
        return np.stack([walker.move(*move) for move in self.change_moves(list_moves(actions), make_generator(seed))])

    def _send_gripper(self, poses: Any, seed: int) -> Poses:
        return self.change_poses(np.array(poses, np.float64), make_generator(seed))

    @abstractmethod
    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return the moves that are imagined instead of the plan's."""

    @abstractmethod
    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return the poses that are imagined instead of the plan's; the first one is unchanged."""


@dataclass(frozen=True)
class _ErrantFork:
    """Stands in for a fork of the simulator, and executes a different plan than the requested one."""

    fork: WorldFork
    error: MotionDegradation
    seed: int

    @property
    def renderer(self) -> Any:
        return self.fork.renderer

    def camera_poses_after(self, actions: NDArray[np.int8]) -> NDArray[np.float64]:
        return self.error.find_camera_poses(self.fork, actions, self.seed)


def _make_idle(poses: Poses, bench: Workbench) -> Poses:
    """Return the poses, the present one as an action that changes nothing: an error may repeat it as one."""
    return np.concatenate([bench.idle_action[None], poses[1:]])


def list_moves(actions: NDArray[np.int8]) -> Moves:
    """Return the moves of a plan as it is."""
    known = {int(FORWARD): (STRIDE, 0.0, 0.0), int(TURN_LEFT): (0.0, 0.0, TURN), int(TURN_RIGHT): (0.0, 0.0, -TURN)}
    return np.array([known.get(int(action), (0.0, 0.0, 0.0)) for action in actions]).reshape(-1, 3)


class Scale(MotionDegradation):
    """Motion that leads too far."""

    kind = "scale"
    about = "Makes each step, each turn and each gripper motion longer."
    unit = "added share of the true length"
    doses = per_space((0.5, 1.0, 2.0), (0.25, 0.5, 1.0))

    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return longer moves."""
        return moves * (1 + self.dose)

    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return poses further from the present one, in metres; orientation and gripper stay as planned."""
        found = poses.copy()
        found[:, :3] = poses[0, :3] + (1 + self.dose) * (poses[:, :3] - poses[0, :3])
        return found


class Direction(MotionDegradation):
    """Motion to one side."""

    kind = "direction"
    about = "Turns each step to one side of its heading, and each gripper motion about the vertical."
    unit = "degrees; the side is random for each future"
    doses = per_space((30.0, 90.0, 180.0), (10.0, 30.0, 90.0))
    most = 180.0
    draws_future = True

    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return moves to the side; the camera looks where it should."""
        angle = _draw_side(generator) * np.radians(self.dose)
        found = moves.copy()
        found[:, 0] = np.cos(angle) * moves[:, 0] - np.sin(angle) * moves[:, 1]
        found[:, 1] = np.sin(angle) * moves[:, 0] + np.cos(angle) * moves[:, 1]
        return found

    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return poses whose way from the present one is turned."""
        angle = _draw_side(generator) * np.radians(self.dose)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        found = poses.copy()
        found[:, :2] = poses[0, :2] + (poses[:, :2] - poses[0, :2]) @ turn.T
        return found


class Lag(MotionDegradation):
    """Frames that lag behind the plan."""

    kind = "lag"
    about = "Shows after each action the frame that followed an earlier one."
    unit = "actions"
    doses = per_space((1.0, 2.0, 4.0), (1.0, 2.0, 3.0))

    def __init__(self, dose: float) -> None:
        super().__init__(dose)
        if not self.dose.is_integer():
            raise ArgumentError(f"error 'lag': expected a whole number of actions as dose, got {dose:g}")

    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return no move at first, then the plan's."""
        return np.concatenate([np.zeros_like(moves), moves])[len(moves) - self._count_late(moves) :][: len(moves)]

    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return the present pose at first, then the plan's."""
        late = self._count_late(poses)
        return np.concatenate([np.repeat(poses[:1], late, axis=0), poses])[: len(poses)]

    def _count_late(self, plan: NDArray[np.float64]) -> int:
        return int(min(self.dose, len(plan)))


class Drift(MotionDegradation):
    """Motion that slips to one side, whatever the action."""

    kind = "drift"
    about = "Shifts the camera, or the gripper, sideways with every action."
    unit = "metres per action; the direction is random for each future"
    doses = per_space((0.05, 0.1, 0.2), (0.02, 0.05, 0.1))
    draws_future = True

    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return the moves with a step to the left or to the right in each."""
        return moves + np.array([0.0, _draw_side(generator) * self.dose, 0.0])

    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return poses ever further from the plan's, in one horizontal direction."""
        angle = generator.uniform(0, 2 * np.pi)
        found = poses.copy()
        found[:, :2] += self.dose * np.arange(len(poses))[:, None] * np.array([np.cos(angle), np.sin(angle)])
        return found


class Ignored(MotionDegradation):
    """Actions without effect."""

    kind = "ignored"
    about = "Ignores random actions: nothing moves after them."
    unit = "share of the actions"
    doses = per_space((0.25, 0.5, 1.0))
    most = 1.0
    draws_future = True

    def change_moves(self, moves: Moves, generator: np.random.Generator) -> Moves:
        """Return the moves with no move where an action is ignored."""
        return np.where(generator.random(len(moves))[:, None] < self.dose, 0.0, moves)

    def change_poses(self, poses: Poses, generator: np.random.Generator) -> Poses:
        """Return the poses with the one before where an action is ignored."""
        kept = np.concatenate([[True], generator.random(len(poses) - 1) >= self.dose])
        return np.asarray(poses[np.maximum.accumulate(np.where(kept, np.arange(len(poses)), 0))])


def _draw_side(generator: np.random.Generator) -> float:
    """Return 1 for the left or -1 for the right."""
    return 1.0 if generator.random() < 0.5 else -1.0
