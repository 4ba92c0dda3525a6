# SPDX-License-Identifier: Apache-2.0
"""Whether a model's frames are pictures of the place that it was shown: upright, in RGB, on the scale of uint8.

Everything is judged on a sample of the pixels, by correlations, so that a frame 0 that a video model has encoded and
decoded again passes, whatever the model's quality, and what was done to a whole picture does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ContractError
from wiw.types import Control

COLUMNS = 64
"""Columns of a picture's sample, about."""
FLAT = 2.0
"""Standard deviation, in levels of 255, up to which a picture has no structure to compare."""
CLOSE = 16.0
"""Mean difference, in levels of 255, up to which two pictures are alike whatever their structure."""
ALIKE, OTHER = 0.9, 0.5
"""Correlations from which pictures show the same, and up to which they do not."""
DARK = 16.0
"""Mean level up to which an observation may be followed by black."""
THIRDS = np.full(3, 1 / 3, np.float32)
"""Weights of the channels in brightness."""
ALTERED: dict[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "mirrored": lambda picture: picture[:, ::-1],
    "upside down": lambda picture: picture[::-1],
    "turned by 180 degrees": lambda picture: picture[::-1, ::-1],
    "inverted": lambda picture: 255 - picture,
}
"""Common mistakes with pictures, by name."""
CHANNELS = "red and blue are swapped (BGR): give RGB; for OpenCV images use frames[..., ::-1]"
SCALE = (
    "no value is above 1: floats from 0 to 1 were cast to uint8 without scaling; give np.rint(np.clip(frames, 0, 1) * "
    "255).astype(np.uint8)"
)
BLACK = f"{SCALE}. All is black, as after NaN or negative numbers were cast, or the input was overwritten"

Picture = NDArray[np.float32]


def sample(images: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return about `COLUMNS` columns of images [..., H, W, 3] and rows as far apart, as a view."""
    step = max(1, images.shape[-2] // COLUMNS)
    return images[..., step // 2 :: step, step // 2 :: step, :]


def check_pictures(
    name: str, observations: NDArray[np.uint8], frames: NDArray[np.uint8], controls: Sequence[Control]
) -> None:
    """Hold an answer to showing what was observed; `observations` are samples of the images that were handed over.

    Looked at are frame 0, and the frames that are each row's own. These may be black where nothing is known of what
    lies there, but not from everywhere.

    Raises:
        ContractError: frame 0 is another picture ("frame 0"), red and blue are exchanged ("channels"), or floats were
            cast without their scale ("scale").
    """
    black, lit = set[bytes](), False
    for observed, row, control in zip(observations, sample(frames), controls, strict=True):
        own = row[1 + control.shared : 1 + control.length]
        if observed.std() <= FLAT:
            continue
        bright = observed.mean() > DARK
        brightest = max(own.max(initial=0), row[0].max())
        if bright and brightest <= 1:
            raise ContractError(f"{name}.rollout: {SCALE if brightest else BLACK}", "scale")
        expected = observed.astype(np.float32)
        exact = np.array_equal(row[0], observed)
        if not exact and (fault := find_first_frame_fault(expected, row[0].astype(np.float32))):
            raise ContractError(
                f"{name}.rollout: frame 0 is not the observation: {fault}. Frame k is what follows action k; put the "
                "observation first: frames[:, 0] = observations.image",
                "channels" if fault == CHANNELS else "frame 0",
            )
        if len(own) == 0:
            continue
        if bright and own.max() == 1:
            raise ContractError(f"{name}.rollout: after frame 0, {SCALE}", "scale")
        if bright and control.shared == 0 and own.max() == 0:  # as behind a wall, of which a front view shows nothing
            black.add(observed.tobytes())
        lit = lit or bool(own.max() > 1)
        # The frame after one action shows nearly what was observed. Later ones may show another wall by chance.
        least = OTHER if control.shared == 0 else ALIKE
        if are_channels_swapped(expected, own[0].astype(np.float32), least):
            raise ContractError(f"{name}.rollout: after frame 0, {CHANNELS}", "channels")
    if len(black) > 1 and not lit:
        raise ContractError(f"{name}.rollout: after frame 0, {BLACK}", "scale")


def find_first_frame_fault(observed: Picture, found: Picture) -> str:
    """Return what is wrong with a frame 0, in words; nothing where it is the observation, if only by and large."""
    if are_channels_swapped(observed, found):
        return CHANNELS
    one, other = compute_brightness(observed), compute_brightness(found)
    alike = correlate(one, other)
    if alike >= ALIKE or np.abs(observed - found).mean() <= CLOSE:
        return ""
    for name, alter in ALTERED.items():
        if correlate(alter(one), other) >= max(ALIKE, alike + 0.05):
            return f"it is {name}"
    return "" if alike >= OTHER else f"it is a different image (their correlation is {alike:.2f} of 1)"


def are_channels_swapped(one: Picture, other: Picture, least: float = OTHER) -> bool:
    """Return whether two pictures, whose brightness must correlate by `least`, show the same with red for blue."""
    if correlate(compute_brightness(one), compute_brightness(other)) < least:
        return False
    return correlate(*[picture[..., 0] - picture[..., 2] for picture in (one, other)]) <= -OTHER


def compute_brightness(picture: Picture) -> NDArray[np.float32]:
    """Return the mean over the channels of a picture [..., H, W, 3], as [..., H, W]."""
    return picture @ THIRDS


def correlate(one: NDArray[np.float32], other: NDArray[np.float32]) -> float:
    """Return Pearson's correlation of two arrays of one shape; 0 where one has no structure (`FLAT`)."""
    one, other = one - one.mean(), other - other.mean()
    squares = float(np.vdot(one, one)), float(np.vdot(other, other))
    if min(squares) <= FLAT**2 * one.size:
        return 0.0
    return float(np.vdot(one, other)) / math.sqrt(squares[0] * squares[1])
