# SPDX-License-Identifier: Apache-2.0
"""Train a video generator to follow actions, on a navigation dataset, and write a checkpoint that world models load."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import wiw
from wiw.datasets.navigation import NavigationData, Part
from wiw.errors import ArgumentError, TrainingError
from wiw.files import atomic_folder
from wiw.training.post_training.clip_trainer import ClipTrainer, arrange_clips
from wiw.training.post_training.families import find_family, load_generator
from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.post_training.trainer import PostTrainer
from wiw.training.trainer import run_training
from wiw.world_models import devices
from wiw.world_models.base import Requirements
from wiw.world_models.video import loading
from wiw.world_models.video.actions import checkpoint as action_checkpoint
from wiw.world_models.video.actions.config import ActionConfig
from wiw.world_models.video.actions.injection import embedding_width
from wiw.world_models.video.model import VideoModel
from wiw.world_models.video.weights import is_path

CARD = "training.json"
"""Name of the file beside the weights that says on what and how they were trained."""


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
    part: Part = "train",
    seconds: float = 600.0,
    on_step: Callable[[int, int, float], None] = lambda *_: None,
) -> dict[str, Any]:
    """Train an action-conditioned model for navigation, or resume its training, and write its checkpoint.

    A state is kept beside `out`, in `OUT.checkpoint`, every so often, at SIGUSR1, and before the process stops at
    SIGTERM or Ctrl-C. The same call resumes from it, and on the CPU ends with the same bytes.

    Args:
        name: of the world model, such as "ltx-action".
        data: folder of `wiw collect navigation`, of panoramas.
        out: folder of the checkpoint, new or empty; `wiw.world_model(name, checkpoint=out)` loads it.
        weights: of the stock generator, a folder as `save_pretrained` writes it or a name on the hub; its usual ones
            if None.
        revision: of the weights on the hub.
        variant: of the weight files, such as "fp16".
        device: of torch; "cuda" where there is one, else "cpu".
        recipe: the numbers; the shipped recipe if None, in float32 where there is no GPU.
        part: of the dataset: "train", which leaves a share of the scenes for validation, or "all".
        seconds: least time between two writes of the state.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.

    Returns:
        What the checkpoint's `training.json` says: model, data, recipe, steps and the loss at the end.

    Raises:
        ArgumentError: a model that is not trained here, a dataset of perspective views, too few clips, a recipe that
            the model cannot have, or a state of a training with other data or numbers.
        TrainingError: the loss is not finite; the last good state is kept, the message names the batch.
        FileError: `out` holds something, or the dataset is missing or damaged.
        WeightsError, DependencyError, DeviceMemoryError: see `wiw.world_models.video.model.VideoModel`.
    """
    out = Path(out)
    model, objective_class = find_family(name)
    devices.require(Requirements(("peft",), "diffusers"))
    device = devices.device(device)
    recipe = recipe or choose_precision(load_recipe(name), device)
    _require_free(out)
    dataset = NavigationData(data, part)
    require_panoramas(dataset)
    arrange_clips(len(dataset.clips(recipe.frames)), recipe)
    options = {"revision": revision, "variant": variant, "device": device, **_extra_options(name)}
    generator = load_generator(model, recipe, None if weights is None else _resolve(str(weights)), options)
    recipe = replace(recipe, frames=generator.frames, size=generator.size)
    card = {"model": name, **describe_training(generator, dataset, part, recipe)}
    state = SignalledCheckpoint(out.with_name(f"{out.name}.checkpoint"), card, seconds)
    with devices.memory_guard(f"training {name} on {generator.device}", "; ".join(list_remedies(recipe))):
        config = build_config(model.base, model.denoisers[0], generator)
        objective, clips = objective_class(generator, recipe), dataset.clips(recipe.frames)
        trainer = PostTrainer(objective, config, model.denoisers, clips, recipe)
        run_steps(trainer, state, on_step)
    card |= {"steps": trainer.step_count, "loss": trainer.mean_loss}
    write_checkpoint(out, trainer, card)
    state.remove()
    return card


def run_steps(trainer: ClipTrainer, state: SignalledCheckpoint, on_step: Callable[[int, int, float], None]) -> None:
    """Train from the start, or from the state that is kept, to the end.

    Raises:
        TrainingError: the loss is not finite; the state before is kept.
        ArgumentError, FileError: see `wiw.training.checkpoint.Checkpoint`.
    """
    recipe, phases = trainer.recipe, trainer.phases
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


def describe_training(
    generator: VideoModel, data: NavigationData, part: str, recipe: PostTrainingRecipe
) -> dict[str, Any]:
    """Return what the outcome of a training depends on, as JSON values."""
    return {
        "wiw": wiw.__version__,
        "weights": identify_weights(generator),
        "data": describe_dataset(data, part),
        "recipe": recipe.describe(),
        "versions": loading.versions(),
    }


def identify_weights(generator: VideoModel) -> dict[str, str]:
    """Return the hub's commit of a generator's weights, or the digest of their folder."""
    described = generator.describe()
    return {key: str(described[key]) for key in ("commit", "digest") if key in described}


def write_checkpoint(out: Path, trainer: PostTrainer, card: Mapping[str, Any]) -> None:
    """Write what world models load, and how it was made, as a folder that is there whole or not at all.

    Raises:
        FileError: `out` holds something, or cannot be written.
    """
    with atomic_folder(out) as draft:
        encoders = {place: encoder.eval() for place, encoder in trainer.encoders.items()}
        action_checkpoint.save(draft, encoders, trainer.objective.pipeline, lora=bool(trainer.recipe.lora))
        (draft / CARD).write_text(json.dumps(card, indent=2) + "\n", encoding="utf-8")


def build_config(base: str, place: str, generator: VideoModel) -> ActionConfig:
    """Return the configuration of encoders for primitives, for the denoisers of a generator."""
    return ActionConfig(
        base=base,
        weights=generator.weights,
        revision=identify_weights(generator).get("commit"),
        width=embedding_width(getattr(generator.pipeline, place)),
        stride=generator.stride,
    )


def describe_dataset(data: NavigationData, part: str) -> dict[str, Any]:
    """Return what identifies a dataset: a digest of its files' checksums, which part, how many segments."""
    files = json.dumps(data.meta["files"], sort_keys=True)
    return {"sha256": hashlib.sha256(files.encode()).hexdigest(), "part": part, "segments": len(data)}


def choose_precision(recipe: PostTrainingRecipe, device: str | None) -> PostTrainingRecipe:
    """Return the recipe in float32 where there is no GPU, on which half precision is fast."""
    return recipe if devices.device(device).startswith("cuda") else replace(recipe, precision="float32")


def list_remedies(recipe: PostTrainingRecipe) -> list[str]:
    """List the numbers of a recipe that need less memory than the present ones, the mildest first."""
    height, width = recipe.size
    remedies = [f"rows=1 (now {recipe.rows})"] if recipe.rows > 1 else []
    remedies += ["precision=bfloat16"] if recipe.precision == "float32" else []
    remedies += [] if recipe.checkpointing else ["checkpointing=true"]
    remedies += [] if recipe.lora else ["lora=32, for the Wan models"]
    return [*remedies, f"a smaller size than {height}x{width}", f"fewer frames than {recipe.frames}"]


def _resolve(weights: str) -> str:
    """Return a folder with its whole path, which the checkpoint names; a name on the hub as it is."""
    folder = Path(weights).expanduser()
    return str(folder.resolve()) if folder.is_dir() or is_path(weights) else weights


def _extra_options(name: str) -> dict[str, Any]:
    """Return options without a default; the filter of Cosmos-Predict2 has nothing to look at where none is shown."""
    return {"guardrail": False} if name == "cosmos-predict2-action" else {}


def _require_free(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ArgumentError(f"{out} holds something already; name a folder that is new or empty")


def require_panoramas(data: NavigationData) -> None:
    """Raise ArgumentError unless a dataset is of panoramas."""
    camera = data.meta.get("camera", {}).get("projection")
    if camera != "equirectangular":
        raise ArgumentError(
            f"{data.folder}: models that follow primitives see panoramas, but this dataset has {camera} views; collect "
            "without --perspective"
        )
