# SPDX-License-Identifier: Apache-2.0
"""`wiw train pocket`: train a small video generator from scratch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wiw.cli.train_video import TrainingProgress, describe_steps, require_data

if TYPE_CHECKING:
    from wiw.datasets.navigation import NavigationData


def train_pocket(
    out: Path,
    data: Path | None,
    cache: Path,
    val: str,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    given: Mapping[str, Any],
    bar: Callable[..., Any],
) -> None:
    """Train pocket, evaluate it on held-out scenes and print the results.

    Args:
        out: file of the weights.
        data: folder of the dataset.
        cache: folder of prepared training data.
        val: scenes to evaluate it on.
        recipe: YAML file on top of the shipped recipe.
        pairs: KEY=VALUE overrides of both.
        numbers: values of the recipe that have their own flags.
        given: the part of the dataset to train on, and the validation data.
        bar: wraps an iterable in a progress bar.

    Raises:
        ArgumentError: no data, scenes that do not exist, or scenes used for both training and evaluation; see also
            `wiw.training.pocket.train.train_pocket`.
    """
    from wiw.datasets.navigation import NavigationData
    from wiw.runs.part_options import parse_options
    from wiw.training.pocket import train as training
    from wiw.training.pocket.held_out import evaluate
    from wiw.training.pocket.recipe import PocketRecipe
    from wiw.training.post_training.recipe import load_recipe
    from wiw.world_models.pocket.model import Pocket
    from wiw.world_models.pocket.weights import load, save

    options = {**numbers, **parse_options(pairs, PocketRecipe, "--option")}
    chosen = load_recipe("pocket", recipe, options, kind=PocketRecipe)
    folder = require_data("pocket", data)
    _check_held_out(val, NavigationData(folder, given["part"], chosen.held_out))  # before hours of training
    with TrainingProgress(chosen.batch) as progress:
        card = training.train_pocket(
            folder, out, cache, chosen, on_step=progress, on_validation=progress.show_validation, bar=bar, **given
        )
    card["val"] = val
    card["held_out"] = evaluate(Pocket(out), val, chosen.seed, bar=bar)
    save(out, load(out)[0], card)
    _report(card)
    print(f"log       {out}.log")


def _check_held_out(val: str, data: NavigationData) -> None:
    """Check that scenes exist and are not trained on; a dataset identifies its scenes only by name."""
    from wiw.datasets.scene_splits import name_scene
    from wiw.errors import ArgumentError
    from wiw.scenes import resolve, strip_edits

    trained = {strip_edits(row["scene"]) for row in data.segments}
    shared = next((spec for spec in resolve(val) if strip_edits(name_scene(spec)) in trained), None)
    if shared is not None:
        raise ArgumentError(
            f"--val: expected held-out scenes, got {shared}, but {data.folder} has a scene of that name to train on; "
            "choose others"
        )


def _report(card: Mapping[str, Any]) -> None:
    print(describe_steps(card, card["recipe"]["batch"]))
    for kind, found in card["held_out"].items():
        print(f"{f'{kind}: steps of 0.2 m ahead':<30}" + "".join(f"{step:>8}" for step in found["psnr"]["copy"]))
        for name, values in found["psnr"].items():
            print(f"  {name:<28}" + "".join(f"{values[step]:8.1f}" for step in values))
        if found["gap"]:
            print(f"  {'control gap':<28}" + "".join(f"{value:8.1f}" for value in found["gap"].values()))
    print("PSNR in dB of whole panoramas, weighted by latitude; the gap is the loss when given another window's places")
