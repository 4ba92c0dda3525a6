# SPDX-License-Identifier: Apache-2.0
"""Measure how close imagined frames are to the true ones of held-out clips, and whether they follow the actions.

The *control gap* is the error under the actions of another clip less the error under the true ones. Which frames count,
how they are compared and what is imagined under other actions differs between the kinds of clips: panoramas
(`held_out_panoramas`), front views of an agent that moves (`held_out_front_views`) and of an arm
(`held_out_demonstrations`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.errors import ArgumentError
from wiw.metrics import psnr, ssim
from wiw.metrics.images import Weights
from wiw.types import Conditioning, Control
from wiw.world_models.base import WorldModel

STEPS = (1, 4, 8, 14)
"""Numbers of actions after which frames are compared."""
APART = 0.1
"""Metres from which on two places of an agent are not the same; a step is 0.2 m."""

Frames = NDArray[np.uint8]
Imagine = Callable[[Conditioning, NDArray[Any], NDArray[np.uint64], NDArray[np.int64]], Frames]
"""Maps observations of B rows, plans, seeds [B] and numbers of actions [B, S] to the frames [B, S, H, W, 3] that follow
so many actions of each plan. Plans are of primitives, int8 [B, K], or of gripper poses, float64 [B, K + 1, 7] with that
of frame 0 in front."""


class ShownView(ABC):
    """A view of panoramas that a model of primitives sees and imagines."""

    weights: ClassVar[Weights]
    """Weights of the rows where two such views are compared."""

    @abstractmethod
    def show(self, panoramas: Frames, headings: NDArray[np.float64]) -> Frames:
        """Return panoramas [N, H, W, 3] as the model sees them once the agent has turned left by `headings` [N]."""


@dataclass(frozen=True)
class ClipErrors:
    """Errors of imagined frames against what was seen: N clips at S numbers of actions."""

    scenes: tuple[str, ...]
    """[N]."""
    steps: tuple[int, ...]
    """[S]."""
    psnr: NDArray[np.float64]
    """float64 [N, S] dB."""
    ssim: NDArray[np.float64]
    shuffled: NDArray[np.float64]
    """float64 [N, S] dB: PSNR under the actions of another clip."""
    counted: NDArray[np.bool_]
    """bool [N, S]: whether the frame shows what a model has to imagine."""
    apart: NDArray[np.bool_]
    """bool [N, S]: whether it does, and the other actions lead to something else."""

    def summarise(self) -> dict[str, float]:
        """Return means by name: "psnr" over all steps, "psnr/4" and "ssim/4" after 4 actions, of the frames that are
        counted; "gap" in dB of those that are apart. Those without a frame are left out.
        """
        found = {"psnr": take_mean(self.psnr, self.counted)}
        for column, step in enumerate(self.steps):
            found[f"psnr/{step}"] = take_mean(self.psnr[:, column], self.counted[:, column])
            found[f"ssim/{step}"] = take_mean(self.ssim[:, column], self.counted[:, column])
        found["gap"] = take_mean(self.psnr - self.shuffled, self.apart)
        return keep_finite(found)


Errors = TypeVar("Errors", bound=ClipErrors)


@dataclass(frozen=True)
class HeldOutClips(ABC, Generic[Errors]):
    """N clips that no model is trained on."""

    scenes: tuple[str, ...]
    """[N]: the scene, or the demonstration, of each."""
    frames: Frames
    """uint8 [N, 1 + S, H, W, 3]: the observation, and what is seen after each of `steps`."""
    plans: NDArray[Any]
    """[N, ...]: the actions, as `Imagine` takes them."""
    shuffled: NDArray[Any]
    """[N, ...]: the actions of another clip; the same in another order if there is one clip alone."""
    steps: tuple[int, ...]
    """[S]: numbers of actions, ascending, at most those of a plan."""

    def __len__(self) -> int:
        return len(self.scenes)

    @property
    def view(self) -> ShownView | None:
        """View in which models of such clips see stored decisions; None if no agent moves."""
        return None

    def observe(self, rows: slice) -> Conditioning:
        """Return what a model is shown of some clips."""
        return Conditioning(self.frames[rows, 0])

    @abstractmethod
    def compare(self, own: Frames, other: Frames) -> Errors:
        """Compare frames [N, S, H, W, 3] imagined under the true actions, and under the other ones, with the truth."""


def take_mean(values: NDArray[Any], chosen: NDArray[np.bool_]) -> float:
    """Return the mean of the chosen values; NaN if there are none."""
    return float(values[chosen].mean()) if chosen.any() else math.nan


def keep_finite(found: Mapping[str, float]) -> dict[str, float]:
    """Return the measures that are finite."""
    return {name: value for name, value in found.items() if math.isfinite(value)}


def measure_frames(clips: HeldOutClips[Any], own: Frames, other: Frames, weights: Weights) -> dict[str, Any]:
    """Return the fields of `ClipErrors` that pictures alone decide on: names, steps, and all errors."""
    truth = clips.frames[:, 1:]
    return {
        "scenes": clips.scenes,
        "steps": clips.steps,
        "psnr": np.asarray(psnr(own, truth, weights=weights)),
        "ssim": np.asarray(ssim(own, truth, weights=weights)),
        "shuffled": np.asarray(psnr(other, truth, weights=weights)),
    }


def draw_order(total: int, count: int, seed: int) -> tuple[NDArray[np.int64], np.random.Generator]:
    """Return at most `count` of `total` clips at random, int64 [N], and a generator for the rest, both by a seed."""
    rng = np.random.default_rng((seed, 0x4E1D))
    return rng.permutation(total)[:count], rng


def fit_steps(steps: Sequence[int], actions: int) -> tuple[int, ...]:
    """Return the numbers of actions that clips of so many actions have; the last one in place of larger ones.

    Raises:
        ArgumentError: clips without actions.
    """
    if actions < 1:
        raise ArgumentError("expected clips of at least 2 frames, got 1")
    return tuple(sorted({min(step, actions) for step in steps}))


def pair_clips(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return another clip for each, int64 [count], no clip twice; of a single one, itself."""
    order = rng.permutation(count)
    others = np.empty(count, np.int64)
    others[order] = np.roll(order, 1)
    return others


def shuffle_plans(plans: NDArray[np.int8], rng: np.random.Generator) -> NDArray[np.int8]:
    """Return plans [N, K] such that each row has the actions of another row; of a single row, in another order."""
    if len(plans) == 1:
        return rng.permuted(plans, axis=1)
    return plans[pair_clips(len(plans), rng)]


def resize_frames(frames: Frames, size: tuple[int, int]) -> Frames:
    """Bring frames [N, H, W, 3] to a size (height, width) by means over areas."""
    if frames.shape[1:3] == tuple(size):
        return frames
    return np.stack([cv2.resize(frame, size[::-1], interpolation=cv2.INTER_AREA) for frame in frames]).astype(np.uint8)


def measure_clips(
    imagine: Imagine,
    clips: HeldOutClips[Errors],
    seed: int = 0,
    batch: int = 16,
    between: Callable[[], None] = lambda: None,
) -> tuple[Errors, tuple[Frames, Frames]]:
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
        observations, seeds = clips.observe(rows), np.arange(rows.start, rows.stop, dtype=np.uint64) + np.uint64(seed)
        wanted = np.tile(np.array(clips.steps), (len(observations), 1))
        made = []
        for plans in (clips.plans[rows], clips.shuffled[rows]):
            between()
            made.append(imagine(observations, plans, seeds, wanted))
        parts.append((made[0], made[1]))
    own, other = (np.concatenate(frames) for frames in zip(*parts, strict=True))
    return clips.compare(own, other), (own, other)


def imagine_with(model: WorldModel) -> Imagine:
    """Return how a world model of primitives imagines; only the wanted frames are asked of causal models."""

    def imagine(
        observations: Conditioning, plans: NDArray[Any], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
    ) -> Frames:
        length = model.accepts.frames - 1 if model.accepts.frames else plans.shape[1]
        controls = [
            make_control(plan, length, int(own.max()), int(own.min()) - 1)
            for plan, own in zip(plans, wanted, strict=True)
        ]
        parts = [
            model.rollout(observations.rows(range(rows.start, rows.stop)), controls[rows], seeds[rows])
            for rows in _slice_batches(len(controls), model.accepts.best_batch)
        ]
        return np.concatenate(parts)[np.arange(len(controls))[:, None], wanted]

    return imagine


def make_control(plan: NDArray[np.int8], length: int, own: int, shared: int = 0) -> Control:
    """Return a plan of primitives as a control of `length` actions, of which `own` are wanted."""
    actions = action.pad(plan[:own], length)
    views = action.to_trajectory(actions), action.to_viewpoints(actions)
    return Control(actions, *views, ids=action.with_null(actions), length=own, shared=shared)


def _slice_batches(count: int, batch: int) -> Iterator[slice]:
    for first in range(0, count, batch):
        yield slice(first, min(first + batch, count))
