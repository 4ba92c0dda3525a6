# SPDX-License-Identifier: Apache-2.0
"""Reprojection extended into regions that the real observation did not show, by the imagined frame's colours."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.perception.boxes import Mask, box_width, find_box
from wiw.perception.tracking import Reprojection
from wiw.types import Box, Observation

MARGIN = 8.0
"""Pixels searched around the box, besides the box's own width or height."""
SIDE = 96
"""Longer side in pixels at which colours are compared."""
SEED_MARGIN = 5
"""Pixels (at that size) around the seed that count as the target until colours decide."""
ROUNDS = 3
MIN_PIXELS = 3
"""Pixels that foreground and background must each have for their colours to be compared."""


class Growing(Reprojection):
    """Grows a reprojected mask into the warp's holes with GrabCut (Rother et al., SIGGRAPH 2004).

    Pixels that the observation showed are either in the seed or not the target. Those it did not show, because
    something was in front, may belong to the target if they continue its colours.
    """

    def predict_masks(
        self,
        observations: Sequence[Observation],
        viewpoints: Sequence[NDArray[np.float64]],
        frames: Sequence[NDArray[np.uint8]],
        panoramic: bool,
        real: Sequence[int],
    ) -> list[NDArray[np.bool_]]:
        """Return the grown masks."""
        seeds = self.reproject_with_holes(observations, viewpoints, frames, panoramic)
        return [
            np.array([grow_mask(*parts, panoramic) for parts in zip(images, masks, holes, strict=True)], bool)
            for images, (masks, holes) in zip(frames, seeds, strict=True)
        ]


def grow_mask(frame: NDArray[np.uint8], seed: Mask, unseen: Mask, wraps: bool) -> Mask:
    """Return the seed, bool [H, W], with the connected unseen pixels that have its colours."""
    box = find_box(seed, wraps)
    if box is None or not unseen.any():
        return seed
    shift = round(seed.shape[1] / 2 - box[0] - box_width(box, seed.shape[1]) / 2) if wraps else 0
    image, own, open_ = np.roll(frame, shift, axis=1), np.roll(seed, shift, axis=1), np.roll(unseen, shift, axis=1)
    middle = find_box(own)
    assert middle is not None
    crop = _crop_around(middle, seed.shape)
    found = own.copy()
    found[crop] |= _run_grabcut(image[crop], own[crop], open_[crop]) & open_[crop]
    return np.roll(found, -shift, axis=1)


def _crop_around(box: Box, size: Sequence[int]) -> tuple[slice, slice]:
    left, top, right, bottom = box
    more = max(right - left, bottom - top) + MARGIN
    rows = slice(int(max(0, top - more)), int(min(size[0], bottom + more)))
    return rows, slice(int(max(0, left - more)), int(min(size[1], right + more)))


def _run_grabcut(image: NDArray[np.uint8], seed: Mask, unseen: Mask) -> Mask:
    """Run GrabCut at a small size: seed and seen pixels are fixed, unseen ones are not."""
    scale = min(1.0, SIDE / max(image.shape[:2]))
    size = tuple(max(2, round(edge * scale)) for edge in image.shape[1::-1])
    labels = np.where(unseen, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    labels[seed] = cv2.GC_FGD
    labels = np.asarray(cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    settled = labels == cv2.GC_FGD
    if min(settled.sum(), (labels != cv2.GC_FGD).sum()) < MIN_PIXELS:
        return seed
    near = cv2.dilate(settled.astype(np.uint8), np.ones((SEED_MARGIN, SEED_MARGIN), np.uint8)) > 0
    labels[near & (labels == cv2.GC_PR_BGD)] = cv2.GC_PR_FGD
    if (labels & 1).all():  # no background to compare with
        return seed
    small = np.ascontiguousarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    cv2.setRNGSeed(0)  # its mixtures of colours begin at random
    rectangle = (0, 0, 0, 0)  # not looked at where a mask is given
    cv2.grabCut(small, labels, rectangle, np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_MASK)
    _, pieces = cv2.connectedComponents((labels & 1).astype(np.uint8))
    kept = np.isin(pieces, np.unique(pieces[settled])).astype(np.uint8)
    return np.asarray(cv2.resize(kept, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0, bool)
