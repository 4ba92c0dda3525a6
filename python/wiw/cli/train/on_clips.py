# SPDX-License-Identifier: Apache-2.0
"""Train a small world model, pocket or warpnet, on a collected dataset, watched in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.errors import ArgumentError
from wiw.training.save_signal import hold_save_signal

if TYPE_CHECKING:
    from wiw.datasets.navigation import NavigationData
    from wiw.training.post_training.recipe import ClipRecipe


@hold_save_signal()
def train_and_measure(
    name: str,
    out: Path,
    data: Path,
    cache: Path,
    val: str,
    recipe: ClipRecipe,
    watched: Mapping[str, Any],
    evaluate: Callable[..., Mapping[str, Any]],
) -> dict[str, Any]:
    """Train a world model on clips, measure it on held-out scenes, and write its weights; return the file's card.

    Args:
        name: of the world model, one of `wiw.training.learners.LEARNERS`.
        out: file of the weights.
        data: folder of `wiw collect navigation`.
        cache: folder for prepared frames.
        val: held-out scenes.
        recipe: the numbers.
        watched: `part`, `validation`, `decisions`, `tracker` and `device` of `wiw.training.train_on_clips`.
        evaluate: measures a world model, given it, the scenes, a seed and `bar`.

    Raises:
        ArgumentError: a val scene is trained on, or see `train_on_clips`.
    """
    from wiw.datasets.navigation import NavigationData
    from wiw.training.learners import make_learner
    from wiw.training.train_on_clips import train_on_clips

    _check_held_out(val, NavigationData(data, watched["part"], recipe.held_out))  # before hours of training
    with TrainingProgress(recipe.batch, "clips") as progress:
        card = train_on_clips(
            name,
            data,
            out,
            cache,
            recipe,
            on_step=progress,
            on_validation=progress.show_validation,
            bar=track_items,
            **watched,
        )
    if card.get("val") == val and "held_out" in card:
        print(f"{out}: trained and measured before; delete it to train anew")
        return card
    learner = make_learner(name)
    card["val"] = val
    card["held_out"] = evaluate(learner.model(out), val, recipe.seed, bar=track_items)
    learner.save(out, learner.load(out)[0], card)
    return card


def _check_held_out(val: str, data: NavigationData) -> None:
    """Check that scenes exist and are not trained on; a dataset identifies its scenes only by name."""
    from wiw.scenes import resolve

    shared = data.find_shared(resolve(val))
    if shared is not None:
        raise ArgumentError(
            f"--val: expected held-out scenes, got {shared}, but {data.folder} has a scene of that name to train on; "
            "choose others"
        )
