# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME-action`: post-training of video generators."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from wiw.cli.bars import Bars
from wiw.cli.stop import announce_resume

VideoName = Literal[
    "svd-action",
    "ltx-action",
    "wan2.1-action",
    "wan2.2-5b-action",
    "wan2.2-a14b-action",
    "cosmos-predict2-action",
]
VIDEO: tuple[str, ...] = get_args(VideoName)
"""World models that are video generators trained to follow actions."""
LINE_SECONDS = 60.0
"""Time between two lines of progress where the output is no terminal."""


def train_video(
    name: str,
    out: Path,
    data: Path | None,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    weights: Mapping[str, Any],
) -> int:
    """Post-train a video generator and print where its checkpoint is.

    Args:
        name: of the world model.
        out: folder of the checkpoint.
        data: folder of the dataset.
        recipe: YAML file on top of the shipped recipe.
        pairs: KEY=VALUE of the recipe, on top of both.
        numbers: of the recipe that have flags of their own.
        weights: which weights of the stock generator, on which device; part of the dataset.

    Raises:
        ArgumentError: no data; see also `wiw.training.post_training.train.post_train`.
    """
    from wiw.runs.part_options import parse_options
    from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
    from wiw.training.post_training.train import choose_precision, post_train

    folder = require_data(name, data)
    options = {**numbers, **parse_options(pairs, PostTrainingRecipe, "--option")}
    chosen = load_recipe(name, recipe, options)
    if "precision" not in options:
        chosen = choose_precision(chosen, weights.get("device"))
    began = time.monotonic()
    with announce_resume(), TrainingProgress(chosen.batch) as progress:
        card = post_train(name, folder, out, recipe=chosen, on_step=progress, **weights)
    print(f"{card['steps']:,} steps of {chosen.batch} clips, loss {card['loss']:.4f}, {time.monotonic() - began:.0f} s")
    print(f"checkpoint  {out}")
    shown = " ".join(f"--world-model-option {pair}" for pair in (f"checkpoint={out}", *_list_shape(name, card)))
    print(f"run it:     wiw run imagenav --world-model {name} {shown}")
    return 0


def require_data(name: str, data: Path | None) -> Path:
    """Return the folder of the dataset.

    Raises:
        ArgumentError: there is none.
    """
    from wiw.errors import ArgumentError

    if data is None:
        raise ArgumentError(
            f"{name} trains on a navigation dataset; give a folder of `wiw collect navigation` by --data"
        )
    return data


def _list_shape(name: str, card: Mapping[str, Any]) -> list[str]:
    """Return size and frames of the clips as options of the world model, where they are not its own."""
    from wiw.training.post_training.recipe import load_recipe

    usual = load_recipe(name).describe()
    return [f"'{key}={card['recipe'][key]}'" for key in ("size", "frames") if card["recipe"][key] != usual[key]]


class TrainingProgress:
    """Steps, loss, clips per second and memory: a bar with the time left, or a line a minute."""

    def __init__(self, batch: int) -> None:
        self._batch, self._bars = batch, Bars()

    def __enter__(self) -> TrainingProgress:
        self._bars.__enter__()
        self._began = self._said = time.monotonic()
        self._first: int | None = None
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.__exit__()

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


def _describe_memory() -> str:
    """Return the most memory used so far, of the GPU if there is one."""
    import resource

    import torch

    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return f"{torch.cuda.max_memory_allocated() / 2**30:.1f} GB of GPU memory"
    scale = 1 if sys.platform == "darwin" else 1024
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 2**30:.1f} GB of memory"
