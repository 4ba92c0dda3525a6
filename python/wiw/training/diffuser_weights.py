# SPDX-License-Identifier: Apache-2.0
"""Weights of the diffusion policy, from a folder of demonstrations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from wiw.datasets.demonstrations import Demonstrations
from wiw.envs.sensors import Sensors
from wiw.errors import ArgumentError
from wiw.networks import single_thread
from wiw.policies.diffuser.weights import save
from wiw.policies.diffuser.workspace import PinholeCamera
from wiw.training.checkpoint import Checkpoint, require_unfinished
from wiw.training.diffuser import Recipe, Samples, extract_samples, train
from wiw.training.diffuser_paths import measure_paths
from wiw.training.preparation import ProgressBar, show_no_bar


def make_weights(
    out: Path,
    demonstrations: Path,
    recipe: Recipe = Recipe(),
    minutes: float | None = None,
    on_step: Callable[[int, int, float], None] = lambda step, steps, loss: None,
    bar: ProgressBar = show_no_bar,
) -> dict[str, Any]:
    """Train on demonstrations, or resume, evaluate on those held out, and write the weights; return the file's card.

    Args:
        out: file of the weights; the state of training is kept beside it.
        demonstrations: folder of `wiw collect manipulation`, with depth.
        recipe: how to train.
        minutes: if given, reduces the number of epochs so that training takes about this long.
        on_step: called after each step with its number, the number of all steps and a running mean of the loss.
        bar: shows the progress of reading.

    Raises:
        ArgumentError: demonstrations without depth, of views in another size, or that all failed; finished weights in
            the file, or a state of another training.
        TrainingError: the loss or a gradient is not finite.
        FileError: demonstrations are missing or damaged, or a file cannot be written.
    """
    require_unfinished(out)
    collection = Demonstrations(demonstrations)
    samples, held_out = _read_samples(collection, bar).hold_out()
    card: dict[str, Any] = {"demonstrations": collection.config, "moments": len(samples), "held out": len(held_out)}
    card |= {"failed": samples.failed} if samples.failed else {}
    checkpoint = Checkpoint.beside(out, {**card, "recipe": asdict(recipe), "minutes": minutes})
    with single_thread():
        network, recipe = train(samples, recipe, minutes, on_step, checkpoint)
        found = measure_paths(network, held_out) if len(held_out) else {}
    card |= {"recipe": asdict(recipe), "found": found}
    save(out, network, card)
    checkpoint.remove()
    return card


def _read_samples(collection: Demonstrations, bar: ProgressBar) -> Samples:
    if collection.config.get("size") != Sensors.size:
        raise ArgumentError(
            f"--demonstrations: diffuser needs views of {Sensors.size} x {Sensors.size} pixels, got demonstrations of "
            f"{collection.config.get('size')}; collect with --size {Sensors.size}"
        )
    camera = PinholeCamera(collection.camera.intrinsics, collection.camera.T_world_camera)
    return extract_samples(bar(collection, "reading", len(collection)), camera, collection.wrist_intrinsics)
