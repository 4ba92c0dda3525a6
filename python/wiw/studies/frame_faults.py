# SPDX-License-Identifier: Apache-2.0
"""Find faults of imagined frames by comparison with the truth: channels, orientation, values that wrap."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.action import TURN_LEFT, TURN_RIGHT
from wiw.world_models.pictures import (
    ALTERED,
    CHANNELS,
    OTHER,
    Picture,
    are_channels_swapped,
    compute_brightness,
    correlate,
)

BETTER = 0.15
"""By how much an altered picture has to fit better, in correlation."""
JUMP = 160
"""Levels of 255 between neighbouring pixels that only edges between black and white have."""

Frames = NDArray[np.uint8]


def describe_alteration(truth: Sequence[Frames], found: Sequence[Frames]) -> str:
    """Describe how all frames [K, H, W, 3] of some rollouts are altered; empty if they are not.

    `truth` are frames of the same moments, of any size.
    """
    pairs = _pairs(truth, found)
    if sum(are_channels_swapped(true, frame) for true, frame in pairs) > len(pairs) / 2:
        return CHANNELS
    levels = [(compute_brightness(true), compute_brightness(frame)) for true, frame in pairs]
    alike = np.mean([correlate(true, frame) for true, frame in levels])
    fits = {name: np.mean([correlate(alter(true), frame) for true, frame in levels]) for name, alter in ALTERED.items()}
    best = max(fits, key=lambda name: fits[name])
    return f"frames are {best}" if fits[best] > max(OTHER, alike + BETTER) else ""


def mean_correlation(truth: Sequence[Frames], found: Sequence[Frames]) -> float:
    """Return the mean correlation of frames with those of the same moments."""
    levels = [[compute_brightness(picture) for picture in pair] for pair in _pairs(truth, found)]
    return float(np.mean([correlate(*pair) for pair in levels]))


def measure_jump_fraction(images: Sequence[NDArray[np.uint8]] | NDArray[np.uint8]) -> float:
    """Return the share of horizontal neighbours in images [..., H, W, 3] that are nearly black and nearly white."""
    jumps = [np.abs(np.diff(image.astype(np.int16), axis=-2)) > JUMP for image in images]
    return float(np.mean([each.mean() for each in jumps]))


def swap_turns(plan: NDArray[Any]) -> NDArray[Any]:
    """Return a plan of primitives with left and right turns swapped."""
    exchange = {int(TURN_LEFT): int(TURN_RIGHT), int(TURN_RIGHT): int(TURN_LEFT)}
    return np.array([exchange.get(int(one), int(one)) for one in plan], plan.dtype)


def _pairs(truth: Sequence[Frames], found: Sequence[Frames]) -> list[tuple[Picture, Picture]]:
    """Return frames of the same moments at the size of the true ones."""
    return [
        (true.astype(np.float32), _resize(frame, true.shape[:2]).astype(np.float32))
        for trues, frames in zip(truth, found, strict=True)
        for true, frame in zip(trues, frames, strict=True)
    ]


def _resize(image: Frames, size: tuple[int, ...]) -> Frames:
    return np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA), np.uint8)
