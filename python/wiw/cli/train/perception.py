# SPDX-License-Identifier: Apache-2.0
"""`wiw train perception`."""

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
    to_percent,
    write_weights,
)


def train_perception(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("perception.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:160",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    places: Count = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train the labeller for question answering: it gives each pixel of a view a category and a state (on or off, open
    or closed). Colour words are calibrated along with it.

    $ wiw train perception --out perception.safetensors

    Views of the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes one to two hours on two idle cores; repeat an interrupted command to resume it. FILE also holds the
    recipe, accuracy and IoU of categories, and accuracy of states and of colour words on the val scenes. The weights
    shipped with wiw were trained for four epochs of a schedule first laid out for six (docs/perception.md).

    Args:
        out: File for the weights (safetensors); colour words go into a JSON file next to it.
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes for evaluation; none may be trained on.
        places: Places sampled per scene. Default: 12.
        epochs: Number of epochs: how often each sample is used, on average. Default: 4.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.perception.learned_labeller import require_torch

    check_counts(places=places, epochs=epochs)
    require_torch()
    check_scenes(scenes, val)
    with write_weights("perception", out):
        recipe = drop_none({"epochs": epochs, "seed": limits.seed})
        _train(out, scenes, val, limits, preparation, drop_none({"places": places}), recipe)
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
    from wiw.perception.labeller_weights import load, save
    from wiw.perception.scene_labels import CATEGORIES
    from wiw.training import color_naming
    from wiw.training import perception as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.gather import gather_views
    from wiw.training.labelled_views import HELD_OUT_FIELD, ViewRules

    rules, recipe, seed = ViewRules(**rule_options), training.Recipe(**recipe_options), limits.seed
    views = gather_views(scenes, seed, rules, **preparation.arguments, change=True)
    held_out_rules = replace(rules, fields=(HELD_OUT_FIELD, HELD_OUT_FIELD))
    held_out = gather_views(val, seed, held_out_rules, **preparation.arguments, change=True)
    card: dict[str, Any] = {"scenes": scenes, "val": val, "views": len(views), "sampling": asdict(rules)}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": limits.minutes})
    with single_thread():
        with TrainingProgress() as progress:
            network, recipe = training.train(views, recipe, limits.minutes, progress, checkpoint)
        namer = color_naming.calibrate(views, seed)
    card |= {"recipe": asdict(recipe), "categories": list(CATEGORIES), "states": training.find_possible_states(views)}
    save(out, network, card)  # before the evaluation, which takes another minute
    colors = out.with_suffix(".colors.json")
    namer.save(colors)
    network = load(out)[0]  # as it is stored, in half precision
    card["held_out"] = training.evaluate(network, card["states"], held_out, seed)
    card["held_out"]["colors"] = color_naming.evaluate(namer.load(colors), held_out)
    save(out, network, card)
    checkpoint.remove()
    _report(card)
    print(f"colours   {colors}")


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
