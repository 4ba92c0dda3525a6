# SPDX-License-Identifier: Apache-2.0
"""Runway Gen-4, a paid service."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.types import Conditioning, Control
from wiw.world_models.base import Requirements, WorldModel, accepts
from wiw.world_models.clips import EVEN, Alignment, frames_after_actions
from wiw.world_models.plan_text import make_template, read_words, write_prompt
from wiw.world_models.runway_gen4.tasks import Tasks
from wiw.world_models.runway_gen4.videos import encode_data_uri, fetch_video

LONGEST_PROMPT = 1000
"""UTF-16 code units that the service takes."""
SIDE = 960
"""Pixels of a side of the service's clips."""


@dataclass(kw_only=True, eq=False)
class RunwayGen4(WorldModel):
    """Runway Gen-4: a clip from the front view and the plan in words, generated on Runway's servers for a fee.

    The key is read from the environment, RUNWAYML_API_SECRET. All rows of a call are begun at once and waited for
    together. A row that the service has confirmed is never begun again: a repeated request continues to wait for it.

    Args:
        model: "gen4_turbo", or "gen4.5".
        duration: seconds of a clip, 2 to 10; each costs credits.
        size: (height, width) of input and output, square and at most 960x960, which the service makes of it.
        frames: of a rollout, the observation included: the maximum number of actions that a clip is to show, plus one.
        batch: rows that are begun at once.
        budget: credits after which no more tasks are started; None means no limit.
        template, alignment: as of `TextVideoModel`; clips count as having `frames` frames.
        poll: seconds between two looks at the tasks.
        patience: seconds after which a task that has not ended counts as lost.
        url: of the service; RUNWAYML_BASE_URL if not given, else Runway's own.

    Raises:
        DependencyError: `runwayml` is not installed.
        ArgumentError: no key in the environment, or an option out of range.
    """

    accepts = accepts(control="text", view="perspective", frames=25)
    version = "1"
    immaterial = ("batch", "budget", "poll")
    requires = Requirements(("runwayml",), "runway", variables=("RUNWAYML_API_SECRET",))

    model: Literal["gen4_turbo", "gen4.5"] = "gen4_turbo"
    duration: int = 5
    size: tuple[int, int] = (480, 480)
    frames: int = 25
    batch: int = 4
    template: str | Path | Mapping[str, Any] | None = None
    alignment: str = EVEN
    budget: float | None = None
    poll: float = 5.0
    patience: float = 600.0
    url: str | None = None

    def __post_init__(self) -> None:
        if self.model not in ("gen4_turbo", "gen4.5") or self.duration not in range(2, 11):
            raise ArgumentError(
                f"RunwayGen4: expected model gen4_turbo or gen4.5 and a duration of 2 to 10 whole seconds, got "
                f"{self.model!r} and {self.duration!r}"
            )
        if self.batch < 1 or self.poll < 0 or not self.patience > 0:
            raise ArgumentError(
                f"RunwayGen4: expected a batch of at least 1, poll of at least 0 s and patience above 0 s, got "
                f"{self.batch}, {self.poll} and {self.patience}"
            )
        if not isinstance(self.frames, int) or self.frames < 2:
            raise ArgumentError(f"RunwayGen4: expected frames, a whole number of at least 2, got {self.frames!r}")
        sides = tuple(self.size) if isinstance(self.size, list | tuple) else ()
        if len(sides) != 2 or sides[0] != sides[1] or sides[0] not in range(1, SIDE + 1):
            raise ArgumentError(
                f"RunwayGen4: clips are square, {SIDE}x{SIDE}: expected size (side, side) of at most that, got "
                f"{self.size!r}"
            )
        self.size = (int(sides[0]), int(sides[1]))
        self.template = read_words(self.template)
        self._words = make_template(self.template)
        self._alignment = Alignment.parse(self.alignment, self.frames)
        self.accepts = replace(
            type(self).accepts,
            size=self.size,
            frames=self._alignment.frames,
            best_batch=self.batch,
            template=self._words,
        )
        self.requires.require()
        self._tasks = Tasks(self.url, self.poll, self.patience, self.budget)

    @property
    def credits(self) -> int:  # type: ignore[override]
        """Charges of the service so far."""
        return self._tasks.credits

    def rollout(
        self, observations: Conditioning, controls: Sequence[Control], seeds: NDArray[np.uint64]
    ) -> NDArray[np.uint8]:
        """Return one clip per row; by default evenly sampled, where padding repeats the last frame of the plan.

        Raises:
            InfrastructureError: the service refused, failed or took too long, or the budget is spent.
        """
        orders = [
            self._make_order(image, control, int(seed))
            for image, control, seed in zip(observations.image, controls, seeds, strict=True)
        ]
        frames = np.empty((len(controls), self.accepts.frames, *observations.image.shape[1:]), np.uint8)
        for row, (url, control) in enumerate(zip(self._tasks.outputs(orders), controls, strict=True)):
            clip = fetch_video(url, self.size)
            frames[row] = clip[self._choose_frames(control.length, len(clip))]
        frames[:, 0] = observations.image
        return frames

    def _choose_frames(self, length: int, clip: int) -> NDArray[np.int64]:
        """Return which frame of a clip of the service each frame of the rollout is."""
        pace = self._alignment.pace
        if pace is None:
            return frames_after_actions(length, clip, self.frames)
        return Alignment(clip, pace * Fraction(clip - 1, self.frames - 1)).choose_frames(length)

    def _make_order(self, image: NDArray[np.uint8], control: Control, seed: int) -> dict[str, Any]:
        """Return what the service is asked for one row."""
        prompt = write_prompt(control, self._words, self._alignment)
        if len(prompt.encode("utf-16-le")) > 2 * LONGEST_PROMPT:
            raise ArgumentError(
                f"RunwayGen4: the service takes prompts of up to {LONGEST_PROMPT} characters, but {control.length} "
                f"actions take {len(prompt)}; lower frames (now {self.frames})"
            )
        return {
            "model": self.model,
            "prompt_image": encode_data_uri(image),
            "prompt_text": prompt,
            "ratio": f"{SIDE}:{SIDE}",
            "duration": self.duration,
            "seed": seed % 2**32,
        }

    def __reduce__(self) -> Any:
        """Pickle the options: another process opens its own connection."""
        return partial(type(self), **{field.name: getattr(self, field.name) for field in fields(self)}), ()
