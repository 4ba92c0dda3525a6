# SPDX-License-Identifier: Apache-2.0
"""Questions to a world model as the loop asks them, row by row, to be asked in other company."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT
from wiw.loop.agent import Query
from wiw.loop.attempts import DEADLINE, Attempts
from wiw.loop.clock import Clock
from wiw.loop.history import EpisodeHistories
from wiw.loop.imagine_poses import IMAGINE
from wiw.policies.base import FrameSpec
from wiw.registry import TASKS
from wiw.types import Conditioning, Control, History, Key, Proposal, Space
from wiw.world_models.base import Accepts, WorldModel

EPISODES = 2
PLAN = ("actions", "trajectory", "viewpoints", "ids")
"""Arrays of a control."""
PAST = ("images", "poses", "actions", "lengths", "count")
"""Arrays of a history."""
Frames = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Row:
    """One row of a rollout."""

    image: Frames
    depth: Any
    semantic: Any
    history: History | None
    """Of one row."""
    simulator: Any
    control: Control
    seed: np.uint64


class Questions:
    """What the loop would ask a model in the first moments of some episodes.

    Args:
        model: who is asked: about primitives in scenes, or, if it takes poses, about poses at a table.
        scenes: where the episodes with primitives are.
        deadline: seconds that a call may take.

    Raises:
        ArgumentError: a deadline that is not above 0.
    """

    def __init__(self, model: WorldModel, scenes: str, deadline: float = DEADLINE) -> None:
        self._model, self._attempts = model, Attempts(model, deadline)
        self._space = model.accepts.space
        queries = _at_tables() if self._space == "pose7" else _in_scenes(scenes)
        self._queries = [_later_moment(model.accepts, *each) for each in queries]
        self.row_seconds = 0.0
        """What a row took in the last call."""
        self.changed: set[str] = set()
        """What of its inputs the model has changed."""
        self.reuses = False
        """Whether an answer lay in the memory of the one before."""
        self._latest: Frames | None = None

    def rows(self, plans: Sequence[Sequence[Any]]) -> list[Row]:
        """The rows of these plans, of primitives or poses, in each episode."""
        recorder = _Recorder(self._model)
        proposals = [[Proposal(np.array(plan)) for plan in plans] for _ in self._queries]
        origins = [range(len(plans)) for _ in proposals]
        IMAGINE[self._space](recorder, self._queries, proposals, origins, FrameSpec("front", (48, 48)), Clock())
        return [
            Row(
                observations.image[place],
                None if observations.depth is None else observations.depth[place],
                None if observations.semantic is None else observations.semantic[place],
                None if observations.history is None else observations.history.rows([place]),
                None if observations.simulators is None else observations.simulators[place],
                replace(control, shared=0),
                seeds[place],
            )
            for observations, controls, seeds in recorder.asked
            for place, control in enumerate(controls)
        ]

    def ask(self, rows: Sequence[Row], shared: int = 0) -> Frames:
        """The model's answer, in calls of as many rows as it takes best, held to the contract.

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
        given = [("seeds", seeds)]
        given += [(f"observations.{name}", getattr(observations, name)) for name in ("image", "depth", "semantic")]
        if observations.history is not None:
            past = observations.history
            given += [(f"observations.history.{name}", getattr(past, name)) for name in PAST]
        given += [(f"control.{name}", getattr(control, name)) for control in controls for name in PLAN]
        given = [(name, array) for name, array in given if array is not None]
        kept = [array.copy() for _, array in given]
        frames = self._attempts.once(observations, controls, seeds)
        self.changed |= {
            name for (name, array), before in zip(given, kept, strict=True) if not np.array_equal(array, before)
        }
        self.reuses |= self._latest is not None and np.may_share_memory(frames, self._latest)
        self._latest = frames
        return np.array(frames)


class _Recorder(Attempts):
    """Notes what the loop asks of a model, and answers that nothing moves."""

    def __init__(self, model: WorldModel) -> None:
        super().__init__(model)
        self.asked: list[tuple[Conditioning, Sequence[Control], NDArray[np.uint64]]] = []

    def __call__(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        self.asked.append((observations, controls, seeds))
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), 1)


def _history_of(rows: Sequence[Row]) -> History:
    return History.concatenate([row.history for row in rows if row.history is not None])


def _in_scenes(scenes: str) -> list[tuple[Any, Any, Key]]:
    """Return some episodes of an agent that walks: environment, first observation and key."""
    task = TASKS.make("imagenav", scenes=scenes)
    envs = [task.environment(depth=True) for _ in range(EPISODES)]
    return [(env, env.begin(task.episode(index)), Key(0, index)) for index, env in enumerate(envs)]


def _at_tables() -> list[tuple[Any, Any, Key]]:
    """Return some episodes of an arm."""
    task = TASKS.make("manipulation")
    envs = [task.environment(depth=True) for _ in range(EPISODES)]
    return [(env, env.begin(task.episode(index)), Key(0, index)) for index, env in enumerate(envs)]


def _later_moment(accepts: Accepts, env: Any, observation: Any, key: Key) -> Query:
    """Return an episode's first moment; of a model with a memory, a moment some decisions later.

    One episode is older than the other, and its segments are shorter, so that histories differ in padding.
    """
    histories, executed = EpisodeHistories(accepts), list[Any]()
    decisions = 1 + key.episode if accepts.history else 0
    for decision in range(decisions):
        histories.add([Query(observation, env.goal, key.at(decision))], [executed])
        plan = _segment(accepts.space, observation, 3 - key.episode)
        observation = env.run(plan).observation
        executed += plan.tolist()
    semantic = env.semantic() if accepts.space == "discrete" else None
    query = Query(observation, env.goal, key.at(decisions), env.fork(), semantic=semantic)
    return histories.add([query], [executed])[0]


def _segment(space: Space, observation: Any, length: int) -> NDArray[Any]:
    """Return what is carried out at a decision: some way ahead and a turn, or a gripper's way up."""
    if space == "discrete":
        return np.array([FORWARD] * (length - 1) + [TURN_LEFT], np.int8)
    ways = np.arange(1, length + 1)[:, None] * (0, 0, 0.01, 0, 0, 0, 0)
    return np.asarray(observation.pose + ways, np.float64)
