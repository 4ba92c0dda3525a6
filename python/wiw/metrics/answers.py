# SPDX-License-Identifier: Apache-2.0
"""Question-answering scores (paper, A-EQA appendix). Raw scores are a judge's marks from 1 to 5."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wiw._core import metrics as _core
from wiw.errors import ArgumentError


def aeqa_score(scores: ArrayLike) -> float:
    """Return the mean answer score in percent, 100 (clip(s, 1, 5) - 1) / 4.

    Raises:
        ArgumentError: no episode, or NaN.
    """
    return 100.0 * float(_core.mean(_core.answer_credit(np.asarray(scores, np.float64))))


def aeqa_spl(scores: ArrayLike, shortest: ArrayLike, travelled: ArrayLike, answered: ArrayLike | None = None) -> float:
    """Return the answer score weighted by path length in percent: mean of (s - 1) / 4 * L* / max(L, L*).

    Args:
        scores: [N] raw marks; values outside 1 to 5 are clipped.
        shortest: [N] L* in metres, from the start to a viewpoint that affords the answer.
        travelled: [N] L in metres.
        answered: [N] booleans; where False, the agent itself gave no answer (a blind answer was judged), and the
            episode contributes nothing.

    Raises:
        ArgumentError: lists of different lengths or empty, NaN, or a negative length.
    """
    credit = np.asarray(_core.answer_credit(np.asarray(scores, np.float64)))
    if answered is not None:
        own = np.asarray(answered, bool)
        if own.shape != credit.shape:
            raise ArgumentError(f"answered: expected one flag an episode {credit.shape}, got {own.shape}")
        credit = np.where(own, credit, 0.0)
    terms = _core.path_efficiency(credit, np.asarray(shortest, np.float64), np.asarray(travelled, np.float64))
    return 100.0 * float(_core.mean(terms))
