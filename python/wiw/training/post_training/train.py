# SPDX-License-Identifier: Apache-2.0
"""Train a pretrained model to follow actions, on a corpus, and write a checkpoint that world models load."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import wiw
from wiw.datasets.navigation import Part
from wiw.errors import ArgumentError, FileError, TrainingError
from wiw.files import atomic_file, atomic_folder
from wiw.networks import memory_guard, resolve_device
from wiw.training.checkpoint import locate_checkpoint
from wiw.training.held_out_clips import Imagine
from wiw.training.post_training import distributed
from wiw.training.post_training.clip_trainer import ClipTrainer, arrange_clips
from wiw.training.post_training.corpora import Corpus, CorpusPart, open_corpus, require_training_split
from wiw.training.post_training.families import Family, Loaded, PretrainedWeights, announce_shape, find_family
from wiw.training.post_training.latent_cache import LatentCache, require_folder
from wiw.training.post_training.recipe import ClipRecipe, PostTrainingRecipe, load_recipe
from wiw.training.post_training.sampling import create_sampler
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.post_training.trackers import open_tracker
from wiw.training.post_training.trainer import PostTrainer
from wiw.training.post_training.training_log import LOG, TrainingLog, remove_log, require_own_log
from wiw.training.post_training.validation import (
    CARD,
    OnValidation,
    ValidatedTrainer,
    ValidationSet,
    build_validation_set,
    find_held_out,
)
from wiw.training.save_signal import hold_save_signal
from wiw.training.trainer import run_training, take_middles
from wiw.types import GRIPPER_POSES, PRIMITIVES
from wiw.world_models.video import loading

TASKS: Mapping[str, str] = {PRIMITIVES: "imagenav", GRIPPER_POSES: "manipulation"}
"""A task for the actions of each space."""


@hold_save_signal()
@distributed.join_processes()
def post_train(
    name: str,
    data: str | Path,
    out: str | Path,
    *,
    weights: str | Path | None = None,
    revision: str | None = None,
    variant: str | None = None,
    device: str | None = None,
    recipe: PostTrainingRecipe | None = None,
    part: CorpusPart = "train",
    validation: str | Path | None = None,
    decisions: str | Path | None = None,
    tracker: str | None = None,
    cache: str | Path | None = None,
    seconds: float = 600.0,
    on_step: Callable[[int, int, float], None] = lambda *_: None,
    on_validation: OnValidation = lambda *_: None,
) -> dict[str, Any]:
    """Train a model on navigation or manipulation, or resume its training, and write its checkpoint.

    In processes that torchrun has started, all train together: call it alike in each; the first one writes and reports.
    A state is kept beside `out`, in `OUT.checkpoint`, every so often, at SIGUSR1, and before the process stops at
    SIGTERM or Ctrl-C. The same call resumes from it, and on the CPU ends with the same bytes. `OUT.log` has the loss
    of each step and what validations found, with pictures; the checkpoint has the weights that were best in validation.

    Args:
        name: such as "ltx-action".
        data: folder of `wiw collect navigation` or `wiw collect manipulation`.
        out: folder of the checkpoint, new or empty; `wiw.world_model(name, checkpoint=out)` loads it, for NWM
            `wiw.world_model("nwm", weights=out)`.
        weights: pretrained, a folder as the world model takes it or a name on the hub; its usual ones if None.
        revision: of the weights on the hub.
        variant: of the weight files, such as "fp16".
        device: of torch; "cuda" if there is one, else "cpu".
        recipe: the numbers; the shipped recipe if None, in float32 if there is no GPU.
        part: of the data: "train", which leaves a share of scenes or demonstrations for validation, or "all".
        validation: folder of another dataset whose clips it is validated on; what is left out if None. With all of the
            data in training and no other dataset, there is no validation, and the checkpoint has the last weights.
        decisions: file of `wiw collect decisions`, for the rank agreement with the oracle.
        tracker: "trackio", "wandb" or "tensorboard", which receives the log.
        cache: folder where encoded clips are kept, for later epochs and other trainings on the same data; none if None.
        seconds: least time between two writes of the state.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        on_validation: called after each validation with the number of steps done and what was found.

    Returns:
        What the checkpoint's `training.json` says: model, data, recipe, steps, the loss at the end, how it is run.

    Raises:
        ArgumentError: a model that is not trained here or not on such data, scenes of a split for evaluation, too few
            clips, a recipe that the model cannot have, a state of a training with other data or numbers, or validation
            on what is trained on, not there, or of another kind; a folder of the log with files of others, or a file
            in the place of a folder.
        TrainingError: the loss is not finite; the last good state is kept, the message names the batch.
        FileError: `out` holds something, or the dataset is missing or damaged.
        WeightsError, DependencyError, DeviceMemoryError: see the world model.
    """
    out = Path(out)
    family, device = find_family(name), resolve_device(device)
    distributed.require_own_gpu(device)
    recipe = recipe or choose_precision(load_recipe(name), device)
    _require_free(out)
    require_own_log(locate_log(out), out.name, locate_checkpoint(out).exists())
    if cache is not None:
        require_folder(Path(cache))
    asked = recipe
    corpus, recipe = family.fit(open_corpus(data, part, recipe.held_out), asked)
    if distributed.is_main():
        announce_shape(name, asked, recipe)
    require_training_split(corpus)
    arrange_clips(len(corpus.clips(recipe.frames)), recipe)
    held_out = find_held_out(partial(open_part, family, recipe), corpus, validation, decisions, recipe)
    source = PretrainedWeights(None if weights is None else str(weights), revision, variant, device)
    with memory_guard(f"training {name} on {device}", "; ".join(list_remedies(recipe))):
        loaded = family.load(corpus, recipe, source)
        recipe = loaded.recipe
        checked = None
        if held_out is not None:
            checked = build_validation_set(held_out, loaded.model.select_clips(held_out), decisions, recipe)
        card = {"model": name, **describe_training(loaded, corpus)}
        card |= {"validated_on": checked.identity if checked else None}
        state = open_state(out, card, seconds)
        latents = None if cache is None else open_cache(Path(cache), loaded, corpus)
        trainer = PostTrainer(loaded.model, corpus.clips(recipe.frames), recipe, latents)
        validated = train_and_validate(
            trainer,
            create_sampler(trainer) if checked else None,
            checked,
            out,
            lambda best, found: write_checkpoint(best, trainer, {**card, **found}, lambda _: True),
            state,
            tracker,
            on_step,
            on_validation,
        )
    card |= {"trained_steps": trainer.step_count, "loss": trainer.mean_loss}
    card |= {"run": describe_run(family, corpus, recipe)}
    card = publish_checkpoint(out, validated, trainer, card)
    distributed.call_on_main(state.remove)
    return card


def open_part(family: Family, recipe: PostTrainingRecipe, folder: str | Path, part: Part) -> Corpus:
    """Open a part of a dataset in the views that a model sees.

    Raises:
        ArgumentError, FileError, DependencyError: see `Family.fit` and `open_corpus`.
    """
    return family.fit(open_corpus(folder, part, recipe.held_out), recipe)[0]


def train_and_validate(
    trainer: ClipTrainer,
    imagine: Imagine | None,
    validation: ValidationSet | None,
    out: Path,
    save: Callable[[Path, Mapping[str, Any]], None],
    state: SignalledCheckpoint,
    tracker: str | None,
    on_step: Callable[[int, int, float], None],
    on_validation: OnValidation,
) -> ValidatedTrainer:
    """Train from the start, or from the state that is kept, to the end, and validate what came out.

    Args:
        trainer: to be trained.
        imagine: with its networks; None without validation.
        validation: the validation set; None to log alone.
        out: of the training; its log is in `OUT.log`, and begins anew where no state is kept.
        save: writes the trainer's weights as a checkpoint, given the folder and what was found.
        state: of the training; written every so often and at signals.
        tracker: "trackio", "wandb" or "tensorboard", which receives the log.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        on_validation: called after each validation with the number of steps done and what was found.

    Returns:
        The trainer, which knows where its best weights are.

    Raises:
        TrainingError: the loss is not finite; the state before is kept.
        FileError: a clip cannot be read, or something cannot be written; the state before is kept if it can be written,
            and there is no other process.
        DependencyError: the tracker's package is not installed.
        ArgumentError: the log's folder has files of others; see also `wiw.training.checkpoint.Checkpoint`.
    """
    if not state.path.exists() and distributed.is_main():
        remove_log(locate_log(out), out.name)
    epochs = trainer.recipe.epochs
    validated = ValidatedTrainer(
        trainer,
        imagine,
        validation,
        _open_log(out, tracker, trainer.recipe),
        save,
        lambda: state.save_if_due(validated, epochs, validated.step_count),
        on_validation,
    )
    _run_steps(validated, state, on_step)
    return validated


def _run_steps(
    trainer: ValidatedTrainer, state: SignalledCheckpoint, on_step: Callable[[int, int, float], None]
) -> None:
    inner = trainer.trainer
    recipe, phases = inner.recipe, inner.phases

    def scale_rate(progress: float) -> float:
        """Scale by the schedule of the network in training, each of which has its own."""
        return recipe.scale_rate(progress * phases % 1)

    with state.watch():
        try:
            run_training(
                lambda: trainer,
                recipe,
                inner.steps_per_epoch,
                None,
                take_middles(scale_rate, recipe.epochs * inner.steps_per_epoch),
                lambda step, steps, _: on_step(step, steps, inner.mean_loss) if distributed.is_main() else None,
                state,
            )
            trainer.validate()
        except (TrainingError, FileError) as error:
            alone = distributed.count_processes() == 1 and trainer.is_logged
            if trainer.step_count and (alone or isinstance(error, TrainingError)):
                state.save(trainer, recipe.epochs, trainer.step_count)
            raise
        finally:
            trainer.finish()


def _open_log(out: Path, tracker: str | None, recipe: ClipRecipe) -> TrainingLog:
    """Return the log of a training, which is also passed to a tracker."""
    folder, told = locate_log(out), tracker if distributed.is_main() else None
    return TrainingLog(folder / LOG, [open_tracker(told, out.name, folder, recipe.describe())] if told else [])


def open_state(out: Path, identity: Mapping[str, Any], seconds: float) -> SignalledCheckpoint:
    """Return the state of a training, in `OUT.checkpoint`."""
    return SignalledCheckpoint(locate_checkpoint(out), identity, seconds, shared=distributed.count_processes() > 1)


def locate_log(out: Path) -> Path:
    """Return the folder of a training's log."""
    return out.with_name(f"{out.name}.log")


def publish_checkpoint(
    out: Path, trainer: ValidatedTrainer, trained: PostTrainer, card: Mapping[str, Any]
) -> dict[str, Any]:
    """Put the best weights in validation, or the last ones without it, where they belong; return their card.

    Raises:
        FileError: `out` holds something, or cannot be written.
    """
    if distributed.call_on_main(trainer.best.exists):
        return distributed.call_on_main(lambda: _publish_best(out, trainer, card))
    found = {**card, "steps": trainer.step_count}
    write_checkpoint(out, trained, found)
    return found


def _publish_best(out: Path, trainer: ValidatedTrainer, card: Mapping[str, Any]) -> dict[str, Any]:
    own = json.loads((trainer.best / CARD).read_text(encoding="utf-8"))
    found = {**card, "steps": own["steps"], "validation": own["validation"]}
    with atomic_file(trainer.best / CARD) as draft:
        draft.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    try:
        trainer.best.rename(out)
    except OSError as error:
        raise FileError(
            f"{out}: cannot be written ({error.strerror}); expected a writable folder: make room, then repeat the "
            f"command. The best weights are in {trainer.best}"
        ) from error
    return found


def describe_run(family: Family, corpus: Corpus, recipe: PostTrainingRecipe) -> dict[str, Any]:
    """Return the task, the world model and its options by which a checkpoint is run."""
    return {
        "task": TASKS[corpus.space],
        "world_model": family.world_model,
        "checkpoint": family.checkpoint_option,
        "options": family.list_options(corpus, recipe),
    }


def describe_training(loaded: Loaded, corpus: Corpus) -> dict[str, Any]:
    """Return what the outcome of a training depends on, as JSON values."""
    return {
        "wiw": wiw.__version__,
        "weights": loaded.identity,
        "data": corpus.describe(),
        "recipe": {name: value for name, value in loaded.recipe.describe().items() if name != "shard"},
        "versions": loading.versions(),
    }


def write_checkpoint(
    out: Path, trainer: PostTrainer, card: Mapping[str, Any], replace: Callable[[Path], bool] = lambda _: False
) -> None:
    """Write what world models load, and how it was made, as a folder that exists whole or not at all.

    `replace` says whether a folder that holds something may be replaced.

    Raises:
        FileError: `out` holds something, or cannot be written.
    """

    def write() -> None:
        with atomic_folder(out, replace) as draft:
            trainer.model.write(draft)
            (draft / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")

    with trainer.use_final_weights():
        distributed.call_on_main(write)


def open_cache(folder: Path, loaded: Loaded, corpus: Corpus) -> LatentCache:
    """Return the cache of a corpus's clips as a model's frozen networks encode them."""
    recipe = loaded.recipe
    shape = {"frames": recipe.frames, "size": recipe.size, "versions": loading.versions()}
    return LatentCache(folder, {"data": corpus.describe(), "latents": loaded.model.describe_latents(), **shape})


def choose_precision(recipe: PostTrainingRecipe, device: str) -> PostTrainingRecipe:
    """Return the recipe in float32 unless the device is a GPU, on which half precision is fast."""
    return recipe if device.startswith("cuda") else replace(recipe, precision="float32")


def list_remedies(recipe: PostTrainingRecipe) -> list[str]:
    """List the numbers of a recipe that need less memory than the present ones, the mildest first."""
    remedies = [f"rows=1 (now {recipe.rows})"] if recipe.rows > 1 else []
    *precision, size, frames = list_smaller(recipe)
    remedies += precision
    remedies += [] if recipe.checkpointing else ["checkpointing=true"]
    several = distributed.count_processes() > 1
    remedies += ["shard=true"] if several and not recipe.shard and recipe.optimizer == "adamw" else []
    eight = recipe.optimizer == "adamw" and not recipe.lora and not recipe.shard
    remedies += ["optimizer=adamw8bit"] if eight else []
    remedies += ["ema=0"] if recipe.ema else []
    remedies += [] if recipe.lora else ["lora=32, for the Wan models"]
    remedies += [size, frames]
    return remedies + (["validate_every=null, if it is validation that does not fit"] if recipe.validate_every else [])


def list_smaller(recipe: PostTrainingRecipe) -> list[str]:
    """List the numbers of a recipe with which clips and networks are smaller than with the present ones."""
    height, width = recipe.size or (0, 0)
    precision = ["precision=bfloat16"] if recipe.precision == "float32" else []
    return [*precision, f"a smaller size than {height}x{width}", f"fewer frames than {recipe.frames}"]


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ArgumentError(f"{out} is not empty; choose a new or empty folder")
