# SPDX-License-Identifier: Apache-2.0
"""Similarity of a place to the goal image: colour histograms and normalised correlation, over all headings.

A panorama is reduced to a band of 32 x 128 pixels, latitudes within 45 degrees, 2.8 degrees a column; the goal's
90-degree view covers 32 of those columns. The similarity of a place is the best over all 128 headings, so that turning
on the spot gains nothing: only the position counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

PANORAMA = (64, 128)
ROWS = slice(16, 48)
COLUMNS = 128
WINDOW = 32
MIDDLE = slice(COLUMNS // 2 - WINDOW // 2, COLUMNS // 2 + WINDOW // 2)
"""Columns of the front view."""
BINS = (5, 16, 16)
"""Histogram bins of L, a, b."""
LAYERS = 2
"""The band's upper and lower half have separate histograms: the floor is not the wall."""
HISTOGRAM_WEIGHT = 2.0
HIGHEST = HISTOGRAM_WEIGHT + 2.0
"""Similarity of a place to itself. Where nothing but a bare wall is seen, rounding can lead beyond it."""


@dataclass(frozen=True)
class Band:
    """Features of N places."""

    colors: NDArray[np.float32]
    """[N, 3, 32, W]."""
    edges: NDArray[np.float32]
    """[N, 4, 32, W]."""
    bins: NDArray[np.intp]
    """[N, 32, W]: each pixel's histogram bin, by layer and Lab."""

    def take(self, index: int) -> Band:
        """Return one of the N places."""
        one = slice(index, index + 1)
        return Band(self.colors[one], self.edges[one], self.bins[one])


@dataclass(frozen=True)
class GoalTemplate:
    """The goal's features, zero-mean and unit-norm within `mask`, as spectra over columns."""

    colors: NDArray[np.float32]
    edges: NDArray[np.float32]
    bins: NDArray[np.intp]
    """[all bins]: index of each bin among the goal's own, or one past the last for bins it lacks."""
    shares: NDArray[np.float32]
    """[goal's own bins]: share of the goal's pixels; sums to one."""
    mask: NDArray[np.float32]


def build_goal_template(image: NDArray[np.uint8]) -> GoalTemplate:
    """Extract features of a goal view uint8 [S, S, 3] with HFOV 90."""
    band, mask = project_front(image)
    return build_template(band, mask[:, MIDDLE])


def build_template(goal: NDArray[np.uint8], mask: NDArray[np.bool_]) -> GoalTemplate:
    """Extract features of a panorama uint8 [64, 128, 3] whose front is the goal; `mask` [32, 32] is what it shows."""
    features, window = extract_features(goal[None]), MIDDLE
    weights = mask.astype(np.float32)
    own, counts = np.unique(features.bins[0][:, window][weights > 0], return_counts=True)
    numbers = np.full(LAYERS * int(np.prod(BINS)), len(own), np.intp)
    numbers[own] = np.arange(len(own))
    return GoalTemplate(
        colors=_normalise(features.colors[0][..., window], weights),
        edges=_normalise(features.edges[0][..., window], weights),
        bins=numbers,
        shares=(counts / counts.sum()).astype(np.float32),
        mask=weights,
    )


def extract_features(panoramas: NDArray[np.uint8]) -> Band:
    """Extract features of panoramas uint8 [N, 64, 128, 3]."""
    bands = panoramas[:, ROWS]
    labs = [_lab(band) for band in bands]
    return Band(
        colors=np.stack([_color_map(lab) for lab in labs]),
        edges=np.stack([_edge_map(lab) for lab in labs]),
        bins=np.stack([_bins(lab) for lab in labs]),
    )


def similarity(places: Band, goal: GoalTemplate) -> NDArray[np.float32]:
    """Return float32 [N, 128]: 2 x histogram overlap + colour correlation + edge correlation, for each heading column.

    Column c is the centre of the compared window.
    """
    score = HISTOGRAM_WEIGHT * histogram_similarity(places, goal)
    score += _correlation(places.colors, goal.colors, goal.mask)
    score += _correlation(places.edges, goal.edges, goal.mask)
    return score


def histogram_similarity(places: Band, goal: GoalTemplate) -> NDArray[np.float32]:
    """Return the Bhattacharyya coefficient of the goal's and each window's histogram: float32 [N, 128].

    Only bins that the goal has contribute, so only those are summed.
    """
    numbers, own = goal.bins[places.bins], len(goal.shares)
    count, rows, width = numbers.shape
    flat = numbers + (own + 1) * np.arange(count * width).reshape(count, 1, width)
    columns = np.bincount(flat.ravel(), minlength=count * width * (own + 1)).reshape(count, width, own + 1)[..., :own]
    wrapped = np.concatenate([columns[:, -WINDOW // 2 :], columns, columns[:, : WINDOW // 2]], 1)
    sums = np.cumsum(np.pad(wrapped, ((0, 0), (1, 0), (0, 0))), axis=1)
    windows = (sums[:, WINDOW:] - sums[:, :-WINDOW])[:, :COLUMNS] / np.float32(WINDOW * rows)
    return np.sqrt(windows, dtype=np.float32) @ np.sqrt(goal.shares)


def project_front(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Project a 90-degree view uint8 [S, S, 3] to a panorama uint8 [64, 128, 3]; also return the band's mask [32, 128].

    Its border is continued outside, so that blurring finds no edge there.
    """
    u, v, inside = _front_map()
    size = image.shape[0]
    small = cv2.resize(image, (64, 64), interpolation=cv2.INTER_AREA) if size != 64 else image
    wide = cv2.remap(small, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(wide, np.uint8), inside[ROWS]


@cache
def _front_map() -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Return where each panorama pixel looks up a 64 x 64 view of 90 degrees, and whether it is inside."""
    height, width = PANORAMA
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    latitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    ahead = np.cos(longitude) * np.cos(latitude)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.tan(longitude), np.sin(latitude) / ahead
    inside = (ahead > 0) & (np.abs(x) <= 1) & (np.abs(y) <= 1)
    u, v = (np.clip(x, -1, 1) + 1) * 32 - 0.5, (1 - np.clip(y, -1, 1)) * 32 - 0.5
    return u.astype(np.float32), v.astype(np.float32), inside


def _lab(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """float32 [H, W, 3]: L 0..100, a and b about -100..100."""
    return cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)  # type: ignore[return-value]


def _color_map(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return Lab [3, 32, W], blurred so that a place a step away still correlates."""
    return _blur(lab, 2.0).transpose(2, 0, 1)


def _edge_map(lab: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the strength of lightness edges in four orientations, blurred: [4, 32, W]."""
    light = cv2.copyMakeBorder(lab[..., 0], 1, 1, 1, 1, cv2.BORDER_WRAP)
    dx, dy = cv2.Sobel(light, cv2.CV_32F, 1, 0)[1:-1, 1:-1], cv2.Sobel(light, cv2.CV_32F, 0, 1)[1:-1, 1:-1]
    dy[[0, -1]] = 0  # the wrap that is right for columns is wrong for rows
    angle = np.remainder(np.arctan2(dy, dx), np.pi)
    strength = np.sqrt(np.hypot(dx, dy))
    centres = np.arange(4) * np.pi / 4
    share = np.maximum(np.cos(2 * (angle[..., None] - centres)), 0) ** 2
    return _blur(strength[..., None] * share, 1.0).transpose(2, 0, 1)


def _blur(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    margin = int(3 * sigma) + 1
    wide = cv2.copyMakeBorder(image, 0, 0, margin, margin, cv2.BORDER_WRAP)
    blurred = cv2.GaussianBlur(wide, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred[:, margin:-margin], np.float32)


def _bins(lab: NDArray[np.float32]) -> NDArray[np.intp]:
    """Return the index of each pixel's bin, [H, W]; chroma within 40 covers what rooms show."""
    scaled = np.stack([lab[..., 0] / 100, lab[..., 1] / 80 + 0.5, lab[..., 2] / 80 + 0.5], -1)
    cells = np.clip((scaled * BINS).astype(np.intp), 0, np.array(BINS) - 1)
    layer = np.arange(len(lab))[:, None] * LAYERS // len(lab)
    return layer * int(np.prod(BINS)) + np.ravel_multi_index(tuple(np.moveaxis(cells, -1, 0)), BINS)


def _normalise(values: NDArray[np.float32], mask: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normalise to zero mean within the mask per channel, and unit norm over all channels."""
    centred = (values - (values * mask).sum((-2, -1), keepdims=True) / mask.sum()) * mask
    return (centred / max(float(np.linalg.norm(centred)), 1e-6)).astype(np.float32)


def _correlation(
    places: NDArray[np.float32], goal: NDArray[np.float32], mask: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the normalised correlation of the goal with the window centred at each column, by FFT: [N, 128].

    With w the goal's mask of n pixels and f a channel: sum (f - mean) g = sum f g because g has zero mean, and the
    window's energy is sum over channels of sum w f^2 - (sum w f)^2 / n.
    """
    spectrum = np.fft.rfft(places, axis=-1)
    spectrum_squared = np.fft.rfft((places**2).sum(1), axis=-1)
    pad = COLUMNS - WINDOW
    goal_spectrum = np.conj(np.fft.rfft(np.pad(goal, ((0, 0), (0, 0), (0, pad))), axis=-1))
    mask_spectrum = np.conj(np.fft.rfft(np.pad(mask, ((0, 0), (0, pad))), axis=-1))
    dot = np.fft.irfft((spectrum * goal_spectrum).sum((1, 2)), COLUMNS, axis=-1)
    sums = np.fft.irfft((spectrum * mask_spectrum).sum(2), COLUMNS, axis=-1)
    squares = np.fft.irfft((spectrum_squared * mask_spectrum).sum(1), COLUMNS, axis=-1)
    energy = np.maximum(squares - (sums**2).sum(1) / mask.sum(), 1e-6)
    return np.roll(dot / np.sqrt(energy), WINDOW // 2, axis=-1).astype(np.float32)
