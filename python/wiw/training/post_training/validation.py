# SPDX-License-Identifier: Apache-2.0
"""Validation while training: every so many steps on what is held out of it; the best weights are kept by it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from wiw.datasets.decisions import Decisions, digest_decisions, load_decisions, read_scenes
from wiw.datasets.navigation import Part
from wiw.datasets.scene_splits import find_shared_scene
from wiw.errors import ArgumentError
from wiw.files import atomic_file
from wiw.training.checkpoint import ResumableTrainer
from wiw.training.decision_errors import measure_decisions
from wiw.training.held_out_clips import Frames, HeldOutClips, Imagine, ShownView, measure_clips
from wiw.training.post_training import distributed
from wiw.training.post_training.clip_trainer import ClipTrainer
from wiw.training.post_training.corpora import Corpus
from wiw.training.post_training.recipe import ClipRecipe
from wiw.training.post_training.training_log import BEST, TrainingLog
from wiw.types import PRIMITIVES

CARD = "training.json"
"""Name of the file beside the weights that says on what and how they were trained."""
CRITERION = "psnr"
"""Measure that the best weights have the most of: mean PSNR of the frames that count."""
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

    clips: HeldOutClips[Any]
    decisions: tuple[Decisions, ShownView] | None
    """With the view that the model sees of them."""
    every: int
    """Steps between two validations."""
    identity: Mapping[str, Any]
    """JSON-able: which clips and decisions they are."""

    def measure(self, imagine: Imagine, seed: int, between: Callable[[], None]) -> tuple[dict[str, float], Frames]:
        """Return what was found, by name, and a sheet of pictures."""
        errors, (own, other) = measure_clips(imagine, self.clips, seed, between=between)
        found = errors.summarise()
        if self.decisions is not None:
            decisions, view = self.decisions
            found |= measure_decisions(imagine, decisions, seed, between=between, view=view).summarise()
        return found, draw_sheet(self.clips, own, other)


OpenPart = Callable[[str | Path, Part], Corpus]
"""Opens a part of a dataset in the views that the model in training sees."""


def find_held_out(
    open_part: OpenPart,
    corpus: Corpus,
    validation: str | Path | None,
    decisions: str | Path | None,
    recipe: ClipRecipe,
) -> Corpus | None:
    """Return what a training is validated on: another dataset, or the part that its own leaves out for it.

    None if there is no validation.

    Args:
        open_part: opens either.
        corpus: that is trained on.
        validation: folder of the other dataset.
        decisions: file of `wiw collect decisions`.
        recipe: of the training.

    Raises:
        ArgumentError: another kind of dataset or height of the camera, nothing is held out, something is in both,
            decisions for an arm, decisions in scenes that are trained on, or either without a validation.
        FileError: the dataset, or the file of decisions, is missing or damaged.
    """
    if recipe.validate_every is None:
        _require_none(validation, decisions, "the recipe's validate_every is null; leave it out, or set validate_every")
        return None
    if validation is None and corpus.part != "train":
        _require_none(None, decisions, "--part all holds nothing out; give another dataset with --validation")
        return None
    held_out = open_part(corpus.data.folder, "held-out") if validation is None else open_part(validation, "all")
    if held_out.space != corpus.space:
        raise ArgumentError(
            f"validation: expected a dataset of `{corpus.command}`, like the training's, but {held_out.data.folder} is "
            f"from `{held_out.command}`"
        )
    if held_out.camera_height != corpus.camera_height:
        raise ArgumentError(
            f"validation: expected a camera {corpus.camera_height} m above the floor, as in training, but "
            f"{held_out.data.folder} has one at {held_out.camera_height} m; collect it with --height "
            f"{corpus.camera_height}"
        )
    if decisions is not None and corpus.space != PRIMITIVES:
        raise ArgumentError("decisions: those of `wiw collect decisions` are for a moving agent; leave them out")
    if shared := held_out.list_shared(corpus):
        raise ArgumentError(
            f"validation: expected {corpus.unit}s that are not trained on, got {', '.join(shared[:3])}; leave them out "
            f"of {held_out.data.folder}, or train on others"
        )
    _require_unseen_decisions(decisions, corpus.units)
    if not held_out.units:
        raise ArgumentError(
            f"validation: no {corpus.unit} of {held_out.data.folder} is held out; collect more {corpus.unit}s, raise "
            "held_out in the recipe, give another dataset with --validation, or train without validation (--option "
            "validate_every=null)"
        )
    return held_out


def _require_none(validation: str | Path | None, decisions: str | Path | None, why: str) -> None:
    """Refuse what a training without validation does not read."""
    for name, given in {"validation": validation, "decisions": decisions}.items():
        if given is not None:
            raise ArgumentError(f"{name}: {given} has no effect on a training without validation: {why}")


def _require_unseen_decisions(decisions: str | Path | None, trained: AbstractSet[str]) -> None:
    """Check that no stored decision is made in a scene that is trained on, as far as its name tells.

    Raises:
        ArgumentError: names such a scene.
        FileError: the file is damaged.
    """
    if decisions is None:
        return
    seen = find_shared_scene(read_scenes(decisions), trained)
    if seen is not None:
        raise ArgumentError(
            f"decisions: expected scenes that are not trained on, got {seen}; collect decisions in others, such as "
            "apartments:val:40"
        )


def build_validation_set(
    held_out: Corpus, clips: HeldOutClips[Any], decisions: str | Path | None, recipe: ClipRecipe
) -> ValidationSet:
    """Return what a training is validated on: clips that are held out, and stored decisions, if any.

    Args:
        held_out: corpus of the clips.
        clips: selected for the model.
        decisions: file of `wiw collect decisions`.
        recipe: of the training.

    Raises:
        ArgumentError: decisions are longer than a clip.
        FileError: the file of decisions is damaged.
    """
    identity: dict[str, Any] = {"data": held_out.data.digest(), f"{held_out.unit}s": sorted(set(clips.scenes))}
    stored = None
    if decisions is not None:
        assert clips.view is not None, "find_held_out"
        stored = load_decisions(decisions), clips.view
        longest, actions = stored[0].plans.shape[-1], clips.plans.shape[1]
        if longest > actions:
            raise ArgumentError(
                f"{decisions}: expected plans of at most {actions} actions, as in a clip, got {longest}; collect "
                f"others with --actions {actions}"
            )
        identity["decisions"] = digest_decisions(decisions)
    assert recipe.validate_every, "asked for"
    return ValidationSet(clips, stored, recipe.validate_every, identity)


class ValidatedTrainer(ResumableTrainer):
    """A trainer that is validated before a step, every so many steps; training does not depend on it.

    Validation belongs to the step after it, so that a state written before it resumes with it. The weights, the log
    and the picture of the best are in one folder. With several processes, all imagine the same, with weights that may
    be sharded, and the first one writes.

    Args:
        trainer: to be validated.
        imagine: with its networks.
        validation: the validation set; None to log alone.
        log: of the training; pictures and the best weights lie beside it.
        save: writes the trainer's weights as a checkpoint, given the folder and what was found; called in all
            processes.
        between: called between two calls of the model, for example to stop on a signal.
        on_validation: receives the results, in the first process.
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

    @property
    def is_logged(self) -> bool:
        """Whether the log has the last step, so that a state belongs to it; to be asked in the process that logs."""
        return self._log.step == self.step_count

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
        return self._folder / BEST

    def state_dict(self) -> dict[str, Any]:
        """Return the trainer's state."""
        return self.trainer.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a state that `state_dict` returned; what was logged after it is forgotten.

        Weights that were best at a later step stay so until better ones are found: those of an earlier step, which they
        have replaced, would not be found again.

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


def draw_sheet(clips: HeldOutClips[Any], own: Frames, other: Frames) -> NDArray[np.uint8]:
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
