# SPDX-License-Identifier: Apache-2.0
"""Statistics of features as LeRobot computes them: min, max, mean, std, count and five quantiles.

LeRobot looks at some frames of long episodes and some pixels of large pictures; so does this. It reads quantiles off
histograms of 5000 bins, here they are exact. For a whole dataset it has averages or bounds of the episodes' quantiles
(versions differ), here they are those of all values together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.lerobot.layout import Feature
from wiw.errors import FileError

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
LARGE_PIXELS, THINNED_PIXELS = 300, 150
"""Pixels of the longer side from which on a picture is thinned, and about how many are left."""
MERGED_AT_ONCE = 256
"""Episodes: a merge sorts all that came before again, so that it is not done for each."""


@dataclass(frozen=True)
class Distribution:
    """How often each value occurs."""

    values: NDArray[np.float64]
    """float64 [K], ascending."""
    counts: NDArray[np.int64]
    """int64 [K]."""

    @classmethod
    def from_values(cls, values: NDArray[Any]) -> Distribution:
        """Count the values of an array of any shape; bytes and 16-bit numbers fast."""
        if values.dtype in (np.uint8, np.uint16):
            every = np.bincount(values.ravel())
            (levels,) = np.nonzero(every)
            return cls(levels.astype(np.float64), every[levels])
        found, counts = np.unique(values.astype(np.float64), return_counts=True)
        return cls(found, counts)

    @classmethod
    def merge(cls, parts: Sequence[Distribution]) -> Distribution:
        """Count the values of several distributions together."""
        values, places = np.unique(np.concatenate([each.values for each in parts]), return_inverse=True)
        counts = np.zeros(len(values), np.int64)
        np.add.at(counts, places, np.concatenate([each.counts for each in parts]))
        return cls(values, counts)

    def describe(self) -> list[float]:
        """Return min, max, mean, standard deviation and the quantiles."""
        total = self.counts.sum()
        mean = self.values @ self.counts / total
        deviation = np.sqrt((self.values - mean) ** 2 @ self.counts / total)
        places = np.searchsorted(np.cumsum(self.counts), np.multiply(QUANTILES, total))
        return [self.values[0], self.values[-1], mean, deviation, *self.values[places]]


STATISTICS = ("min", "max", "mean", "std", *(f"q{round(100 * each):02d}" for each in QUANTILES))


@dataclass(frozen=True)
class FeatureTally:
    """Distributions of a feature's channels or entries, over some frames."""

    feature: Feature
    channels: tuple[Distribution, ...]
    frames: int
    """Number of frames that were looked at."""

    @classmethod
    def merge(cls, parts: Sequence[FeatureTally]) -> FeatureTally:
        """Add up the tallies of one feature."""
        channels = zip(*(each.channels for each in parts), strict=True)
        return cls(parts[0].feature, tuple(map(Distribution.merge, channels)), sum(each.frames for each in parts))

    def describe(self) -> dict[str, Any]:
        """Return the statistics, nested as LeRobot nests them: [C] of vectors, [C][1][1] of pictures in 0 to 1."""
        scale = 255.0 if self.feature.is_image and not self.feature.is_depth else 1.0
        table = np.array([channel.describe() for channel in self.channels]).T / scale
        shape = (-1, 1, 1) if self.feature.is_image else (-1,)
        rows = zip(STATISTICS, table, strict=True)
        return {name: row.reshape(shape).tolist() for name, row in rows} | {"count": [self.frames]}


def tally_episode(features: Mapping[str, Feature], columns: Mapping[str, Any]) -> dict[str, FeatureTally]:
    """Tally the features of an episode.

    Args:
        features: by name.
        columns: T values of each: an array [T] or [T, n], or T encoded pictures.

    Raises:
        FileError: a picture is damaged.
    """
    return {name: _tally_feature(feature, columns[name]) for name, feature in features.items()}


def _tally_feature(feature: Feature, values: Any) -> FeatureTally:
    if feature.is_image:
        return _tally_pictures(feature, [values[index] for index in sample_frames(len(values))])
    rows = np.asarray(values).reshape(len(values), -1)
    return FeatureTally(feature, tuple(Distribution.from_values(column) for column in rows.T), len(rows))


def _tally_pictures(feature: Feature, pictures: Sequence[bytes]) -> FeatureTally:
    channels = np.concatenate([_decode_thinned(each, feature) for each in pictures], axis=1)
    return FeatureTally(feature, tuple(Distribution.from_values(channel) for channel in channels), len(pictures))


def _decode_thinned(encoded: bytes, feature: Feature) -> NDArray[Any]:
    """Return some pixels of a picture, [C, N]."""
    how = cv2.IMREAD_UNCHANGED if feature.is_depth else cv2.IMREAD_COLOR
    image = cv2.imdecode(np.frombuffer(encoded, np.uint8), how)
    height, width, channels = feature.shape
    if image is None or image.shape[:2] != (height, width) or (image.dtype == np.uint8) == feature.is_depth:
        kind = "depth" if feature.is_depth else "colour"
        got = "something else" if image is None else f"{image.dtype} {list(image.shape)}"
        raise FileError(
            f"expected {kind} images of {height} x {width}, got {got}; `wiw data verify` finds them in navigation "
            "datasets"
        )
    step = max(1, max(height, width) // THINNED_PIXELS) if max(height, width) >= LARGE_PIXELS else 1
    return image[::step, ::step].reshape(-1, channels).T[::-1]  # OpenCV decodes to BGR


def sample_frames(count: int) -> list[int]:
    """Return the frames of an episode whose pictures count: all up to 100, then fewer and fewer, as LeRobot has it."""
    samples = max(min(count, 100), min(int(count**0.75), 10_000))
    return [int(each) for each in np.round(np.linspace(0, count - 1, samples))]


class DatasetTally:
    """The tallies of all episodes of a dataset together."""

    def __init__(self) -> None:
        self._parts: list[Mapping[str, FeatureTally]] = []

    def add(self, episode: Mapping[str, FeatureTally]) -> None:
        """Add an episode."""
        self._parts.append(episode)
        if len(self._parts) == MERGED_AT_ONCE:
            self._parts = [self._merge()]

    def describe(self) -> dict[str, Any]:
        """Return the content of `meta/stats.json`."""
        return {name: tally.describe() for name, tally in self._merge().items()}

    def _merge(self) -> dict[str, FeatureTally]:
        return {name: FeatureTally.merge([each[name] for each in self._parts]) for name in self._parts[0]}
