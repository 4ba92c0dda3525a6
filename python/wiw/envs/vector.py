# SPDX-License-Identifier: Apache-2.0
"""Many navigation episodes as one gymnasium vector environment, stepped and observed as a batch."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from wiw._core import env as _env
from wiw.action import NULL
from wiw.envs.trip import (
    PRIMITIVES,
    NavigationTask,
    Trip,
    action_space,
    declared,
    drawn,
    known,
    observation_space,
    observed,
    outputs,
    start,
)
from wiw.errors import ArgumentError
from wiw.types import Answer, Goal, Key, Truth


class VectorEnv(gymnasium.vector.VectorEnv[dict[str, Any], NDArray[np.int64], NDArray[Any]]):
    """`num_envs` navigation episodes of one task, each as `NavigationEnv` shows it, with [N] in front.

    An episode that ends starts over at the next step (gymnasium's next-step autoreset): that step ignores the place's
    action, gives reward 0 and shows the first observation of the next episode of the task that nobody has begun. Where
    the agents truly are stays in `truth()`, outside observations and infos.

    Raises:
        ArgumentError: `num_envs` below 1.
    """

    metadata = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, task: NavigationTask, num_envs: int, depth: bool = False) -> None:
        if num_envs < 1:
            raise ArgumentError(f"VectorEnv: expected num_envs of at least 1, got {num_envs}")
        self.task, self.num_envs, self.render_mode = task, num_envs, "rgb_array"
        self.outputs = outputs(task, depth)
        self.single_observation_space = observation_space(task, depth)
        self.single_action_space = action_space(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._core: Any = None
        self._trips: list[Trip] = []
        self._goals: list[Goal] = []
        self._over = np.zeros(num_envs, bool)
        self._front: NDArray[np.uint8] | None = None
        self._next = 0

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts N episodes: `options={"episode": [3, 5]}`, or the next ones; `seed` draws a first one at random."""
        super().reset(seed=seed)
        indices = (options or {}).get("episode")
        if indices is None:
            first = drawn(self.task, self.np_random) if seed is not None else self._next
            indices = range(first, first + self.num_envs)
        if len(indices) != self.num_envs:
            raise ArgumentError(f"reset: expected {self.num_envs} episodes, got {len(indices)}")
        indices = [known(self.task, int(index)) for index in indices]
        started = [start(self.task, self.task.episode(int(index))) for index in indices]
        self._core = _env.VectorEnv([core for core, _, _ in started])
        self._trips, self._goals = [trip for _, trip, _ in started], [goal for _, _, goal in started]
        self._over[:] = False
        self._next = max(map(int, indices)) + 1
        infos: dict[str, Any] = {}
        for place, index in enumerate(indices):
            self._add_info(infos, self._named(int(index)), place)
        return self._observe(), infos

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Carries out one primitive each: 0 forward, 1 turn left, 2 turn right, 3 stop; from 4 on: a final answer."""
        self._require_episodes()
        primitives, answers = self._understood(actions)
        infos: dict[str, Any] = {}
        for place in np.flatnonzero(self._over):
            self._add_info(infos, self._start_over(int(place)), int(place))
        self._core.step(np.where(self._over, NULL, primitives).astype(np.int8))
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        for place in np.flatnonzero(~self._over):
            trip, answer = self._trips[place], answers[place]
            if answer is None:
                trip.note(self.task, int(primitives[place]), self._core[place].position, at_decision=True)
            else:
                trip.hear(self.task, answer, final=True)
        observation = self._observe()
        for place in np.flatnonzero(~self._over):
            trip = self._trips[place]
            terminated[place], truncated[place] = trip.ended, not trip.ended and trip.spent(self.task)
            rewards[place] = trip.success
            if terminated[place] or truncated[place]:
                self._add_info(infos, {"result": self.result(int(place))}, int(place))
        self._over = terminated | truncated
        return observation, rewards, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """The front views."""
        self._require_episodes()
        assert self._front is not None
        return tuple(self._front)

    @property
    def goals(self) -> tuple[Goal, ...]:
        """What each agent is asked to reach."""
        self._require_episodes()
        return tuple(self._goals)

    def fork(self, place: int) -> Any:
        """One place's simulator as it stands, to be run ahead by the oracle; nothing here moves."""
        self._require_episodes()
        return self._core[place].fork()

    # -- privileged ----------------------------------------------------------------------------------------------------

    def truth(self, place: int) -> Truth:
        """Where one agent truly is; for metrics, records and reports alone."""
        self._require_episodes()
        return self._trips[place].truth(self._core[place].yaw)

    def result(self, place: int) -> dict[str, float]:
        """The task's metrics of one place's running episode."""
        self._require_episodes()
        return self.task.result(self._trips[place])

    # ------------------------------------------------------------------------------------------------------------------

    def _start_over(self, place: int) -> dict[str, Any]:
        """Puts the next episode in a place; what its info says."""
        index = known(self.task, self._next)
        self._core[place], self._trips[place], self._goals[place] = start(self.task, self.task.episode(index))
        self._next = index + 1
        return self._named(index)

    def _named(self, index: int) -> dict[str, Any]:
        return {"key": Key(self.task.seed, index)}

    def _observe(self) -> dict[str, Any]:
        images = self._core.observe(self.outputs)
        odometry = np.stack([self._core[place].odometry for place in range(self.num_envs)])
        shown = {**images, "odometry": odometry}
        if self.task.pointing is not None:
            each = [self._pointed_out(images, odometry, place) for place in range(self.num_envs)]
            shown = {name: np.stack([values[name] for values in each]) for name in each[0]}
        self._front = shown["front"]
        return shown

    def _pointed_out(self, images: dict[str, Any], odometry: NDArray[np.float64], place: int) -> dict[str, Any]:
        """One place's observation, with its target's boxes."""
        own, trip = {name: image[place] for name, image in images.items()}, self._trips[place]
        observation = observed(self.task, own, odometry[place], trip)
        if not self._over[place]:
            trip.look(self.task, observation)
        return observation.as_dict()

    def _understood(self, actions: ArrayLike) -> tuple[NDArray[np.int8], list[Answer | None]]:
        """The primitives to carry out, none where a final answer is given, and the answers."""
        given, count = np.asarray(actions), len(PRIMITIVES) + len(self.task.choices)
        if given.shape != (self.num_envs,) or given.dtype.kind not in "iu" or not _in_range(given, count):
            raise ArgumentError(f"step: expected {self.num_envs} actions from 0 to {count - 1}, got {actions!r}")
        table = np.array([*PRIMITIVES, *[NULL] * (count - len(PRIMITIVES))], np.int8)
        return table[given], [declared(self.task, int(action)) for action in given]

    def _require_episodes(self) -> None:
        if self._core is None:
            raise ArgumentError("the environment has no episodes yet; call reset() first")


def _in_range(actions: NDArray[Any], count: int) -> bool:
    return bool(((actions >= 0) & (actions < count)).all())
