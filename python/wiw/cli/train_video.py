# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME-action`: post-training of video generators and of NWM."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from wiw.cli.bars import Bars
from wiw.cli.stop import announce_resume
from wiw.errors import ArgumentError
from wiw.ray_cluster import Engine
from wiw.training.launcher import ProcessLayout

if TYPE_CHECKING:
    from wiw.training.post_training.recipe import PostTrainingRecipe

VideoName = Literal[
    "svd-action",
    "ltx-action",
    "wan2.1-action",
    "wan2.2-5b-action",
    "wan2.2-a14b-action",
    "cosmos-predict2-action",
    "nwm-action",
]
TrackerName = Literal["trackio", "wandb", "tensorboard"]
VIDEO: tuple[str, ...] = get_args(VideoName)
"""Pretrained models that can be post-trained to follow actions."""
RUN_AS: Mapping[str, str] = {"nwm-action": "nwm"}
"""World models whose name differs from the name they are trained under."""
LINE_SECONDS = 60.0
"""Seconds between progress lines if the output is not a terminal."""


def train_video(
    name: str,
    out: Path,
    data: Path | None,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    weights: Mapping[str, Any],
    layout: ProcessLayout,
    dry_run: bool,
) -> int:
    """Post-train a model and print where its checkpoint is, or start several processes that do so.

    Args:
        name: of the model.
        out: folder of the checkpoint.
        data: folder of the dataset.
        recipe: YAML file on top of the shipped recipe.
        pairs: KEY=VALUE overrides of both.
        numbers: values of the recipe that have their own flags.
        weights: pretrained weights and device; part of the data; validation data; folder of encoded clips.
        layout: how many processes run, and where.
        dry_run: whether to print torchrun's command and train nothing.

    Returns:
        The exit code; if there are several processes, that of the first one that failed.

    Raises:
        ArgumentError: no data, or a recipe whose steps cannot be split among the processes; see also
            `wiw.training.post_training.train.post_train`.
        DependencyError, InfrastructureError: see `wiw.training.launcher.submit_job`.
    """
    folder = require_data(name, data, " or `wiw collect manipulation`")
    chosen = _choose_recipe(name, recipe, pairs, numbers, weights)
    if dry_run or layout != ProcessLayout():
        flags = {**numbers, **weights, "data": folder, "recipe": recipe, "out": out}
        options = [*flags.items(), *(("option", pair) for pair in pairs)]
        given = [part for key, value in options if value is not None for part in (f"--{key}", str(value))]
        return _launch(["train", name, *given], chosen, layout, out, dry_run)
    return _train(name, folder, out, chosen, weights)


def _train(name: str, data: Path, out: Path, recipe: PostTrainingRecipe, weights: Mapping[str, Any]) -> int:
    from wiw.training.post_training import distributed
    from wiw.training.post_training.train import post_train

    began = time.monotonic()
    with distributed.join_processes(), announce_resume(distributed.is_main()):
        with TrainingProgress(recipe.batch) as progress:
            card = post_train(
                name, data, out, recipe=recipe, on_step=progress, on_validation=progress.show_validation, **weights
            )
        if distributed.is_main():
            print(f"{describe_steps(card, recipe.batch)}, {time.monotonic() - began:.0f} s")
            print(f"log         {out}.log")
            print(f"checkpoint  {out}")
            print(f"run it:     {_write_command(out, card['run'])}")
    return 0


def encode_video(
    name: str,
    data: Path | None,
    cache: Path | None,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    weights: Mapping[str, Any],
    workers: int,
    place: Engine,
) -> int:
    """Encode the clips of a model's training into a folder; arguments as of `train_video`.

    Raises:
        ArgumentError: no data or no folder; see also `wiw.training.post_training.encode_clips.encode_clips`.
    """
    from wiw.training.post_training.encode_clips import encode_clips

    folder = require_data(name, data, " or `wiw collect manipulation`")
    if cache is None:
        raise ArgumentError("train: --encode-only writes encoded clips into a folder; name it with --cache")
    chosen, began = _choose_recipe(name, recipe, pairs, numbers, weights), time.monotonic()
    with announce_resume(), Bars() as bars:

        def show(done: int, total: int) -> None:
            bars.show("clips", done, total, f"{done}/{total}")

        count = encode_clips(name, folder, cache, recipe=chosen, workers=workers, place=place, progress=show, **weights)
    print(f"{count:,} clips encoded in {time.monotonic() - began:.0f} s: {cache}")
    return 0


def _launch(
    arguments: Sequence[str], recipe: PostTrainingRecipe, layout: ProcessLayout, out: Path, dry_run: bool
) -> int:
    """Run a command in several processes, submit it, or print it; return the exit code."""
    from wiw.training.launcher import require_single_process, run_processes, submit_job, write_command
    from wiw.training.post_training.clip_trainer import require_equal_shares

    require_single_process("--gpus, --nodes, --partition and --dry-run", "leave these options out")
    require_equal_shares(recipe.batch, recipe.rows, layout.count)
    if dry_run:
        print(write_command(arguments, layout))
        return 0
    if not layout.is_job:
        return run_processes(arguments, layout)
    jobs = out.with_name(f"{out.name}.jobs")
    print(f"job {submit_job(arguments, layout, jobs)}, output in {jobs}; repeat the command if it fails")
    return 0


def _choose_recipe(
    name: str, file: Path | None, pairs: Sequence[str], numbers: Mapping[str, Any], weights: Mapping[str, Any]
) -> PostTrainingRecipe:
    from wiw.runs.part_options import parse_options
    from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
    from wiw.training.post_training.train import choose_precision

    options = {**numbers, **parse_options(pairs, PostTrainingRecipe, "--option")}
    chosen = load_recipe(name, file, options)
    return chosen if "precision" in options else choose_precision(chosen, weights.get("device"))


def describe_steps(card: Mapping[str, Any], batch: int) -> str:
    """Describe a training: its length, how it ended, and which weights were best."""
    text = f"{card['trained_steps']:,} steps of {batch} clips, loss {card['loss']:.4f}"
    if "validation" not in card:
        return text
    return f"{text}, best after {card['steps']:,} ({describe_validation(card['validation'])})"


def _write_command(out: Path, run: Mapping[str, Any]) -> str:
    """Return the command that runs a checkpoint."""
    options = {run["checkpoint"]: out, **run["options"]}
    pairs = [shlex.quote(f"{key}={value}") for key, value in options.items()]
    shown = " ".join(f"--world-model-option {pair}" for pair in pairs)
    return f"wiw run {run['task']} --world-model {run['world_model']} {shown}"


def require_data(name: str, data: Path | None, also: str = "") -> Path:
    """Return the folder of the dataset.

    Raises:
        ArgumentError: there is none.
    """
    if data is None:
        raise ArgumentError(f"{name} trains on a dataset; give a folder of `wiw collect navigation`{also} with --data")
    return data


class TrainingProgress:
    """Steps, loss, clips per second and memory: a progress bar with the time left, or one line per minute."""

    def __init__(self, batch: int) -> None:
        self._batch, self._bars = batch, Bars()

    def __enter__(self) -> TrainingProgress:
        self._bars.__enter__()
        self._began = self._said = time.monotonic()
        self._first: int | None = None
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.__exit__()

    def show_validation(self, step: int, found: Mapping[str, float]) -> None:
        """Print the results of a validation."""
        print(f"validation: step {step:,}, {describe_validation(found)}", file=sys.stderr, flush=True)

    def __call__(self, step: int, steps: int, loss: float) -> None:
        now = time.monotonic()
        if self._first is None:  # the first step warms up, and comes after the weights were loaded
            self._first, self._began = step, now
        done = step - self._first
        rate = done / (now - self._began) if done else 0.0
        text = f"step {step:,}/{steps:,}, loss {loss:.4f}, {rate * self._batch:.2f} clips/s, {_describe_memory()}"
        if sys.stderr.isatty():
            self._bars.show("training", step, steps, text)
        elif now - self._said >= LINE_SECONDS or step == steps:
            left = f", {(steps - step) / rate / 60:.0f} min left" if rate and step < steps else ""
            print(f"training: {text}{left}", file=sys.stderr, flush=True)
            self._said = now


def describe_validation(found: Mapping[str, float]) -> str:
    """Return the main figures of a validation."""
    texts = [f"PSNR {found['psnr']:.2f} dB"] if "psnr" in found else []
    if "gap" in found:
        texts.append(f"control gap {found['gap']:.2f} dB")
    if "gap/displacements" in found:
        texts.append(f"gap of displacements {found['gap/displacements']:.2f} dB")
    if "rank" in found:
        texts.append(f"rank agreement {found['rank']:.2f}")
    return ", ".join(texts) or "no clip moves the camera"


def _describe_memory() -> str:
    """Describe the peak memory so far, of the GPU if there is one."""
    import resource

    import torch

    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return f"{torch.cuda.max_memory_allocated() / 2**30:.1f} GB of GPU memory"
    scale = 1 if sys.platform == "darwin" else 1024
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**30:.1f} GB of memory"
