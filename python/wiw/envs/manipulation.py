# SPDX-License-Identifier: Apache-2.0
"""Manipulation episodes as a gymnasium environment, one gripper pose a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from wiw.errors import ArgumentError
from wiw.render import Output
from wiw.tabletop.workbench import Pose, Workbench
from wiw.types import ArmObservation, Episode, Goal, Key, Truth

SIZE = (480, 480)
"""Pixels of the front view."""


class Table(Protocol):
    """One episode's table, as a task has set it."""

    @property
    def bench(self) -> Workbench:
        """The arm and the things."""

    @property
    def goal(self) -> Goal:
        """What the agent is asked to do."""

    @property
    def objects(self) -> Sequence[str]:
        """Names of what agents are told the place of."""

    def succeeded(self) -> bool:
        """Whether what is asked for is done."""


class ManipulationTask(Protocol):
    """What the environment asks of a task."""

    @property
    def seed(self) -> int:
        """Of the run."""

    @property
    def actions(self) -> int:
        """K: poses an episode may take."""

    def episode(self, index: int) -> Episode:
        """An episode by its number."""

    def table(self, episode: Episode) -> Table:
        """An episode's table, as it begins."""


@dataclass(frozen=True)
class Segment:
    """What carrying out several poses came to."""

    observation: ArmObservation
    executed: NDArray[np.float64]
    path: NDArray[np.float64]
    """float64 [n + 1, 3]: places of the gripper."""
    terminated: bool
    truncated: bool
    key: Key
    """Of the next decision."""
    refused: tuple[str, ...] = ()
    """Why ways were not gone to their ends, one an action that was not."""


class ManipulationEnv(gymnasium.Env[dict[str, Any], NDArray[np.float64]]):
    """An arm at a table that is told in words what to do.

    Actions are absolute poses float64 [7] of the gripper: x, y, z in metres, roll, pitch, yaw, and how open it is. A
    way that leads into the table or out of reach is gone as far as it is free, and recorded. Observations are dicts:
    "front" uint8 [480, 480, 3], "pose" float64 [7], "depth" float32 [480, 480] where asked for. The reward is 1 on
    success.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - gymnasium's name and type

    def __init__(self, task: ManipulationTask, depth: bool = False) -> None:
        self.task, self.depth = task, depth
        self.render_mode = "rgb_array"
        least, most = np.array([-2.0] * 3 + [-7.0] * 3 + [0.0]), np.array([2.0] * 3 + [7.0] * 3 + [1.0])
        self.action_space = spaces.Box(least, most, dtype=np.float64)
        seen: dict[str, Any] = {
            "front": spaces.Box(0, 255, (*SIZE, 3), np.uint8),
            "pose": spaces.Box(-np.inf, np.inf, (7,), np.float64),
        }
        if depth:
            seen["depth"] = spaces.Box(0, np.inf, SIZE, np.float32)
        self.observation_space = spaces.Dict(seen)
        self._table: Table | None = None
        self._observation: ArmObservation | None = None
        self._taken = self._decisions = self._next = 0
        self._refused: list[str] = []
        self._key = Key(task.seed, 0)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode: `options={"episode": 3}`, or the next one; `seed` draws one at random."""
        super().reset(seed=seed)
        index = (options or {}).get("episode")
        if index is None:
            index = int(self.np_random.integers(1000)) if seed is not None else self._next
        observation = self.begin(self.task.episode(int(index)))
        self._next, self._key = int(index) + 1, Key(self.task.seed, int(index))
        return observation.as_dict(), {"key": self._key, "instruction": self.goal.text}

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Goes to one pose, which is a decision of its own.

        Raises:
            ArgumentError: no finite pose [7] with a gripper from 0 to 1; nothing has moved then.
        """
        segment = self.run(np.asarray(action, np.float64)[None])
        info: dict[str, Any] = {"key": segment.key, "refused": segment.refused}
        if segment.terminated or segment.truncated:
            info["result"] = self.result()
        return segment.observation.as_dict(), float(segment.terminated), segment.terminated, segment.truncated, info

    def render(self) -> NDArray[np.uint8]:
        """The front view."""
        return self.observation.front

    # -- the loop ------------------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> ArmObservation:
        """Starts a given episode and observes."""
        self._table = self.task.table(episode)
        self._taken = self._decisions = 0
        self._refused = []
        return self._observe()

    def run(self, plan: ArrayLike) -> Segment:
        """Carries out one decision's poses [K, 7], as far as the episode goes on; observes once, at the end."""
        table, executed, refused = self.table, [], []
        path = [table.bench.pose[:3]]
        for pose in np.asarray(plan, np.float64)[: self.task.actions - self._taken]:
            move = table.bench.go(pose)
            executed.append(pose)
            path.append(table.bench.pose[:3])
            refused += [] if move.why == "free" else [move.why]
            if table.succeeded():
                break
        self._decisions += 1
        self._taken += len(executed)
        self._refused += refused
        self._key = self._key.at(self._key.decision + 1)
        done = table.succeeded()
        over = not done and self._taken >= self.task.actions
        taken = np.array(executed).reshape(-1, 7)
        return Segment(self._observe(), taken, np.stack(path), done, over, self._key, tuple(refused))

    @property
    def goal(self) -> Goal:
        """What the agent is asked to do."""
        return self.table.goal

    @property
    def observation(self) -> ArmObservation:
        """What the agent perceives now."""
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
        """The physics as they stand, to be run ahead by the oracle; this environment does not move."""
        return self.table.bench.fork()

    def truth(self) -> Truth:
        """Where the gripper is, at distance 0 when what is asked for is done, else 1; for records and reports alone."""
        return Truth(self.table.bench.pose[:3], 0.0, float(not self.table.succeeded()), float("nan"))

    def result(self) -> dict[str, float]:
        """Metrics of the running episode: success (0 or 1), `actions` (decisions, as the paper counts), poses gone to,
        and ways refused.
        """
        return {
            "success": float(self.table.succeeded()),
            "actions": float(self._decisions),
            "poses": float(self._taken),
            "refused": float(len(self._refused)),
        }

    # ------------------------------------------------------------------------------------------------------------------

    def _observe(self) -> ArmObservation:
        bench = self.table.bench
        outputs: tuple[Output, ...] = ("color", "depth") if self.depth else ("color",)
        seen = bench.picture("front", SIZE, outputs)
        places: dict[str, Pose] = bench.places(self.table.objects)
        self._observation = ArmObservation(seen["color"], bench.pose, seen.get("depth"), places)
        return self._observation

    def _require_episode(self) -> None:
        if self._table is None:
            raise ArgumentError("the environment has no episode yet; call reset() first")
