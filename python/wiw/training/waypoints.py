# SPDX-License-Identifier: Apache-2.0
"""Waypoints of a traversal: Algorithm 1 of the World-in-World paper, stages 1 and 3.

Samples of an island are ranked by their leaf score, eccentricity + alpha x mean distance, which is high at the
periphery, and pruned to a minimum spacing. Waypoints are removed as the agent visits them, and the rest ranked anew.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from wiw.nav import NavMesh, select_waypoints
from wiw.training.navigation_rules import NavigationRules

PREFERRED_DISTANCE = 2.0
"""Metres, for `next_waypoint="2m"`."""


class Waypoints:
    """Unvisited waypoints of one island of a navigation mesh.

    Args:
        navmesh: the mesh; all distances are geodesic.
        island: index into `navmesh.islands`.
        seed: of the samples.
        rules: the numbers of the algorithm.
    """

    def __init__(self, navmesh: NavMesh, island: int, seed: int, rules: NavigationRules) -> None:
        self._navmesh, self._rules = navmesh, rules
        count = max(rules.min_samples, math.floor(rules.density * navmesh.islands[island].area))
        samples = navmesh.sample(count, seed, island)
        distances = navmesh.distance_matrix(samples)
        connected = find_connected(distances)
        self.samples: NDArray[np.float32] = samples[connected]
        """float32 [N, 3]: the points that waypoints are chosen among, uniform over the island."""
        self._distances = distances[np.ix_(connected, connected)]
        self._remaining, _ = select_waypoints(self._distances, mean_weight=rules.mean_weight, spacing=rules.spacing)
        self._leaf_count = math.ceil(rules.leaf_ratio * count)
        self.points: NDArray[np.float32] = self.samples[self._remaining]
        """float32 [W, 3]: all waypoints, in descending order of leaf score."""

    @property
    def candidates(self) -> NDArray[np.int64]:
        """Indices into `samples` of the candidates for the next waypoint, int64 [U]."""
        return self._remaining[: self._leaf_count]

    def find_next(self, position: NDArray[np.float32], current: int) -> int | None:
        """Return the index of the waypoint to go to from a position on the mesh; None if only `current` is left."""
        candidates = self.candidates[self.candidates != current]
        if not len(candidates):
            return None
        metres = self._navmesh.distances_from(position)(self.samples[candidates])
        wanted = 0.0 if self._rules.next_waypoint == "nearest" else PREFERRED_DISTANCE
        return int(candidates[np.argmin(np.abs(metres - wanted))])

    def mark_visited(self, positions: NDArray[np.float32]) -> None:
        """Remove the waypoints closer than the visited radius to any executed position [T, 3]; rank the rest anew."""
        if len(self._remaining):
            nearest = self._navmesh.distances_from(positions)(self.samples[self._remaining])
            self._remaining = self._remaining[nearest >= self._rules.visited_radius]
            self._rank()

    def drop(self, index: int) -> None:
        """Remove a waypoint that cannot be reached, and rank the rest anew."""
        self._remaining = self._remaining[self._remaining != index]
        self._rank()

    def _rank(self) -> None:
        """Sort the remaining waypoints by their leaf scores among themselves."""
        count = len(self._remaining)
        if count > 1:
            among = self._distances[np.ix_(self._remaining, self._remaining)]
            scores = among.max(axis=1) + self._rules.mean_weight * among.sum(axis=1) / (count - 1)
            self._remaining = self._remaining[np.argsort(-scores, kind="stable")]


def find_connected(distances: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the points within reach of the one that reaches most, from distances [N, N] that may be infinite.

    A sample may lie on the very edge of a wall without thickness, from which no path is found: about one in 400,000.
    """
    finite = np.isfinite(distances)
    return np.flatnonzero(finite[finite.sum(axis=1).argmax()])
