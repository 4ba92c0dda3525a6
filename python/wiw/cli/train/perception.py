# SPDX-License-Identifier: Apache-2.0
"""`wiw train perception`."""

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


def train_perception(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("perception.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:160",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    places: Count = None,
    epochs: Count = None,
    batch: Count = None,
    rate: Annotated[float | None, arg(metavar="RATE", help_behavior_hint="")] = None,
    device: Annotated[str | None, arg(metavar="DEVICE", help_behavior_hint="")] = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train the labeller for question answering: it gives each pixel of a view a category and a state (on or off, open
    or closed). Colour words are calibrated along with it.

    $ wiw train perception --out perception.safetensors

    Views of the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes two to three hours on a CPU. On a GPU, larger batches and more epochs give much better weights in
    minutes; those shipped with wiw were trained this way (docs/perception.md):

    $ wiw train perception --scenes apartments:train:280 --places 18 --epochs 16 --batch 32

    Repeat an interrupted command to resume it. FILE also holds the recipe, accuracy and IoU of categories, and accuracy
    of states and of colour words on the val scenes.

    Args:
        out: File for the weights (safetensors); colour words go into a JSON file next to it.
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes for evaluation; none may be trained on.
        places: Places sampled per scene. Default: 12.
        epochs: Number of epochs: how often each sample is used, on average. Default: 4.
        batch: Views in a batch. On a GPU, 32 hardly takes longer but needs more epochs for as many updates. Default: 4.
        rate: Peak learning rate. Default: 0.002.
        device: Where to train: cpu, cuda, cuda:1, ... Default: the GPU if there is one.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.perception.learned_labeller import require_torch

    check_counts(places=places, epochs=epochs, batch=batch)
    require_torch()
    with write_weights("perception", out):
        from wiw.training import perception as training
        from wiw.training.labelled_views import ViewRules

        rules = ViewRules(**drop_none({"places": places}))
        recipe = training.Recipe(**drop_none({"epochs": epochs, "batch": batch, "rate": rate, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = training.make_weights(
                out, scenes, val, rules, recipe, limits.minutes, preparation, progress, track_items, device
            )
        _report(card)
        print(f"colours   {training.name_colors_file(out)}")
    return 0


def _report(card: Mapping[str, Any]) -> None:
    held_out = card["held_out"]
    plain, colors = held_out["plain"], held_out["colors"]
    kinds = {"with depth": plain, "without": held_out["no_depth"], "degraded too": held_out["degraded"]}
    print(f"{card['views']} views, {card['recipe']['epochs']} epochs; held out: {held_out['views']} views")
    print(f"{'':<20}" + "".join(f"{name:>14}" for name in kinds))
    for name, key in (("pixel accuracy", "pixel_accuracy"), ("mean IoU", "mean_iou"), ("states", "state_accuracy")):
        print(f"  {name:<18}" + "".join(f"{to_percent(part[key]):>14}" for part in kinds.values()))
    print(f"  {'colours of things':<18}{to_percent(colors['accuracy']):>14}")
    print("IoU by category: " + ", ".join(f"{name} {value:.2f}" for name, value in plain["iou"].items() if name))
    for name, values in plain["states"].items():
        print(f"  {name:<18}" + ", ".join(f"{state} {to_percent(value)}" for state, value in values.items()))
