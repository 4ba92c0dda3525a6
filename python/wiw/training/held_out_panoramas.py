# SPDX-License-Identifier: Apache-2.0
"""Held-out clips of panoramas: frames from another place, and those after turns alone.

A turn on the spot rolls a panorama and shows nothing new, so frames from another place and frames after turns alone
are counted apart. Most of the control gap comes from headings; the *gap of displacements* is what is left once the
frames imagined under the other actions are turned to the true heading. A model that knows nothing but turns has none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.metrics import psnr
from wiw.training.held_out_clips import (
    APART,
    STEPS,
    ClipErrors,
    Frames,
    HeldOutClips,
    ShownView,
    draw_order,
    fit_steps,
    keep_finite,
    measure_frames,
    resize_frames,
    shuffle_plans,
    take_mean,
)


@dataclass(frozen=True)
class WholePanorama(ShownView):
    """Panoramas as they are, in a size (height, width) or their own."""

    size: tuple[int, int] | None = None
    weights = "latitude"

    def show(self, panoramas: Frames, headings: NDArray[np.float64]) -> Frames:
        """Return the panoramas turned."""
        turned = turn_panoramas(panoramas, headings)
        return turned if self.size is None else resize_frames(turned, self.size)


@dataclass(frozen=True)
class PanoramaErrors(ClipErrors):
    """Errors of imagined panoramas; counted are those from another place, apart those from yet another one.

    Rows are weighted by the cosine of their latitude.
    """

    turned: NDArray[np.float64]
    """float64 [N, S] dB: PSNR under the actions of another clip, turned to the true heading."""

    def summarise(self) -> dict[str, float]:
        """Return "psnr/turns" of frames after turns alone and "gap/displacements" in dB, too; see `ClipErrors`."""
        turns, gap = take_mean(self.psnr, ~self.counted), take_mean(self.psnr - self.turned, self.apart)
        return super().summarise() | keep_finite({"psnr/turns": turns, "gap/displacements": gap})


@dataclass(frozen=True)
class PanoramaClips(HeldOutClips[PanoramaErrors]):
    """Clips of panoramas and primitives, int8 [N, K]."""

    @property
    def view(self) -> WholePanorama:
        """Panoramas of the size of the clips."""
        return WholePanorama(self.frames.shape[2:4])

    def compare(self, own: Frames, other: Frames) -> PanoramaErrors:
        """Compare imagined frames with the true ones; see `HeldOutClips.compare`."""
        columns = np.array(self.steps) - 1
        paths, others = (action.to_trajectory(plans)[:, columns] for plans in (self.plans, self.shuffled))
        moved = np.linalg.norm(paths[..., :2], axis=-1) > APART
        turned = turn_panoramas(other, paths[..., 2] - others[..., 2])
        return PanoramaErrors(
            **measure_frames(self, own, other, self.view.weights),
            counted=moved,
            apart=moved & (np.linalg.norm(paths[..., :2] - others[..., :2], axis=-1) > APART),
            turned=np.asarray(psnr(turned, self.frames[:, 1:], weights=self.view.weights)),
        )


def select_panoramas(
    clips: Sequence[NavigationSegment], count: int, seed: int, size: tuple[int, int], steps: Sequence[int] = STEPS
) -> PanoramaClips:
    """Select clips at random, the same ones for a seed, and decode the frames that are compared.

    Args:
        clips: windows of one length, such as `NavigationData(folder, "held-out").clips(14)`.
        count: how many; all where there are fewer.
        seed: of the choice.
        size: (height, width) that frames are brought to.
        steps: numbers of actions; longer ones than a clip are replaced by its last frame.

    Raises:
        ArgumentError: clips of a single frame.
        FileError: a picture is damaged.
    """
    order, rng = draw_order(len(clips), count, seed)
    chosen = [clips[int(index)] for index in order]
    plans = np.stack([clip.actions[1:] for clip in chosen])
    fitted = fit_steps(steps, plans.shape[1])
    frames = np.stack([resize_frames(clip.images[[0, *fitted]], size) for clip in chosen])
    return PanoramaClips(tuple(clip.scene for clip in chosen), frames, plans, shuffle_plans(plans, rng), fitted)


def turn_panoramas(frames: NDArray[Any], azimuth: NDArray[np.float64]) -> NDArray[Any]:
    """Turn panoramas [..., H, W, C] left by azimuths [...] in radians, rounded to columns."""
    width = frames.shape[-2]
    columns = np.rint(azimuth / (2 * np.pi) * width).astype(np.int64)
    sources = (np.arange(width) - columns[..., None]) % width
    return np.take_along_axis(frames, sources[..., None, :, None], axis=-2)
