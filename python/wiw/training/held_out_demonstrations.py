# SPDX-License-Identifier: Apache-2.0
"""Held-out clips of an arm: front views, and the poses of its gripper.

All frames count. Steps are frames of a clip, which is spread evenly over a plan however many actions that has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.training.held_out_clips import (
    STEPS,
    ClipErrors,
    Frames,
    HeldOutClips,
    draw_order,
    fit_steps,
    measure_frames,
    pair_clips,
    resize_frames,
)

APART = 0.02
"""Metres from which on two places of a gripper are not the same."""


@dataclass(frozen=True)
class DemonstratedPlan:
    """A part of a demonstration: a plan of K actions, and N frames spread evenly over it."""

    name: str
    """Name of the demonstration."""
    images: Frames
    """uint8 [N, H, W, 3]."""
    start: NDArray[np.float64]
    """float64 [7]: where the gripper is in frame 0."""
    targets: NDArray[np.float64]
    """float64 [K, 7]: the commanded poses."""

    def spread(self, targets: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a pose for each frame of a plan that begins here, float64 [N, 7], as the loop puts it to a model."""
        poses = action.resample(targets, len(self.images) - 1, start=self.start)
        return np.concatenate([self.start[None], poses])


class ArmClips(HeldOutClips[ClipErrors]):
    """Clips of an arm and poses of its gripper, float64 [N, K + 1, 7]."""

    def compare(self, own: Frames, other: Frames) -> ClipErrors:
        """Compare imagined frames with the true ones; apart are those with the gripper at different places."""
        columns = np.array(self.steps)
        places, others = (plans[:, columns, :3] for plans in (self.plans, self.shuffled))
        apart = np.linalg.norm(places - others, axis=-1) > APART
        return ClipErrors(**measure_frames(self, own, other, "uniform"), counted=np.ones_like(apart), apart=apart)


def select_demonstrations(
    plans: Sequence[DemonstratedPlan], count: int, seed: int, size: tuple[int, int], steps: Sequence[int] = STEPS
) -> ArmClips:
    """Select clips at random, the same ones for a seed, and decode the frames that are compared.

    Under the actions of another clip the gripper goes from where it is to the poses commanded there; of a single clip,
    to its own in reverse.

    Args:
        plans: parts of demonstrations, all of as many frames.
        count: how many; all where there are fewer.
        seed: of the choice.
        size: (height, width) that frames are brought to.
        steps: numbers of frames after the first; larger ones than a clip has are replaced by its last.

    Raises:
        ArgumentError: clips of a single frame.
        FileError: a picture is damaged.
    """
    order, rng = draw_order(len(plans), count, seed)
    chosen = [plans[int(index)] for index in order]
    fitted = fit_steps(steps, len(chosen[0].images) - 1)
    others = pair_clips(len(chosen), rng)
    targets = [chosen[other].targets for other in others] if len(chosen) > 1 else [chosen[0].targets[::-1]]
    return ArmClips(
        tuple(plan.name for plan in chosen),
        np.stack([resize_frames(plan.images[[0, *fitted]], size) for plan in chosen]),
        np.stack([plan.spread(plan.targets) for plan in chosen]),
        np.stack([plan.spread(own) for plan, own in zip(chosen, targets, strict=True)]),
        fitted,
    )
