# SPDX-License-Identifier: Apache-2.0
"""One batch of imagination: plans in, imagined views out; the world model is entered once for all live episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import action, panorama
from wiw._core import core, planner
from wiw.errors import ArgumentError, ContractError
from wiw.loop.history import RowHistories
from wiw.loop.imagination import Answer, Imagination, ModelInput, Request
from wiw.loop.views import maker_of, view_maker
from wiw.policies.base import FrameSpec
from wiw.types import Conditioning, Control, Key, Observation, Rollout, View
from wiw.world_models.base import Accepts, WorldModel, ask

NO_SEMANTICS = (
    "needs semantics: choose a source with --semantics simulator or --semantics rednet "
    "(wiw.experiments.semantics.Labelled); see docs/perception.md"
)

PURPOSE = 0x696D6167
"""Separates the seeds of futures from those of plans."""


@dataclass(frozen=True)
class ImaginedPrimitives(Imagination):
    """Answer to one batch of plans."""

    rollouts: list[list[Rollout]]
    """Rollouts by [episode][candidate]."""
    costs: list[dict[str, int]]
    """What the batch cost each episode: a consultation, rows asked and frames imagined."""
    observations: Sequence[Observation]
    batch: Any
    answers: list[NDArray[np.uint8]]
    """What the world model gave, one array a part of the batch."""
    view: View
    """View that the answers show."""
    source_size: tuple[int, int] | None

    def show(self, frames: FrameSpec) -> list[list[Rollout]]:
        """Return the rollouts in other views than the reviser's."""
        panoramas = [observation.panorama for observation in self.observations]
        return _show(self.batch, panoramas, self.answers, self.view, frames)

    def ends(self, chosen: Sequence[tuple[int, int]]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the panoramas and front views that (episode, candidate) plans end with, as they would be observed."""
        first = np.cumsum([0, *map(len, self.rollouts)])
        candidates = [first[episode] + candidate for episode, candidate in chosen]
        panoramas = [observation.panorama for observation in self.observations]
        sizes = panoramas[0].shape[:2], self.observations[0].front.shape[:2]
        whole, front = (
            self.batch.ends(candidates, panoramas, self.answers, view_maker(view, size))
            for view, size in zip(("panorama", "front"), sizes, strict=True)
        )
        return whole, front


def imagine_primitives(model: WorldModel, request: Request) -> ImaginedPrimitives:
    """Imagine every plan of every episode and show the futures in the views that the reviser asked for."""
    accepts, clock = model.accepts.at_size(request.frames.source_size), request.clock
    with clock("platform"):
        plans = [[plan.actions for plan in own] for own in request.plans]
        batch = planner.Batch.build(plans, make_model_spec(accepts, request.frames.ends))
        panoramas = [observation.panorama for observation in request.observations]
        parts, conditioning = batch.parts, _build_conditioning(accepts, batch, request.inputs)
        histories = None
        if accepts.history:
            flat = [actions for own in plans for actions in own]
            histories = RowHistories(accepts, batch, parts, flat, request.inputs, conditioning.image)
        seeds = _draw_seeds(accepts, batch, request.keys, request.origins)
    answers: list[NDArray[np.uint8]] = []
    for part in parts:
        with clock("platform"):
            observations = _select_starts(conditioning, part, answers, accepts)
            if histories is not None:
                observations = replace(observations, history=histories.before(part, answers))
            controls = _make_controls(accepts, part, request.wordless)
        with clock("world_model"):
            found = ask(model, observations, controls, seeds[part.rows])
            answers.append(_require_own_memory(found, answers, model))
    with clock("platform"):
        if request.retouch is not None:
            pairs = zip(parts, answers, strict=True)
            answers = [
                request.retouch(Answer(found, seeds[part.rows], part.first, part.length, part.shared, accepts.view))
                for part, found in pairs
            ]
        rollouts = _show(batch, panoramas, answers, accepts.view, request.frames)
        costs = _count_cost(batch, len(request.keys))
        source_size = accepts.size if model.accepts.is_scalable else None
        return ImaginedPrimitives(rollouts, costs, request.observations, batch, answers, accepts.view, source_size)


def _show(
    batch: Any, panoramas: Sequence[NDArray[np.uint8]], answers: list[NDArray[np.uint8]], kind: View, frames: FrameSpec
) -> list[list[Rollout]]:
    """Rollouts in the views that are requested, or in the front view where the model gives no other."""
    view = "front" if kind == "perspective" else frames.view
    size = frames.size if view == frames.view else (384, 384)
    shown = batch.views(panoramas, answers, view_maker(view, size), kind)
    real, lengths = batch.real, batch.lengths
    rollouts: list[list[Rollout]] = [[] for _ in panoramas]
    for i, episode in enumerate(batch.candidate_episode):
        rollouts[episode].append(Rollout(shown[i, : lengths[i]], real[i, : lengths[i]], view))
    return rollouts


def make_model_spec(accepts: Accepts, ends: bool = False) -> Any:
    """Return the model's properties that the planner needs; `ends` as in `FrameSpec`."""
    return planner.ModelSpec(causal=accepts.causal, frames=accepts.frames, max_rows=accepts.best_batch, ends=ends)


def _build_conditioning(accepts: Accepts, batch: Any, inputs: Sequence[ModelInput]) -> Conditioning:
    """Build each row's start: the real observation after the plan's leading turns, in the model's view and size."""
    maker = maker_of(accepts)
    depth = simulators = None
    if "depth" in accepts.needs:
        depth = batch.depths(list_depths(inputs), maker)
    semantic = _label_starts(accepts, batch, inputs) if "semantic" in accepts.needs else None
    if "simulator" in accepts.needs:
        simulators = [
            _turn(inputs[e].simulator, turns) for e, turns in zip(batch.row_episode, batch.row_turns, strict=True)
        ]
    panoramas = [own.observation.panorama for own in inputs]
    return Conditioning(batch.observations(panoramas, maker), depth=depth, semantic=semantic, simulators=simulators)


def _label_starts(accepts: Accepts, batch: Any, inputs: Sequence[ModelInput]) -> NDArray[np.uint32]:
    """Return the labels at the start of each row, without blending.

    Raises:
        ArgumentError: an episode has none.
    """
    labels = np.stack([_require_labels(own) for own in inputs])
    if accepts.view == "panorama":  # small numbers survive as floats, and distances are turned by the nearest pixel
        turned = batch.depths(labels.astype(np.float32), view_maker("panorama", accepts.size))
        return np.asarray(turned, np.uint32)
    rows = zip(batch.row_episode, np.degrees(action.ActionSpace().turn_rad) * batch.row_turns, strict=True)
    return np.stack([panorama.to_perspective(labels[e], 90.0, accepts.size, yaw, 0.0, "nearest") for e, yaw in rows])


def _require_labels(shown: ModelInput) -> NDArray[np.uint32]:
    if shown.semantic is None:
        raise ArgumentError(f"the world model {NO_SEMANTICS}")
    return shown.semantic


def _turn(simulator: Any, turns: int) -> Any:
    """Return a fork of the simulator after `turns` left turns."""
    fork = simulator.fork()
    for _ in range(abs(int(turns))):
        fork.step(int(action.TURN_LEFT if turns > 0 else action.TURN_RIGHT))
    return fork


def _select_starts(
    whole: Conditioning, part: Any, answers: Sequence[NDArray[np.uint8]], accepts: Accepts
) -> Conditioning:
    """Return the rows of one call; a call that continues a long plan begins at the frame where the one before ended."""
    if part.first == 0:
        rows = _slice_of(part.rows)
        depth = None if whole.depth is None else whole.depth[rows]
        semantic = None if whole.semantic is None else whole.semantic[rows]
        simulators = None if whole.simulators is None else [whole.simulators[r] for r in part.rows]
        return Conditioning(whole.image[rows], depth=depth, semantic=semantic, simulators=simulators)
    assert not set(accepts.needs) - {"history"}  # check_model: imagined frames have no depth, labels or simulator
    return Conditioning(np.stack([answers[p][i, f] for p, i, f in part.start]))


def _require_own_memory(found: NDArray[np.uint8], before: Sequence[NDArray[np.uint8]], model: Any) -> NDArray[np.uint8]:
    """Return the answer, if it lies elsewhere than those of earlier calls, which are still to be read."""
    if any(np.may_share_memory(found, answer) for answer in before):
        raise ContractError(
            f"{type(model.unwrapped).__name__}.rollout: returned the memory of an earlier answer, whose frames are "
            "overwritten by that; return a new array from every call",
            "memory",
        )
    return found


def _slice_of(rows: NDArray[np.int64]) -> slice | NDArray[np.int64]:
    """Return the rows as a slice where they are consecutive, so that taking them copies nothing."""
    first, last = int(rows[0]), int(rows[-1])
    return slice(first, last + 1) if last - first + 1 == len(rows) else rows


def _make_controls(accepts: Accepts, part: Any, wordless: bool) -> list[Control]:
    tells = accepts.control == "text" and not wordless
    return [
        Control(
            actions=actions,
            trajectory=trajectory,
            viewpoints=viewpoints,
            text=action.to_text(actions[:length], accepts.template) if tells else "",
            ids=_get_action_ids(accepts, actions),
            length=int(length),
            shared=int(shared),
        )
        for actions, trajectory, viewpoints, length, shared in zip(
            part.actions, part.trajectories, part.viewpoints, part.length, part.shared, strict=True
        )
    ]


def _get_action_ids(accepts: Accepts, actions: NDArray[np.int8]) -> NDArray[Any] | None:
    if accepts.control != "action":
        return None
    primitives = action.with_null(actions) if accepts.null_first else actions
    return primitives if accepts.vocabulary is None else action.to_controls(primitives, accepts.vocabulary)


def seed_of(key: Key, candidate: int) -> int:
    """Return the seed of a candidate's future, whatever else is imagined beside it.

    It is of no stream that a policy draws from: what a model draws must not depend on how the plan was drawn.
    """
    return int(core.fold_key([key.seed, key.episode, key.decision, candidate, PURPOSE]))


def list_depths(inputs: Sequence[ModelInput]) -> list[NDArray[np.float32]]:
    """Return the depth of each observation.

    Raises:
        ArgumentError: one has none.
    """
    depths = [own.observation.depth for own in inputs]
    if any(value is None for value in depths):
        raise ArgumentError("the world model needs depth: create the environment with depth=True")
    return depths


def _draw_seeds(
    accepts: Accepts, batch: Any, keys: Sequence[Key], origins: Sequence[Sequence[int]]
) -> NDArray[np.uint64]:
    """Return uint64 [rows], keyed by (episode, decision, candidate), whatever else is in the batch; 0 without seeds."""
    if not accepts.seeded:
        return np.zeros(len(batch.row_owner), np.uint64)
    seeds = [seed_of(key, candidate) for key, numbers in zip(keys, origins, strict=True) for candidate in numbers]
    return np.array(seeds, np.uint64)[batch.row_owner]


def _count_cost(batch: Any, episodes: int) -> list[dict[str, int]]:
    """Count rows asked of the world model for each episode and frames of them that no other row answers."""
    rows = np.bincount(batch.row_episode, minlength=episodes)
    frames = np.bincount(batch.row_episode, batch.row_length - batch.row_shared, minlength=episodes)
    return [{"consultations": 1, "rows": int(r), "frames": int(f)} for r, f in zip(rows, frames, strict=True)]
