# SPDX-License-Identifier: Apache-2.0
"""`wiw train warpnet`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.cli.options import Options
from wiw.cli.train.corpus import TrackerName, describe_steps
from wiw.cli.train.on_clips import train_and_measure
from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import NO_LIMITS, VAL_SCENES, Count, Limits, check_counts, drop_none, write_weights
from wiw.errors import ArgumentError
from wiw.training.preparation import PREPARATION, Preparation

SCENES = "apartments:train:80"
"""Whose walks are recorded, unless the user says otherwise."""


def train_warpnet(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("warpnet.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = SCENES,
    data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    places: Count = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    recipe: Annotated[Path | None, arg(metavar="YAML", help_behavior_hint="")] = None,
    option: Options = (),
    part: Literal["train", "all"] = "train",
    validation: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    decisions: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    tracker: TrackerName | None = None,
    device: Annotated[str | None, arg(metavar="DEVICE", help_behavior_hint="")] = None,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train warpnet, a world model for navigation that predicts the panorama seen from a place nearby.

    $ wiw train warpnet --out warpnet.safetensors
    $ wiw train warpnet --data data --out warpnet.safetensors  # what `wiw collect navigation` made
    $ wiw run imagenav --world-model warpnet --world-model-option weights=warpnet.safetensors

    Walks through the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes 15 to 30 minutes on two idle cores, and resumes when the command is repeated; finished weights are
    never replaced. FILE also holds the recipe, and PSNR and SSIM on the val scenes,
    next to copy and warp. The weights shipped with wiw were trained by this command with its defaults.

    With --data, it trains on the clips of a dataset instead, in the order that post-training uses: validated on scenes
    that are left out, resumed when the command is repeated (on the CPU exactly), and with a log beside FILE.

    Args:
        out: File for the weights (safetensors).
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        data: Dataset of `wiw collect navigation`, with depth, to train on in place of walks.
        val: Held-out scenes for evaluation; none may be trained on.
        places: Walks recorded per scene. Default: 24.
        epochs: Number of epochs: how often each sample is used, on average. Default: 6. With --data: 3.
        recipe: With --data: YAML file that overrides values of the built-in recipe.
        option: With --data: override a value of its recipe, such as clips=1600 or batch=8; may be repeated. See
            `wiw.training.warpnet_clips.WarpNetClipRecipe`.
        part: With --data: the part to train on; train holds out one in twenty scenes for validation.
        validation: With --data: another dataset, with other scenes, for validation. Default: the scenes held out.
        decisions: With --data: file of `wiw collect decisions`, with which validation also measures how well the
            model's ranking of the plans agrees with the true one.
        tracker: With --data: experiment tracker that plots loss and validation; requires its package.
        device: With --data: where to train: cpu, cuda, cuda:1, ... Default: the GPU if there is one.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.world_models.warpnet.model import WarpNet

    check_counts(places=places, epochs=epochs)
    WarpNet.requires.require()
    watched = {
        "part": part,
        "validation": validation,
        "decisions": decisions,
        "tracker": tracker,
        "device": device,
    }
    _check_source(data, scenes, places, limits, recipe, option, watched, preparation)
    with write_weights("warpnet", out):
        if data is not None:
            _train_on_data(out, data, val, epochs, limits.seed, recipe, option, watched, preparation)
            return 0
        from wiw.training import warpnet as training
        from wiw.training.walks import WalkRules

        rules = WalkRules(**drop_none({"places": places}))
        numbers = training.Recipe(**drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = training.make_weights(
                out, scenes, val, rules, numbers, limits.minutes, preparation, progress, track_items
            )
        print(f"{card['ways']} walks, {card['recipe']['epochs']} epochs")
        _report(card["held_out"])
    return 0


def _check_source(
    data: Path | None,
    scenes: str,
    places: int | None,
    limits: Limits,
    recipe: Path | None,
    option: Sequence[str],
    watched: Mapping[str, Any],
    preparation: Preparation,
) -> None:
    """Refuse options that what is trained on does not have."""
    if data is None:
        found = {
            "--recipe": recipe is not None,
            "--option": bool(option),
            "--part": watched["part"] != "train",
            **{f"--{name}": watched[name] is not None for name in ("validation", "decisions", "tracker", "device")},
        }
        source = "walks; they go with --data"
    else:
        found = {
            "--scenes": scenes != SCENES,
            "--places": places is not None,
            "--minutes": limits.minutes is not None,
            "--workers": preparation.workers != PREPARATION.workers,
        }
        source = "--data, which has its own scenes and clips (--option clips=N for fewer)"
    if given := [name for name, is_given in found.items() if is_given]:
        raise ArgumentError(f"{given[0]} has no effect on a training on {source}; leave it out")


def _train_on_data(
    out: Path,
    data: Path,
    val: str,
    epochs: int | None,
    seed: int,
    recipe: Path | None,
    option: Sequence[str],
    watched: Mapping[str, Any],
    preparation: Preparation,
) -> None:
    from wiw.runs.part_options import parse_options
    from wiw.training.post_training.recipe import load_recipe
    from wiw.training.warpnet import evaluate
    from wiw.training.warpnet_clips import WarpNetClipRecipe

    numbers = drop_none({"epochs": epochs, "seed": seed or None})  # 0, the default, leaves that of the recipe's file
    options = {**numbers, **parse_options(option, WarpNetClipRecipe, "--option")}
    chosen = load_recipe("warpnet", recipe, options, kind=WarpNetClipRecipe)
    card = train_and_measure("warpnet", out, data, preparation.folder, val, chosen, watched, evaluate)
    print(describe_steps(card, chosen.batch))
    _report(card["held_out"])
    print(f"log       {out}.log")


def _report(held_out: Mapping[str, Any]) -> None:
    print(f"held out: {held_out['ways']} walks")
    print(f"{'steps of 0.2 m ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [f"{held_out['psnr'][name][n]:8.1f} {held_out['ssim'][name][n]:6.3f}" for n in held_out["psnr"][name]]
        print(f"  {name:<18}" + "".join(cells))
    print("PSNR in dB and SSIM of whole panoramas, weighted by latitude")
