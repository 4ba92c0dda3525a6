# SPDX-License-Identifier: Apache-2.0
"""One batch of imagination where plans are poses of a gripper, seen by a fixed camera (paper, section "Unified Action
API").

A model of a given length imagines any plan at that length: longer plans are sampled evenly, shorter ones interpolated,
from the gripper's present pose on. The frame at each pose of the plan is shown to the reviser.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.errors import ArgumentError
from wiw.loop.clock import Clock
from wiw.loop.history import frames_of, stack_histories
from wiw.loop.imagine import Imagination, depths_of, imagine, seed_of
from wiw.loop.rollout_cache import Asking
from wiw.loop.views import resize
from wiw.policies.base import FrameSpec
from wiw.types import Conditioning, Control, Proposal, Rollout, Space, View
from wiw.world_models.base import Accepts


@dataclass(frozen=True)
class PoseImagination:
    """Answer to one batch of plans."""

    rollouts: list[list[Rollout]]
    """[episode][candidate]."""
    calls: list[dict[str, int]]
    """What the batch cost each episode: a consultation, rows asked and frames imagined."""
    frames: list[list[NDArray[np.uint8]]]
    """uint8 [K, H, W, 3] by [episode][candidate], in the model's size."""
    view: View = "perspective"

    def seen(self, frames: FrameSpec) -> list[list[Rollout]]:
        """The rollouts in another size."""
        return [[_rollout(own, frames.size) for own in plans] for plans in self.frames]


@dataclass(frozen=True)
class _Row:
    """One future that a model is asked for, and the plans that it answers."""

    episode: int
    plan: NDArray[np.float64]
    control: Control
    seed: int


def imagine_poses(
    ask: Asking,
    queries: Sequence[Any],
    proposals: Sequence[Sequence[Proposal]],
    origins: Sequence[Sequence[int]],
    frames: FrameSpec,
    clock: Clock,
    seen: Sequence[Any] | None = None,
) -> PoseImagination:
    """Imagines every proposal of every episode, equal ones of an episode once; see `wiw.loop.imagine.imagine`."""
    accepts = ask.model.accepts
    with clock("platform"):
        rows, places = _rows(accepts, queries, proposals, origins)
        shown = queries if seen is None else seen
    answers: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)] * len(rows)
    for part in _parts(rows, accepts.best_batch):
        with clock("platform"):
            observations = _conditioning(accepts, [shown[rows[i].episode] for i in part])
            seeds = np.array([rows[i].seed for i in part], np.uint64)
        with clock("world_model"):
            before = ask.cache_seconds
            found = ask(observations, [rows[i].control for i in part], seeds)
        clock.move(ask.cache_seconds - before, "world_model", "cache")
        for i, own in zip(part, found, strict=True):
            answers[i] = own[_frames_of(rows[i])]
    with clock("platform"):
        made = [[answers[place] for place in plans] for plans in places]
        rollouts = [[_rollout(own, frames.size) for own in plans] for plans in made]
        return PoseImagination(rollouts, _cost(rows, len(queries)), made)


IMAGINE: Mapping[Space, Callable[..., Imagination | PoseImagination]] = {"discrete": imagine, "pose7": imagine_poses}
"""By what plans are made of."""


def _rows(
    accepts: Accepts,
    queries: Sequence[Any],
    proposals: Sequence[Sequence[Proposal]],
    origins: Sequence[Sequence[int]],
) -> tuple[list[_Row], list[list[int]]]:
    """The futures to be asked for, and the place among them of each episode's plans."""
    rows: list[_Row] = []
    places: list[list[int]] = []
    for episode, (query, plans, numbers) in enumerate(zip(queries, proposals, origins, strict=True)):
        known: dict[tuple[bytes, str], int] = {}
        for plan, number in zip(plans, numbers, strict=True):
            name = plan.actions.tobytes(), plan.text
            if name not in known:
                known[name] = len(rows)
                control = _control(accepts, plan, query.observation.pose)
                rows.append(_Row(episode, plan.actions, control, seed_of(query.key, number)))
        places.append([known[plan.actions.tobytes(), plan.text] for plan in plans])
    return rows, places


def _control(accepts: Accepts, plan: Proposal, here: NDArray[np.float64]) -> Control:
    """The plan at the length that the model imagines, or at its own."""
    poses = plan.actions
    if accepts.frames:
        poses = action.resample(poses, accepts.frames - 1, start=here)
    count = len(poses)
    return Control(
        actions=np.full(count, int(action.NULL), np.int8),
        trajectory=np.zeros((count, 3)),
        viewpoints=np.broadcast_to(np.eye(4), (count, 4, 4)),
        text=plan.text or action.to_text(plan.actions) if accepts.control == "text" else "",
        ids=np.concatenate([here[None], poses]) if accepts.control == "action" else None,
        length=count,
    )


def _parts(rows: Sequence[_Row], most: int) -> Iterator[list[int]]:
    """Rows of equal length, in calls of at most `most`."""
    order = sorted(range(len(rows)), key=lambda i: rows[i].control.length)
    for _, same in groupby(order, key=lambda i: rows[i].control.length):
        places = list(same)
        for first in range(0, len(places), most):
            yield places[first : first + most]


def _conditioning(accepts: Accepts, queries: Sequence[Any]) -> Conditioning:
    depth = simulators = None
    if "depth" in accepts.needs:
        depth = np.stack([resize(value, accepts.size, cv2.INTER_NEAREST) for value in depths_of(queries)])
    if "simulator" in accepts.needs:
        simulators = [query.simulator for query in queries]
        if any(value is None for value in simulators):
            raise ArgumentError("the world model needs the simulator: pass decide(..., simulator=env.fork())")
    image = np.stack([resize(query.observation.front, accepts.size) for query in queries])
    history = None
    if accepts.history:
        history = stack_histories([frames_of(accepts, query) for query in queries], accepts.history)
    return Conditioning(image, depth=depth, history=history, simulators=simulators)


def _frames_of(row: _Row) -> NDArray[np.int64]:
    """int64 [K]: the frame of a rollout at which the gripper has come to each pose of the plan."""
    return action.frames_of_actions(len(row.plan), row.control.length + 1, "resample")[:, 1]


def _rollout(frames: NDArray[np.uint8], size: tuple[int, int]) -> Rollout:
    shown = np.stack([resize(frame, size) for frame in frames])
    return Rollout(shown, np.zeros(len(frames), np.bool_), "front")


def _cost(rows: Sequence[_Row], episodes: int) -> list[dict[str, int]]:
    counts = [{"consultations": 1, "rows": 0, "frames": 0} for _ in range(episodes)]
    for row in rows:
        counts[row.episode]["rows"] += 1
        counts[row.episode]["frames"] += row.control.length
    return counts
