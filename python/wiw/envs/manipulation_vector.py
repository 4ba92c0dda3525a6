# SPDX-License-Identifier: Apache-2.0
"""Many manipulation episodes as one gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from wiw._core import core
from wiw.envs.base import read_episode_numbers
from wiw.envs.manipulation import ManipulationEnv, check_poses
from wiw.envs.manipulation_spec import ManipulationSpec
from wiw.errors import ArgumentError
from wiw.types import Goal

Moved = tuple[dict[str, Any], float, bool, bool, dict[str, Any]]


class ManipulationVectorEnv(gymnasium.vector.VectorEnv[dict[str, Any], NDArray[Any], NDArray[Any]]):
    """`num_envs` tables, each as `ManipulationEnv` shows it, with [N] in front.

    Tables are stepped by threads: physics and pictures hold no lock of Python's. An episode that ends starts over at
    the next step (gymnasium's next-step autoreset): that step ignores the place's action, gives reward 0 and shows the
    first observation of the next episode of the task that nobody has begun.

    Args:
        task: whose episodes are run.
        num_envs: how many at a time.
        depth: whether observations carry it.
        sensors: as `ManipulationEnv` takes them.

    Raises:
        ArgumentError: `num_envs` below 1, or as `ManipulationEnv`.
    """

    metadata = {"render_modes": ["rgb_array"], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(self, task: ManipulationSpec, num_envs: int, depth: bool = False, **sensors: Any) -> None:
        if num_envs < 1:
            raise ArgumentError(f"ManipulationVectorEnv: expected num_envs of at least 1, got {num_envs}")
        self.task, self.num_envs, self.render_mode = task, num_envs, "rgb_array"
        self.envs = tuple(ManipulationEnv(task, depth, **sensors) for _ in range(num_envs))
        self.single_observation_space = self.envs[0].observation_space
        self.single_action_space = self.envs[0].action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        threads = min(num_envs, core.num_threads())
        crowded = core.run_inline if threads == core.num_threads() else None  # pictures are not shared out once more
        self._threads = ThreadPoolExecutor(threads, "table", crowded)
        self._over = np.zeros(num_envs, bool)
        self._next = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start N episodes: `options={"episode": [3, 5]}`, or the next ones; `seed` draws a first one at random.

        Raises:
            ArgumentError: an unknown option, or no list of N whole numbers of at least 0.
        """
        super().reset(seed=seed)
        indices = read_episode_numbers(options, self.num_envs)
        if indices is None:
            first = int(self.np_random.integers(1000)) if seed is not None else self._next
            indices = list(range(first, first + self.num_envs))
        begun = self._each(lambda place: self._begin(place, indices[place]))
        self._over[:] = False
        self._next = max(indices) + 1
        return self._stack([observation for observation, *_ in begun]), self._merge_infos([info for *_, info in begun])

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Go to one pose each, [N, 7].

        Raises:
            ArgumentError: another shape, or an action that `ManipulationEnv.step` refuses where an episode is running;
                nothing has moved then.
        """
        given = np.asarray(actions)
        if given.shape != (self.num_envs, 7):
            raise ArgumentError(f"step: expected actions [{self.num_envs}, 7], got {list(given.shape)}")
        running = given[~self._over]
        if len(running):
            check_poses(running if self.envs[0].grid is None else self.envs[0].grid.decode(running))
        fresh = {int(place): self._next + count for count, place in enumerate(np.flatnonzero(self._over))}
        self._next += len(fresh)
        moved = self._each(
            lambda place: self._begin(place, fresh[place]) if place in fresh else self.envs[place].step(given[place])
        )
        observations, rewards, done, over, infos = zip(*moved, strict=True)
        terminated, truncated = np.array(done, bool), np.array(over, bool)
        self._over = terminated | truncated
        return self._stack(observations), np.array(rewards), terminated, truncated, self._merge_infos(infos)

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Return the front views."""
        return tuple(env.render() for env in self.envs)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._threads.shutdown()

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goal of each agent."""
        return tuple(env.goal for env in self.envs)

    # ------------------------------------------------------------------------------------------------------------------

    def _each(self, work: Callable[[int], Moved]) -> list[Moved]:
        """Do something at every place at once."""
        return list(self._threads.map(work, range(self.num_envs)))

    def _begin(self, place: int, index: int) -> Moved:
        observation, info = self.envs[place].reset(options={"episode": index})
        return observation, 0.0, False, False, info

    def _stack(self, observations: Any) -> dict[str, Any]:
        return {name: np.stack([each[name] for each in observations]) for name in observations[0]}

    def _merge_infos(self, infos: Any) -> dict[str, Any]:
        merged: dict[str, Any] = {}
        for place, info in enumerate(infos):
            merged = self._add_info(merged, info, place)
        return merged
