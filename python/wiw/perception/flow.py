# SPDX-License-Identifier: Apache-2.0
"""A tracker by optical flow, for machines without the weights of a video segmenter."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.perception.boxes import Mask, find_box
from wiw.perception.frame_tracking import FrameTracker

SURROUNDINGS = 24
"""Pixels around the target's box that belong to the patch searched for."""
SCALES = (0.85, 1.0, 1.2, 1.4)
"""Sizes of the patch that are tried: a step towards a near thing enlarges it by a fifth and more."""
SIDE = 40
"""Longer side of the patch in pixels as it is searched for."""
RING = 10
"""Pixels around the target whose corners move with it."""
CORNERS = 80
"""Maximum number of corners followed."""
FEWEST = 6
"""Fewest corners that must agree on one motion ..."""
AGREEING = 0.25
"""... and their least share."""
RETURN = 2.5
"""Pixels by which a corner that is followed there and back may miss its place."""
OUTLIER = 3.0
"""Pixels from the common motion beyond which a corner does not agree."""
LIKENESS = 0.6
"""Minimum correlation between the target where it was seen last, moved, and the frame."""
LARGEST_SCALE = 2.0
"""Larger changes of size from one frame to the next are mistakes."""

Grey = NDArray[np.uint8]
Point = tuple[float, float]


class Flow(FrameTracker):
    """Finds the target's patch again by correlation, follows its corners by optical flow, and moves its mask with them.

    Flow is pyramidal Lucas-Kanade, there and back (Kalal et al., ICPR 2010); the mask moves by the similarity that most
    corners agree on.

    Each frame is compared with the one that showed the target last, and then with the seed. Where too few corners agree
    or the moved target differs from the frame, the target is lost. Nothing is learned, and parts that come into sight
    are not added to the mask.
    """

    def follow(
        self, views: NDArray[np.uint8], masks: NDArray[np.bool_], frames: NDArray[np.uint8]
    ) -> NDArray[np.bool_]:
        """Follow the target from the latest of the real views that show most of it."""
        shown = masks.sum(axis=(1, 2))
        best = len(shown) - 1 - int(shown[::-1].argmax())
        seed = latest = _to_grey(views[best]), masks[best]
        found = np.zeros(frames.shape[:3], bool)
        for frame, mask in zip(frames, found, strict=True):
            grey = _to_grey(frame)
            moved = next((moved for known in (latest, seed) if (moved := _find_target(*known, grey)) is not None), None)
            if moved is not None:
                mask[:] = moved
                latest = grey, moved
        return found


def _find_target(image: Grey, mask: Mask, frame: Grey) -> Mask | None:
    """Return the target's mask in a frame, given that in another image; None if it is lost."""
    near = _dilate(mask)
    start = cv2.goodFeaturesToTrack(image, CORNERS, 0.005, 3, mask=near.astype(np.uint8), blockSize=5)
    if start is None or len(start) < FEWEST or (patch := _find_patch(image, mask, frame)) is None:
        return None
    corner, place, scale = patch
    guess = ((start - np.array(corner, np.float32)) * scale + np.array(place, np.float32)).astype(np.float32)
    end, arrived = _follow_corners(image, frame, start, guess)
    back, returned = _follow_corners(frame, image, end, start)
    kept = arrived & returned & (np.abs(back - start).max(axis=(1, 2)) < RETURN)
    kept &= ((end >= 0) & (end < np.array(frame.shape[::-1], np.float32))).all(axis=(1, 2))
    if kept.sum() < FEWEST:
        return None
    motion, agree = cv2.estimateAffinePartial2D(start[kept], end[kept], ransacReprojThreshold=OUTLIER)
    if motion is None or agree.sum() < max(FEWEST, AGREEING * len(start)):
        return None
    return _move_mask(image, mask, frame, motion)


def _find_patch(image: Grey, mask: Mask, frame: Grey) -> tuple[Point, Point, float] | None:
    """Return the upper left corner of the target's patch in the image, its place in the frame, and its scale there."""
    box = find_box(mask)
    assert box is not None
    left, top, right, bottom = (int(edge) for edge in box)
    left, top = max(0, left - SURROUNDINGS), max(0, top - SURROUNDINGS)
    patch = image[top : bottom + SURROUNDINGS, left : right + SURROUNDINGS]
    shrink = min(1.0, SIDE / max(patch.shape))
    small = cv2.resize(frame, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    found: tuple[float, tuple[Point, Point, float]] | None = None
    for scale in SCALES:
        size = tuple(max(1, round(edge * shrink * scale)) for edge in patch.shape[::-1])
        if size[0] > small.shape[1] or size[1] > small.shape[0]:
            continue
        scores = cv2.matchTemplate(small, cv2.resize(patch, size, interpolation=cv2.INTER_AREA), cv2.TM_CCOEFF_NORMED)
        _, best, _, (x, y) = cv2.minMaxLoc(scores)
        if found is None or best > found[0]:
            found = best, ((left, top), (x / shrink, y / shrink), scale)
    return None if found is None else found[1]


def _follow_corners(image: Grey, frame: Grey, start: Any, guess: Any) -> tuple[NDArray[np.float32], Mask]:
    """Return where corners [N, 1, 2] of an image are in a frame, near a guess, and whether they were found."""
    until = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        image, frame, start, guess.copy(), winSize=(21, 21), maxLevel=2, criteria=until,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(end, np.float32), np.asarray(found)[:, 0] > 0


def _move_mask(image: Grey, mask: Mask, frame: Grey, motion: Any) -> Mask | None:
    """Return the mask, moved; None if it leaves the frame, changes its size a lot, or differs from the frame."""
    size = frame.shape[::-1]
    moved = np.asarray(cv2.warpAffine(mask.astype(np.uint8) * 255, motion, size)) > 127
    if not moved.any() or not 1 / LARGEST_SCALE < np.hypot(*motion[0, :2]) < LARGEST_SCALE:
        return None
    near = _dilate(moved)
    expected, shown = cv2.warpAffine(image, motion, size)[near].astype(float), frame[near].astype(float)
    if not expected.std() or not shown.std() or np.corrcoef(expected, shown)[0, 1] < LIKENESS:
        return None
    return moved


def _dilate(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * RING + 1, 2 * RING + 1), np.uint8))) > 0


def _to_grey(image: NDArray[np.uint8]) -> Grey:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
