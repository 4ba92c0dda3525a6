# SPDX-License-Identifier: Apache-2.0
"""Agreement between two rankings of the same plans."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def rank_agreement(scores: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Return Kendall's tau-b of two scorings [N] of the same plans; NaN if all scores of one of them are equal.

    All pairs are compared, as plans are few: `scipy.stats` gives the same, but takes half a second to load in each
    process of a run.
    """
    if len(scores) < 2 or np.ptp(scores) == 0 or np.ptp(true) == 0:
        return math.nan
    one, other = (np.sign(np.subtract.outer(each, each)) for each in (np.asarray(scores), np.asarray(true)))
    untied = [np.count_nonzero(order) / 2 for order in (one, other)]  # each pair is compared twice
    agreement = (one * other).sum() / 2 / math.sqrt(untied[0]) / math.sqrt(untied[1])
    return float(np.clip(agreement, -1, 1))
