# SPDX-License-Identifier: Apache-2.0
"""`wiw train armnet`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import NO_LIMITS, Count, Limits, check_counts, drop_none, write_weights
from wiw.training.preparation import PREPARATION, Preparation


def train_armnet(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("armnet.safetensors"),
    plays: Annotated[int, arg(metavar="N")] = 2000,
    demonstrations: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train armnet, a world model for manipulation that predicts the front view after each gripper pose of a plan.

    $ wiw train armnet --out armnet.safetensors
    $ wiw run manipulation --world-model armnet --world-model-option weights=armnet.safetensors

    Plays are simulated at the tables of the manipulation tasks and cached first, so that an interrupted command does
    not simulate them again. Training takes 15 to 30 minutes on two idle cores; repeat an interrupted command to resume
    it. FILE also holds the recipe, and errors on held-out plays, next to copy and to a table where nothing but the arm
    moves. The weights shipped with wiw were trained by this command with its defaults.

    Args:
        out: File for the weights (safetensors).
        plays: Number of simulated plays, of eight gripper poses each.
        demonstrations: Folder of `wiw collect manipulation`, for additional data.
        epochs: Number of epochs: how often each sample is used, on average. Default: 4.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.world_models.armnet.model import ArmNet
    from wiw.world_models.devices import require

    check_counts(plays=plays, epochs=epochs)
    require(ArmNet.requires)
    with write_weights("armnet", out):
        _train(out, plays, demonstrations, limits, preparation, drop_none({"epochs": epochs, "seed": limits.seed}))
    return 0


def _train(
    out: Path,
    count: int,
    demonstrations: Path | None,
    limits: Limits,
    preparation: Preparation,
    recipe_options: Mapping[str, Any],
) -> None:
    from wiw.datasets.demonstrations import read_manifest
    from wiw.networks import single_thread
    from wiw.training import armnet as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.plays import gather_plays, merge_plays, read_demonstration_plays
    from wiw.world_models.armnet.weights import load, save

    recipe, seed, gathering = training.Recipe(**recipe_options), limits.seed, preparation.list_arguments(track_items)
    plays = gather_plays(count, seed, **gathering)
    held_out = gather_plays(training.HELD_OUT, seed + training.HELD_OUT_SEED_OFFSET, **gathering)
    card: dict[str, Any] = {"plays": len(plays), "demonstrations": 0}
    if demonstrations is not None:
        demonstrated = read_demonstration_plays(demonstrations)
        card |= {"demonstrations": len(demonstrated), "collection": read_manifest(demonstrations)}
        plays = merge_plays([plays, demonstrated])
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": limits.minutes})
    with single_thread(), TrainingProgress() as progress:
        network, recipe = training.train(plays, recipe, limits.minutes, progress, checkpoint)
    card["recipe"] = asdict(recipe)
    save(out, network, card)  # before the evaluation, which takes another minute
    network = load(out)[0]  # as it is stored, in half precision
    card["held_out"] = training.evaluate(network, held_out)
    save(out, network, card)
    checkpoint.remove()
    _report(card)


def _report(card: Mapping[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['plays']} plays, {card['recipe']['epochs']} epochs; held out: {held_out['plays']} plays")
    print(f"{'poses ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [
            f"{held_out['changed'][name][n]:8.1f} {held_out['psnr'][name][n]:6.1f}" for n in held_out["psnr"][name]
        ]
        print(f"  {name:<18}" + "".join(cells))
    print("mean absolute error (of 255) of changed pixels, and PSNR in dB of the window around the table")
