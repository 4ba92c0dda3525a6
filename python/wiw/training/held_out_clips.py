# SPDX-License-Identifier: Apache-2.0
"""How near imagined frames are to the true ones of held-out clips, and whether they follow the actions.

A turn on the spot rolls a panorama and shows nothing new, so frames from another place and frames after turns alone
are counted apart. The *control gap* is the error under the actions of another clip less the error under the true ones.
Most of it comes from headings; the *gap of displacements* is what is left once the frames imagined under the other
actions are turned to the true heading. A model that knows nothing but turns has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.errors import ArgumentError
from wiw.metrics import psnr, ssim
from wiw.types import Conditioning, Control
from wiw.world_models.base import WorldModel

STEPS = (1, 4, 8, 14)
"""Numbers of actions after which frames are compared."""
APART = 0.1
"""Metres from which on two places are not the same; a step is 0.2 m."""

Frames = NDArray[np.uint8]
Imagine = Callable[[Frames, NDArray[np.int8], NDArray[np.uint64], NDArray[np.int64]], Frames]
"""Maps observations [B, H, W, 3], plans of primitives [B, K], seeds [B] and numbers of actions [B, S] to the frames
[B, S, H, W, 3] that follow so many actions of each plan."""


@dataclass(frozen=True)
class HeldOutClips:
    """N clips that no model is trained on."""

    scenes: tuple[str, ...]
    """[N]."""
    frames: Frames
    """uint8 [N, 1 + S, H, W, 3]: the observation, and what is seen after each of `steps`."""
    plans: NDArray[np.int8]
    """int8 [N, K]: the actions."""
    shuffled: NDArray[np.int8]
    """int8 [N, K]: the actions of another clip; the same in another order where there is one clip alone."""
    steps: tuple[int, ...]
    """[S]: numbers of actions, ascending, at most K."""

    def __len__(self) -> int:
        return len(self.scenes)


def select_clips(
    clips: Sequence[NavigationSegment], count: int, seed: int, size: tuple[int, int], steps: Sequence[int] = STEPS
) -> HeldOutClips:
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
    rng = np.random.default_rng((seed, 0x4E1D))
    chosen = [clips[int(index)] for index in rng.permutation(len(clips))[:count]]
    plans = np.stack([clip.actions[1:] for clip in chosen])
    frames = np.stack([resize_frames(clip.images[[0, *fit_steps(steps, plans.shape[1])]], size) for clip in chosen])
    scenes = tuple(clip.scene for clip in chosen)
    return HeldOutClips(scenes, frames, plans, shuffle_plans(plans, rng), fit_steps(steps, plans.shape[1]))


def fit_steps(steps: Sequence[int], actions: int) -> tuple[int, ...]:
    """Return the numbers of actions that clips of so many actions have; the last one in place of larger ones.

    Raises:
        ArgumentError: there are no actions.
    """
    if actions < 1:
        raise ArgumentError("expected clips of at least 2 frames, got 1")
    return tuple(sorted({min(step, actions) for step in steps}))


def shuffle_plans(plans: NDArray[np.int8], rng: np.random.Generator) -> NDArray[np.int8]:
    """Return plans [N, K] such that each row has the actions of another row; of a single row, in another order."""
    if len(plans) == 1:
        return rng.permuted(plans, axis=1)
    order = rng.permutation(len(plans))
    shuffled = np.empty_like(plans)
    shuffled[order] = plans[np.roll(order, 1)]
    return shuffled


def resize_frames(frames: Frames, size: tuple[int, int]) -> Frames:
    """Bring frames [N, H, W, 3] to a size (height, width) by means over areas."""
    if frames.shape[1:3] == tuple(size):
        return frames
    return np.stack([cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA) for frame in frames]).astype(np.uint8)


@dataclass(frozen=True)
class ClipErrors:
    """Errors of imagined frames against what was seen: N clips at S numbers of actions."""

    scenes: tuple[str, ...]
    """[N]."""
    steps: tuple[int, ...]
    """[S]."""
    psnr: NDArray[np.float64]
    """float64 [N, S] dB, rows weighted by the cosine of their latitude; so are all of these."""
    ssim: NDArray[np.float64]
    shuffled: NDArray[np.float64]
    """float64 [N, S] dB: under the actions of another clip."""
    turned: NDArray[np.float64]
    """float64 [N, S] dB: the same frames, turned to the true heading."""
    moved: NDArray[np.bool_]
    """bool [N, S]: whether the true frame is from another place than the observation."""
    apart: NDArray[np.bool_]
    """bool [N, S]: whether it is so, and the other actions lead to yet another place."""

    def summarise(self) -> dict[str, float]:
        """Return means by name: "psnr" over all steps, "psnr/4" and "ssim/4" after 4 actions, of frames from another
        place; "psnr/turns" of the rest; "gap" and "gap/displacements" in dB. Those without a frame are left out.
        """
        found = {"psnr": _mean(self.psnr, self.moved)}
        for column, step in enumerate(self.steps):
            found[f"psnr/{step}"] = _mean(self.psnr[:, column], self.moved[:, column])
            found[f"ssim/{step}"] = _mean(self.ssim[:, column], self.moved[:, column])
        found["psnr/turns"] = _mean(self.psnr, ~self.moved)
        found["gap"] = _mean(self.psnr - self.shuffled, self.apart)
        found["gap/displacements"] = _mean(self.psnr - self.turned, self.apart)
        return {name: value for name, value in found.items() if math.isfinite(value)}


def measure_clips(
    imagine: Imagine, clips: HeldOutClips, seed: int = 0, batch: int = 16, between: Callable[[], None] = lambda: None
) -> tuple[ClipErrors, tuple[Frames, Frames]]:
    """Compare a model with held-out clips.

    Args:
        imagine: the model.
        clips: that it is not trained on.
        seed: of what it draws.
        batch: clips in one call.
        between: called before each call.

    Returns:
        The errors, and the frames [N, S, H, W, 3] imagined under the true and under the other actions.
    """
    parts: list[tuple[Frames, Frames]] = []
    for rows in _slice_batches(len(clips), batch):
        images, seeds = clips.frames[rows, 0], np.arange(rows.start, rows.stop, dtype=np.uint64) + np.uint64(seed)
        wanted = np.tile(np.array(clips.steps), (len(images), 1))
        made = []
        for plans in (clips.plans[rows], clips.shuffled[rows]):
            between()
            made.append(imagine(images, plans, seeds, wanted))
        parts.append((made[0], made[1]))
    own, other = (np.concatenate(frames) for frames in zip(*parts, strict=True))
    return compare_frames(clips, own, other), (own, other)


def compare_frames(clips: HeldOutClips, own: Frames, other: Frames) -> ClipErrors:
    """Compare frames [N, S, H, W, 3] imagined under the true actions, and under the other ones, with the true ones."""
    columns = np.array(clips.steps) - 1
    paths, others = (action.to_trajectory(plans)[:, columns] for plans in (clips.plans, clips.shuffled))
    moved = np.linalg.norm(paths[..., :2], axis=-1) > APART
    truth = clips.frames[:, 1:]
    turned = turn_panoramas(other, paths[..., 2] - others[..., 2])
    return ClipErrors(
        clips.scenes,
        clips.steps,
        _psnr(own, truth),
        np.asarray(ssim(own, truth, weights="latitude")),
        _psnr(other, truth),
        _psnr(turned, truth),
        moved,
        moved & (np.linalg.norm(paths[..., :2] - others[..., :2], axis=-1) > APART),
    )


def turn_panoramas(frames: NDArray[Any], azimuth: NDArray[np.float64]) -> NDArray[Any]:
    """Turn panoramas [..., H, W, C] left by azimuths [...] in radians, rounded to columns."""
    width = frames.shape[-2]
    columns = np.rint(azimuth / (2 * np.pi) * width).astype(np.int64)
    sources = (np.arange(width) - columns[..., None]) % width
    return np.take_along_axis(frames, sources[..., None, :, None], axis=-2)


def imagine_with(model: WorldModel) -> Imagine:
    """Return how a world model of primitives imagines; only the wanted frames are asked of causal models."""

    def imagine(
        images: Frames, plans: NDArray[np.int8], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        length = model.accepts.frames - 1 if model.accepts.frames else plans.shape[1]
        controls = [
            make_control(plan, length, int(own.max()), int(own.min()) - 1)
            for plan, own in zip(plans, wanted, strict=True)
        ]
        rows = [
            model.rollout(Conditioning(images[rows]), controls[rows], seeds[rows])
            for rows in _slice_batches(len(images), model.accepts.best_batch)
        ]
        return np.concatenate(rows)[np.arange(len(images))[:, None], wanted]

    return imagine


def make_control(plan: NDArray[np.int8], length: int, own: int, shared: int = 0) -> Control:
    """Return a plan of primitives as a control of `length` actions, of which `own` are wanted."""
    actions = action.pad(plan[:own], length)
    views = action.to_trajectory(actions), action.to_viewpoints(actions)
    return Control(actions, *views, ids=action.with_null(actions), length=own, shared=shared)


def _slice_batches(count: int, batch: int) -> Iterator[slice]:
    for first in range(0, count, batch):
        yield slice(first, min(first + batch, count))


def _psnr(frames: Frames, truth: Frames) -> NDArray[np.float64]:
    return np.asarray(psnr(frames, truth, weights="latitude"))


def _mean(values: NDArray[Any], chosen: NDArray[np.bool_]) -> float:
    return float(values[chosen].mean()) if chosen.any() else math.nan
