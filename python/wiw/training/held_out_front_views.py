# SPDX-License-Identifier: Apache-2.0
"""Held-out clips of front views of an agent that moves, with the frames before the observation.

A turn shows something new in a front view, so frames after turns count as those from another place do. They cannot be
turned to another heading, so that there is no gap of displacements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.datasets.navigation_segment import NavigationSegment
from wiw.training.held_out_clips import (
    APART,
    STEPS,
    ClipErrors,
    Frames,
    HeldOutClips,
    ShownView,
    draw_order,
    fit_steps,
    measure_frames,
    resize_frames,
    shuffle_plans,
)
from wiw.training.held_out_panoramas import turn_panoramas
from wiw.training.post_training.corpora import cut_front_views
from wiw.types import Conditioning, History

TURNED = np.radians(1.0)
"""Radians from which on two headings are not the same."""


@dataclass(frozen=True)
class FrontView(ShownView):
    """The part of an agent's front view that a model sees and imagines."""

    size: tuple[int, int]
    """Height and width of the front view."""
    rows: slice
    """Rows of it that the model sees."""
    weights = "uniform"

    def show(self, panoramas: Frames, headings: NDArray[np.float64]) -> Frames:
        """Return front views that are cut out of the panoramas as the loop does."""
        return self.fit(cut_front_views(turn_panoramas(panoramas, headings), self.size))

    def fit(self, views: Frames) -> Frames:
        """Return what the model sees of front views [N, H, W, 3] of any size."""
        return np.ascontiguousarray(resize_frames(views, self.size)[:, self.rows])


@dataclass(frozen=True)
class FrontViewClips(HeldOutClips[ClipErrors]):
    """Clips of front views and primitives, int8 [N, K].

    Counted are frames from another place or with another heading than the observation.
    """

    seen_by: FrontView
    context: Frames
    """uint8 [N, C, H, W, 3]: what was seen up to the observation, one action apart."""
    before: NDArray[np.int8]
    """int8 [N, C - 1]: the actions between these."""

    @property
    def view(self) -> FrontView:
        """The part of a front view that the model sees."""
        return self.seen_by

    def observe(self, rows: slice) -> Conditioning:
        """Return the observations and what was seen before them."""
        images, actions = self.context[rows], self.before[rows]
        poses = np.pad(action.to_trajectory(actions), ((0, 0), (1, 0), (0, 0)))  # in the frame of the oldest
        history = History(
            images,
            action.relative_poses(poses),
            actions[..., None],
            lengths=np.ones(actions.shape, np.int64),
            count=np.full(len(images), images.shape[1]),
        )
        return Conditioning(self.frames[rows, 0], history=history)

    def compare(self, own: Frames, other: Frames) -> ClipErrors:
        """Compare imagined frames with the true ones; see `HeldOutClips.compare`."""
        columns = np.array(self.steps) - 1
        paths, others = (action.to_trajectory(plans)[:, columns] for plans in (self.plans, self.shuffled))
        counted = _differ(paths, np.zeros(3))
        return ClipErrors(
            **measure_frames(self, own, other, self.view.weights),
            counted=counted,
            apart=counted & _differ(paths, others),
        )


def select_front_views(
    clips: Sequence[NavigationSegment],
    cut: Callable[[Frames], Frames],
    view: FrontView,
    context: int,
    count: int,
    seed: int,
    steps: Sequence[int] = STEPS,
) -> FrontViewClips:
    """Select clips at random, the same ones for a seed, and decode their context and the frames that are compared.

    Args:
        clips: windows of one length, which begin with the context.
        cut: maps pictures [N, H, W, 3] of the dataset to front views.
        view: what the model sees of these.
        context: frames up to the observation, which is the last of them.
        count: how many clips; all where there are fewer.
        seed: of the choice.
        steps: numbers of actions; longer ones than a clip are replaced by its last frame.

    Raises:
        ArgumentError: clips with nothing after the context.
        FileError: a picture is damaged.
    """
    order, rng = draw_order(len(clips), count, seed)
    chosen = [clips[int(index)] for index in order]
    actions = np.stack([clip.actions for clip in chosen])
    plans = actions[:, context:]
    fitted = fit_steps(steps, plans.shape[1])
    shown = [*range(context), *(context - 1 + step for step in fitted)]
    frames = np.stack([view.fit(cut(clip.images[shown])) for clip in chosen])
    return FrontViewClips(
        tuple(clip.scene for clip in chosen),
        frames[:, context - 1 :],
        plans,
        shuffle_plans(plans, rng),
        fitted,
        view,
        frames[:, :context],
        actions[:, 1:context],
    )


def _differ(poses: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether planar poses [..., 3] are at another place or heading than others, bool [...]."""
    change = poses - others
    turned = np.abs(np.remainder(change[..., 2] + np.pi, 2 * np.pi) - np.pi)
    return (np.linalg.norm(change[..., :2], axis=-1) > APART) | (turned > TURNED)
