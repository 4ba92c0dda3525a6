# SPDX-License-Identifier: Apache-2.0
"""Navigation episodes as a gymnasium environment, one primitive a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wiw.envs.guide import Guide, Way
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
from wiw.perception.semantics import TrueSemantics
from wiw.perception.simulator import read_categories
from wiw.types import Answer, Episode, Goal, Key, Observation, Truth


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
    float64 [3], and "depth" float32 [576, 1024] where asked for. Where the task points something out, its box is drawn
    on the images, with "panorama_box" and "front_box" float32 [4] (-1 where it is out of sight), and the actions after
    the primitives are final answers, one for each of `goal.choices`. The reward is 1 on reaching the goal, or for the
    right answer. Where the agent truly is stays in `truth()`, outside observation and info.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - gymnasium's name and type

    def __init__(self, task: NavigationTask, depth: bool = False) -> None:
        self.task = task
        self.render_mode = "rgb_array"
        self.outputs = outputs(task, depth)
        self.action_space = action_space(task)  # type: ignore[assignment]
        self.observation_space = observation_space(task, depth)
        self._core: Any = None
        self._way: Way | None = None
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
        """Carries out one primitive: 0 forward, 1 turn left, 2 turn right, 3 stop; from 4 on: a final answer."""
        if not self.action_space.contains(action):
            most = len(PRIMITIVES) + len(self.task.choices) - 1
            raise ArgumentError(f"step: expected an action from 0 to {most}, got {action!r}")
        answer = declared(self.task, int(action))
        if answer is not None:
            self.trip.hear(self.task, answer, final=True)
        segment = self._carry_out([PRIMITIVES[action]] if answer is None else [])
        info: dict[str, Any] = {"key": segment.key}
        if segment.terminated or segment.truncated:
            info["result"] = self.result()
        return segment.observation.as_dict(), float(self.trip.success), segment.terminated, segment.truncated, info

    def render(self) -> NDArray[np.uint8]:
        """The front view, as the observation shows it."""
        return self.observation.as_dict()["front"]

    # -- the loop ------------------------------------------------------------------------------------------------------

    def begin(self, episode: Episode) -> Observation:
        """Starts a given episode and observes."""
        self._core, self._trip, self._goal = start(self.task, episode)
        self._way = None
        return self._observe()

    def run(self, actions: Sequence[int] | NDArray[np.int8], answer: Answer | None = None) -> Segment:
        """Carries out one decision's primitives, as far as the episode goes on; observes once, at the end.

        Where the goal has choices, `answer` comes first, and nothing is carried out after the last one.

        Raises:
            ArgumentError: the goal has choices and no answer is given.
        """
        self.trip.decisions += 1
        if answer is None and self.task.choices:
            raise ArgumentError("run: the goal has choices; give the decision's answer too, run(actions, answer)")
        over = answer is not None and self.trip.hear(self.task, answer)
        return self._carry_out([] if over else actions)

    def _carry_out(self, actions: Sequence[int] | NDArray[np.int8]) -> Segment:
        trip, executed = self.trip, []
        first = len(trip.positions) - 1
        for i, action in enumerate(actions):
            self._core.step(int(action))
            executed.append(int(action))
            trip.note(self.task, int(action), self._core.position, at_decision=i + 1 == len(actions))
            if trip.ended:
                break
        path = np.stack(trip.positions[first:])
        self._key = self._key.at(self._key.decision + 1)
        observation = self._observe()
        trip.look(self.task, observation)
        over = trip.spent(self.task) and not trip.ended
        return Segment(observation, np.array(executed, np.int8), path, trip.ended, over, self._key)

    @property
    def goal(self) -> Goal:
        """What the agent is asked to reach."""
        self._require_episode()
        assert self._goal is not None
        return self._goal

    @property
    def observation(self) -> Observation:
        """What the agent perceives now: plain images, and the target apart, as agents and world models are given it."""
        self._require_episode()
        assert self._observation is not None
        return self._observation

    def fork(self) -> Any:
        """The simulator as it stands, to be run ahead by the oracle; this environment does not move."""
        self._require_episode()
        return self._core.fork()

    def semantic(self) -> NDArray[np.uint32]:
        """What each pixel of the panorama truly is, uint32 [576, 1024]: ids of `wiw.perception.semantics.CATEGORIES`.

        For agents that are granted the simulator's semantics, as others are granted depth.
        """
        source = TrueSemantics(read_categories(self.trip.world.scene))
        ids = self._core.observe(["panorama_ids"])["panorama_ids"]
        return source.label_panoramas(self.observation.panorama[None], ids=ids[None])[0]

    # -- privileged ----------------------------------------------------------------------------------------------------

    def guide(self) -> Guide:
        """The truth about plans from here, for stages of the loop that an experiment tells it."""
        trip = self.trip
        if self._way is None:
            self._way = Way(trip.world.navmesh, self.task.destination(trip))
        return Guide(self.task, trip, self._core.fork(), self._way)

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

    def _observe(self) -> Observation:
        images = self._core.observe(self.outputs)
        self._observation = observed(self.task, images, self._core.odometry, self.trip)
        return self._observation

    def _require_episode(self) -> None:
        if self._trip is None:
            raise ArgumentError("the environment has no episode yet; call reset() first")
