# SPDX-License-Identifier: Apache-2.0
"""One training of a data-scaling study, and what its model is worth: a job for a separate process."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wiw.datasets.decisions import Decisions, load_decisions
from wiw.datasets.navigation import Clips, NavigationData, SelectedClips
from wiw.errors import FileError
from wiw.files import atomic_file
from wiw.networks import describe_device, memory_guard, single_thread
from wiw.studies.data_scaling_plan import STEP, ScalingPlan, ScalingSettings, Training
from wiw.training.decision_errors import DecisionErrors, measure_decisions
from wiw.training.held_out_clips import Frames, Imagine, imagine_with, measure_clips
from wiw.training.held_out_panoramas import PanoramaClips, PanoramaErrors, select_panoramas, turn_panoramas
from wiw.training.learners import Learner, make_learner
from wiw.types import Conditioning

if TYPE_CHECKING:
    from wiw.training.post_training.recipe import ClipRecipe
    from wiw.training.reduced_frames import ReducedFrames

FRAMES, DECISIONS = "frames", "decisions.parquet"
"""Folder and file in a study's folder that all trainings read."""
SAVED_EVERY = 60.0
"""Seconds between two writes of a training's state."""

Measures = dict[str, dict[str, list[float]]]
"""Sum and number of values in each scene, by measure."""


@dataclass(frozen=True)
class Material:
    """Data that all trainings of a study share."""

    clips: Clips
    """All windows of the scenes to train on."""
    scenes: NDArray[np.str_]
    """[W]: scene of each."""
    frames: ReducedFrames
    held_out: PanoramaClips
    decisions: Decisions

    def select_rows(self, training: Training) -> NDArray[np.int64]:
        """Return the clips that a training draws its own from: those of its scenes, fewer scenes being among more."""
        order = np.random.default_rng((training.seed, 0x5CE7)).permutation(np.unique(self.scenes))
        return np.flatnonzero(np.isin(self.scenes, order[: training.scenes]))


@cache
def load_material(data: Path, folder: Path, settings: ScalingSettings) -> Material:
    """Return what a study's trainings share, once for each process.

    Raises:
        ArgumentError: no scene is held out, or no segment is as long as a clip.
        FileError: the dataset or the decisions are missing or damaged.
    """
    from wiw.training.reduced_frames import reduce_frames

    trained, held_out = (NavigationData(data, part, settings.held_out) for part in ("train", "held-out"))
    clips = trained.clips(settings.length)
    return Material(
        clips,
        list_scenes(trained, clips),
        reduce_frames(trained, settings.size, folder / FRAMES),
        select_panoramas(held_out.clips(settings.length), settings.held_out_clips, 0, settings.size),
        load_decisions(folder / DECISIONS),
    )


def list_scenes(data: NavigationData, clips: Clips) -> NDArray[np.str_]:
    """Return the scene of each clip of a dataset."""
    return np.array([data.segments[clips.locate(row)[0]]["scene"] for row in range(len(clips))])


@dataclass(frozen=True)
class TrainingJob:
    """A training whose weights and measures go into a study's folder."""

    training: Training
    plan: ScalingPlan
    data: Path
    folder: Path
    device: str = "cpu"
    """Torch device of the training; the model is measured on the CPU."""

    @property
    def weights(self) -> Path:
        """File of the weights."""
        return self.folder / "weights" / f"{self.training.name}.safetensors"

    def read_measures(self) -> Measures | None:
        """Return what was measured; None if it is not finished.

        Raises:
            FileError: the file is damaged.
        """
        if not self._measures.exists():
            return None
        try:
            return dict(json.loads(self._measures.read_text(encoding="utf-8"))["measures"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise FileError(f"{self._measures}: expected the measures of a training, got {error}; delete it") from error

    def run(self) -> Measures:
        """Train, or resume, measure, and write what was found.

        Raises:
            FileError: the folder cannot be written, or a file of it is damaged.
            DeviceMemoryError: memory does not suffice.
            TrainingError: the loss is not finite.
        """
        began, learner = time.monotonic(), make_learner(self.training.model)
        material = load_material(self.data, self.folder, self.plan.settings)
        with single_thread():
            if not self.weights.exists():
                self._train(material)
            model = learner.model(self.weights)
            measures = measure(imagine_with(model), material.held_out, material.decisions)
        found = {
            **self._card,
            "seconds": time.monotonic() - began,
            "device": model.card.get("device"),
            "measures": measures,
        }
        with atomic_file(self._measures) as draft:
            draft.write_text(json.dumps(found) + "\n", encoding="utf-8")
        return measures

    def _train(self, material: Material) -> None:
        """Train for as many updates as planned; the learning rate's schedule ends with the last one."""
        from wiw.training.checkpoint import Checkpoint
        from wiw.training.trainer import run_training, take_middles

        learner, settings, own = make_learner(self.training.model), self.plan.settings, self.training
        recipe = create_recipe(learner, settings, own.clips, own.seed)
        rows = material.select_rows(own).tolist()
        checkpoint = Checkpoint(self.weights.with_suffix(".checkpoint"), self._card, SAVED_EVERY)
        with memory_guard(f"training {own.name} on {self.device}", "use fewer --workers, or --device cpu"):
            trainer, _ = run_training(
                lambda: learner.trainer(SelectedClips(material.clips, rows), material.frames, recipe, self.device),
                recipe,
                own.updates,
                None,
                take_middles(recipe.scale_rate, recipe.epochs * own.updates),
                lambda *_: None,
                checkpoint,
            )
        how = {"recipe": recipe.describe(), "device": describe_device(self.device)}
        learner.save(self.weights, trainer.network, {**self._card, **how})
        checkpoint.remove()

    @property
    def _card(self) -> dict[str, Any]:
        return {"training": asdict(self.training), "data": self.plan.data}

    @property
    def _measures(self) -> Path:
        return self.folder / "measures" / f"{self.training.name}.json"


def create_recipe(learner: Learner, settings: ScalingSettings, clips: int, seed: int) -> ClipRecipe:
    """Return the recipe of a training.

    Raises:
        ArgumentError: the learner cannot be trained so, such as on panoramas of that size.
    """
    return learner.create_recipe(
        frames=settings.length, size=settings.size, batch=settings.batch, clips=clips, seed=seed
    )


def measure(imagine: Imagine, clips: PanoramaClips, decisions: Decisions) -> Measures:
    """Measure a model on held-out clips and decisions."""
    errors, _ = measure_clips(imagine, clips)
    return tabulate_clips(errors) | tabulate_decisions(measure_decisions(imagine, decisions))


def tabulate_clips(errors: PanoramaErrors) -> Measures:
    """Return sums by scene of the error after `STEP` actions, PSNR and SSIM at all steps, and both gaps."""
    levels = 255 * 10 ** (-errors.psnr / 20)
    found = {}
    for column, step in enumerate(errors.steps):
        counted = errors.counted[:, column]
        if step == STEP:
            found["error"] = _sum_by_scene(errors.scenes, levels[:, column], counted)
        found[f"psnr/{step}"] = _sum_by_scene(errors.scenes, errors.psnr[:, column], counted)
        found[f"ssim/{step}"] = _sum_by_scene(errors.scenes, errors.ssim[:, column], counted)
    found["gap"] = _sum_by_scene(errors.scenes, errors.psnr - errors.shuffled, errors.apart)
    found["gap/displacements"] = _sum_by_scene(errors.scenes, errors.psnr - errors.turned, errors.apart)
    return found


def tabulate_decisions(errors: DecisionErrors) -> Measures:
    """Return sums by scene of regret and rank agreement."""
    return {
        "regret": _sum_by_scene(errors.scenes, errors.regret, np.ones(len(errors.regret), np.bool_)),
        "rank": _sum_by_scene(errors.scenes, errors.agreement, np.isfinite(errors.agreement)),
    }


def measure_references(clips: PanoramaClips, decisions: Decisions) -> dict[str, dict[str, float]]:
    """Return the primary measures of a model that knows turns alone, and the regret of chance and of the oracle."""
    errors, _ = measure_clips(imagine_turns, clips)
    known = measure_decisions(imagine_turns, decisions).summarise()
    return {
        "turns alone": {"error": average(tabulate_clips(errors)["error"]), "regret": known["regret"]},
        "chance": {"regret": known["regret/chance"]},
        "oracle": {"regret": known["regret/oracle"]},
    }


def imagine_turns(
    observations: Conditioning, plans: NDArray[np.int8], seeds: NDArray[np.uint64], wanted: NDArray[np.int64]
) -> Frames:
    """Return the observation, turned as the agent turns: an `Imagine` that has learnt nothing."""
    from wiw import action

    azimuth = np.take_along_axis(action.to_trajectory(plans)[..., 2], wanted - 1, axis=1)
    return turn_panoramas(np.repeat(observations.image[:, None], wanted.shape[1], axis=1), azimuth)


def average(table: dict[str, list[float]]) -> float:
    """Return the mean over all values of a measure."""
    sums, counts = np.array(list(table.values())).T
    return float(sums.sum() / counts.sum())


def _sum_by_scene(
    scenes: Sequence[str], values: NDArray[np.float64], chosen: NDArray[np.bool_]
) -> dict[str, list[float]]:
    """Return sum and number of the chosen values in each scene that has some."""
    found: dict[str, list[float]] = {}
    for scene in sorted(set(scenes)):
        own = np.array([each == scene for each in scenes])
        there = values[own][chosen[own]]
        if there.size:
            found[scene] = [float(there.sum()), float(there.size)]
    return found
