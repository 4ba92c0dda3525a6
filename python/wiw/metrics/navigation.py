# SPDX-License-Identifier: Apache-2.0
"""Navigation scores (paper, ImageNav appendix): success rate, SPL and mean trajectory length."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wiw._core import metrics as _core
from wiw.errors import ArgumentError


def success_rate(success: ArrayLike) -> float:
    """Return the percent of episodes that succeeded.

    Args:
        success: [N] booleans or numbers in [0, 1].

    Raises:
        ArgumentError: no episode, or a value that is not from 0 to 1.
    """
    values = _numbers(success)
    outside = values[~((values >= 0) & (values <= 1))]
    if outside.size:
        raise ArgumentError(f"success: expected booleans or numbers from 0 to 1, not percent, got {outside[0]:g}")
    return 100.0 * float(_core.mean(values))


def path_efficiency(success: ArrayLike, shortest: ArrayLike, travelled: ArrayLike) -> NDArray[np.float64]:
    """Return each episode's term of SPL, float64 [N] in [0, 1]; see `spl`."""
    return np.asarray(_core.path_efficiency(_numbers(success), _numbers(shortest), _numbers(travelled)))


def spl(success: ArrayLike, shortest: ArrayLike, travelled: ArrayLike) -> float:
    """Return the success weighted by path length in percent: mean of S L* / max(L, L*).

    An episode that starts at its goal (L* = 0) counts fully if the agent stayed there and nothing otherwise.

    Args:
        success: [N] booleans or numbers in [0, 1].
        shortest: [N] L*, shortest path from start to goal in metres; may be infinite where the agent failed.
        travelled: [N] L, length of the path walked in metres.

    Raises:
        ArgumentError: lists of different lengths or empty, a negative length, NaN, or success on an unreachable goal.
    """
    return 100.0 * float(_core.mean(path_efficiency(success, shortest, travelled)))


def mean_trajectory(lengths: ArrayLike) -> float:
    """Return the mean trajectory length over all episodes, in the unit of `lengths` (ImageNav: executed actions).

    Raises:
        ArgumentError: no episode, or a value that is not finite.
    """
    return float(_core.mean(_numbers(lengths)))


def _numbers(values: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(values, np.float64)
