# SPDX-License-Identifier: Apache-2.0
"""Validation while training: every so many steps on scenes that are held out; the best weights are kept by it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.decisions import Decisions, digest_decisions, load_decisions
from wiw.datasets.navigation import NavigationData
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.training.checkpoint import ResumableTrainer
from wiw.training.decision_errors import measure_decisions
from wiw.training.held_out_clips import Frames, HeldOutClips, Imagine, measure_clips, resize_frames, select_clips
from wiw.training.post_training import distributed
from wiw.training.post_training.clip_trainer import ClipTrainer
from wiw.training.post_training.recipe import ClipRecipe
from wiw.training.post_training.training_log import TrainingLog

CARD = "training.json"
"""Name of the file beside the weights that says on what and how they were trained."""
CRITERION = "psnr"
"""Measure that the best weights have the most of: mean PSNR of frames from another place than the observation."""
PREFIX = "validation/"
SHOWN = 4
"""Clips in a picture."""
EDGE = 4
"""Pixels between the pictures of a sheet."""

OnValidation = Callable[[int, Mapping[str, float]], None]
"""Called with the number of steps done and what was found."""


@dataclass(frozen=True)
class ValidationSet:
    """Clips and decisions that a model in training is measured on."""

    clips: HeldOutClips
    decisions: Decisions | None
    every: int
    """Steps between two validations."""
    identity: Mapping[str, Any]
    """JSON-able: which clips and decisions they are."""

    def measure(self, imagine: Imagine, seed: int, between: Callable[[], None]) -> tuple[dict[str, float], Frames]:
        """Return what was found, by name, and a sheet of pictures."""
        errors, (own, other) = measure_clips(imagine, self.clips, seed, between=between)
        found = errors.summarise()
        if self.decisions is not None:
            found |= measure_decisions(imagine, self.decisions, seed, between=between).summarise()
        return found, draw_sheet(self.clips, own, other)


def choose_validation_set(
    data: NavigationData, held_out: NavigationData, decisions: str | Path | None, recipe: ClipRecipe
) -> ValidationSet:
    """Return the clips of held-out scenes that a training is validated on, and stored decisions, if any.

    Args:
        data: what is trained on.
        held_out: the scenes that are not.
        decisions: file of `wiw collect decisions`.
        recipe: of the training: size and number of clips.

    Raises:
        ArgumentError: a scene is in both, there is none held out, or decisions are longer than a clip.
        FileError: a picture or the file of decisions is damaged.
    """
    scenes, trained = ({row["scene"] for row in each.segments} for each in (held_out, data))
    if scenes & trained:
        raise ArgumentError(
            f"validation: expected scenes that are not trained on, got {', '.join(sorted(scenes & trained)[:3])}"
        )
    if not scenes:
        raise ArgumentError(
            f"validation: no scene of {held_out.folder} is held out; collect more scenes, raise held_out in the "
            "recipe, give another dataset by --validation, or train without (--option validate_every=null)"
        )
    stored = None if decisions is None else load_decisions(decisions)
    if stored is not None:
        if stored.plans.shape[-1] > recipe.frames - 1:
            raise ArgumentError(
                f"{decisions}: expected plans of at most {recipe.frames - 1} actions, those of a clip, got "
                f"{stored.plans.shape[-1]}; collect others with --actions {recipe.frames - 1}"
            )
        stored = resize_decisions(stored, recipe.clip_size)
    clips = select_clips(held_out.clips(recipe.frames), recipe.validate_clips, recipe.seed, recipe.clip_size)
    identity: dict[str, Any] = {"data": held_out.digest(), "scenes": sorted(set(clips.scenes))}
    if decisions is not None:
        identity["decisions"] = digest_decisions(decisions)
    assert recipe.validate_every, "asked for"
    return ValidationSet(clips, stored, recipe.validate_every, identity)


def resize_decisions(decisions: Decisions, size: tuple[int, int]) -> Decisions:
    """Return decisions with pictures of another size (height, width)."""
    futures = np.stack([resize_frames(each, size) for each in decisions.futures])
    images, goals = resize_frames(decisions.images, size), resize_frames(decisions.goals, size)
    return Decisions(decisions.scenes, images, goals, decisions.plans, futures, decisions.distances)


class ValidatedTrainer(ResumableTrainer):
    """A trainer that is validated before a step, every so many steps; what it learns does not depend on it.

    Validation belongs to the step after it, so that a state written before it resumes with it. The weights, the log
    and the picture of the best are in one folder. With several processes, all imagine the same, with weights that may
    be sharded, and the first one writes.

    Args:
        trainer: to be validated.
        imagine: with its networks.
        validation: what it is measured on; None to log alone.
        log: of the training; pictures and the best weights lie beside it.
        save: writes the trainer's weights as a checkpoint, given the folder and what was found; called in all
            processes.
        between: called between two calls of the model, such as to stop when told to.
        on_validation: told what was found, in the first process.
    """

    def __init__(
        self,
        trainer: ClipTrainer,
        imagine: Imagine | None,
        validation: ValidationSet | None,
        log: TrainingLog,
        save: Callable[[Path, Mapping[str, Any]], None],
        between: Callable[[], None] = lambda: None,
        on_validation: OnValidation = lambda *_: None,
    ) -> None:
        self.trainer, self._imagine, self._validation, self._log = trainer, imagine, validation, log
        self._folder, self._save, self._between, self._tell = log.path.parent, save, between, on_validation
        self._validated: set[int] = set()

    @property
    def step_count(self) -> int:  # type: ignore[override]
        """Number of steps done."""
        return self.trainer.step_count

    def train_step(self, learning_rate: float) -> float:
        """Validate if it is time, then train on one batch and return its loss.

        Raises:
            TrainingError, FileError: see `ClipTrainer.train_step`.
        """
        if self._validation is not None and self.step_count % self._validation.every == 0:
            self.validate()
        loss = self.trainer.train_step(learning_rate)
        distributed.call_on_main(lambda: self._log.write(self.step_count, {"loss": loss, "rate": learning_rate}))
        return loss

    def validate(self) -> None:
        """Measure the model as it is, unless it was already, and keep its weights if it is the best so far.

        Raises:
            FileError: something cannot be written.
        """
        if self._validation is None or self._imagine is None or self.step_count in self._validated:
            return
        found, sheet = self._validation.measure(self._imagine, self.trainer.recipe.seed, self._between)
        if distributed.call_on_main(lambda: self._draw(found, sheet)):
            self._save(self.best, {"steps": self.step_count, "validation": found})
        distributed.call_on_main(lambda: self._report(found))
        self._validated.add(self.step_count)

    def _draw(self, found: Mapping[str, float], sheet: Frames) -> bool:
        """Write the picture of a validation and return whether its weights are the best so far."""
        write_picture(self._folder / f"step-{self.step_count:07d}.png", sheet)
        return self.step_count > 0 and found.get(CRITERION, -np.inf) > self._read_best()

    def _report(self, found: Mapping[str, float]) -> None:
        self._log.write(self.step_count, {f"{PREFIX}{name}": value for name, value in found.items()})
        self._tell(self.step_count, found)

    def finish(self) -> None:
        """Tell the trackers that the training has ended."""
        if distributed.is_main():
            self._log.finish()

    @property
    def best(self) -> Path:
        """Folder of the best weights."""
        return self._folder / "best"

    def state_dict(self) -> dict[str, Any]:
        """Return the trainer's state."""
        return self.trainer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned; what was logged after it is forgotten.

        Raises:
            FileError: the log cannot be read or written.
        """
        self.trainer.load_state_dict(state)
        lines = distributed.call_on_main(lambda: self._log.rewind(self.step_count))
        self._validated = {line["step"] for line in lines if f"{PREFIX}{CRITERION}" in line}

    def _read_best(self) -> float:
        card = self.best / CARD
        if not card.exists():
            return -np.inf
        return float(json.loads(card.read_text(encoding="utf-8"))["validation"][CRITERION])


def draw_sheet(clips: HeldOutClips, own: Frames, other: Frames) -> NDArray[np.uint8]:
    """Return a picture, uint8 [H, W, 3], of the first clips: three rows each.

    What was seen, what is imagined under the true actions, and under those of another clip; the first column is the
    observation, the others follow numbers of actions. White lines part the clips.
    """
    rows = []
    for seen, imagined, shuffled in zip(clips.frames[:SHOWN], own, other, strict=False):
        for frames in (seen, np.concatenate([seen[:1], imagined]), np.concatenate([seen[:1], shuffled])):
            rows.append(np.concatenate(list(frames), axis=1))
        rows.append(np.full((EDGE, rows[-1].shape[1], 3), 255, np.uint8))
    return np.concatenate(rows[:-1])


def write_picture(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write a picture as PNG.

    Raises:
        FileError: it cannot be written.
    """
    with atomic_file(path) as draft:
        draft.write_bytes(bytes(cv2.imencode(".png", picture[..., ::-1])[1]))
