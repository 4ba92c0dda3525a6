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
from wiw.envs.base import read_episode_numbers
from wiw.envs.episode_state import (
    EpisodeState,
    NavigationSpec,
    answer_in_words,
    draw_episode,
    image_names,
    make_observation,
    round_odometry,
    start_episode,
    wrap_episode,
)
from wiw.envs.spaces import (
    FIRST_ACTION,
    LAST_PRIMITIVE,
    action_space,
    answer_of,
    batched_observation_space,
    observation_space,
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

    def __init__(self, task: NavigationSpec, num_envs: int, depth: bool = False) -> None:
        if num_envs < 1:
            raise ArgumentError(f"VectorEnv: expected num_envs of at least 1, got {num_envs}")
        self.task, self.num_envs, self.render_mode = task, num_envs, "rgb_array"
        self._images, target = image_names(task, depth), task.pointing is not None
        self.single_observation_space = observation_space(depth, target)
        self.single_action_space = action_space(task.choices)
        self.observation_space = batched_observation_space(depth, target, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._core: Any = None
        self._states: list[EpisodeState] = []
        self._goals: list[Goal] = []
        self._keys: list[Key] = []
        self._over = np.zeros(num_envs, bool)
        self._front: NDArray[np.uint8] | None = None
        self._next = 0

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start N episodes: `options={"episode": [3, 5]}`, or the next ones; `seed` draws a first one at random.

        Raises:
            ArgumentError: an unknown option, or no list of N whole numbers of at least 0.
        """
        super().reset(seed=seed)
        numbers = read_episode_numbers(options, self.num_envs)
        if numbers is None:
            first = draw_episode(self.task, self.np_random) if seed is not None else self._next
            numbers = list(range(first, first + self.num_envs))
        indices = [wrap_episode(self.task, number) for number in numbers]
        started = [start_episode(self.task, self.task.episode(index)) for index in indices]
        self._core = _env.VectorEnv([core for core, _, _ in started])
        self._states, self._goals = [state for _, state, _ in started], [goal for _, _, goal in started]
        self._over[:] = False
        self._next = max(numbers) + 1  # not of `indices`: after a wrap the next one is not the first again
        self._keys = [Key(self.task.seed, index) for index in indices]
        return self._observe(), self._describe_keys()

    def step(
        self, actions: ArrayLike
    ) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Carry out an action each, numbered as in `NavigationEnv.step`; `infos["key"]` identifies the next
        decisions.
        """
        self._require_episodes()
        primitives, answers = self._decode(actions)
        for place in np.flatnonzero(self._over):
            self._start_over(int(place))
        self._core.step(np.where(self._over, NULL, primitives).astype(np.int8))
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, bool)
        for place in np.flatnonzero(~self._over):
            state, answer = self._states[place], answers[place]
            if answer is None:
                state.record_primitive(self.task, int(primitives[place]), self._core[place].position, at_decision=True)
            else:
                state.record_answer(self.task, answer, final=True)
            state.observed.append(len(state.positions) - 1)
            self._keys[place] = self._keys[place].at(self._keys[place].decision + 1)
        observation, infos = self._observe(), self._describe_keys()
        for place in np.flatnonzero(~self._over):
            state = self._states[place]
            terminated[place], truncated[place] = state.ended, not state.ended and state.is_out_of_budget(self.task)
            rewards[place] = state.success
            if terminated[place] or truncated[place]:
                self._add_info(infos, {"result": self.result(int(place))}, int(place))
        self._over = terminated | truncated
        return observation, rewards, terminated, truncated, infos

    def answer(self, place: int, text: str) -> dict[str, float]:
        """End one place's episode with an answer in words; return its metrics. The next step starts the place over.

        Raises:
            ArgumentError: see `NavigationEnv.answer`.
        """
        self._require_episodes()
        answer_in_words(self.task, self._goals[place], self._states[place], text)
        self._over[place] = True
        return self.result(place)

    def render(self) -> tuple[NDArray[np.uint8], ...]:
        """Return the front views."""
        self._require_episodes()
        assert self._front is not None
        return tuple(self._front)

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goal of each agent."""
        self._require_episodes()
        return tuple(self._goals)

    def fork(self, place: int) -> Any:
        """Return a copy of one place's simulator, which the oracle runs ahead; nothing here moves."""
        self._require_episodes()
        return self._core[place].fork()

    # -- privileged ----------------------------------------------------------------------------------------------------

    def truth(self, place: int) -> Truth:
        """Return where one agent truly is; for metrics, records and reports alone."""
        self._require_episodes()
        return self._states[place].make_truth(self._core[place].yaw)

    def result(self, place: int) -> dict[str, float]:
        """Return the task's metrics of one place's running episode."""
        self._require_episodes()
        return self.task.measure(self._states[place])

    # ------------------------------------------------------------------------------------------------------------------

    def _start_over(self, place: int) -> None:
        """Put the next episode in a place."""
        index = wrap_episode(self.task, self._next)
        self._core[place], self._states[place], self._goals[place] = start_episode(self.task, self.task.episode(index))
        self._keys[place], self._next = Key(self.task.seed, index), index + 1

    def _describe_keys(self) -> dict[str, Any]:
        """Return infos with the key of each place's next decision."""
        infos: dict[str, Any] = {}
        for place, key in enumerate(self._keys):
            self._add_info(infos, {"key": key}, place)
        return infos

    def _observe(self) -> dict[str, Any]:
        images = self._core.observe(self._images)
        odometry = round_odometry(np.stack([self._core[place].odometry for place in range(self.num_envs)]))
        shown = {**images, "odometry": odometry}
        if self.task.pointing is not None:
            each = [self._observe_target(images, odometry, place) for place in range(self.num_envs)]
            shown = {name: np.stack([values[name] for values in each]) for name in each[0]}
        self._front = shown["front"]
        return shown

    def _observe_target(self, images: dict[str, Any], odometry: NDArray[np.float64], place: int) -> dict[str, Any]:
        """Return one place's observation, with its target's boxes."""
        own, state = {name: image[place] for name, image in images.items()}, self._states[place]
        observation = make_observation(self.task, own, odometry[place], state)
        if not self._over[place]:
            state.record_observation(self.task, observation)
        return observation.as_dict()

    def _decode(self, actions: ArrayLike) -> tuple[NDArray[np.int8], list[Answer | None]]:
        """Return the primitives to carry out, none where a final answer is given, and the answers."""
        given, last = np.asarray(actions), LAST_PRIMITIVE + len(self.task.choices)
        in_range = given.dtype.kind in "iu" and bool(((given >= FIRST_ACTION) & (given <= last)).all())
        if given.shape != (self.num_envs,) or not in_range:
            raise ArgumentError(
                f"step: expected {self.num_envs} actions from {FIRST_ACTION} to {last}, got {actions!r}"
            )
        answers = [answer_of(int(action), self.task.choices) for action in given]
        return np.where(given > LAST_PRIMITIVE, int(NULL), given).astype(np.int8), answers

    def _require_episodes(self) -> None:
        if self._core is None:
            raise ArgumentError("the environment has no episodes yet; call reset() first")
