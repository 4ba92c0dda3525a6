# SPDX-License-Identifier: Apache-2.0
"""Weights of armnet, from simulated plays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wiw.datasets.demonstrations import read_manifest
from wiw.networks import single_thread
from wiw.training.armnet import HELD_OUT, HELD_OUT_SEED_OFFSET, Recipe, evaluate, train
from wiw.training.armnet_events import evaluate_events
from wiw.training.checkpoint import Checkpoint, require_unfinished
from wiw.training.plays import gather_plays, merge_plays, read_demonstration_plays
from wiw.training.preparation import PREPARATION, Preparation, ProgressBar, show_no_bar
from wiw.world_models.armnet.weights import load, save

PLAYS = 2000
"""Number of plays that are trained on if none is given."""


def make_weights(
    out: Path,
    count: int = PLAYS,
    demonstrations: Path | None = None,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    preparation: Preparation = PREPARATION,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
) -> dict[str, Any]:
    """Record plays, train on them, or resume, evaluate on held-out plays, and write the weights; return the card.

    Args:
        out: file of the weights; the state of training is kept beside it.
        count: number of plays.
        demonstrations: folder of `wiw collect manipulation`, as additional data.
        recipe: how to train; its seed is that of the plays, too.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        preparation: how plays are recorded and cached.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of recording.

    Raises:
        ArgumentError: finished weights in the file, or a state of another training.
        TrainingError: the loss or a gradient is not finite.
        FileError: demonstrations are missing or damaged, or a file cannot be written.
    """
    require_unfinished(out)
    gathering = preparation.list_arguments(bar)
    plays = gather_plays(count, recipe.seed, **gathering)
    held_out = gather_plays(HELD_OUT, recipe.seed + HELD_OUT_SEED_OFFSET, **gathering)
    card: dict[str, Any] = {"plays": len(plays), "demonstrations": 0}
    if demonstrations is not None:
        demonstrated = read_demonstration_plays(demonstrations)
        card |= {"demonstrations": len(demonstrated), "collection": read_manifest(demonstrations)}
        plays = merge_plays([plays, demonstrated])
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": minutes})
    with single_thread():
        network, recipe = train(plays, recipe, minutes, on_step, checkpoint)
        card["recipe"] = asdict(recipe)
        save(out, network, card)  # before the evaluation, which takes another minute
        network = load(out)[0]  # as it is stored, in half precision
        card["held_out"] = evaluate(network, held_out) | {"events": evaluate_events(network, held_out)}
    save(out, network, card)
    checkpoint.remove()
    return card
