# SPDX-License-Identifier: Apache-2.0
"""Agreement of two orders of the same plans."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def rank_agreement(scores: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Return Kendall's tau-b of two scorings of the same plans; NaN where all scores of one of them are equal."""
    from scipy.stats import kendalltau

    if len(scores) < 2 or np.ptp(scores) == 0 or np.ptp(true) == 0:
        return math.nan
    return float(kendalltau(scores, true).statistic)
