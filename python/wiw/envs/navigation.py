# SPDX-License-Identifier: Apache-2.0
"""Navigation episodes as a gymnasium environment, one primitive per step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wiw.envs.base import Env, Segment, read_episode_number
from wiw.envs.episode_state import (
    EpisodeState,
    NavigationSpec,
    answer_in_words,
    draw_episode,
    observe_place,
    start_episode,
    wrap_episode,
)
from wiw.envs.navigation_guide import NavigationGuide, ShortestPath
from wiw.envs.spaces import (
    FIRST_ACTION,
    LAST_PRIMITIVE,
    action_space,
    answer_of,
    check_primitives,
    observation_space,
)
from wiw.errors import ArgumentError
from wiw.perception.semantics import TrueSemantics, read_semantic_categories
from wiw.types import Answer, Episode, Goal, Key, Observation, TextAnswer, Truth


class NavigationEnv(gymnasium.Env[dict[str, Any], int], Env):
    """An agent that sees a panorama and a front view and moves by 0.2 m or turns by 22.5 degrees.

    Actions are numbered as in `wiw.action`: `env.step(wiw.action.FORWARD)` goes forward.

    Observations are dicts: "panorama" uint8 [576, 1024, 3], "front" uint8 [480, 480, 3] (HFOV 90), "odometry" float64
    [3], and "depth" float32 [576, 1024] if requested. If the task marks an object, its box is drawn on the images, with
    "panorama_box" and "front_box" float32 [4] (-1 if it is out of sight), and the actions after the primitives are
    final answers, one for each of `goal.choices`. The reward is 1 for reaching the goal, or for the right answer. The
    agent's true position is only in `truth()`, not in observation or info.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 - gymnasium's name and type

    def __init__(self, task: NavigationSpec, depth: bool = False) -> None:
        self.task = task
        self.render_mode = "rgb_array"
        self._depth = depth
        self.action_space = action_space(task.choices)  # type: ignore[assignment]
        self.observation_space = observation_space(depth, task.pointing is not None)
        self._core: Any = None
        self._path: ShortestPath | None = None
        self._state: EpisodeState | None = None
        self._goal: Goal | None = None
        self._observation: Observation | None = None
        self._next = 0
        self._key = Key(task.seed, 0)

    # -- gymnasium -----------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode: `options={"episode": 3}`, or the next one; `seed` picks one at random.

        `info["key"]` identifies the next decision, for `agent.decide`; every step returns a new one.

        Raises:
            ArgumentError: an unknown option, or no whole number of at least 0.
        """
        super().reset(seed=seed)
        index = read_episode_number(options)
        if index is None:
            index = draw_episode(self.task, self.np_random) if seed is not None else self._next
        index = wrap_episode(self.task, index)
        observation = self.begin(self.task.episode(index))
        self._next = index + 1
        self._key = Key(self.task.seed, index)
        return observation.as_dict(), {"key": self._key}

    def step(self, action: int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Execute one primitive of `wiw.action` (1 forward, 2 left, 3 right, 4 stop), or give a final answer (from 5
        on).

        Raises:
            ArgumentError: another number, or the episode has ended; nothing has moved then.
        """
        if not self.action_space.contains(action):
            most = LAST_PRIMITIVE + len(self.task.choices)
            raise ArgumentError(
                f"step: expected an action from {FIRST_ACTION} to {most}, as wiw.action has them, got {action!r}"
            )
        self._require_going("step")
        answer = answer_of(int(action), self.task.choices)
        if answer is not None:
            self.state.record_answer(self.task, answer, final=True)
        segment = self._carry_out([int(action)] if answer is None else [])
        info: dict[str, Any] = {"key": segment.key}
        if segment.terminated or segment.truncated:
            info["result"] = self.result()
        return segment.observation.as_dict(), float(self.state.success), segment.terminated, segment.truncated, info

    def render(self) -> NDArray[np.uint8]:
        """Return the front view, as in the observation."""
        return self.observation.mark_target("front")

    # -- the loop ------------------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> Observation:
        """Start a given episode and observe."""
        self._core, self._state, self._goal = start_episode(self.task, episode)
        self._path = None
        return self._observe()

    def run(self, plan: Sequence[int] | NDArray[np.int8], answer: Answer | TextAnswer | None = None) -> Segment:
        """Execute one decision's primitives, as long as the episode continues; observe once, at the end.

        If the goal expects an answer, `answer` comes first, and nothing is executed after a final one.

        Raises:
            ArgumentError: no primitives [K] of `wiw.action`, no answer where the goal expects one, or the episode has
                ended; nothing has moved or been counted then.
        """
        actions = check_primitives(plan)
        self._require_going("run")
        if answer is None and self.goal.expects_answer:
            raise ArgumentError(
                "run: the goal expects an answer; pass the decision's answer as well, run(plan, answer)"
            )
        self.state.decisions += 1
        stays = answer is not None and self.state.record_answer(self.task, answer)
        return self._carry_out([] if stays else self.state.limit_plan(self.task, actions))

    def answer(self, text: str) -> dict[str, float]:
        """End the episode with an answer in words, for callers who step it themselves; return its metrics.

        Raises:
            ArgumentError: the goal is not a question, the text is empty, or the episode has been ended before.
        """
        answer_in_words(self.task, self.goal, self.state, text)
        return self.result()

    def _carry_out(self, actions: Sequence[int] | NDArray[np.int8]) -> Segment:
        state, executed = self.state, []
        first = len(state.positions) - 1
        for i, action in enumerate(actions):
            self._core.step(int(action))
            executed.append(int(action))
            state.record_primitive(self.task, int(action), self._core.position, at_decision=i + 1 == len(actions))
            if state.ended:
                break
        path = np.stack(state.positions[first:])
        state.observed.append(len(state.positions) - 1)
        self._key = self._key.at(self._key.decision + 1)
        observation = self._observe()
        state.record_observation(self.task, observation)
        over = state.is_out_of_budget(self.task) and not state.ended
        return Segment(observation, np.array(executed, np.int8), path, state.ended, over, self._key)

    @property
    def goal(self) -> Goal:
        """The goal of the running episode."""
        self._require_episode()
        assert self._goal is not None
        return self._goal

    @property
    def observation(self) -> Observation:
        """The agent's present view: plain images, and the target apart, as agents and world models are given it."""
        self._require_episode()
        assert self._observation is not None
        return self._observation

    def fork(self) -> Any:
        """Return a copy of the simulator, which the oracle runs ahead; this environment does not move."""
        self._require_episode()
        return self._core.fork()

    def semantic(self) -> NDArray[np.uint32]:
        """Return what each pixel of the panorama is, uint32 [576, 1024]: ids of `wiw.perception.semantics.CATEGORIES`.

        For agents that are granted the simulator's semantics, as others are granted depth.
        """
        source = TrueSemantics(read_semantic_categories(self.state.world.scene))
        ids = self._core.observe(["panorama_ids"])["panorama_ids"]
        return source.label_panoramas(self.observation.panorama[None], ids=ids[None])[0]

    def instances(self) -> tuple[NDArray[np.uint32], Sequence[Mapping[str, Any]]]:
        """Return the true instance of each pixel of the panorama, uint32 [576, 1024], and the scene's table of them."""
        scene = self.state.world.scene
        return self._core.observe(["panorama_ids"])["panorama_ids"], scene.instances

    # -- privileged ----------------------------------------------------------------------------------------------------

    def guide(self) -> NavigationGuide:
        """Return the truth about plans from here, for stages of the loop that an experiment tells it."""
        state = self.state
        if self._path is None:
            self._path = ShortestPath(state.world.navmesh, self.task.find_destination(state))
        return NavigationGuide(self.task, state, self._core.fork(), self._path)

    @property
    def state(self) -> EpisodeState:
        """The privileged record of the running episode."""
        self._require_episode()
        assert self._state is not None
        return self._state

    def truth(self) -> Truth:
        """Return where the agent truly is; for metrics, records and reports alone."""
        return self.state.make_truth(self._core.yaw)

    def result(self) -> dict[str, float]:
        """Return the task's metrics of the running episode."""
        return self.task.measure(self.state)

    def details(self) -> dict[str, Any]:
        """See `Env.details`."""
        return self.task.describe_end(self.state)

    # ------------------------------------------------------------------------------------------------------------------

    def _observe(self) -> Observation:
        self._observation = observe_place(self.task, self._core, self.state, self._depth)
        return self._observation

    def _require_episode(self) -> None:
        if self._state is None:
            raise ArgumentError("the environment has no episode yet; call reset() first")

    def _require_going(self, method: str) -> None:
        if self.state.ended or self.state.is_out_of_budget(self.task):
            raise ArgumentError(f"{method}: the episode has ended; call reset() to start another")
