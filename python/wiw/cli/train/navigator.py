# SPDX-License-Identifier: Apache-2.0
"""`wiw train navigator`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import (
    NO_LIMITS,
    VAL_SCENES,
    Count,
    Limits,
    check_counts,
    drop_none,
    to_percent,
    write_weights,
)
from wiw.training.preparation import PREPARATION, Preparation


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
    with write_weights("navigator", out):
        from wiw.training import navigator as training
        from wiw.training.goal_places import PlaceRules

        rules = PlaceRules(**drop_none({"anchors": places}))
        recipe = training.Recipe(**drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = training.make_weights(
                out, scenes, val, rules, recipe, limits.minutes, preparation, progress, track_items
            )
        _report(card)
    return 0


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
