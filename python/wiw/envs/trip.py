# SPDX-License-Identifier: Apache-2.0
"""One navigation episode in progress, as the single and the vector environment both keep it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from wiw._core import env as _env
from wiw.action import FORWARD, STOP, TURN_LEFT, TURN_RIGHT
from wiw.datasets.worlds import World, world
from wiw.envs.pointing import IDS, Pointing
from wiw.errors import ArgumentError
from wiw.types import Answer, Episode, Goal, Observation, Truth

PRIMITIVES = (FORWARD, TURN_LEFT, TURN_RIGHT, STOP)
"""What the discrete action space counts: `env.step(0)` goes forward. The goal's choices, if any, come after them."""


class NavigationTask(Protocol):
    """What an environment asks of its task."""

    seed: int
    backend: Literal["auto", "cpu", "gpu"]
    rules: Any

    @property
    def pointing(self) -> Pointing | None: ...
    @property
    def choices(self) -> tuple[str, ...]: ...
    @property
    def motion(self) -> str: ...
    @property
    def budget(self) -> int: ...
    @property
    def size(self) -> int | None: ...
    def episode(self, index: int) -> Episode: ...
    def goal(self, world: World, episode: Episode) -> Goal: ...
    def goal_position(self, world: World, episode: Episode) -> NDArray[np.float64]: ...
    def sure(self, trip: Trip) -> bool: ...
    def succeeded(self, trip: Trip) -> bool: ...
    def result(self, trip: Trip) -> dict[str, float]: ...
    def destination(self, trip: Trip) -> NDArray[np.float64]: ...
    def progress(self, trip: Trip, fork: Any, left: float) -> float: ...


@dataclass
class Trip:
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
    answers: list[Answer] = field(default_factory=list)
    """What the agent believed, decision by decision."""

    @property
    def actions(self) -> int:
        """Primitives carried out, refused moves and stop included."""
        return len(self.positions) - 1

    @property
    def travelled(self) -> float:
        """Metres walked, measured horizontally as shortest paths are."""
        steps = np.diff(self.positions, axis=0).reshape(-1, 3)
        return float(np.hypot(steps[:, 0], steps[:, 2]).sum())

    def distance_to_goal(self) -> float:
        """Straight-line metres from the agent to the goal's position."""
        return float(np.linalg.norm(self.positions[-1] - self.goal_position))

    def geodesic_to_goal(self) -> float:
        """Metres of the shortest walk to the goal; inf when it cannot be reached."""
        return float(self.world.navmesh.geodesic_distance(self.positions[-1], self.goal_position))

    def truth(self, yaw: float) -> Truth:
        """Where the agent truly is, heading `yaw` radians."""
        return Truth(self.positions[-1], yaw, self.distance_to_goal(), self.geodesic_to_goal())

    def note(self, task: NavigationTask, action: int, position: NDArray[np.float64], at_decision: bool) -> None:
        """Records where a primitive led."""
        self.positions.append(position)
        self.stopped, self.at_decision = action == STOP, at_decision
        self.ended = self.stopped
        self.success = task.succeeded(self)
        self.ended = self.ended or self.success

    def hear(self, task: NavigationTask, answer: Answer, final: bool = False) -> bool:
        """Takes in what the agent believes; True where that is its last word, after which nothing is carried out.

        It is when the task says that it is sure enough, with the last decision, and when the agent calls it `final`.
        """
        self.answers.append(answer)
        self.ended = final or task.sure(self)
        self.success = task.succeeded(self)
        return self.ended or self.spent(task)

    def look(self, task: NavigationTask, observation: Observation) -> None:
        """Takes in what is seen now."""
        if task.pointing is not None and task.pointing.ends(observation.target):
            self.ended = True
            self.success = task.succeeded(self)

    def spent(self, task: NavigationTask) -> bool:
        """Whether the decisions are used up, or the primitives where they are given one by one, without decisions."""
        return self.decisions >= task.rules.decisions if self.decisions else self.actions >= task.budget


def drawn(task: NavigationTask, random: np.random.Generator) -> int:
    """A random episode's number; among the first 64 where there is no end of them."""
    return int(random.integers(task.size or 64))


def known(task: NavigationTask, index: int) -> int:
    """The number of an episode, counted round where the last one is passed.

    Raises:
        ArgumentError: a negative number.
    """
    if index < 0:
        raise ArgumentError(f"expected an episode's number of at least 0, got {index}")
    return index % task.size if task.size else index


def start(task: NavigationTask, episode: Episode) -> tuple[Any, Trip, Goal]:
    """The simulator at the start of an episode, its record, and what the agent is asked to reach."""
    place = world(episode.scene, task.backend)
    config = _env.NavigationConfig(motion=_env.Motion.__members__[task.motion])
    core = _env.NavigationEnv(place.renderer.core, place.navmesh, place.ground, config)
    core.reset(np.asarray(episode.start_position), episode.start_yaw)
    goal_position = task.goal_position(place, episode)
    return core, Trip(episode, place, goal_position, [core.position]), task.goal(place, episode)


def outputs(task: NavigationTask, depth: bool) -> list[str]:
    """Images that the simulator is asked for, by its names."""
    return ["panorama", "front", *(["depth"] if depth else []), *([] if task.pointing is None else IDS)]


def observed(task: NavigationTask, images: dict[str, Any], odometry: NDArray[np.float64], trip: Trip) -> Observation:
    """What the agent is given of what the simulator showed."""
    if task.pointing is not None:
        images = task.pointing.split(images, int(trip.episode.info["target"]))
    return Observation(**images, odometry=odometry)


def declared(task: NavigationTask, action: int) -> Answer | None:
    """The final answer that an action of the discrete space stands for, if it is none of the primitives."""
    choice = action - len(PRIMITIVES)
    return None if choice < 0 else Answer(task.choices, np.eye(len(task.choices))[choice])


def action_space(task: NavigationTask) -> gymnasium.spaces.Discrete:
    """The primitives, and a final answer for each of the choices that the task gives."""
    return gymnasium.spaces.Discrete(len(PRIMITIVES) + len(task.choices))


def observation_space(task: NavigationTask, depth: bool) -> gymnasium.spaces.Dict:
    """What an environment shows; the shapes that `wiw.types.Observation` documents."""
    box = gymnasium.spaces.Box
    spaces: dict[str, gymnasium.Space[Any]] = {
        "panorama": box(0, 255, (576, 1024, 3), np.uint8),
        "front": box(0, 255, (480, 480, 3), np.uint8),
        "odometry": box(-1e4, 1e4, (3,), np.float64),
    }
    if depth:
        spaces["depth"] = box(0, 1e4, (576, 1024), np.float32)
    if task.pointing is not None:
        spaces["panorama_box"] = box(-1, 1024, (4,), np.float32)
        spaces["front_box"] = box(-1, 480, (4,), np.float32)
    return gymnasium.spaces.Dict(spaces)
