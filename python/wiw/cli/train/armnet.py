# SPDX-License-Identifier: Apache-2.0
"""`wiw train armnet`."""

from __future__ import annotations

from collections.abc import Mapping
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
    moves, and by what happens to each object. The weights shipped with wiw were trained by this command with its
    defaults.

    Args:
        out: File for the weights (safetensors).
        plays: Number of simulated plays, of eight gripper poses each.
        demonstrations: Folder of `wiw collect manipulation`, for additional data.
        epochs: Number of epochs: how often each sample is used, on average. Default: 4.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.world_models.armnet.model import ArmNet

    check_counts(plays=plays, epochs=epochs)
    ArmNet.requires.require()
    with write_weights("armnet", out):
        from wiw.training.armnet import Recipe
        from wiw.training.armnet_weights import make_weights

        recipe = Recipe(**drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = make_weights(out, plays, demonstrations, recipe, limits.minutes, preparation, progress, track_items)
        _report(card)
    return 0


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
    print(f"{'object':<20}{'the next pose':>30}{'all poses in a row':>30}")
    events = held_out["events"]
    for name, one_pose in events["one_pose"].items():
        cells = [_format_event(figures) for figures in (one_pose, events["free_running"].get(name, {}))]
        print(f"  {name:<18}" + "".join(f"{cell:>30}" for cell in cells))
    print("mean absolute error (of 255) of each object, arm alone -> armnet; sharpness; lamps of the right colour")


def _format_event(figures: Mapping[str, float]) -> str:
    if not figures:
        return "-"
    right = f" {100 * figures['right']:3.0f} %" if "right" in figures else ""
    return f"{figures['arm']:.1f} -> {figures['armnet']:.1f} {figures['sharpness']:.2f}{right}"
