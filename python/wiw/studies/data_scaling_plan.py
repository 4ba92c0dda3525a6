# SPDX-License-Identifier: Apache-2.0
"""The plan of a data-scaling study, written down before anything is trained: sizes, arms, measures, tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import wiw
from wiw.analysis.data_scaling import EQUAL_UPDATES, FEWER_SCENES, ONE_EPOCH, ScalingArm
from wiw.errors import ArgumentError
from wiw.training.learners import LEARNERS
from wiw.typed_values import require_positive

PRIMARY: Mapping[str, str] = {
    "error": "held-out error after 4 actions, grey levels (RMS)",
    "regret": "top-1 regret in constructed decisions, m",
}
"""Measures that conclusions are drawn from; less is better."""
REGISTERED = (
    "Primary: error, the root of the mean squared error of frames after 4 actions of held-out clips, in grey levels of "
    "255, rows weighted by the cosine of their latitude, averaged over frames from another place than the observation; "
    "and regret, how many metres further from the goal the plan ends whose imagined end looks most like the goal than "
    "the best plan does. Everything else is secondary.",
    "Trend: Page's test over trainings, one-sided, of each primary measure falling over the sizes, in the arms of one "
    "epoch and of equal updates: sizes are ranked in each seed, p is from all orders of the trainings within seeds; "
    "level 0.05, without correction for several tests.",
    "Split: of the gain from the smallest to the largest size at one epoch, the part that the smallest size gains when "
    "it is trained for as many updates as the largest is due to updates, the rest to data. Where the 95 % interval of "
    "the updates' share lies above 50 %, the curve is mostly updates; below, mostly data; else it is undecided.",
    "Scenes: the difference between the same number of clips from the fewest and from all scenes, at equal updates; "
    "shown where a two-sided test that flips the signs of whole seeds, Holm-adjusted for all models and both primary "
    "measures, has p of at most 0.05.",
    "Intervals: 95 %, percentiles over scenes and seeds drawn anew together, all trainings paired.",
)
"""Rules that are settled before the first training."""
SPAN = 100
"""The largest size over the smallest."""
STEP = 4
"""Actions after which the primary error is taken."""


@dataclass(frozen=True, kw_only=True)
class ScalingSettings:
    """Numbers that a user of a study chooses.

    Raises:
        ArgumentError: a number is out of range.
    """

    models: tuple[str, ...] = LEARNERS
    size: tuple[int, int] = (64, 128)
    """Height and width of the panoramas."""
    length: int = 14
    """Frames of a clip."""
    batch: int = 16
    clips: int = 12_800
    """The largest size; the smallest is a hundredth of it."""
    sizes: int = 4
    """How many sizes."""
    seeds: tuple[int, ...] = (0, 1)
    """Each draws other clips and scenes, and other weights to begin with."""
    held_out: float = 0.25
    """Share of the dataset's scenes that is held out."""
    held_out_clips: int = 200
    decision_scenes: str = "apartments:val:40"
    decisions_per_scene: int = 30

    def __post_init__(self) -> None:
        unknown = [name for name in self.models if name not in LEARNERS]
        if unknown or not self.models:
            got = ", ".join(unknown) or "none"
            raise ArgumentError(f"data-scaling: expected models among {', '.join(LEARNERS)}, got {got}")
        for name, few in (("models", self.models), ("seeds", self.seeds)):
            if not few or len(set(few)) < len(few):
                raise ArgumentError(f"data-scaling: expected different {name}, got {few}")
        if self.sizes < 3:
            raise ArgumentError(f"data-scaling: expected at least 3 sizes, for a trend, got {self.sizes}")
        require_positive("data-scaling", self, "batch", "held_out_clips", "decisions_per_scene")
        if self.length <= STEP:
            raise ArgumentError(
                f"data-scaling: expected clips of at least {STEP + 1} frames, as errors are measured after {STEP} "
                f"actions, got a length of {self.length}"
            )
        if min(self.seeds) < 0:
            raise ArgumentError(f"data-scaling: expected seeds of 0 or more, got {self.seeds}")


FULL = ScalingSettings()
SMALL = ScalingSettings(
    size=(32, 64), clips=3200, held_out_clips=96, decision_scenes="apartments:val:20", decisions_per_scene=12
)
"""Less than an hour on two cores."""
SMALL_SCENES, SMALL_SIZE = "apartments:train:16", (128, 256)
"""The dataset that the small version collects."""


@dataclass(frozen=True)
class Training:
    """One training from nothing."""

    model: str
    clips: int
    scenes: int
    updates: int
    seed: int

    @property
    def setting(self) -> str:
        """Name of the training without its seed."""
        return f"{self.model}-{self.clips}-clips-{self.scenes}-scenes-{self.updates}-updates"

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.setting}-seed-{self.seed}"


@dataclass(frozen=True)
class ScalingPlan:
    """All numbers that the outcome of a study depends on."""

    settings: ScalingSettings
    data: str
    """Digest of the dataset."""
    sizes: tuple[int, ...]
    """Numbers of clips, ascending."""
    scenes: tuple[int, ...]
    """Numbers of training scenes of the third arm, ascending; the last one is all of them, as in the other arms."""
    fewer_clips: int
    """Clips of the third arm."""

    @property
    def updates(self) -> int:
        """Updates of the largest size in one epoch: those of all trainings in the other arms."""
        return self.sizes[-1] // self.settings.batch

    def describe_arms(self) -> list[ScalingArm]:
        """Return the arms of all models, whose trainings are those of every seed."""
        return [
            ScalingArm(
                model,
                name,
                tuple(each.scenes if name == FEWER_SCENES else each.clips for each in trainings),
                trainings[-1].clips,
                tuple(each.updates for each in trainings),
                tuple(each.setting for each in trainings),
            )
            for model in self.settings.models
            for name, trainings in self.list_arms(model, self.settings.seeds[0]).items()
        ]

    def list_arms(self, model: str, seed: int) -> dict[str, list[Training]]:
        """Return the trainings of each arm, from few clips or scenes to many; arms share some."""
        whole, batch = self.scenes[-1], self.settings.batch
        return {
            ONE_EPOCH: [Training(model, clips, whole, clips // batch, seed) for clips in self.sizes],
            EQUAL_UPDATES: [Training(model, clips, whole, self.updates, seed) for clips in self.sizes],
            FEWER_SCENES: [Training(model, self.fewer_clips, scenes, self.updates, seed) for scenes in self.scenes],
        }

    def list_trainings(self) -> list[Training]:
        """Return all trainings, each once: a seed after the other, the short ones first."""
        found = {
            each
            for model in self.settings.models
            for seed in self.settings.seeds
            for arm in self.list_arms(model, seed).values()
            for each in arm
        }
        return sorted(found, key=lambda each: (each.seed, each.updates, each.clips, each.scenes, each.model))

    def describe(self) -> dict[str, Any]:
        """Return the plan as JSON values: first what is measured and how it is judged, then all numbers."""
        return {
            "primary": dict(PRIMARY),
            "registered": list(REGISTERED),
            "wiw": wiw.__version__,
            **_list_values(asdict(self.settings)),
            **_list_values({"data": self.data, "clips": self.sizes, "scenes": self.scenes}),
            "fewer_clips": self.fewer_clips,
            "updates": self.updates,
        }


def _list_values(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def choose_sizes(largest: int, batch: int, count: int = 4) -> tuple[int, ...]:
    """Return numbers of clips over two orders of magnitude, evenly in logarithm, in whole batches.

    Raises:
        ArgumentError: too few clips for different sizes.
    """
    whole = max(1, largest // batch * batch)
    sizes = [max(batch, round(size / batch) * batch) for size in np.geomspace(whole / SPAN, whole, count)]
    if len(set(sizes)) < count:
        more = f"{SPAN * batch} or more, or " if whole < SPAN * batch else ""
        raise ArgumentError(
            f"data-scaling: {largest} clips are too few for {count} sizes in batches of {batch}; expected {more}fewer "
            "--sizes"
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
