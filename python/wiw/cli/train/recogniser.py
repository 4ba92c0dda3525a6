# SPDX-License-Identifier: Apache-2.0
"""`wiw train recogniser`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import NO_LIMITS, VAL_SCENES, Count, Limits, check_counts, drop_none, write_weights
from wiw.training.preparation import PREPARATION, Preparation


def train_recogniser(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("recogniser.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:160",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    categories: Annotated[tuple[str, ...], arg(metavar="NAME", help_behavior_hint="")] = (),
    weights: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    extents: bool = True,
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
    Training takes 15 to 30 minutes on two idle cores, and resumes when the command is repeated; finished weights are
    never replaced. FILE also holds the recipe, and accuracy and calibration error on
    one half of the val scenes, after calibration on the other half. Of the weights shipped with wiw, `extents` were
    trained by this recipe with --scenes apartments:train:80, `pictures` by an earlier one (docs/results.md).

    Args:
        out: File for the weights (safetensors).
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes; none may be trained on. They, or the samples of a single scene, are split into halves for
            calibration and evaluation.
        categories: Categories to distinguish. Default: the built-in list of 26.
        weights: File written by this command to start from. Default: random weights.
        extents: Also go by the object's size in metres, as measured with depth in real views. Such a recogniser knows
            other furniture better, and gains less from imagination.
        places: Places sampled per scene. Default: 8.
        epochs: Number of epochs: how often each sample is used, on average. Default: 25.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.datasets.ar import CATEGORIES
    from wiw.perception.recogniser import Recogniser, require_torch

    check_counts(places=places, epochs=epochs)
    require_torch()
    with write_weights("recogniser", out):
        from wiw.training import recogniser as training
        from wiw.training.glimpse_sets import GlimpseSetRules

        names, start = categories or CATEGORIES, None if weights is None else Recogniser.load(weights)
        rules = GlimpseSetRules(**drop_none({"places": places}))
        recipe = training.Recipe(extents=extents, **drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            made = training.make_weights(
                out, scenes, val, names, rules, recipe, limits.minutes, start, preparation, progress, track_items
            )
        _report(made.card, made.temperature)
    return 0


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
