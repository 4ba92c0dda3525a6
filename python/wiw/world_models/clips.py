# SPDX-License-Identifier: Apache-2.0
"""Choose the frames of a rollout from the clip of a video generator."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from wiw import action
from wiw.errors import ArgumentError

EVEN, FIXED = "even", "frames_per_action="


def frames_after_actions(length: int, clip: int, frames: int) -> NDArray[np.int64]:
    """Return which frame of a clip each frame of a rollout is, where the clip shows a plan evenly.

    Args:
        length: actions of the plan; the frames after it repeat the clip's last.
        clip: frames of the clip.
        frames: frames of the rollout, the observation included.

    Returns:
        int64 [frames].
    """
    indices = np.full(frames, clip - 1)
    indices[0] = 0
    indices[1 : 1 + length] = action.frames_of_actions(length, clip, "resample")[:, 1]
    return indices


@dataclass(frozen=True)
class Alignment:
    """Which frame of a clip shows which action of a plan.

    "even": the clip shows the whole plan, however long: action k of K is at frame k (N - 1) / K of N, to the nearest.
    "frames_per_action=F": action k is at frame k F, rounded down, whatever the length of the plan; the clip then always
    shows (N - 1) / F actions, rounded down, and the prompt names as many: those beyond the plan are its padding.
    """

    clip: int
    """Frames of the clip, the observation included."""
    pace: Fraction | None = None
    """Frames per action; None for "even"."""

    @classmethod
    def parse(cls, text: str, clip: int) -> Alignment:
        """Return the alignment that a text names: "even", "frames_per_action=2" or "frames_per_action=24/13".

        Raises:
            ArgumentError: another text, or so many frames per action that a clip shows none.
        """
        if text == EVEN:
            return cls(clip)
        try:
            pace = Fraction(text.removeprefix(FIXED)) if text.startswith(FIXED) else Fraction(0)
        except (ValueError, ZeroDivisionError):
            pace = Fraction(0)
        if pace <= 0 or pace > clip - 1:
            raise ArgumentError(
                f"alignment: expected {EVEN}, or {FIXED}N with N from 0 to {clip - 1}, the last frame of a clip, such "
                f"as {FIXED}2 or {FIXED}24/13; got '{text}'"
            )
        return cls(clip, pace)

    @property
    def frames(self) -> int:
        """Frames of a rollout: the observation, and one for each action that a clip can show."""
        return self.clip if self.pace is None else 1 + int((self.clip - 1) / self.pace)

    def choose_frames(self, length: int) -> NDArray[np.int64]:
        """Return which frame of a clip each frame of a rollout is, int64 [frames], for a plan of so many actions."""
        if self.pace is None:
            return frames_after_actions(length, self.clip, self.frames)
        return np.array([int(k * self.pace) for k in range(self.frames)])
