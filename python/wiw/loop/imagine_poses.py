# SPDX-License-Identifier: Apache-2.0
"""One batch of imagination where plans are poses of a gripper, seen by a fixed camera (paper, section "Unified Action
API").

A model of a given length imagines any plan at that length: longer plans are sampled evenly, shorter ones interpolated,
from the gripper's present pose on. The frame at each pose of the plan, or at its last, is shown to the reviser.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.loop.history import frames_of, stack_histories
from wiw.loop.imagination import Answer, Imagination, ModelInput, Request
from wiw.loop.imagine import list_depths, seed_of
from wiw.loop.views import resize
from wiw.policies.base import FrameSpec
from wiw.types import Conditioning, Control, Proposal, Rollout, View
from wiw.world_models.base import Accepts, WorldModel, ask


@dataclass(frozen=True)
class ImaginedPoses(Imagination):
    """Answer to one batch of plans."""

    rollouts: list[list[Rollout]]
    """[episode][candidate]."""
    costs: list[dict[str, int]]
    """What the batch cost each episode: a consultation, rows asked and frames imagined."""
    frames: list[list[NDArray[np.uint8]]]
    """uint8 [K, H, W, 3] by [episode][candidate], in the model's size."""
    view: View = "perspective"

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Return the rollouts in another size."""
        return [[_make_rollout(own, frames.size) for own in plans] for plans in self.frames]


@dataclass(frozen=True)
class _Row:
    """One rollout to request, and the plans that it serves."""

    episode: int
    plan: NDArray[np.float64]
    control: Control
    seed: int


def imagine_poses(model: WorldModel, request: Request) -> ImaginedPoses:
    """Imagine every plan of every episode, equal ones of an episode once; see `wiw.loop.imagine`."""
    accepts, clock = model.accepts, request.clock
    with clock("platform"):
        rows, places = _list_rows(accepts, request)
    answers: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)] * len(rows)
    for part in _split_rows(rows, accepts.best_batch):
        with clock("platform"):
            observations = _build_conditioning(accepts, [request.inputs[rows[i].episode] for i in part])
            controls = [rows[i].control for i in part]
            seeds = np.array([rows[i].seed for i in part], np.uint64)
        with clock("world_model"):
            found = ask(model, observations, controls, seeds)
        if request.retouch is not None:
            with clock("platform"):
                lengths, shared = [own.length for own in controls], [own.shared for own in controls]
                found = request.retouch(Answer(found, seeds, 0, lengths, shared, accepts.view))
        for i, own in zip(part, found, strict=True):
            answers[i] = own[_find_frames(rows[i], request.frames.ends)]
    with clock("platform"):
        made = [[answers[place] for place in plans] for plans in places]
        rollouts = [[_make_rollout(own, request.frames.size) for own in plans] for plans in made]
        return ImaginedPoses(rollouts, _count_cost(rows, len(request.keys)), made)


def _list_rows(accepts: Accepts, request: Request) -> tuple[list[_Row], list[list[int]]]:
    """Return the rollouts to request, and for each episode's plans their indices among them."""
    rows: list[_Row] = []
    places: list[list[int]] = []
    for episode, (plans, numbers) in enumerate(zip(request.plans, request.origins, strict=True)):
        known: dict[tuple[bytes, str], int] = {}
        for plan, number in zip(plans, numbers, strict=True):
            name = plan.actions.tobytes(), plan.text
            if name not in known:
                known[name] = len(rows)
                seed = seed_of(request.keys[episode], number) if accepts.seeded else 0
                control = _make_control(accepts, plan, request.observations[episode].pose, request)
                rows.append(_Row(episode, plan.actions, control, seed))
        places.append([known[plan.actions.tobytes(), plan.text] for plan in plans])
    return rows, places


def _make_control(accepts: Accepts, plan: Proposal, here: NDArray[np.float64], request: Request) -> Control:
    """Return the plan at the length that the model imagines, or at its own."""
    tells = accepts.control == "text" and not request.wordless
    poses = plan.actions
    if accepts.frames:
        poses = action.resample(poses, accepts.frames - 1, start=here)
    text = plan.text or action.to_text(plan.actions, accepts.template) if tells else ""
    ids = np.concatenate([here[None], poses]) if accepts.control == "action" else None
    if ids is not None and accepts.vocabulary is not None:
        ids = action.to_controls(ids, accepts.vocabulary)
    unread = len(poses) - 1 if request.frames.ends and accepts.causal else 0
    return Control.of_poses(len(poses), text, ids, unread)


def _split_rows(rows: Sequence[_Row], most: int) -> Iterator[list[int]]:
    """Return rows of equal length, in calls of at most `most`."""
    order = sorted(range(len(rows)), key=lambda i: rows[i].control.length)
    for _, same in groupby(order, key=lambda i: rows[i].control.length):
        places = list(same)
        for first in range(0, len(places), most):
            yield places[first : first + most]


def _build_conditioning(accepts: Accepts, inputs: Sequence[ModelInput]) -> Conditioning:
    depth = simulators = None
    if "depth" in accepts.needs:
        depth = np.stack([resize(value, accepts.size, cv2.INTER_NEAREST_EXACT) for value in list_depths(inputs)])
    if "simulator" in accepts.needs:
        simulators = [own.simulator for own in inputs]
    image = np.stack([resize(own.observation.front, accepts.size) for own in inputs])
    history = None
    if accepts.history:
        history = stack_histories([frames_of(accepts, own) for own in inputs], accepts.history)
    return Conditioning(image, depth=depth, history=history, simulators=simulators)


def _find_frames(row: _Row, ends: bool) -> NDArray[np.int64]:
    """int64 [K]: the frame of a rollout at which the gripper has come to each pose of the plan; `ends`: to its last."""
    frames = action.frames_of_actions(len(row.plan), row.control.length + 1, "resample")[:, 1]
    return frames[-1:] if ends else frames


def _make_rollout(frames: NDArray[np.uint8], size: tuple[int, int]) -> Rollout:
    shown = np.stack([resize(frame, size) for frame in frames])
    return Rollout(shown, np.zeros(len(frames), np.bool_), "front")


def _count_cost(rows: Sequence[_Row], episodes: int) -> list[dict[str, int]]:
    counts = [{"consultations": 1, "rows": 0, "frames": 0} for _ in range(episodes)]
    for row in rows:
        counts[row.episode]["rows"] += 1
        counts[row.episode]["frames"] += row.control.length - row.control.shared
    return counts
