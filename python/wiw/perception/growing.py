# SPDX-License-Identifier: Apache-2.0
"""Reprojection that goes on into what the real observation did not show, by the imagined frame's colours."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.perception.boxes import Mask, box_of, width_of
from wiw.perception.tracking import Reprojection
from wiw.types import Box, Observation

MARGIN = 8.0
"""Pixels around the box that are looked at, besides as much again as the box is wide or high."""
SIDE = 96
"""Pixels of the longer side at which colours are compared."""
NEAR = 5
"""Pixels (at that size) around the seed that are taken for the target until colours tell otherwise."""
ROUNDS = 3
FEWEST = 3
"""Pixels that either part must have for their colours to be told apart."""


class Growing(Reprojection):
    """A reprojected mask is the seed; GrabCut (Rother et al., SIGGRAPH 2004) lets it grow into the warp's holes.

    What the observation did show is either in the seed or not the target. What it did not show, because something hid
    it, may be more of the target, and the frame tells if it goes on in the same colours.
    """

    def masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
    ) -> list[NDArray[np.bool_]]:
        """The grown masks."""
        seeds = self.reprojected(observations, viewpoints, frames, panoramic)
        return [
            np.array([grown(*parts, panoramic) for parts in zip(images, masks, holes, strict=True)], bool)
            for images, (masks, holes) in zip(frames, seeds, strict=True)
        ]


def grown(frame: NDArray[np.uint8], seed: Mask, unseen: Mask, wraps: bool) -> Mask:
    """The seed, bool [H, W], and those of the unseen pixels around that hang together with it and have its colours."""
    box = box_of(seed, wraps)
    if box is None or not unseen.any():
        return seed
    shift = round(seed.shape[1] / 2 - box[0] - width_of(box, seed.shape[1]) / 2) if wraps else 0
    image, own, open_ = np.roll(frame, shift, axis=1), np.roll(seed, shift, axis=1), np.roll(unseen, shift, axis=1)
    middle = box_of(own)
    assert middle is not None
    crop = _around(middle, seed.shape)
    found = own.copy()
    found[crop] |= _cut(image[crop], own[crop], open_[crop]) & open_[crop]
    return np.roll(found, -shift, axis=1)


def _around(box: Box, size: Sequence[int]) -> tuple[slice, slice]:
    left, top, right, bottom = box
    more = max(right - left, bottom - top) + MARGIN
    rows = slice(int(max(0, top - more)), int(min(size[0], bottom + more)))
    return rows, slice(int(max(0, left - more)), int(min(size[1], right + more)))


def _cut(image: NDArray[np.uint8], seed: Mask, unseen: Mask) -> Mask:
    """GrabCut at a small size: seed and seen pixels are settled, unseen ones are not."""
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = tuple(max(2, round(edge * scale)) for edge in image.shape[1::-1])
    labels = np.where(unseen, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    labels[seed] = cv2.GC_FGD
    labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    settled = labels == cv2.GC_FGD
    if min(settled.sum(), (labels != cv2.GC_FGD).sum()) < FEWEST:
        return seed
    near = cv2.dilate(settled.astype(np.uint8), np.ones((NEAR, NEAR), np.uint8)) > 0
    labels[near & (labels == cv2.GC_PR_BGD)] = cv2.GC_PR_FGD
    small = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    cv2.setRNGSeed(0)  # its mixtures of colours begin at random
    rectangle = (0, 0, 0, 0)  # not looked at where a mask is given
    cv2.grabCut(small, labels, rectangle, np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK)
    _, pieces = cv2.connectedComponents((labels & 1).astype(np.uint8))
    kept = np.isin(pieces, np.unique(pieces[settled])).astype(np.uint8)
    return np.asarray(cv2.resize(kept, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0, bool)
