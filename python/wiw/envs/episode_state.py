# SPDX-License-Identifier: Apache-2.0
"""The state of one navigation episode, for the single and the vector environment, and the task's side of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw._core import env as _env
from wiw.action import STOP, count_leading_turns
from wiw.datasets.worlds import World, world
from wiw.envs.pointing import IDS, Pointing
from wiw.errors import ArgumentError
from wiw.types import Answer, Episode, Goal, Observation, TextAnswer, Truth


class NavigationSpec(ABC):
    """The side of a navigation task that its environments use: goals, and when one is reached."""

    name: str
    seed: int
    backend: Literal["auto", "cpu", "gpu"]
    choices: tuple[str, ...] = ()
    """Labels that answers are chosen from, where the task asks for any."""
    complete_progress: float = float("inf")
    """Progress with which an episode has ended, whatever a plan would do afterwards; inf where places do not end it."""

    @property
    def free_turns(self) -> bool:
        """Whether the turn at the start of a segment does not count."""
        return False

    @property
    def limit(self) -> int | None:
        """Maximum number of primitives of an episode, however they are divided over decisions; None if decisions are
        counted.
        """
        return None

    @property
    @abstractmethod
    def decisions(self) -> int:
        """K: decisions that an episode may take."""

    @property
    @abstractmethod
    def budget(self) -> int:
        """Primitives that an episode may take where they are given one by one."""

    @property
    @abstractmethod
    def motion(self) -> str:
        """Rule for blocked moves: "refuse" or "slide"."""

    @property
    @abstractmethod
    def episode_count(self) -> int | None:
        """How many episodes there are; None if there is no end of them, or if it takes too long to know."""

    @property
    def drawn_count(self) -> int:
        """Among how many episodes, the first ones, a seed of gymnasium's `reset` draws."""
        return self.episode_count or 64

    def wrap_index(self, index: int) -> int:
        """Return an episode's number modulo the number of episodes."""
        return index % self.episode_count if self.episode_count else index

    @property
    def pointing(self) -> Pointing | None:
        """How the task points its target out, where it has one."""
        return None

    @abstractmethod
    def episode(self, index: int) -> Episode:
        """Return an episode by its number."""

    def locate(self, place: World, episode: Episode) -> Episode:
        """Return an episode with everything that is only known once its scene is open; most have it already."""
        return episode

    @abstractmethod
    def make_goal(self, place: World, episode: Episode) -> Goal:
        """Return what the agent is asked to do."""

    @abstractmethod
    def find_goal_position(self, place: World, episode: Episode) -> NDArray[np.float64]:
        """Return where distances to the goal end."""

    @abstractmethod
    def is_success(self, state: EpisodeState) -> bool:
        """Return whether an episode has been successful so far."""

    @abstractmethod
    def measure(self, state: EpisodeState) -> dict[str, float]:
        """Return the metrics of an episode."""

    def is_sure(self, state: EpisodeState) -> bool:
        """Return whether the answers so far are confident enough to end the episode."""
        return False

    def waits(self, state: EpisodeState) -> bool:
        """Return whether the agent stays where it is after its last answer, to be asked again there."""
        return False

    def describe_end(self, state: EpisodeState) -> dict[str, Any]:
        """Return what is recorded of an episode besides its metrics, JSON-able."""
        return {}

    def find_destination(self, state: EpisodeState) -> NDArray[np.float64]:
        """Return the destination of an agent that knows the scene."""
        return state.goal_position

    def measure_progress(self, state: EpisodeState, fork: Any, primitives_left: float) -> float:
        """Return the progress at the present state of a fork of the simulator, the higher the better.

        `primitives_left` counts those of the shortest path from there to the destination; here the fewer, the better.
        """
        return -primitives_left


@dataclass
class EpisodeState:
    """The privileged record of one episode so far: what metrics are computed from."""

    episode: Episode
    world: World
    goal_position: NDArray[np.float64]
    """As the distances to it are measured: on the floor, as the positions are."""
    positions: list[NDArray[np.float64]]
    """After each primitive, beginning with the start."""
    decisions: int = 0
    """Segments carried out by `run`."""
    at_decision: bool = True
    """Whether the agent stands at the end of an executed segment."""
    stopped: bool = False
    success: bool = False
    ended: bool = False
    """By success, by stopping, by an answer that was sure enough, or for want of a target."""
    answers: list[Answer | TextAnswer] = field(default_factory=list)
    """The agent's beliefs, decision by decision."""
    observed: list[int] = field(default_factory=lambda: [0])
    """Indices of `positions` from which the agent has observed."""
    uncounted: int = 0
    """Primitives that the task does not count."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Intermediate results that the task keeps while it measures the episode."""

    @property
    def actions(self) -> int:
        """Primitives carried out, refused moves and stop included, but for those that the task does not count."""
        return len(self.positions) - 1 - self.uncounted

    @property
    def path_length(self) -> float:
        """Metres walked, measured horizontally as shortest paths are."""
        steps = np.diff(self.positions, axis=0).reshape(-1, 3)
        return float(np.hypot(steps[:, 0], steps[:, 2]).sum())

    def distance_to_goal(self) -> float:
        """Return the straight-line metres from the agent to the goal's position."""
        return float(np.linalg.norm(self.positions[-1] - self.goal_position))

    def geodesic_to_goal(self) -> float:
        """Return the metres of the shortest walk to the goal; inf when it cannot be reached."""
        return float(self.world.navmesh.geodesic_distance(self.positions[-1], self.goal_position))

    def make_truth(self, yaw: float) -> Truth:
        """Return where the agent truly is, heading `yaw` radians."""
        return Truth(self.positions[-1], yaw, self.distance_to_goal(), self.geodesic_to_goal())

    def record_primitive(
        self, task: NavigationSpec, action: int, position: NDArray[np.float64], at_decision: bool
    ) -> None:
        """Record where a primitive led; `at_decision` where it is a segment's last, as a stop is wherever it stands."""
        self.positions.append(position)
        self.stopped = action == STOP
        self.at_decision = at_decision or self.stopped
        self.ended = self.stopped
        self.success = task.is_success(self)
        self.ended = self.ended or self.success

    def record_answer(self, task: NavigationSpec, answer: Answer | TextAnswer, final: bool = False) -> bool:
        """Record what the agent believes; return whether nothing is carried out after it.

        Nothing is after the last answer: when the task says that it is sure enough, with the last decision, and when
        the agent ends the episode with it (`final`). Nothing is either where the task asks again on the same view.
        """
        self.answers.append(answer)
        self.ended = final or task.is_sure(self)
        self.success = task.is_success(self)
        return self.ended or self.is_out_of_budget(task) or task.waits(self)

    def record_observation(self, task: NavigationSpec, observation: Observation) -> None:
        """End the episode where the task says so once its target is out of sight."""
        if task.pointing is not None and task.pointing.ends(observation.target):
            self.ended = True
            self.success = task.is_success(self)

    def limit_plan(self, task: NavigationSpec, plan: Any) -> Any:
        """Return as much of a plan as may still be carried out, where the task limits primitives."""
        if task.limit is None:
            return plan
        free, left = count_leading_turns(plan) if task.free_turns else 0, max(0, task.limit - self.actions)
        self.uncounted += free
        return plan[: free + left]

    def is_out_of_budget(self, task: NavigationSpec) -> bool:
        """Return whether the decisions are used up, or the primitives where these are limited or given one by one."""
        if task.limit is not None:  # an agent that only turns for nothing, or only waits, must come to an end too
            return self.actions >= task.limit or self.decisions >= 2 * task.limit
        return self.decisions >= task.decisions if self.decisions else self.actions >= task.budget


def answer_in_words(task: NavigationSpec, goal: Goal, state: EpisodeState, text: str) -> None:
    """End an episode with an answer in words.

    Raises:
        ArgumentError: the goal is not a question, the text is empty, or the episode has been ended before.
    """
    if not goal.question or not text.strip():
        raise ArgumentError(f"answer: expected a text in reply to a question, got {text!r} in task {task.name}")
    if state.ended:  # an episode whose budget is used up may still be answered
        raise ArgumentError(
            "answer: the episode has ended; reset(), or in a vector environment the next step, starts another"
        )
    state.record_answer(task, TextAnswer(text, 1.0, final=True), final=True)


def draw_episode(task: NavigationSpec, random: np.random.Generator) -> int:
    """Return a random episode's number."""
    return int(random.integers(task.drawn_count))


def wrap_episode(task: NavigationSpec, index: int) -> int:
    """Return the number of an episode, modulo the number of episodes.

    Raises:
        ArgumentError: a negative number.
    """
    if index < 0:
        raise ArgumentError(f"expected an episode number of at least 0, got {index}")
    return task.wrap_index(index)


def start_episode(task: NavigationSpec, episode: Episode) -> tuple[Any, EpisodeState, Goal]:
    """Return the simulator at the start of an episode, the episode's record, and what the agent is asked to do."""
    place = world(episode.scene, task.backend)
    episode = task.locate(place, episode)
    config = _env.NavigationConfig(motion=_env.Motion.__members__[task.motion])
    core = _env.NavigationEnv(place.renderer.core, place.navmesh, place.ground, config)
    core.reset(np.asarray(episode.start_position), episode.start_yaw)
    goal_position = task.find_goal_position(place, episode)
    state = EpisodeState(episode, place, goal_position, [core.position])
    return core, state, task.make_goal(place, episode)


def image_names(task: NavigationSpec, depth: bool) -> list[str]:
    """Return the images to request from the simulator, by its names."""
    return ["panorama", "front", *(["depth"] if depth else []), *([] if task.pointing is None else IDS)]


def observe_place(task: NavigationSpec, core: Any, state: EpisodeState, depth: bool) -> Observation:
    """Return what the agent sees from where the simulator stands.

    The panorama, and its depth, are drawn now for whoever decides next, and with the episode over only if somebody
    looks; so is the front view always. Where the task has a target, everything is rendered to find its box.
    """
    if task.pointing is not None:
        return make_observation(task, core.observe(image_names(task, depth)), core.odometry, state)
    over = state.ended or state.is_out_of_budget(task)
    images = {} if over else core.observe(["panorama", *(["depth"] if depth else [])])
    return Observation.from_outlook(core.outlook(), round_odometry(core.odometry), images, depth)


def make_observation(
    task: NavigationSpec, images: dict[str, Any], odometry: NDArray[np.float64], state: EpisodeState
) -> Observation:
    """Return the agent's observation, from the simulator's images."""
    if task.pointing is not None:
        images = task.pointing.split(images, int(state.episode.info["target"]))
    return Observation(**images, odometry=round_odometry(odometry))


def round_odometry(odometry: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return odometry [..., 3] to a tenth of a millimetre.

    The simulator's positions are float32 in the scene's frame. The rounding of differences of such numbers reveals
    which of some given starts they are relative to; to a tenth of a millimetre they do not.
    """
    rounded = odometry.copy()
    rounded[..., :2] = np.round(odometry[..., :2], 4) + 0.0  # no negative zeros
    return rounded
