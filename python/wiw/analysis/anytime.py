# SPDX-License-Identifier: Apache-2.0
"""Intervals and tests that stay valid however often a run is looked at, and whenever it is stopped.

A gambler who bets against a mean m cannot expect to win where m is the truth: her capital is a non-negative martingale,
and by Ville's inequality it ever reaches 1 / alpha with a chance of at most alpha. All means against which it never has
are a confidence sequence (Waudby-Smith and Ramdas, Estimating means of bounded random variables by betting, JRSS B 86,
2024). Bets here are a mixture of fixed shares of the capital, equally weighted, on either side, as in Cover's universal
portfolio (Orabona and Jun, IEEE Trans. Information Theory 70, 2024): nothing is tuned, and the order of values matters
only through when one looks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from wiw.analysis.intervals import Array, Interval

SHARES = np.arange(1, 32) / 32
"""Greatest shares of the capital that a bet may lose, on either side."""
MEANS = 500
"""Steps of the grid on which an interval's ends are sought."""


def find_anytime_interval(values: ArrayLike, confidence: float = 0.95, bounds: Interval = (0.0, 1.0)) -> Interval:
    """Return the interval of the mean after all looks so far; the intervals of all looks hold it together.

    Args:
        values: float [t], independent with the same mean, in the order in which they came; e.g. means of scenes.
        confidence: that no look ever misses the mean.
        bounds: least and largest possible value.
    """
    least, most = bounds
    means = (np.arange(MEANS) + 0.5) / MEANS
    scaled = (np.asarray(values, np.float64) - least) / (most - least)
    held = means[_find_best_capital(scaled, means) < -np.log(1 - confidence)]
    if len(held) == 0:  # two looks contradict each other, which happens in at most one of twenty runs
        return float("nan"), float("nan")
    half = 0.5 / MEANS
    low, high = held.min() - half, held.max() + half
    return float(least + (most - least) * low), float(least + (most - least) * high)


def find_anytime_p(differences: ArrayLike) -> float:
    """Return the p of no difference in mean, valid at any look.

    Args:
        differences: float [t] in [-1, 1], independent, in the order in which they came; e.g. means of scenes.
    """
    scaled = (np.asarray(differences, np.float64) + 1) / 2
    return min(1.0, float(np.exp(-_find_best_capital(scaled, np.array([0.5]))[0])))


def _find_best_capital(values: Array, means: Array) -> Array:
    """Return the logarithm of the most capital ever had in betting against each mean, at least 0: float [means]."""
    if len(values) == 0:
        return np.zeros(len(means))
    best: Array = np.maximum(trace_capital(values, means).max(0), 0.0)
    return best


def trace_capital(values: Array, means: Array) -> Array:
    """Return the logarithm of the capital after each value, float [values, means], for values and means in [0, 1]."""
    apart = values[:, None] - means
    over, under = apart / means, -apart / (1 - means)
    capital: Array = np.full(apart.shape, -np.inf)
    for bets in (over, under):
        for share in SHARES:  # one at a time: all together they take gigabytes for some thousand values
            np.logaddexp(capital, np.cumsum(np.log1p(share * bets), axis=0), out=capital)
    capital -= np.log(2 * len(SHARES))
    return capital
