# SPDX-License-Identifier: Apache-2.0
"""Train a pretrained model to follow actions, on a corpus, and write a checkpoint that world models load."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import wiw
from wiw.errors import ArgumentError, TrainingError
from wiw.files import atomic_folder
from wiw.training.post_training.corpora import Corpus, CorpusPart, open_corpus
from wiw.training.post_training.families import Loaded, PretrainedWeights, find_family
from wiw.training.post_training.latent_cache import LatentCache
from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.post_training.trainer import PostTrainer, arrange_clips
from wiw.training.trainer import run_training
from wiw.types import GRIPPER_POSES, PRIMITIVES
from wiw.world_models import devices
from wiw.world_models.video import loading

CARD = "training.json"
"""Name of the file beside a checkpoint's weights that says how it was trained and is run."""
TASKS: Mapping[str, str] = {PRIMITIVES: "imagenav", GRIPPER_POSES: "manipulation"}
"""A task for the actions of each space."""


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
    cache: str | Path | None = None,
    seconds: float = 600.0,
    on_step: Callable[[int, int, float], None] = lambda *_: None,
) -> dict[str, Any]:
    """Train a model on navigation or manipulation, or resume its training, and write its checkpoint.

    A state is kept beside `out`, in `OUT.checkpoint`, every so often, at SIGUSR1, and before the process stops at
    SIGTERM or Ctrl-C. The same call resumes from it, and on the CPU ends with the same bytes.

    Args:
        name: such as "ltx-action".
        data: folder of `wiw collect navigation` or `wiw collect manipulation`.
        out: folder of the checkpoint, new or empty; `wiw.world_model(name, checkpoint=out)` loads it, for NWM
            `wiw.world_model("nwm", weights=out)`.
        weights: pretrained, a folder as the world model takes it or a name on the hub; its usual ones if None.
        revision: of the weights on the hub.
        variant: of the weight files, such as "fp16".
        device: of torch; "cuda" where there is one, else "cpu".
        recipe: the numbers; the shipped recipe if None, in float32 where there is no GPU.
        part: of the data: "train", which leaves a share of scenes or demonstrations for validation, or "all".
        cache: folder where encoded clips are kept, for later epochs and other trainings on the same data; none if None.
        seconds: least time between two writes of the state.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.

    Returns:
        What the checkpoint's `training.json` says: model, data, recipe, steps, the loss at the end, how it is run.

    Raises:
        ArgumentError: a model that is not trained here or not on such data, too few clips, a recipe that the model
            cannot have, or a state of a training with other data or numbers.
        TrainingError: the loss is not finite; the last good state is kept, the message names the batch.
        FileError: `out` holds something, or the dataset is missing or damaged.
        WeightsError, DependencyError, DeviceMemoryError: see the world model.
    """
    out = Path(out)
    family, device = find_family(name), devices.device(device)
    recipe = recipe or choose_precision(load_recipe(name), device)
    _require_free(out)
    corpus, recipe = family.fit(open_corpus(data, part), recipe)
    arrange_clips(len(corpus.clips(recipe.frames)), recipe)
    source = PretrainedWeights(None if weights is None else str(weights), revision, variant, device)
    with devices.memory_guard(f"training {name} on {device}", "; ".join(list_remedies(recipe))):
        loaded = family.load(corpus, recipe, source)
        recipe = loaded.recipe
        card = {"model": name, **describe_training(loaded, corpus)}
        state = SignalledCheckpoint(out.with_name(f"{out.name}.checkpoint"), card, seconds)
        latents = None if cache is None else open_cache(Path(cache), loaded, corpus)
        trainer = PostTrainer(loaded.model, corpus.clips(recipe.frames), recipe, latents)
        run_steps(trainer, state, on_step)
    card |= {"steps": trainer.step_count, "loss": trainer.mean_loss}
    card["run"] = {
        "task": TASKS[corpus.space],
        "world_model": family.world_model,
        "checkpoint": family.checkpoint_option,
    }
    card["run"] |= {"options": family.list_options(corpus, recipe)}
    write_checkpoint(out, trainer, card)
    state.remove()
    return card


def run_steps(trainer: PostTrainer, state: SignalledCheckpoint, on_step: Callable[[int, int, float], None]) -> None:
    """Train from the start, or from the state that is kept, to the end.

    Raises:
        TrainingError: the loss is not finite; the state before is kept.
        ArgumentError, FileError: see `wiw.training.checkpoint.Checkpoint`.
    """
    recipe, phases = trainer.recipe, len(trainer.model.places)
    with state.watch():
        try:
            run_training(
                lambda: trainer,
                recipe,
                trainer.steps_per_epoch,
                None,
                lambda progress: recipe.scale_rate(progress * phases % 1),  # each network has a schedule of its own
                lambda step, steps, _: on_step(step, steps, trainer.mean_loss),
                state,
            )
        except TrainingError:
            if trainer.step_count:
                state.save(trainer, recipe.epochs, trainer.step_count)
            raise


def describe_training(loaded: Loaded, corpus: Corpus) -> dict[str, Any]:
    """Return what the outcome of a training depends on, as JSON values."""
    return {
        "wiw": wiw.__version__,
        "weights": loaded.identity,
        "data": corpus.describe(),
        "recipe": loaded.recipe.describe(),
        "versions": loading.versions(),
    }


def write_checkpoint(out: Path, trainer: PostTrainer, card: Mapping[str, Any]) -> None:
    """Write what world models load, and how it was made, as a folder that is there whole or not at all.

    Raises:
        FileError: `out` holds something, or cannot be written.
    """
    with atomic_folder(out) as draft:
        with trainer.use_averages():
            trainer.model.write(draft)
        (draft / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


def open_cache(folder: Path, loaded: Loaded, corpus: Corpus) -> LatentCache:
    """Return the cache of a corpus's clips as a model's frozen networks encode them."""
    recipe = loaded.recipe
    shape = {"frames": recipe.frames, "size": recipe.size, "versions": loading.versions()}
    return LatentCache(folder, {"data": corpus.describe(), "latents": loaded.model.describe_latents(), **shape})


def choose_precision(recipe: PostTrainingRecipe, device: str | None) -> PostTrainingRecipe:
    """Return the recipe in float32 where there is no GPU, on which half precision is fast."""
    return recipe if devices.device(device).startswith("cuda") else replace(recipe, precision="float32")


def list_remedies(recipe: PostTrainingRecipe) -> list[str]:
    """List the numbers of a recipe that need less memory than the present ones, the mildest first."""
    height, width = recipe.size or (0, 0)
    remedies = [f"rows=1 (now {recipe.rows})"] if recipe.rows > 1 else []
    remedies += ["precision=bfloat16"] if recipe.precision == "float32" else []
    remedies += [] if recipe.checkpointing else ["checkpointing=true"]
    remedies += ["optimizer=adamw8bit"] if recipe.optimizer == "adamw" and not recipe.lora else []
    remedies += ["ema=0"] if recipe.ema else []
    remedies += [] if recipe.lora else ["lora=32, for the Wan and LTX models"]
    return [*remedies, f"a smaller size than {height}x{width}", f"fewer frames than {recipe.frames}"]


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ArgumentError(f"{out} holds something already; name a folder that is new or empty")
