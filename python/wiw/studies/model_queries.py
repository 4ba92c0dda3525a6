# SPDX-License-Identifier: Apache-2.0
"""Requests to a world model as the loop makes them, which can be batched in other ways."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import panorama
from wiw.action import FORWARD, TURN_LEFT
from wiw.loop.attempts import DEADLINE, Attempted
from wiw.loop.clock import Clock
from wiw.loop.history import EpisodeHistories
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.imagine import seed_of
from wiw.loop.plan_space import plan_space
from wiw.policies.base import FrameSpec, Situation
from wiw.registry import TASKS
from wiw.studies.call_watch import Watched, read_watch, watch_calls
from wiw.types import GRIPPER_POSES, PRIMITIVES, Conditioning, Control, History, Key, Proposal, View
from wiw.world_models.base import Accepts, WorldModel

EPISODES = 2
SMALL = 96
"""Columns of true frames."""
TRUE_PANORAMA = (288, 512)
Frames = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Row:
    """One row of a rollout."""

    image: Frames
    depth: Any
    semantic: Any
    history: History | None
    """History of one row."""
    simulator: Any
    """As the model is given it, if it is."""
    control: Control
    seed: np.uint64
    truth: Any
    """Fork of the simulator where the episode stands."""
    plan: NDArray[Any]
    """Its actions, without padding."""


class ModelQueries:
    """The requests that the loop would make of a model at the start of some episodes.

    Args:
        model: who is asked: about primitives in scenes, or, if it takes poses, about poses at a table.
        scenes: where the episodes with primitives are.
        deadline: seconds that a call may take.

    Raises:
        ArgumentError: a deadline that is not above 0.
    """

    def __init__(self, model: WorldModel, scenes: str, deadline: float = DEADLINE) -> None:
        self._model, self._watch = model, watch_calls(model)
        self._attempts = Attempted(self._watch, deadline)
        self._space = model.accepts.space
        episodes = (
            _begin_manipulation_episodes() if self._space == GRIPPER_POSES else _begin_navigation_episodes(scenes)
        )
        self._moments = [_begin_with_history(model.accepts, *each) for each in episodes]
        self.row_seconds = 0.0
        """Seconds a row took in the last call."""

    def watch(self) -> Watched:
        """Return what the model has done to its inputs and answers so far."""
        return read_watch(self._watch)

    def rows(self, plans: Sequence[Sequence[Any]], size: tuple[int, int] | None = None) -> list[Row]:
        """Return the rows of these plans, of primitives or poses, in each episode.

        Observations are in the model's usual size, or another of those that it declares.
        """
        recorder = _RequestRecorder(self._model)
        proposals = [[Proposal(np.array(plan)) for plan in plans] for _ in self._moments]
        origins = [range(len(plans)) for _ in proposals]
        space, keys = plan_space(self._space), [moment.key for moment in self._moments]
        observations = [moment.shown.observation for moment in self._moments]
        inputs = [moment.shown for moment in self._moments]
        frames = FrameSpec("front", (48, 48), source_size=size)
        space.imagine(recorder, Request(space, keys, observations, inputs, proposals, origins, frames, Clock()))
        asked = {
            seed_of(moment.key, number): (moment.shown.simulator, np.array(plan))
            for moment in self._moments
            for number, plan in enumerate(plans)
        }
        return [
            Row(
                observations.image[place],
                None if observations.depth is None else observations.depth[place],
                None if observations.semantic is None else observations.semantic[place],
                None if observations.history is None else observations.history.rows([place]),
                None if observations.simulators is None else observations.simulators[place],
                replace(control, shared=0),
                seeds[place],
                *asked[int(seeds[place])],
            )
            for observations, controls, seeds in recorder.asked
            for place, control in enumerate(controls)
        ]

    def ask(self, rows: Sequence[Row], shared: int = 0) -> Frames:
        """Return the model's frames, in calls of at most `best_batch` rows, checked against the contract.

        With `shared`, the first frames are not asked for: the same question to the model, but not to a server that
        remembers its answers.

        Raises:
            LateError: a call took longer than the deadline.
            ContractError: an answer breaks the contract; and whatever the model raises.
        """
        begin, most = time.perf_counter(), self._model.accepts.best_batch
        rows = [replace(row, control=replace(row.control, shared=shared)) for row in rows]
        answers = [self._call(rows[first : first + most]) for first in range(0, len(rows), most)]
        self.row_seconds = (time.perf_counter() - begin) / len(rows)
        return np.concatenate(answers)

    def _call(self, rows: Sequence[Row]) -> Frames:
        observations = Conditioning(
            np.stack([row.image for row in rows]),
            depth=None if rows[0].depth is None else np.stack([row.depth for row in rows]),
            semantic=None if rows[0].semantic is None else np.stack([row.semantic for row in rows]),
            history=None if rows[0].history is None else _history_of(rows),
            simulators=None if rows[0].simulator is None else [row.simulator for row in rows],
        )
        controls, seeds = [row.control for row in rows], np.array([row.seed for row in rows], np.uint64)
        return np.array(self._attempts.once(observations, controls, seeds))  # a model may write to it later

    def true_frames(self, rows: Sequence[Row], plans: Sequence[NDArray[Any]]) -> list[Frames]:
        """Return what an agent would truly see after each action of a plan, for the place of each row.

        uint8 [K, H, W, 3], in the model's view, of some small size.
        """
        accepts = self._model.accepts
        truth = _render_true_front_views if self._space == GRIPPER_POSES else _render_true_views
        height, width = accepts.size
        small = max(1, round(SMALL * height / width)), SMALL
        return [truth(row.truth, plan, small, accepts.view) for row, plan in zip(rows, plans, strict=True)]


class _RequestRecorder(WorldModel):
    """Records the loop's requests to a model, and answers with unchanged frames."""

    def __init__(self, model: WorldModel) -> None:
        self._model = model
        self.asked: list[tuple[Conditioning, Sequence[Control], NDArray[np.uint64]]] = []

    @property
    def accepts(self) -> Accepts:  # type: ignore[override]
        """The model's; with seeds in any case, by which a row is known again."""
        return replace(self._model.accepts, seeded=True)

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Record the request."""
        self.asked.append((observations, controls, seeds))
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)


@dataclass(frozen=True)
class _Moment:
    """An episode's present state."""

    key: Key
    shown: ModelInput


def _history_of(rows: Sequence[Row]) -> History:
    return History.concatenate([row.history for row in rows if row.history is not None])


def _render_true_views(simulator: Any, plan: NDArray[Any], size: tuple[int, int], view: View) -> Frames:
    """Return an agent's true views along a plan."""
    poses = simulator.camera_poses_after(plan.astype(np.int8))
    panoramas = np.empty((len(plan), *TRUE_PANORAMA, 3), np.uint8)
    simulator.renderer.panorama(poses, TRUE_PANORAMA, panoramas, None, None)
    if view == "perspective":
        return np.asarray(panorama.to_perspective(panoramas, 90.0, size))
    return np.stack([cv2.resize(each, size[::-1], interpolation=cv2.INTER_AREA) for each in panoramas])


def _render_true_front_views(simulator: Any, plan: NDArray[Any], size: tuple[int, int], view: View) -> Frames:
    """Return a manipulator's true front views along a plan."""
    return np.asarray(simulator.fork().render_fronts_after(plan, size))


def _begin_navigation_episodes(scenes: str) -> list[tuple[Any, Any, Key]]:
    """Begin some navigation episodes: environment, first observation and key."""
    task = TASKS.make("imagenav", scenes=scenes)
    envs = [task.environment(depth=True) for _ in range(EPISODES)]
    return [(env, env.begin(task.episode(index)), Key(0, index)) for index, env in enumerate(envs)]


def _begin_manipulation_episodes() -> list[tuple[Any, Any, Key]]:
    """Begin some manipulation episodes: environment, first observation and key."""
    task = TASKS.make("manipulation")
    envs = [task.environment(depth=True) for _ in range(EPISODES)]
    return [(env, env.begin(task.episode(index)), Key(0, index)) for index, env in enumerate(envs)]


def _begin_with_history(accepts: Accepts, env: Any, observation: Any, key: Key) -> _Moment:
    """Return an episode's first moment; of a model with a memory, a moment some decisions later.

    One episode is older than the other, and its segments are shorter, so that histories differ in padding.
    """
    histories, executed = EpisodeHistories(accepts), list[Any]()
    decisions = 1 + key.episode if accepts.history else 0
    for decision in range(decisions):
        histories.add([Situation(observation, env.goal, key.at(decision), None, tuple(executed))])
        plan = _make_segment(accepts.space, observation, 3 - key.episode)
        observation = env.run(plan).observation
        executed += plan.tolist()
    semantic = env.semantic() if accepts.space == PRIMITIVES and "semantic" in accepts.needs else None
    (history,) = histories.add([Situation(observation, env.goal, key.at(decisions), None, tuple(executed))])
    return _Moment(key.at(decisions), ModelInput(observation, env.fork(), semantic, history))


def _make_segment(space: str, observation: Any, length: int) -> NDArray[Any]:
    """Return a decision's actions: steps ahead and a turn, or a gripper's motion upwards."""
    if space == PRIMITIVES:
        return np.array([FORWARD] * (length - 1) + [TURN_LEFT], np.int8)
    ways = np.arange(1, length + 1)[:, None] * (0, 0, 0.01, 0, 0, 0, 0)
    return np.asarray(observation.pose + ways, np.float64)
