# SPDX-License-Identifier: Apache-2.0
"""How true imagination was, decision by decision: every candidate is replayed in the oracle and scored again.

Open-loop error of the frames and the order that their scores bring about are two things: a model may blur every picture
and still tell the better plan. What is found here is written down and reported; no policy or world model sees it.

PSNR and SSIM are taken of what the reviser sees, latitude-weighted where that is panoramas. LPIPS knows no sphere and
needs pixels, so it is taken of perspective views of 90 degrees, 256x256, whatever the reviser sees: the front view of a
model that imagines no more, else the mean over front, left, right and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.loop.attempts import Attempts
from wiw.loop.clock import Clock
from wiw.loop.contract import checked_scores
from wiw.loop.imagine import Imagination
from wiw.loop.imagine_poses import IMAGINE, PoseImagination
from wiw.metrics import Lpips, psnr, ssim
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.types import Fidelity, Proposal, Rollout
from wiw.world_models.oracle import Oracle

PERSPECTIVE = (256, 256)
"""Size of the views that LPIPS is taken of."""


def remembered(situations: Sequence[Situation]) -> list[Situation]:
    """The situations with copies of their memories, as they are before scoring changes those."""
    return [replace(situation, memory=deepcopy(situation.memory)) for situation in situations]


def replay(
    reviser: Policy,
    queries: Sequence[Any],
    situations: Sequence[Situation],
    proposals: Sequence[Sequence[Proposal]],
    imagined: Imagination | PoseImagination,
    scores: Sequence[NDArray[np.float64]],
    lpips: Lpips | None = None,
) -> list[Fidelity]:
    """Truth beside imagination for each episode; `queries` carry forks, `situations` are those before scoring."""
    first = imagined.rollouts[0][0]
    view = FrameSpec(first.view, (first.frames.shape[-3], first.frames.shape[-2]))
    origins = [range(len(plans)) for plans in proposals]
    oracle = Attempts(Oracle().for_space(reviser.space), math.inf)
    true = IMAGINE[reviser.space](oracle, queries, proposals, origins, view, Clock())
    true_scores = checked_scores(reviser, reviser.score(situations, proposals, true.rollouts), proposals)
    distances = [None] * len(queries) if lpips is None else _distances(lpips, imagined, true)
    rows = zip(imagined.rollouts, true.rollouts, scores, true_scores, distances, strict=True)
    return [_compared(*row) for row in rows]


def _compared(
    imagined: Sequence[Rollout],
    true: Sequence[Rollout],
    scores: NDArray[np.float64],
    best: NDArray[np.float64],
    lpips: NDArray[np.float64] | None,
) -> Fidelity:
    errors = np.array([_errors(one, other) for one, other in zip(imagined, true, strict=True)])
    agreement = rank_agreement(scores, best)
    return Fidelity(tuple(true), best, agreement, psnr=errors[:, 0], ssim=errors[:, 1], lpips=lpips)


def rank_agreement(scores: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Kendall's tau-b of two scorings of the same plans; NaN where one of them tells nothing apart."""
    from scipy.stats import kendalltau

    if len(scores) < 2 or np.ptp(scores) == 0 or np.ptp(true) == 0:
        return math.nan
    return float(kendalltau(scores, true).statistic)


def _errors(imagined: Rollout, true: Rollout) -> tuple[float, float]:
    """Mean PSNR and SSIM over the frames that were imagined; NaN where all are the real view turned."""
    made = ~imagined.real
    if not made.any():
        return math.nan, math.nan
    frames, truth = imagined.frames[made], true.frames[made]
    weights: Any = "latitude" if imagined.view == "panorama" else "uniform"
    return float(np.mean(psnr(frames, truth, weights=weights))), float(np.mean(ssim(frames, truth, weights=weights)))


def _distances(lpips: Lpips, imagined: Any, true: Any) -> list[NDArray[np.float64]]:
    """Mean LPIPS over the frames of each plan that were imagined, float64 [M] an episode; NaN without any."""
    view = FrameSpec("front" if imagined.view == "perspective" else "surround", PERSPECTIVE)
    return [
        np.array([_distance(lpips, one, other) for one, other in zip(plans, truths, strict=True)])
        for plans, truths in zip(imagined.seen(view), true.seen(view), strict=True)
    ]


def _distance(lpips: Lpips, imagined: Rollout, true: Rollout) -> float:
    made = ~imagined.real
    return float(np.mean(lpips(imagined.frames[made], true.frames[made]))) if made.any() else math.nan
