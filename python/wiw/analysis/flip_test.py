# SPDX-License-Identifier: Apache-2.0
"""Tests of a paired difference that know scenes: whole scenes change sides.

If two arms are alike, it is a coin's toss which of them is called the arm and which the base, in each scene anew. So
the sum of differences in a scene is as likely to have either sign, whatever the correlation of its episodes and however
many they are: a sign-flip (randomisation) test over scenes is exact (Fisher 1935; Winkler et al., NeuroImage 92, 2014).
With an episode a scene and outcomes of 0 and 1 it is McNemar's exact test.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from wiw.analysis.intervals import Array, Interval, Kind, draw_in_blocks, p_value_of_sums, sum_by_cluster
from wiw.errors import ArgumentError

FEWEST_SCENES = 8
"""Scenes from which on they are flipped: with fewer, too few flips are possible for a small p."""
MOST_ENUMERATED = 14
"""Scenes with a difference up to which all flips are tried where the sums are not whole numbers, or too large."""
DRAWS = 20_000
"""Flips that are drawn at random beyond that."""
LARGEST_SUM, MOST_WORK = 1_000_000, 200_000_000
"""Sum of sizes, and its product with their number, up to which whole numbers have the probability of each sum computed:
beyond it takes too much memory, or seconds.
"""


def find_p_value(
    differences: ArrayLike, scenes: Sequence[str], kind: Kind, reach: Interval = (0.0, 0.0), *, seed: int = 0
) -> float:
    """Return the two-sided p of no difference, with scenes as what is drawn at random.

    Whole scenes are flipped. With 2 to 7 scenes it is the t test that the interval belongs to; with one, episodes are
    flipped, and p says nothing of other scenes.

    Args:
        differences: float [n], arm minus base, one an episode.
        scenes: [n] labels.
        kind: "difference" (of rates) or "length".
        reach: least and greatest possible difference of lengths.
        seed: of the flips, where not all are tried.
    """
    data = np.asarray(differences, np.float64)
    if not np.isfinite(data).all():  # nothing was measured somewhere, so nothing is shown
        return 1.0
    sums, counts = sum_by_cluster(data, np.asarray(scenes))
    if len(sums) == 1:
        return flip_signs(data, seed)
    if len(sums) < FEWEST_SCENES:
        return float(p_value_of_sums(sums, np.square(data).sum(), counts, kind, reach))
    return flip_signs(sums, seed)


def flip_signs(sums: Array, seed: int = 0) -> float:
    """Return the share of all flips of signs with a sum at least as far from 0 as the one seen.

    Args:
        sums: float [scenes]; zeros do not matter.
        seed: of the flips, where not all are tried.

    Raises:
        ArgumentError: sums that are not finite, of which no flip can be counted.
    """
    if not np.isfinite(sums).all():
        raise ArgumentError(f"flip_signs: expected finite sums, got {sums}; leave out what was not measured")
    sizes = np.abs(sums[np.abs(sums) > 1e-12])
    seen = abs(float(sums.sum())) - 1e-9 * float(sizes.sum())
    if len(sizes) == 0:
        return 1.0
    total = sizes.sum()
    if total <= LARGEST_SUM and len(sizes) * total <= MOST_WORK and np.array_equal(sizes, np.round(sizes)):
        shares = _spread_whole_numbers(sizes.astype(int))
        far = np.abs(np.arange(len(shares)) - len(shares) // 2) >= seen
        return min(1.0, float(shares[far].sum()))
    if len(sizes) <= MOST_ENUMERATED:
        totals = np.zeros(1)
        for size in sizes:
            totals = np.concatenate([totals + size, totals - size])
        return float(np.mean(np.abs(totals) >= seen))
    blocks = draw_in_blocks(seed, 2, DRAWS, len(sizes))
    count = sum(int(np.sum(np.abs((coins * 2 - 1) @ sizes) >= seen)) for coins in blocks)
    return (1 + count) / (1 + DRAWS)


def approximate_flips(sums: Array) -> Array:
    """Return about the p of `flip_signs` for many runs of whole numbers at once: flips add up to a normal distribution.

    Args:
        sums: float [..., scenes].
    """
    spread = np.sqrt(np.square(sums).sum(-1))
    reached = np.maximum(np.abs(sums.sum(-1)) - 1, 0)  # sums of flips lie 2 apart
    found: Array = np.where(spread > 0, 2 * special.ndtr(-reached / np.where(spread > 0, spread, 1.0)), 1.0)
    return found


def _spread_whole_numbers(sizes: np.ndarray[tuple[int, ...], np.dtype[np.int_]]) -> Array:
    """Return the probability of each sum, from - to + the sum of `sizes`, over all flips."""
    shares = np.ones(1)
    for size in sizes:
        wider = np.zeros(len(shares) + 2 * size)
        wider[: len(shares)] += shares / 2
        wider[2 * size :] += shares / 2
        shares = wider
    return shares
