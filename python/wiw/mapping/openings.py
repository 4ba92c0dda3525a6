# SPDX-License-Identifier: Apache-2.0
"""Openings: gaps between things as high as walls, through which there is a view of more space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

BAND = (1.35, 1.9)
"""Heights in metres of what bounds an opening: above most furniture, below lintels."""
STEP = 0.5
"""Metres that the space behind an edge must reach further than the edge."""
WIDTH = (0.55, 2.6)
"""Metres between the edges."""
FAR = 6.0
"""Metres up to which openings are looked for."""
SAME = 0.6
"""Metres within which two openings are one."""


@dataclass(frozen=True)
class Opening:
    """A gap between two edges."""

    id: int
    """From 1 on, in the order in which they were found; 0 before it is in a map."""
    edges: NDArray[np.float64]
    """float64 [2, 2]: its ends on the floor, in the frame of the start."""
    decisions: int = 1
    """Observations in which it was seen."""

    @property
    def position(self) -> NDArray[np.float64]:
        """float64 [2]: the middle."""
        return np.asarray(self.edges.mean(axis=0))

    @property
    def width(self) -> float:
        """Metres between the edges."""
        return float(np.linalg.norm(self.edges[1] - self.edges[0]))


def find_openings(
    flat: NDArray[np.float32],
    height: NDArray[np.float32],
    usable: NDArray[np.bool_],
    azimuth: NDArray[np.float64],
    odometry: NDArray[np.float64],
) -> list[Opening]:
    """Find the openings in one panorama.

    Args:
        flat: horizontal distance of each pixel, [H, W], the columns a full circle.
        height: above the floor.
        usable: which pixels hold a depth.
        azimuth: of each column, in the frame of the start.
        odometry: where the panorama was taken.
    """
    tall = usable & (height > BAND[0]) & (height < BAND[1])
    reach = np.where(tall, flat, np.inf).min(axis=0).astype(np.float64)
    reach = np.minimum(reach, 2 * FAR)
    points = odometry[:2] + np.minimum(reach, FAR)[:, None] * np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    jump = np.roll(reach, -1) - reach
    starts = np.flatnonzero((jump > STEP) & (reach < FAR))  # the column before the gap
    ends = np.flatnonzero((-jump > STEP) & (np.roll(reach, -1) < FAR))  # the last column in the gap
    found = []
    for start in starts.tolist():
        pair = _find_far_edge(start, ends, reach, points)
        if pair is not None:
            found.append(Opening(0, np.stack([points[start], points[pair]])))
    return found


def _find_far_edge(
    start: int, ends: NDArray[np.intp], reach: NDArray[np.float64], points: NDArray[np.float64]
) -> int | None:
    """Return the column of the first edge that closes the gap behind `start`, going round the circle."""
    count = len(reach)
    for steps in sorted(((ends - start) % count).tolist()):
        if not 1 <= steps < count // 2:
            continue
        edge = (start + steps + 1) % count
        width = float(np.linalg.norm(points[edge] - points[start]))
        if width > WIDTH[1]:
            return None
        inside = (start + 1 + np.arange(steps)) % count
        if width >= WIDTH[0]:
            line = np.maximum(reach[start], reach[edge])
            return edge if np.median(reach[inside]) > line + STEP / 2 else None
    return None


def merge_openings(known: Sequence[Opening], found: Sequence[Opening]) -> tuple[Opening, ...]:
    """Return the openings known, with those found: what is close to a known one is that one, seen again."""
    merged = list(known)
    again: set[int] = set()
    for opening in found:
        away = [float(np.linalg.norm(other.position - opening.position)) for other in merged]
        nearest = int(np.argmin(away)) if away else -1
        if nearest < 0 or away[nearest] > SAME:
            merged.append(replace(opening, id=len(merged) + 1))
        elif merged[nearest].id not in again:
            old = merged[nearest]
            edges = _align(opening.edges, old.edges)
            mean = (old.edges * old.decisions + edges) / (old.decisions + 1)
            merged[nearest] = Opening(old.id, mean, old.decisions + 1)
            again.add(old.id)
    return tuple(merged)


def _align(edges: NDArray[np.float64], like: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the edges in the order of another opening's, which may have been seen from the other side."""
    straight = np.linalg.norm(edges - like, axis=1).sum()
    crossed = np.linalg.norm(edges[::-1] - like, axis=1).sum()
    return edges if straight <= crossed else edges[::-1]
