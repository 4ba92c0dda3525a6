# SPDX-License-Identifier: Apache-2.0
"""The plan of a data-scaling study, written down before anything is trained: sizes, arms, measures, tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from wiw.errors import ArgumentError

ONE_EPOCH, EQUAL_UPDATES, FEWER_SCENES = "one epoch", "equal updates", "fewer scenes"
PRIMARY: Mapping[str, str] = {
    "error": "held-out error after 4 actions, grey levels (RMS)",
    "regret": "top-1 regret in constructed decisions, m",
}
"""Measures that conclusions are drawn from; less is better."""
REGISTERED = (
    "Primary: error, the root of the mean squared error of frames after 4 actions of held-out clips, in grey levels of 255, "
    "rows weighted by the cosine of their latitude, over frames from another place than the observation; and regret, "
    "how many metres further from the goal the plan ends whose imagined end looks most like the goal than the best "
    "plan does. Everything else is secondary.",
    "Trend: Page's test over scenes, one-sided, of each primary measure falling over the sizes, in the arms of one epoch "
    "and of equal updates; 0.05, without correction for two measures.",
    "Split: of the gain from the smallest to the largest size at one epoch, the part that the smallest size has when "
    "trained for as many updates as the largest is due to updates, the rest to data. Where the 95 % interval of the "
    "updates' share lies above 50 %, the curve is mostly updates; below, mostly data; else it is undecided.",
    "Scenes: the difference between the same number of clips from the fewest and from all scenes, at equal updates.",
    "Intervals: 95 %, percentiles over scenes and seeds drawn anew together, all trainings paired.",
)
"""What was settled before the first training."""
SPAN = 100
"""The largest size over the smallest."""


@dataclass(frozen=True)
class Training:
    """One training from nothing."""

    clips: int
    scenes: int
    updates: int
    seed: int

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.clips}-clips-{self.scenes}-scenes-{self.updates}-updates-seed-{self.seed}"


@dataclass(frozen=True)
class ScalingPlan:
    """All numbers that the outcome of a study depends on."""

    model: str
    data: str
    """Digest of the dataset."""
    size: tuple[int, int]
    """Height and width of the panoramas."""
    length: int
    """Frames of a clip."""
    batch: int
    sizes: tuple[int, ...]
    """Numbers of clips, ascending."""
    scenes: tuple[int, ...]
    """Numbers of training scenes of the third arm, ascending; the last one is all of them, as in the other arms."""
    fewer_clips: int
    """Clips of the third arm."""
    seeds: tuple[int, ...]
    held_out: float
    """Share of the dataset's scenes that is held out."""
    held_out_clips: int
    decision_scenes: str
    decisions_per_scene: int

    @property
    def updates(self) -> int:
        """Updates of the largest size in one epoch: those of all in the other arms."""
        return self.sizes[-1] // self.batch

    def list_arms(self, seed: int) -> dict[str, list[Training]]:
        """Return the trainings of each arm for a seed, from few clips or scenes to many; arms share some."""
        whole = self.scenes[-1]
        return {
            ONE_EPOCH: [Training(clips, whole, clips // self.batch, seed) for clips in self.sizes],
            EQUAL_UPDATES: [Training(clips, whole, self.updates, seed) for clips in self.sizes],
            FEWER_SCENES: [Training(self.fewer_clips, scenes, self.updates, seed) for scenes in self.scenes],
        }

    def list_trainings(self) -> list[Training]:
        """Return all trainings, each once, the short ones first."""
        found = {each for seed in self.seeds for arm in self.list_arms(seed).values() for each in arm}
        return sorted(found, key=lambda each: (each.updates, each.clips, each.scenes, each.seed))

    def describe(self) -> dict[str, Any]:
        """Return the plan as JSON values, with what is measured and how it is judged."""
        numbers = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
        return {**numbers, "updates": self.updates, "primary": dict(PRIMARY), "registered": list(REGISTERED)}


def choose_sizes(most: int, batch: int, count: int = 4) -> tuple[int, ...]:
    """Return numbers of clips over two orders of magnitude, evenly in logarithm, in whole batches.

    Raises:
        ArgumentError: too few clips for different sizes.
    """
    largest = most // batch * batch
    sizes = [max(batch, round(size / batch) * batch) for size in np.geomspace(largest / SPAN, largest, count)]
    if len(set(sizes)) < count:
        raise ArgumentError(
            f"data-scaling: {most} clips are too few for {count} sizes in batches of {batch}; expected {SPAN * batch} "
            "or more: collect more scenes"
        )
    return tuple(sizes)


def choose_scenes(windows: Sequence[int], sizes: Sequence[int]) -> tuple[tuple[int, ...], int]:
    """Return numbers of scenes, each a quarter of the next, at least 2; and a number of clips that the fewest have.

    Args:
        windows: of each training scene.
        sizes: of the study; the number of clips is the largest that surely fits.

    Raises:
        ArgumentError: there are fewer than 8 scenes, or the fewest have too few clips for the smallest size.
    """
    counts = [len(windows)]
    while counts[0] // 4 >= 2 and len(counts) < 3:
        counts.insert(0, counts[0] // 4)
    there = sum(sorted(windows)[: counts[0]])  # whichever scenes are drawn
    fitting = [size for size in sizes if size <= there]
    if len(counts) < 2 or not fitting:
        raise ArgumentError(
            f"data-scaling: expected 8 training scenes or more, with {sizes[0]} clips in a quarter of them, got "
            f"{len(windows)} scenes with {sum(windows)} clips; collect more scenes"
        )
    return tuple(counts), fitting[-1]
