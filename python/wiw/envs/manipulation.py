# SPDX-License-Identifier: Apache-2.0
"""Manipulation episodes as a gymnasium environment, one gripper pose a step."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from wiw.action import PoseGrid
from wiw.envs.base import Env, Segment, read_episode_number
from wiw.envs.manipulation_spec import ManipulationSpec
from wiw.envs.sensors import Sensors
from wiw.envs.table_guide import TableGuide
from wiw.errors import ArgumentError
from wiw.tabletop.table import Table
from wiw.tabletop.workbench import WRIST, Pose, Workbench
from wiw.types import Answer, ArmObservation, CameraView, Episode, Goal, Key, TextAnswer, Truth

LEAST, MOST = np.array([-2.0] * 3 + [-7.0] * 3 + [0.0]), np.array([2.0] * 3 + [7.0] * 3 + [1.0])
"""Poses between these are in the action space; none beyond can be reached."""


class ManipulationEnv(gymnasium.Env[dict[str, Any], NDArray[np.float64]], Env):
    """A robot arm at a table, with an instruction in words.

    Actions are absolute poses float64 [7] of the gripper: x, y, z in metres, roll, pitch, yaw, and how open it is. A
    way that leads into the table or out of reach is gone as far as it is free, and recorded. Success is rewarded by 1.

    Observations are dicts: "front" uint8 [size, size, 3]; "pose" float64 [7], "joints" float64 [9] (the Panda's and its
    fingers') and "held" (1 while the gripper holds something). Requested inputs come on top, for each camera.

    Args:
        task: whose episodes are run.
        depth: whether to give "depth" float32 [size, size]: planar metres, 0 where nothing is hit.
        size: pixels of a side of all pictures; policies and world models of the loop see the front view in it too.
        cameras: "wrist", "left_shoulder", "right_shoulder"; theirs are "wrist", "wrist_depth", "wrist_ids".
        ids: whether to give "ids" uint8 [size, size]: 0 room, 255 arm, else the object's number in `info["objects"]`,
            from 1.
        cloud: whether to give "points" float32 [N, 3] and "colors" uint8 [N, 3] of all cameras' pixels, in the world's
            frame; where nothing is hit, a point is at its camera.
        grid: whether `step` takes whole numbers [7], as `wiw.action.PoseGrid` reads them, instead of poses.

    Raises:
        ArgumentError: no such camera, or a size below 1.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - gymnasium's name and type

    def __init__(
        self,
        task: ManipulationSpec,
        depth: bool = False,
        *,
        size: int = 480,
        cameras: Sequence[str] = (),
        ids: bool = False,
        cloud: bool = False,
        grid: bool = False,
    ) -> None:
        joints = len(task.robot.description.joints)
        self.task, self.sensors = task, Sensors(size, tuple(cameras), depth, ids, cloud, joints)
        self.grid = PoseGrid() if grid else None
        self.render_mode = "rgb_array"
        self.action_space = action_space(self.grid)
        self.observation_space = observation_space(self.sensors)
        self._table: Table | None = None
        self._observation: ArmObservation | None = None
        self._drawn: dict[str, dict[str, NDArray[Any]]] = {}
        self._taken = self._decisions = self._next = 0
        self._refused: list[str] = []
        self._over = False
        self._key = Key(task.seed, 0)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode: `options={"episode": 3}`, or the next one; `seed` draws one at random.

        Raises:
            ArgumentError: an unknown option, or no whole number of at least 0.
        """
        super().reset(seed=seed)
        index = read_episode_number(options)
        if index is None:
            index = int(self.np_random.integers(1000)) if seed is not None else self._next
        self.begin(self.task.episode(index))
        self._next, self._key = index + 1, Key(self.task.seed, index)
        info = {"key": self._key, "instruction": self.goal.text, "objects": tuple(self.table.objects)}
        return self._read_sensors(), info

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Go to one pose, which counts as one decision.

        Raises:
            ArgumentError: no finite pose [7] with a gripper from 0 to 1, nor, with `grid`, whole numbers [7]; or the
                episode has ended; nothing has moved then.
        """
        pose = np.asarray(action) if self.grid is None else self.grid.decode(action)
        segment = self.run(pose[None])
        info: dict[str, Any] = {"key": segment.key, "refused": segment.refused}
        if segment.terminated or segment.truncated:
            info["result"] = self.result()
        return self._read_sensors(), float(segment.terminated), segment.terminated, segment.truncated, info

    def render(self) -> NDArray[np.uint8]:
        """Return the front view."""
        return self.observation.front

    # -- the loop ------------------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> ArmObservation:
        """Start a given episode and observe."""
        self._table = self.task.set_table(episode)
        self._taken = self._decisions = 0
        self._refused, self._over = [], False
        return self._observe()

    def run(self, plan: ArrayLike, answer: Answer | TextAnswer | None = None) -> Segment:
        """Carry out one decision's poses [K, 7], as far as the episode continues; observe once, at the end.

        Raises:
            ArgumentError: as `check_poses`, or the episode has ended; nothing has moved then.
        """
        table, poses, executed, refused = self.table, check_poses(plan), [], []
        if self._over:
            raise ArgumentError("run: the episode has ended; call reset() to start another")
        path = [table.bench.pose[:3]]
        for pose in poses[: self.task.actions - self._taken]:
            move = table.bench.move_to(pose)
            executed.append(pose)
            path.append(table.bench.pose[:3])
            refused += [] if move.reason == "free" else [move.reason]
            if table.is_success():
                break
        self._decisions += 1
        self._taken += len(executed)
        self._refused += refused
        self._key = self._key.at(self._key.decision + 1)
        done = table.is_success()
        over = not done and self._taken >= self.task.actions
        self._over = done or over
        taken = np.array(executed).reshape(-1, 7)
        return Segment(self._observe(), taken, np.stack(path), done, over, self._key, tuple(refused))

    @property
    def goal(self) -> Goal:
        """The goal of the running episode."""
        return self.table.goal

    @property
    def observation(self) -> ArmObservation:
        """The agent's present view."""
        self._require_episode()
        assert self._observation is not None
        return self._observation

    @property
    def table(self) -> Table:
        """The running episode's table; privileged."""
        self._require_episode()
        assert self._table is not None
        return self._table

    def fork(self) -> Workbench:
        """Return a copy of the physics, which the oracle runs ahead; this environment does not move."""
        return self.table.bench.fork()

    def guide(self) -> TableGuide:
        """Return the truth about plans from here, for stages of the loop that an experiment tells it."""
        return TableGuide(self.task, self.table, self.fork())

    def truth(self) -> Truth:
        """Return where the gripper is, for records and reports alone; no distance leads to what is requested."""
        return Truth(self.table.bench.pose[:3], 0.0, float("nan"), float("nan"))

    def result(self) -> dict[str, float]:
        """Return the metrics of the running episode: success (0 or 1), `actions` (decisions, as the paper counts),
        poses gone to, and ways refused.
        """
        return {
            "success": float(self.table.is_success()),
            "actions": float(self._decisions),
            "poses": float(self._taken),
            "refused": float(len(self._refused)),
        }

    # ------------------------------------------------------------------------------------------------------------------

    def _observe(self) -> ArmObservation:
        bench = self.table.bench
        seen = [name for name in ("front", WRIST) if name in self.sensors.names]
        self._drawn = {name: self.sensors.pictures(bench, name) for name in seen}
        front = self._drawn["front"]
        places: dict[str, Pose] = bench.get_poses(self.table.objects)
        depth = front["depth"] if self.sensors.depth else None
        self._observation = ArmObservation(front["color"], bench.pose, depth, places, self._view_from_wrist())
        return self._observation

    def _view_from_wrist(self) -> CameraView | None:
        if WRIST not in self._drawn:
            return None
        drawn = self._drawn[WRIST]
        depth = drawn["depth"] if self.sensors.depth else None
        return CameraView(drawn["color"], self.table.bench.get_camera_pose(WRIST), depth)

    def _read_sensors(self) -> dict[str, Any]:
        """The observation as gymnasium knows it, with what the loop has no use for."""
        return self.sensors.read(self.table.bench, self.table.objects, self._drawn)

    def _require_episode(self) -> None:
        if self._table is None:
            raise ArgumentError("the environment has no episode yet; call reset() first")


@cache
def observation_space(sensors: Sensors) -> spaces.Dict:
    """Return what an environment with these sensors shows; shared by all of them, as its bounds are large."""
    return sensors.space()


def action_space(grid: PoseGrid | None) -> spaces.Space[Any]:
    """Return poses, or whole numbers that a grid reads."""
    if grid is None:
        return spaces.Box(LEAST, MOST, dtype=np.float64)
    return spaces.MultiDiscrete([grid.bins] * 3 + [grid.turns] * 3 + [2])


def check_poses(plan: ArrayLike) -> NDArray[np.float64]:
    """Return a plan as poses float64 [K, 7].

    Raises:
        ArgumentError: another shape, a value that is not finite, or a gripper outside [0, 1].
    """
    try:
        poses = np.asarray(plan, np.float64)
    except (TypeError, ValueError):
        raise ArgumentError(f"run: expected poses [K, 7], got {plan!r}") from None
    if poses.ndim != 2 or poses.shape[1] != 7 or not len(poses):
        raise ArgumentError(f"run: expected poses [K, 7], got {list(poses.shape)}")
    finite, open_by = np.isfinite(poses).all(axis=1), poses[:, 6]
    wrong = np.flatnonzero(~finite | ~((open_by >= 0) & (open_by <= 1)))
    if len(wrong):
        number = int(wrong[0])
        raise ArgumentError(
            f"run: expected finite poses with a gripper from 0 to 1, got {poses[number].tolist()} as number {number}"
        )
    return poses
