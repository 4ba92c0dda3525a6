# SPDX-License-Identifier: Apache-2.0
"""Navigation episodes as a gymnasium environment, one primitive a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wiw.envs.trip import PRIMITIVES, NavigationTask, Trip, drawn, known, observation_space, outputs, start
from wiw.errors import ArgumentError
from wiw.types import Episode, Goal, Key, Observation, Truth


@dataclass(frozen=True)
class Segment:
    """What carrying out several primitives came to."""

    observation: Observation
    executed: NDArray[np.int8]
    path: NDArray[np.float64]
    terminated: bool
    truncated: bool
    key: Key
    """Of the next decision."""


class NavigationEnv(gymnasium.Env[dict[str, Any], int]):
    """An agent that sees a panorama and a front view and moves by 0.2 m or turns by 22.5 degrees.

    Observations are dicts: "panorama" uint8 [576, 1024, 3], "front" uint8 [480, 480, 3] (HFOV 90), "odometry"
    float64 [3], and "depth" float32 [576, 1024] where asked for. The reward is 1 on reaching the goal. Where the agent
    truly is stays in `truth()`, outside observation and info.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - gymnasium's name and type

    def __init__(self, task: NavigationTask, depth: bool = False) -> None:
        self.task = task
        self.render_mode = "rgb_array"
        self.outputs = outputs(depth)
        self.action_space = gymnasium.spaces.Discrete(len(PRIMITIVES))  # type: ignore[assignment]
        self.observation_space = observation_space(depth)
        self._core: Any = None
        self._trip: Trip | None = None
        self._goal: Goal | None = None
        self._observation: Observation | None = None
        self._next = 0
        self._key = Key(task.seed, 0)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode: `options={"episode": 3}`, or the next one; `seed` draws one at random.

        `info["key"]` names the decision that is due, for `agent.decide`; every step gives the next one.
        """
        super().reset(seed=seed)
        index = (options or {}).get("episode")
        if index is None:
            index = drawn(self.task, self.np_random) if seed is not None else self._next
        index = known(self.task, int(index))
        observation = self.begin(self.task.episode(index))
        self._next = index + 1
        self._key = Key(self.task.seed, index)
        return observation.as_dict(), {"key": self._key}

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carries out one primitive: 0 forward, 1 turn left, 2 turn right, 3 stop."""
        if not self.action_space.contains(action):
            raise ArgumentError(f"step: expected an action from 0 to {len(PRIMITIVES) - 1}, got {action!r}")
        segment = self._carry_out([PRIMITIVES[action]])
        info: dict[str, Any] = {"key": segment.key}
        if segment.terminated or segment.truncated:
            info["result"] = self.result()
        return segment.observation.as_dict(), float(self.trip.success), segment.terminated, segment.truncated, info

    def render(self) -> NDArray[np.uint8]:
        """The front view."""
        return self._seen.front

    # -- the loop ------------------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> Observation:
        """Starts a given episode and observes."""
        self._core, self._trip, self._goal = start(self.task, episode)
        return self._observe()

    def run(self, actions: Sequence[int] | NDArray[np.int8]) -> Segment:
        """Carries out one decision's primitives, as far as the episode goes on; observes once, at the end."""
        self.trip.decisions += 1
        return self._carry_out(actions)

    def _carry_out(self, actions: Sequence[int] | NDArray[np.int8]) -> Segment:
        trip, executed = self.trip, []
        first = len(trip.positions) - 1
        done = False
        for i, action in enumerate(actions):
            self._core.step(int(action))
            executed.append(int(action))
            done = trip.note(self.task, int(action), self._core.position, at_decision=i + 1 == len(actions))
            if done:
                break
        path = np.stack(trip.positions[first:])
        self._key = self._key.at(self._key.decision + 1)
        over = trip.spent(self.task) and not done
        return Segment(self._observe(), np.array(executed, np.int8), path, done, over, self._key)

    @property
    def goal(self) -> Goal:
        """What the agent is asked to reach."""
        self._require_episode()
        assert self._goal is not None
        return self._goal

    def fork(self) -> Any:
        """The simulator as it stands, to be run ahead by the oracle; this environment does not move."""
        self._require_episode()
        return self._core.fork()

    # -- privileged ----------------------------------------------------------------------------------------------------

    @property
    def trip(self) -> Trip:
        """The privileged record of the running episode."""
        self._require_episode()
        assert self._trip is not None
        return self._trip

    def truth(self) -> Truth:
        """Where the agent truly is; for metrics, records and reports alone."""
        return self.trip.truth(self._core.yaw)

    def result(self) -> dict[str, float]:
        """The task's metrics of the running episode."""
        return self.task.result(self.trip)

    # ------------------------------------------------------------------------------------------------------------------

    @property
    def _seen(self) -> Observation:
        self._require_episode()
        assert self._observation is not None
        return self._observation

    def _observe(self) -> Observation:
        self._observation = Observation(**self._core.observe(self.outputs), odometry=self._core.odometry)
        return self._observation

    def _require_episode(self) -> None:
        if self._trip is None:
            raise ArgumentError("the environment has no episode yet; call reset() first")
