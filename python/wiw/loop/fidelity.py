# SPDX-License-Identifier: Apache-2.0
"""How true imagination was, decision by decision: every candidate is replayed in the oracle and scored again.

Open-loop error of the frames and the order that their scores bring about are two things: a model may blur every picture
and still tell the better plan. What is found here is written down and reported; no policy or world model sees it.
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
from wiw.loop.imagine import imagine
from wiw.metrics import psnr, ssim
from wiw.policies.base import FrameSpec, Policy, Situation
from wiw.types import Fidelity, Proposal, Rollout
from wiw.world_models.oracle import Oracle


def remembered(situations: Sequence[Situation]) -> list[Situation]:
    """The situations with copies of their memories, as they are before scoring changes those."""
    return [replace(situation, memory=deepcopy(situation.memory)) for situation in situations]


def replay(
    reviser: Policy,
    queries: Sequence[Any],
    situations: Sequence[Situation],
    proposals: Sequence[Sequence[Proposal]],
    rollouts: Sequence[Sequence[Rollout]],
    scores: Sequence[NDArray[np.float64]],
) -> list[Fidelity]:
    """Truth beside imagination for each episode; `queries` carry forks, `situations` are those before scoring."""
    first = rollouts[0][0]
    view = FrameSpec(first.view, (first.frames.shape[-3], first.frames.shape[-2]))
    origins = [range(len(plans)) for plans in proposals]
    true = imagine(Attempts(Oracle(), math.inf), queries, proposals, origins, view, Clock()).rollouts
    true_scores = checked_scores(reviser, reviser.score(situations, proposals, true), proposals)
    rows = zip(rollouts, true, scores, true_scores, strict=True)
    return [_compared(imagined, seen, own, best) for imagined, seen, own, best in rows]


def _compared(
    imagined: Sequence[Rollout], true: Sequence[Rollout], scores: NDArray[np.float64], best: NDArray[np.float64]
) -> Fidelity:
    errors = np.array([_errors(one, other) for one, other in zip(imagined, true, strict=True)])
    return Fidelity(tuple(true), best, rank_agreement(scores, best), psnr=errors[:, 0], ssim=errors[:, 1])


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
