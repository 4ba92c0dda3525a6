# SPDX-License-Identifier: Apache-2.0
"""Belief about where the goal is: a distribution over the map, from the evidence of real and imagined places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from wiw.policies.navigator.way_cells import WayCells
from wiw.policies.navigator.ways import WayMap, Ways

VISITED = 0.45
"""Metres around where the agent has been in which the goal is not: the episode would have ended."""
UNKNOWN_PRIOR = 0.6
"""Likelihood of the goal in an unknown cell, relative to one of known floor."""
SMOOTHING = 1.0
"""Standard deviation, in cells, by which the belief is smoothed before its peaks are found."""
PEAK_GAP = 1.2
"""Metres around a peak in which no other is taken."""
LEAST_LOG = -2.5
"""Minimum logarithm of a likelihood ratio: no place is so sure that others could not overrule it."""


@dataclass(frozen=True)
class Evidence:
    """Evidence about the goal from one place."""

    pose: NDArray[np.float64]
    """float64 [3]: x, y and the azimuth of the panorama's front, in the frame of the start."""
    bearings: NDArray[np.float64]
    """float64 [32]: probability of each heading, by column of the panorama from its left edge on."""
    closeness: NDArray[np.float64]
    """float64 [9]: logarithm of the likelihood ratio of each class of distance."""
    trust: float = 1.0


@dataclass(frozen=True)
class Weights:
    """How much the parts of evidence count."""

    bearing: float
    closeness: float
    doubt: float
    """Probability that a bearing says nothing."""
    overlap: float
    """Metres within which places say nearly the same, and share their weight."""


def compute_belief(
    way_map: WayMap,
    evidence: Sequence[Evidence],
    ways: Ways,
    trail: NDArray[np.float64],
    centres: NDArray[np.float64],
    weights: Weights,
) -> NDArray[np.float64]:
    """Return the probability of each cell, float64 [cells].

    Args:
        way_map: what is known of the floor.
        evidence: what N places say.
        ways: those from these places.
        trail: float64 [K, 2]: where the agent has been.
        centres: float64 [9]: metres in the middle of each class of distance.
        weights: see `Weights`.
    """
    total = np.zeros(way_map.cells.count)
    shares = share_weights(np.array([own.pose[:2] for own in evidence]), weights.overlap)
    for row, (own, share) in enumerate(zip(evidence, shares, strict=True)):
        ratio = weights.bearing * rate_bearings(own, ways.azimuths[row], weights.doubt)
        ratio += weights.closeness * np.interp(ways.metres[row], centres, own.closeness)
        total += own.trust * share * ratio
    prior = np.where(way_map.open, 1.0, UNKNOWN_PRIOR * way_map.unknown).ravel()
    prior = prior * np.isfinite(ways.metres).all(axis=0)
    for place in trail:
        prior[way_map.cells.find_near(place, VISITED)] = 0
    if not prior.any():  # every cell has been seen and visited, which a wrong map can bring about
        prior[:] = 1.0
    belief = prior * np.exp(total - total[prior > 0].max())
    return belief / belief.sum()


def share_weights(places: NDArray[np.float64], overlap: float) -> NDArray[np.float64]:
    """Return the weight of each of N places [N, 2]: what places close together say counts once."""
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    return 1 / np.exp(-0.5 * (apart / overlap) ** 2).sum(axis=1)


def rate_bearings(own: Evidence, azimuths: NDArray[np.float64], doubt: float) -> NDArray[np.float64]:
    """Return the logarithm of the likelihood ratio of azimuths [N], by interpolation between headings."""
    count = len(own.bearings)
    column = (0.5 - (azimuths - own.pose[2]) / (2 * np.pi)) * count - 0.5
    left = np.floor(column).astype(np.intp)
    part = column - left
    found = (1 - part) * own.bearings[left % count] + part * own.bearings[(left + 1) % count]
    return np.maximum(np.log((1 - doubt) * count * found + doubt), LEAST_LOG)


def find_peaks(cells: WayCells, worth: NDArray[np.float64], count: int) -> list[int]:
    """Return the cells of the highest values of [cells], apart from each other, the highest first."""
    rest, found = worth.copy(), list[int]()
    while len(found) < count and rest.max() > 0:
        found.append(int(rest.argmax()))
        rest[cells.find_near(cells.centres[found[-1]], PEAK_GAP)] = 0
    return found


def smooth(cells: WayCells, belief: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the belief smoothed over neighbouring cells, 0 where it is 0: float64 [cells]."""
    smoothed = ndimage.gaussian_filter(belief.reshape(cells.shape), SMOOTHING, mode="constant").ravel()
    return np.where(belief > 0, smoothed, 0.0)
