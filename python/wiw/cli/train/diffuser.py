# SPDX-License-Identifier: Apache-2.0
"""`wiw train diffuser`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg

from wiw.cli.train.progress import TrainingProgress, track_items
from wiw.cli.train.small_networks import NO_LIMITS, Count, Limits, check_counts, drop_none, write_weights
from wiw.errors import ArgumentError


def train_diffuser(
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("diffuser.safetensors"),
    demonstrations: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    epochs: Count = None,
    limits: Annotated[Limits, arg(name="")] = NO_LIMITS,
) -> int:
    """Train diffuser, the 3D diffusion policy for manipulation, on demonstrations.

    $ wiw collect manipulation --episodes 120 --frames 16 --depth --wrist --seed 1 --out demos
    $ wiw train diffuser --demonstrations demos --out diffuser.safetensors
    $ wiw run manipulation --preset paper-diffusion --policy-option weights=diffuser.safetensors --arms none,oracle

    Training takes about half an hour on an idle core for 120 demonstrations of each task; repeat an interrupted command
    to resume it. One demonstration in twenty is held out. FILE also holds the recipe, and how often one of ten paths is
    the expert's on these. The weights shipped with wiw were trained by these commands.

    Args:
        out: File for the weights (safetensors).
        demonstrations: Folder of `wiw collect manipulation --depth`. The policy also learns to use the wrist camera if
            they have its views (--wrist). Failed demonstrations (--keep-failed) are left out.
        epochs: Number of epochs: how often each sample is used, on average. Default: 40.
        limits: Time limit and seed.
    """
    from wiw.policies.diffuser.policy import require_torch

    check_counts(epochs=epochs)
    require_torch()
    with write_weights("diffuser", out):
        if demonstrations is None:
            raise ArgumentError(
                "diffuser trains on demonstrations; give a folder of `wiw collect manipulation --depth` with "
                "--demonstrations"
            )
        from wiw.training.diffuser import Recipe
        from wiw.training.diffuser_weights import make_weights

        recipe = Recipe(**drop_none({"epochs": epochs, "seed": limits.seed}))
        with TrainingProgress() as progress:
            card = make_weights(out, demonstrations, recipe, limits.minutes, progress, track_items)
        _report(card)
    return 0


def _report(card: Mapping[str, Any]) -> None:
    from wiw.training.diffuser_paths import PATHS

    found = card["found"]
    left_out = f", {card['failed']} failed demonstrations left out" if "failed" in card else ""
    print(f"{card['moments']} samples, {card['recipe']['epochs']} epochs{left_out}")
    if not found:
        return
    near = ", ".join(f"one of {paths} for {100 * found[f'near/{paths}']:.0f} %" for paths in PATHS)
    print(
        f"held out  a path is the expert's, of {card['held out']} samples: {near}; the nearest of {max(PATHS)} is "
        f"{1000 * found['off']:.0f} mm off, two paths end {1000 * found['spread']:.0f} mm apart"
    )
