# SPDX-License-Identifier: Apache-2.0
"""Measure how faithful imagination is, decision by decision: replay every candidate in the oracle and score it again.

The open-loop error of the frames and the ranking that their scores produce are two different things: a model may blur
every image and still identify the better plan. The results are recorded and reported; no policy or world model sees
them.

PSNR and SSIM are computed on what the reviser sees, latitude-weighted for panoramas. LPIPS is not defined on a sphere
and needs enough pixels, so it is computed on perspective views of 90 degrees, 256x256, whatever the reviser sees: the
front view for a model that imagines nothing else, otherwise the mean over front, left, right and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw._core import core
from wiw.errors import ArgumentError
from wiw.loop.attempts import Attempted
from wiw.loop.clock import Clock
from wiw.loop.contract import check_scores
from wiw.loop.imagination import ModelInput, Request
from wiw.loop.model_imaginer import ModelImaginer
from wiw.loop.observers import Observer, ScoringBatch
from wiw.loop.privileged import LiveEnvironments, Privileged
from wiw.metrics import Lpips, psnr, rank_agreement, ssim
from wiw.policies.base import FrameSpec, Situation
from wiw.registry import WORLD_MODELS
from wiw.types import Decision, Fidelity, Key, Rollout
from wiw.world_models.base import WorldModel

PERSPECTIVE = (256, 256)
"""Size of the views on which LPIPS is computed."""
_MEASURE = 0x66696465
"""Separates the draw of whether to measure from all other draws of the decision."""


class FidelityObserver(Observer, Privileged):
    """Replays every plan in the simulator and lets the reviser score the true rollouts as well.

    Args:
        lpips: folder of the weights of LPIPS ("auto": `~/.cache/wiw/weights`), to measure fidelity with it as well.
        share: share of the decisions to measure, above 0 and up to 1, sampled by their keys: decisions measured with a
            smaller share are also measured with a larger one.
        oracle: the oracle in which plans are replayed; None means one of the default size.

    Raises:
        WeightsError: those of LPIPS are missing.
        ArgumentError: a share out of range.
    """

    def __init__(self, lpips: str | Path | None = None, share: float = 1.0, oracle: WorldModel | None = None) -> None:
        if not 0 < share <= 1:
            raise ArgumentError(f"fidelity: expected a share above 0 and up to 1, got {share}")
        self._lpips, self._share, self._oracle = None if lpips is None else Lpips(lpips), share, oracle
        self._environments = LiveEnvironments()
        self._seen: dict[Key, _Truth] = {}

    def grant(self, environments: LiveEnvironments) -> None:
        """Take the environments in which plans are replayed."""
        self._environments = environments

    def watch(self, batch: ScoringBatch) -> None:
        """Replay the plans in the simulator, and score the true rollouts with copies of the reviser's memories."""
        with batch.clock("replay"):
            pairs = enumerate(zip(batch.queries, batch.imagined.rollouts, strict=True))
            places = [place for place, (query, own) in pairs if own is not None and self._is_measured(query.key)]
            if places:
                oracle = self._oracle or WORLD_MODELS.make("oracle", space=batch.reviser.space)
                self._seen |= _replay(self._environments, oracle, batch, places, self._lpips)

    def _is_measured(self, key: Key) -> bool:
        return bool(core.uniform(core.fold_key([key.seed, key.episode, key.decision, _MEASURE]), 1)[0] < self._share)

    def annotate(self, decision: Decision) -> Decision:
        """Add the fidelity of a decision's imagination."""
        truth = None if decision.key is None else self._seen.pop(decision.key, None)
        if truth is None or decision.rollouts is None or decision.scores is None:
            return decision
        return replace(decision, fidelity=_compare(decision.rollouts, decision.scores, truth))


@dataclass(frozen=True)
class _Truth:
    rollouts: Sequence[Rollout]
    scores: NDArray[np.float64]
    distances: NDArray[np.float64] | None
    pose_errors: NDArray[np.float64] | None


def _replay(
    environments: LiveEnvironments,
    model: WorldModel,
    batch: ScoringBatch,
    places: Sequence[int],
    lpips: Lpips | None,
) -> dict[Key, _Truth]:
    """Return the true rollouts and scores of each episode that has imagined rollouts."""
    imagined = [batch.imagined.rollouts[place] or () for place in places]
    plans = [batch.plans[place] for place in places]
    queries = [batch.queries[place] for place in places]
    request = Request(
        batch.space,
        [query.key for query in queries],
        [query.observation for query in queries],
        [ModelInput(query.observation) for query in queries],
        plans,
        [range(len(own)) for own in plans],
        _view_of(imagined[0][0], batch.reviser.frames.ends, batch.imagined.source_size),
        Clock(),
    )
    oracle = ModelImaginer(Attempted(model, math.inf))
    oracle.grant(environments)
    true = oracle.imagine(request)
    situations = [_copy_memory(batch.situations[place]) for place in places]
    rollouts = [own or () for own in true.rollouts]
    scores = check_scores(batch.reviser, batch.reviser.score(situations, plans, rollouts), plans)
    distances: Sequence[Any] = [None] * len(places)
    if lpips is not None:
        view = FrameSpec("front" if batch.imagined.view == "perspective" else "surround", PERSPECTIVE)
        shown, truths = batch.imagined.show(view), true.show(view)
        distances = _measure_distances(lpips, [shown[place] for place in places], truths)
    known = batch.imagined.pose_errors
    misplaced = [None if known is None else known[place] for place in places]
    found = zip(queries, rollouts, scores, distances, misplaced, strict=True)
    return {query.key: _Truth(*measured) for query, *measured in found}


def _copy_memory(situation: Situation) -> Situation:
    return replace(situation, memory=deepcopy(situation.memory))


def _view_of(rollout: Rollout, ends: bool, source_size: tuple[int, int] | None) -> FrameSpec:
    """Return the rollout's own view and size, of panoramas as large as those requested from its model."""
    return FrameSpec(rollout.view, (rollout.frames.shape[-3], rollout.frames.shape[-2]), ends, source_size)


def _compare(imagined: Sequence[Rollout], scores: NDArray[np.float64], truth: _Truth) -> Fidelity:
    errors = np.array([_measure_errors(one, other) for one, other in zip(imagined, truth.rollouts, strict=True)])
    agreement = rank_agreement(scores, truth.scores)
    return Fidelity(
        tuple(truth.rollouts),
        truth.scores,
        agreement,
        psnr=errors[:, 0],
        ssim=errors[:, 1],
        lpips=truth.distances,
        pose_errors=truth.pose_errors,
    )


def _measure_errors(imagined: Rollout, true: Rollout) -> tuple[float, float]:
    """Return mean PSNR and SSIM over the frames that were imagined; NaN where all are the real view turned."""
    made = ~imagined.real
    if not made.any():
        return math.nan, math.nan
    frames, truth = imagined.frames[made], true.frames[made]
    weights: Any = "latitude" if imagined.view == "panorama" else "uniform"
    return float(np.mean(psnr(frames, truth, weights=weights))), float(np.mean(ssim(frames, truth, weights=weights)))


def _measure_distances(
    lpips: Lpips, imagined: Sequence[Sequence[Rollout]], true: Sequence[Sequence[Rollout]]
) -> list[NDArray[np.float64]]:
    """Return the mean LPIPS over the imagined frames of each plan, float64 [M] per episode; NaN without any."""
    return [
        np.array([_measure_distance(lpips, one, other) for one, other in zip(plans, truths, strict=True)])
        for plans, truths in zip(imagined, true, strict=True)
    ]


def _measure_distance(lpips: Lpips, imagined: Rollout, true: Rollout) -> float:
    made = ~imagined.real
    return float(np.mean(lpips(imagined.frames[made], true.frames[made]))) if made.any() else math.nan
