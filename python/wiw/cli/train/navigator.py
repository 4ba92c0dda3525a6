# SPDX-License-Identifier: Apache-2.0
"""`wiw train navigator`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
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
    to_percent,
    write_weights,
)


def train_navigator(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("navigator.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:200",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    places: Count = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train the network of policy navigator (Image-Goal Navigation): it estimates, from a panorama and the goal image,
    how far the goal is and in which direction.

    $ wiw train navigator --out navigator.safetensors
    $ wiw run imagenav --policy navigator --policy-option weights=navigator.safetensors

    Views of the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes 15 to 30 minutes on two idle cores; repeat an interrupted command to resume it. FILE also holds the
    recipe, and how well the network separates near pairs of places in the val scenes from far ones and the error of its
    bearings, next to the matcher's similarity. The weights shipped with wiw were trained for three of four epochs
    (docs/navigation-tasks.md).

    Args:
        out: File for the weights (safetensors).
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes for evaluation; none may be trained on.
        places: Places sampled per scene; up to three more are sampled near each. Default: 24.
        epochs: Number of epochs: how often each sample is used, on average. Default: 4.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.policies.navigator.estimator import require_torch

    check_counts(places=places, epochs=epochs)
    require_torch()
    check_scenes(scenes, val)
    with write_weights("navigator", out):
        recipe = drop_none({"epochs": epochs, "seed": limits.seed})
        _train(out, scenes, val, limits, preparation, drop_none({"anchors": places}), recipe)
    return 0


def _train(
    out: Path,
    scenes: str,
    val: str,
    limits: Limits,
    preparation: Preparation,
    rule_options: Mapping[str, Any],
    recipe_options: Mapping[str, Any],
) -> None:
    from wiw.networks import single_thread
    from wiw.policies.navigator.weights import load, save
    from wiw.training import navigator as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.gather import gather_goal_places
    from wiw.training.goal_places import PlaceRules

    rules, recipe, seed = PlaceRules(**rule_options), training.Recipe(**recipe_options), limits.seed
    places = gather_goal_places(scenes, seed, rules, **preparation.arguments)
    held_out = gather_goal_places(val, seed, rules, **preparation.arguments)
    card: dict[str, Any] = {"scenes": scenes, "val": val, "places": sum(map(len, places))}
    card |= {"sampling": asdict(rules)}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": limits.minutes})
    with single_thread(), TrainingProgress() as progress:
        network, recipe = training.train(places, recipe, limits.minutes, progress, checkpoint)
    card |= {"recipe": asdict(recipe), **training.measure_prior(places, recipe)}
    save(out, network, card)  # before the evaluation, which takes another minute
    card["held_out"] = training.evaluate(load(out)[0], card, held_out, seed)  # as stored, in half precision
    save(out, network, card)
    checkpoint.remove()
    _report(card)


def _report(card: Mapping[str, Any]) -> None:
    held_out, other = card["held_out"], "the matcher's similarity"
    print(f"{card['places']} places, {card['recipe']['epochs']} epochs; held out: {held_out['pairs']} pairs")
    auc = {name: "-" if value is None else f"{value:.3f}" for name, value in held_out["auc"].items()}
    print(f"AUC within 2 m: network {auc['network']}, {other} {auc['similarity']}, both {auc['both']}")
    for name, row in held_out["bearing"].items():
        if not row["pairs"]:
            continue
        print(
            f"  bearing, {name:<5} m: median error {row['network']:3.0f} degrees, {other} {row['similarity']:3.0f}; "
            f"within 45: {to_percent(row['within_45'])} of {row['pairs']}"
        )
