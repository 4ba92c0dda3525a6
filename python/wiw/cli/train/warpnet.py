# SPDX-License-Identifier: Apache-2.0
"""`wiw train warpnet`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import NO_LIMITS, VAL_SCENES, Count, Limits, check_counts, drop_none, write_weights
from wiw.training.preparation import PREPARATION, Preparation


def train_warpnet(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("warpnet.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:80",
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    places: Count = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
    preparation: Annotated[Preparation, arg(name="")] = PREPARATION,
) -> int:
    """Train warpnet, a world model for navigation that predicts the panorama seen from a place nearby.

    $ wiw train warpnet --out warpnet.safetensors
    $ wiw run imagenav --world-model warpnet --world-model-option weights=warpnet.safetensors

    Walks through the scenes are rendered and cached first, so that an interrupted command does not render them again.
    Training takes 15 to 30 minutes on two idle cores. FILE also holds the recipe, and PSNR and SSIM on the val scenes,
    next to copy and warp. The weights shipped with wiw were trained by this command with its defaults.

    Args:
        out: File for the weights (safetensors).
        scenes: Training scenes: apartments:train[:N], a mesh, a Gazebo world or scans, as in `wiw run`.
        val: Held-out scenes for evaluation; none may be trained on.
        places: Walks recorded per scene. Default: 24.
        epochs: Number of epochs: how often each sample is used, on average. Default: 6.
        limits: Time limit and seed.
        preparation: How training data is prepared.
    """
    from wiw.world_models.devices import require
    from wiw.world_models.warpnet.model import WarpNet

    check_counts(places=places, epochs=epochs)
    require(WarpNet.requires)
    with write_weights("warpnet", out):
        from wiw.training import warpnet as training
        from wiw.training.walks import WalkRules

        rules = WalkRules(**drop_none({"places": places}))
        recipe = training.Recipe(**drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = training.make_weights(
                out, scenes, val, rules, recipe, limits.minutes, preparation, progress, track_items
            )
        _report(card)
    return 0


def _report(card: Mapping[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['ways']} walks, {card['recipe']['epochs']} epochs; held out: {held_out['ways']} walks")
    print(f"{'steps of 0.2 m ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [f"{held_out['psnr'][name][n]:8.1f} {held_out['ssim'][name][n]:6.3f}" for n in held_out["psnr"][name]]
        print(f"  {name:<18}" + "".join(cells))
    print("PSNR in dB and SSIM of whole panoramas, weighted by latitude")
