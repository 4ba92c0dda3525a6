# SPDX-License-Identifier: Apache-2.0
"""`wiw train diffuser`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
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
            they have its views (--wrist).
        epochs: Number of epochs: how often each sample is used, on average. Default: 40.
        limits: Time limit and seed.
    """
    from wiw.policies.diffuser import require_torch

    check_counts(epochs=epochs)
    require_torch()
    with write_weights("diffuser", out):
        _train(out, demonstrations, limits.minutes, drop_none({"epochs": epochs, "seed": limits.seed}))
    return 0


def _train(out: Path, demonstrations: Path | None, minutes: float | None, recipe_options: Mapping[str, Any]) -> None:
    from wiw.datasets.demonstrations import Demonstrations
    from wiw.envs.sensors import Sensors
    from wiw.networks import single_thread
    from wiw.policies.diffuser.weights import save
    from wiw.policies.diffuser.workspace import PinholeCamera
    from wiw.training import diffuser as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.diffuser_paths import measure_paths

    if demonstrations is None:
        raise ArgumentError(
            "diffuser trains on demonstrations; give a folder of `wiw collect manipulation --depth` with "
            "--demonstrations"
        )
    collection, recipe = Demonstrations(demonstrations), training.Recipe(**recipe_options)
    if collection.config.get("size") != Sensors.size:
        raise ArgumentError(
            f"--demonstrations: diffuser needs views of {Sensors.size} x {Sensors.size} pixels, got demonstrations of "
            f"{collection.config.get('size')}; collect with --size {Sensors.size}"
        )
    camera = PinholeCamera(collection.camera.intrinsics, collection.camera.T_world_camera)
    read = track_items(collection, "reading", len(collection))
    samples, held_out = training.extract_samples(read, camera, collection.wrist_intrinsics).hold_out()
    card: dict[str, Any] = {"demonstrations": collection.config, "moments": len(samples), "held out": len(held_out)}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": minutes})
    with single_thread(), TrainingProgress() as progress:
        network, recipe = training.train(samples, recipe, minutes, progress, checkpoint)
        found = measure_paths(network, held_out) if len(held_out) else {}
    save(out, network, {**card, "recipe": asdict(recipe), "found": found})
    checkpoint.remove()
    print(f"{len(collection)} demonstrations, {len(samples)} samples, {recipe.epochs} epochs")
    if found:
        _report(found, len(held_out))


def _report(found: Mapping[str, float], count: int) -> None:
    from wiw.training.diffuser_paths import PATHS

    near = ", ".join(f"one of {paths} for {100 * found[f'near/{paths}']:.0f} %" for paths in PATHS)
    print(
        f"held out  a path is the expert's, of {count} samples: {near}; the nearest of {max(PATHS)} is "
        f"{1000 * found['off']:.0f} mm off, two paths end {1000 * found['spread']:.0f} mm apart"
    )
