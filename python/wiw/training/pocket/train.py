# SPDX-License-Identifier: Apache-2.0
"""Train pocket on a navigation dataset, or resume its training, and write its weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import wiw
from wiw.datasets.navigation import NavigationData, Part
from wiw.training.pocket.frames import Bar, reduce_frames
from wiw.training.pocket.recipe import PocketRecipe
from wiw.training.pocket.trainer import PocketTrainer
from wiw.training.post_training.clip_trainer import arrange_clips
from wiw.training.post_training.stop_signals import SignalledCheckpoint
from wiw.training.post_training.train import describe_dataset, require_panoramas, run_steps
from wiw.world_models.pocket.weights import save


def train_pocket(
    data: str | Path,
    out: Path,
    cache: Path,
    recipe: PocketRecipe,
    part: Part = "train",
    seconds: float = 600.0,
    on_step: Callable[[int, int, float], None] = lambda *_: None,
    bar: Bar = lambda items, text, total: items,
) -> dict[str, Any]:
    """Train, or resume, and write the file of weights.

    A state is kept beside `out`, in `OUT.checkpoint`, every so often, at SIGUSR1, and before the process stops at
    SIGTERM or Ctrl-C. The same call resumes from it; with the same number of threads it ends with the same bytes.

    Args:
        data: folder of `wiw collect navigation`, of panoramas.
        out: file of the weights.
        cache: folder of frames in the recipe's size, which are made once.
        recipe: the numbers.
        part: of the dataset: "train", which leaves a share of the scenes for validation, or "all".
        seconds: least time between two writes of the state.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows how far decoding has come.

    Returns:
        The card in the file: data, recipe, steps and the loss at the end.

    Raises:
        ArgumentError: a dataset of perspective views, too few clips, or a state of a training with other data or
            numbers.
        TrainingError: the loss is not finite; the last good state is kept, the message names the batch.
        FileError: the dataset is missing or damaged, or a file cannot be written.
    """
    dataset = NavigationData(data, part)
    require_panoramas(dataset)
    clips = dataset.clips(recipe.frames)
    arrange_clips(len(clips), recipe)
    card: dict[str, Any] = {
        "wiw": wiw.__version__,
        "data": describe_dataset(dataset, part),
        "recipe": recipe.describe(),
    }
    trainer = PocketTrainer(clips, reduce_frames(dataset, recipe.size, cache, bar), recipe)
    state = SignalledCheckpoint(out.with_name(f"{out.name}.checkpoint"), {"model": "pocket", **card}, seconds)
    run_steps(trainer, state, on_step)
    card |= {"steps": trainer.step_count, "loss": trainer.mean_loss}
    save(out, trainer.averaged.eval(), card)
    state.remove()
    return card
