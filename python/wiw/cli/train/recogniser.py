# SPDX-License-Identifier: Apache-2.0
"""`wiw train recogniser`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress
from wiw.cli.train.small_networks import (
    NO_LIMITS,
    PREPARATION,
    VAL_SCENES,
    Count,
    Limits,
    Preparation,
    check_counts,
    check_scenes,
    drop_none,
    write_weights,
)


def train_recogniser(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("recogniser.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:160",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    categories: Annotated[tuple[str, ...], arg(metavar="NAME", help_behavior_hint="")] = (),
    weights: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    places: Count = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train the recogniser, the policy for Active Recognition: it names the object in a red box, given any number of
    real and imagined views of it.

    $ wiw train recogniser --out recogniser.safetensors
    $ wiw train recogniser --scenes house.glb --val other.glb --categories chair bed --out house.safetensors
    $ wiw run ar --policy-option weights=house.safetensors

    Views of the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes 15 to 30 minutes on two idle cores. FILE also holds the recipe, and accuracy and calibration error on
    one half of the val scenes, after calibration on the other half. The weights shipped with wiw were trained with an
    earlier recipe (docs/results.md).

    Args:
        out: File for the weights (safetensors).
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes; none may be trained on. They, or the samples of a single scene, are split into halves for
            calibration and evaluation.
        categories: Categories to distinguish. Default: the built-in list of 26.
        weights: File written by this command to start from. Default: random weights.
        places: Places sampled per scene. Default: 8.
        epochs: Number of epochs: how often each sample is used, on average. Default: 25.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.perception.recogniser import require_torch

    check_counts(places=places, epochs=epochs)
    require_torch()
    check_scenes(scenes, val)
    with write_weights("recogniser", out):
        recipe = drop_none({"epochs": epochs, "seed": limits.seed})
        rules = drop_none({"places": places})
        _train(out, scenes, val, categories, weights, limits, preparation, rules, recipe)
    return 0


def _train(
    out: Path,
    scenes: str,
    val: str,
    categories: tuple[str, ...],
    weights: str | None,
    limits: Limits,
    preparation: Preparation,
    rule_options: Mapping[str, Any],
    recipe_options: Mapping[str, Any],
) -> None:
    from wiw.datasets.ar import CATEGORIES
    from wiw.perception.recogniser import Recogniser
    from wiw.training import recogniser as training
    from wiw.training.gather import gather_glimpse_sets, gather_hard_sets
    from wiw.training.glimpse_sets import GlimpseSetRules, merge_glimpse_sets, split_in_half

    names, seed, gathering = categories or CATEGORIES, limits.seed, preparation.arguments
    rules, recipe = GlimpseSetRules(**rule_options), training.Recipe(**recipe_options)
    start = None if weights is None else Recogniser.load(weights)
    sets = gather_glimpse_sets(scenes, names, seed, rules, **gathering)
    hard = gather_hard_sets(scenes, names, seed, **gathering)
    held_out = gather_glimpse_sets(val, names, seed, replace(rules, reshape=1.0), **gathering)
    calibration, held_out = split_in_half(held_out)
    held_out_hard = gather_hard_sets(val, names, seed, **gathering)
    samples = merge_glimpse_sets([sets, *[hard] * recipe.hard])
    with TrainingProgress() as progress:
        network, recipe = training.train(
            samples, names, recipe, limits.minutes, progress, None if start is None else start.network
        )
    card = {"scenes": scenes, "val": val, "sets": len(sets), "hard_sets": len(hard)}
    card |= {"looks": asdict(rules), "recipe": asdict(recipe), "began_with": None if start is None else start.card}
    calibrated = training.calibrate(network, names, calibration, held_out, card, held_out_hard)
    calibrated.save(out)
    _report(calibrated.card, calibrated.temperature)


def _report(card: Mapping[str, Any], temperature: float) -> None:
    print(f"{card['sets']} glimpse sets, {card['recipe']['epochs']} epochs; held out: {card['held_out_sets']} sets")
    for name, accuracy in card["accuracy"].items():
        hard = card["accuracy_hard"].get(name)
        print(
            f"  {name:<20} accuracy {100 * accuracy:5.1f} %"
            + (f", hard {100 * hard:5.1f} %" if hard is not None else "")
        )
    error = card["calibration_error"]
    print(f"calibration error {error['before']:.3f}, {error['after']:.3f} at temperature {temperature:.2f}")
