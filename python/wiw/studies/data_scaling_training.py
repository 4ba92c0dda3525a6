# SPDX-License-Identifier: Apache-2.0
"""One training of a data-scaling study, and what its model is worth: a job for a process of its own."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.decisions import Decisions, load_decisions
from wiw.datasets.navigation import NavigationData, part_of
from wiw.datasets.shrunk_navigation import ShrunkNavigation, shrink_navigation
from wiw.errors import FileError
from wiw.files import atomic_file
from wiw.networks import single_thread
from wiw.studies.data_scaling_plan import ScalingPlan, Training
from wiw.training.decision_errors import DecisionErrors, measure_decisions
from wiw.training.held_out_clips import (
    STEPS,
    ClipErrors,
    Frames,
    HeldOutClips,
    Imagine,
    fit_steps,
    measure_clips,
    shuffle_plans,
    turn_panoramas,
)
from wiw.training.learners import make_learner
from wiw.training.post_training.clip_order import ClipOrder

PICTURES, DECISIONS = "pictures.npz", "decisions.parquet"
"""Files in a study's folder."""
STEP = 4
"""Actions after which the primary error is taken."""
BATCH = 120
"""Frames in one call of a model."""

Measures = dict[str, dict[str, list[float]]]
"""Sum and number of values in each scene, by measure."""


@dataclass(frozen=True)
class TrainingJob:
    """A training whose weights and measures go into a study's folder."""

    training: Training
    plan: ScalingPlan
    data: Path
    folder: Path

    @property
    def weights(self) -> Path:
        """File of the weights."""
        return self.folder / "weights" / f"{self.training.name}.safetensors"

    def read_measures(self) -> Measures | None:
        """Return what was measured; None where it is not finished.

        Raises:
            FileError: the file is damaged.
        """
        path = self._measures
        if not path.exists():
            return None
        try:
            return dict(json.loads(path.read_text(encoding="utf-8"))["measures"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise FileError(f"{path}: expected the measures of a training, got {error}; delete it") from error

    def run(self) -> Measures:
        """Train, or read the weights that are there, measure, and write what was found."""
        began, learner = time.monotonic(), make_learner(self.plan.model)
        data, held_out, decisions = load_material(self.plan, self.data, self.folder)
        windows = choose_windows(data, self.plan, self.training)
        card = {"training": asdict(self.training), "data": self.plan.data}
        with single_thread():
            if not self.weights.exists():
                order = ClipOrder(len(windows), self.training.clips, self.plan.batch, self.training.seed)
                network = learner.train(data, windows, order, self.training.updates, self.training.seed, lambda _: None)
                self.weights.parent.mkdir(parents=True, exist_ok=True)
                with atomic_file(self.weights) as draft:
                    learner.save(network, draft, card)
            measures = measure(learner.imagine(learner.load(self.weights)), held_out, decisions)
        with atomic_file(self._measures) as draft:
            draft.write_text(json.dumps({**card, "seconds": time.monotonic() - began, "measures": measures}))
        return measures

    @property
    def _measures(self) -> Path:
        return self.folder / "measures" / f"{self.training.name}.json"


@cache
def load_material(plan: ScalingPlan, data: Path, folder: Path) -> tuple[ShrunkNavigation, HeldOutClips, Decisions]:
    """Return what all trainings of a study share, once for each process."""
    shrunk = shrink_navigation(NavigationData(data), plan.size, plan.length, folder / PICTURES)
    return shrunk, hold_out_clips(shrunk, plan), load_decisions(folder / DECISIONS)


def hold_out_clips(data: ShrunkNavigation, plan: ScalingPlan) -> HeldOutClips:
    """Select clips of the scenes that are held out; the same ones for all trainings."""
    rng = np.random.default_rng(0x4E1D)
    there = np.flatnonzero(~is_trained_on(data, plan.held_out))
    windows = rng.permutation(there)[: plan.held_out_clips]
    plans = data.plans(windows)
    steps = fit_steps(STEPS, plan.length - 1)
    frames = data.show(windows, np.tile([0, *steps], (len(windows), 1)))
    return HeldOutClips(tuple(data.scenes[windows].tolist()), frames, plans, shuffle_plans(plans, rng), steps)


def is_trained_on(data: ShrunkNavigation, held_out: float) -> NDArray[np.bool_]:
    """Return for each window whether its scene is one to train on."""
    parts = {scene: part_of(scene, held_out) == "train" for scene in np.unique(data.scenes).tolist()}
    return np.array([parts[scene] for scene in data.scenes.tolist()], np.bool_)


def choose_windows(data: ShrunkNavigation, plan: ScalingPlan, training: Training) -> NDArray[np.int64]:
    """Return the windows that a training draws its clips from: those of its scenes, fewer being among more."""
    trained = is_trained_on(data, plan.held_out)
    scenes = np.random.default_rng((training.seed, 0x5CE7)).permutation(np.unique(data.scenes[trained]))
    return np.flatnonzero(trained & np.isin(data.scenes, scenes[: training.scenes]))


def measure(imagine: Imagine, clips: HeldOutClips, decisions: Decisions) -> Measures:
    """Measure a model on held-out clips and decisions."""
    errors, _ = measure_clips(imagine, clips, batch=BATCH // len(clips.steps))
    return tabulate_clips(errors) | tabulate_decisions(measure_decisions(imagine, decisions, batch=BATCH))


def tabulate_clips(errors: ClipErrors) -> Measures:
    """Return sums by scene of the error after `STEP` actions, PSNR and SSIM at all steps, and both gaps."""
    levels = 255 * 10 ** (-errors.psnr / 20)
    found = {"psnr/turns": _sum(errors.scenes, errors.psnr, ~errors.moved)}
    for column, step in enumerate(errors.steps):
        moved = errors.moved[:, column]
        if step == STEP:
            found["error"] = _sum(errors.scenes, levels[:, column], moved)
        found[f"psnr/{step}"] = _sum(errors.scenes, errors.psnr[:, column], moved)
        found[f"ssim/{step}"] = _sum(errors.scenes, errors.ssim[:, column], moved)
    found["gap"] = _sum(errors.scenes, errors.psnr - errors.shuffled, errors.apart)
    found["gap/displacements"] = _sum(errors.scenes, errors.psnr - errors.turned, errors.apart)
    return found


def tabulate_decisions(errors: DecisionErrors) -> Measures:
    """Return sums by scene of regret and rank agreement."""
    return {
        "regret": _sum(errors.scenes, errors.regret, np.ones(len(errors.regret), np.bool_)),
        "rank": _sum(errors.scenes, errors.agreement, np.isfinite(errors.agreement)),
    }


def measure_references(clips: HeldOutClips, decisions: Decisions) -> dict[str, dict[str, float]]:
    """Return the primary measures of who knows turns alone, and the regret of chance and of the oracle."""

    def imagine_turns(images: Frames, plans: Any, seeds: Any, wanted: Any) -> Frames:
        from wiw import action

        azimuth = np.take_along_axis(action.to_trajectory(plans)[..., 2], wanted - 1, axis=1)
        return turn_panoramas(np.repeat(images[:, None], wanted.shape[1], axis=1), azimuth)

    table = measure(imagine_turns, clips, decisions)
    known = measure_decisions(imagine_turns, decisions, batch=BATCH).summarise()
    return {
        "turns alone": {name: average(table[name]) for name in ("error", "regret")},
        "chance": {"regret": known["regret/chance"]},
        "oracle": {"regret": known["regret/oracle"]},
    }


def average(table: dict[str, list[float]]) -> float:
    """Return the mean over all values of a measure."""
    sums, counts = np.array(list(table.values())).T
    return float(sums.sum() / counts.sum())


def _sum(scenes: Sequence[str], values: NDArray[np.float64], chosen: NDArray[np.bool_]) -> dict[str, list[float]]:
    """Return sum and number of the chosen values in each scene that has some."""
    found: dict[str, list[float]] = {}
    for scene in sorted(set(scenes)):
        own = np.array([each == scene for each in scenes])
        there = values[own][chosen[own]]
        if there.size:
            found[scene] = [float(there.sum()), float(there.size)]
    return found
