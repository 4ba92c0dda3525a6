# SPDX-License-Identifier: Apache-2.0
"""Histories for world models with a memory: the latest observations of each live episode.

Each decision adds the one observation that the agent makes for it. An episode's frames are a function of its own past
alone, whatever other episodes are live and in which order they are decided for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.action import TURN_LEFT, TURN_RIGHT, ActionSpace, relative_poses, to_trajectory
from wiw.loop.views import take_views
from wiw.types import ArmObservation, History, Key, Observation
from wiw.world_models.base import Accepts


@dataclass(frozen=True)
class Frame:
    """One frame of a history."""

    image: NDArray[np.uint8]
    """uint8 [H, W, 3] in the world model's view and size."""
    pose: NDArray[np.float64]
    """float64 [3] (x forward, y left, azimuth) in a frame that the frames of an episode share, or [7] of a gripper."""
    actions: NDArray[Any]
    """int8 [K] or float64 [K, 7]: carried out since the frame before."""


@dataclass(frozen=True)
class _Moment:
    decision: int
    executed: int
    """Actions of the episode before it, as far as the agent knows."""
    frame: Frame


class EpisodeHistories:
    """The latest observations of every live episode, as a world model is shown them.

    Args:
        accepts: what the model declares; without a need of history nothing is remembered.
    """

    def __init__(self, accepts: Accepts | None) -> None:
        self._accepts = accepts if accepts is not None and accepts.history else None
        self._moments: dict[tuple[int, int], list[_Moment]] = {}

    def add(self, situations: Sequence[Any]) -> list[tuple[Frame, ...] | None]:
        """Add each episode's observation to those before, and return the latest of each; None if none are needed.

        Decision 0 begins an episode anew; a repeated decision replaces what it added before.
        """
        if self._accepts is None:
            return [None] * len(situations)
        images = take_views(self._accepts, [situation.observation for situation in situations])
        return [
            self._add(situation, image, situation.executed, self._accepts.history)
            for situation, image in zip(situations, images, strict=True)
        ]

    def forget(self, key: Key) -> None:
        """Drop the frames of an episode that has ended."""
        self._moments.pop((key.seed, key.episode), None)

    def _add(self, query: Any, image: NDArray[np.uint8], executed: Sequence[Any], most: int) -> tuple[Frame, ...]:
        name, decision = (query.key.seed, query.key.episode), query.key.decision
        known = self._moments.get(name, [])
        before = [moment for moment in known if moment.decision < decision]
        again = [moment for moment in known if moment.decision == decision]
        if again:  # what has led here is the same, and `executed` has the first answer's actions as well
            actions = again[0].frame.actions
        else:
            actions = _as_actions(query.observation, executed[before[-1].executed :] if before else ())
        frame = Frame(image.copy(), pose_of(query.observation), actions)
        self._moments[name] = [*before, _Moment(decision, len(executed), frame)][-most:]
        return tuple(moment.frame for moment in self._moments[name])


def pose_of(observation: Observation | ArmObservation) -> NDArray[np.float64]:
    """Return where an observation was made: odometry, or the gripper's pose."""
    pose = observation.pose if isinstance(observation, ArmObservation) else observation.odometry
    return np.array(pose, np.float64)


def frames_of(accepts: Accepts, shown: Any) -> tuple[Frame, ...]:
    """Return the frames of a `ModelInput`; of one without, as of an episode's first moment, its observation."""
    if shown.history is not None:
        return tuple(shown.history)
    (image,) = take_views(accepts, [shown.observation])
    return (Frame(image, pose_of(shown.observation), _as_actions(shown.observation, ())),)


def _as_actions(observation: Observation | ArmObservation, actions: Sequence[Any]) -> NDArray[Any]:
    if isinstance(observation, ArmObservation):
        return np.array(actions, np.float64).reshape(-1, 7)
    return np.array(actions, np.int8)


class RowHistories:
    """The histories of a batch's rows, for each call of the world model.

    Args:
        accepts: what the model declares.
        batch: of the planner.
        parts: its calls.
        plans: of all candidates, counted over all episodes.
        inputs: what the model is shown of each episode.
        images: what each row begins with, uint8 [rows, H, W, 3].
    """

    def __init__(
        self,
        accepts: Accepts,
        batch: Any,
        parts: Sequence[Any],
        plans: Sequence[NDArray[np.int8]],
        inputs: Sequence[Any],
        images: NDArray[np.uint8],
    ) -> None:
        self._most, self._steps = accepts.history, accepts.frames - 1
        self._parents, self._shared = batch.row_parent, batch.row_shared
        self._places = {
            (int(row), part.first): (number, index)
            for number, part in enumerate(parts)
            for index, row in enumerate(part.rows)
        }
        own = [frames_of(accepts, shown) for shown in inputs]
        self._starts = [
            _from_frame_0(_turn(own[episode], int(turns), image))
            for episode, turns, image in zip(batch.row_episode, batch.row_turns, images, strict=True)
        ]
        rows = zip(batch.row_owner, batch.row_length, strict=True)
        self._actions = [plans[owner][len(plans[owner]) - length :] for owner, length in rows]

    def before(self, part: Any, answers: Sequence[NDArray[np.uint8]]) -> History:
        """Return the histories of a call's rows, imagined frames of earlier calls included."""
        return stack_histories([self._list_frames(int(row), part.first, answers) for row in part.rows], self._most)

    def _list_frames(self, row: int, first: int, answers: Sequence[NDArray[np.uint8]]) -> Sequence[Frame]:
        if first == 0:
            return self._starts[row]
        actions = self._actions[row][:first]
        poses = to_trajectory(actions)
        imagined = [
            Frame(self._get_image(row, k, answers), poses[k - 1], actions[k - 1 : k])
            for k in range(max(1, first - self._most + 1), first + 1)
        ]
        return [*self._starts[row], *imagined]

    def _get_image(self, row: int, frame: int, answers: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Return an imagined frame of a row; where rows share it, it stands in the answer to the first of them."""
        while frame <= self._shared[row]:
            row = int(self._parents[row])
        first = (frame - 1) // self._steps * self._steps
        number, index = self._places[row, first]
        return answers[number][index, frame - first]


def _turn(frames: Sequence[Frame], turns: int, image: NDArray[np.uint8]) -> Sequence[Frame]:
    """Add the view after leading turns, positive to the left."""
    if turns == 0:
        return frames
    pose = frames[-1].pose + np.array([0, 0, turns * ActionSpace().turn_rad])
    actions = np.full(abs(turns), int(TURN_LEFT if turns > 0 else TURN_RIGHT), np.int8)
    return [*frames, Frame(image, pose, actions)]


def _from_frame_0(frames: Sequence[Frame]) -> list[Frame]:
    """Express poses in the frame of the last one."""
    poses = relative_poses(np.stack([frame.pose for frame in frames]))
    return [replace(frame, pose=pose) for frame, pose in zip(frames, poses, strict=True)]


def stack_histories(rows: Sequence[Sequence[Frame]], most: int) -> History:
    """Return the latest `most` frames of each row as a batch; planar poses in the frame of each row's last."""
    kept = [row[-most:] for row in rows]
    padded = [[row[0]] * (most - len(row)) + list(row) for row in kept]
    poses = np.stack([[frame.pose for frame in row] for row in padded])
    lengths = np.zeros((len(rows), most - 1), np.int64)
    for place, row in enumerate(kept):
        lengths[place, most - len(row) :] = [len(frame.actions) for frame in row[1:]]
    return History(
        images=np.stack([[frame.image for frame in row] for row in padded]),
        poses=poses if poses.shape[-1] == 7 else relative_poses(poses),
        actions=_pad_actions(padded, lengths),
        lengths=lengths,
        count=np.array([len(row) for row in kept], np.int64),
    )


def _pad_actions(rows: Sequence[Sequence[Frame]], lengths: NDArray[np.int64]) -> NDArray[Any]:
    longest = max(1, int(lengths.max(initial=0)))
    poses = rows[0][0].actions.ndim == 2
    actions = np.zeros((*lengths.shape, longest, *((7,) if poses else ())), np.float64 if poses else np.int8)
    for row, (frames, own) in enumerate(zip(rows, lengths, strict=True)):
        for gap, (frame, length) in enumerate(zip(frames[1:], own, strict=True)):
            actions[row, gap, :length] = frame.actions[:length]
            if poses:  # a gripper that is sent nowhere stays where it is
                actions[row, gap, length:] = frame.actions[length - 1] if length else frame.pose
    return actions
