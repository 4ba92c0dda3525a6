# SPDX-License-Identifier: Apache-2.0
"""Votes of all views of a home for the category of each voxel, background included."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wiw.mapping.fragments import Labels, pack_voxels
from wiw.mapping.views import Views, unproject

MOST_DEPTH = 6.0
"""Metres up to which views vote: farther away a pixel covers several voxels."""
STRIDE = 2
"""Rows and columns between the pixels that vote."""
_BITS = 8
"""Lowest bits of a key, which hold the category; those above hold the voxel."""
_CATEGORY = (1 << _BITS) - 1


@dataclass
class LabelVotes:
    """Votes for categories by voxel."""

    _pairs: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sorted keys of the pairs of voxel and category that had any."""
    _votes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def add(self, views: Views, labels: Labels) -> None:
        """Let pixels of four views vote for their category with their confidence; 0, unknown, is a category too."""
        some = np.zeros(views.depth.shape, bool)
        some[:, STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
        where = np.nonzero(some & (views.depth > 0) & (views.depth <= MOST_DEPTH))
        keys = (pack_voxels(unproject(views, *where)) << _BITS) | labels.category[where].astype(np.int64)
        pairs, inverse = np.unique(np.asarray(keys, np.int64), return_inverse=True)
        votes = np.bincount(inverse, labels.confidence[where], len(pairs))
        place = np.searchsorted(self._pairs, pairs)
        known = np.zeros(len(pairs), bool)
        inside = place < len(self._pairs)
        known[inside] = self._pairs[place[inside]] == pairs[inside]
        self._votes[place[known]] += votes[known]
        self._pairs = np.insert(self._pairs, place[~known], pairs[~known])
        self._votes = np.insert(self._votes, place[~known], votes[~known])

    def count(self, voxels: NDArray[np.int64], categories: int) -> NDArray[np.float64]:
        """Return the votes that some voxels got together, float64 [categories].

        Args:
            voxels: sorted keys, see `wiw.mapping.fragments.pack_voxels`.
            categories: how many there are.
        """
        rows, _ = self._find_rows(voxels)
        found = np.bincount(self._pairs[rows] & _CATEGORY, self._votes[rows], categories)
        return np.asarray(found, np.float64)

    def measure_shares(self, voxels: NDArray[np.int64], category: int) -> NDArray[np.float64]:
        """Return the share of each voxel's votes that a category has, float64 [N]; 1 if there are no votes.

        Args:
            voxels: keys, see `wiw.mapping.fragments.pack_voxels`.
            category: its number.
        """
        rows, place = self._find_rows(voxels)
        votes = self._votes[rows]
        total = np.bincount(place, votes, len(voxels))
        own = np.bincount(place, votes * (self._pairs[rows] & _CATEGORY == category), len(voxels))
        return np.divide(own, total, out=np.ones(len(voxels)), where=total > 0)

    def _find_rows(self, voxels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows of some voxels' pairs, and for each row the place of its voxel among those."""
        first = np.searchsorted(self._pairs, voxels << _BITS)
        counts = np.searchsorted(self._pairs, (voxels + 1) << _BITS) - first
        place = np.repeat(np.arange(len(voxels)), counts)
        return np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts), place
