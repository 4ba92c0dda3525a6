# SPDX-License-Identifier: Apache-2.0
"""A tiny navigation dataset, tiny recipes on it, and trainers of tiny networks."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from folders import contents

import tiny_pipelines
from tiny_nwm import TinyNWM
from wiw.datasets.navigation import META
from wiw.datasets.navigation_files import (
    FORMAT,
    SEGMENTS,
    build_table,
    describe_file,
    navigation_schema,
    write_frames,
    write_segment_list,
)
from wiw.datasets.navigation_segment import NavigationSegment, encode_color
from wiw.datasets.parquet_files import MANIFEST
from wiw.networks import single_thread
from wiw.training.post_training.corpora import open_corpus
from wiw.training.post_training.families import PretrainedWeights, find_family
from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
from wiw.training.post_training.sampling import TrainingSampler
from wiw.training.post_training.train import post_train
from wiw.training.post_training.trainer import PostTrainer

FRAMES = {"svd-action": 3, "ltx-action": 9, "nwm-action": 6}
SIZES = {"svd-action": (64, 128), "ltx-action": (64, 128), "nwm-action": (48, 48)}
SCENES = ("flat", "loft", "house")


def save_dataset(
    folder: Path,
    frames: int = 12,
    projection: str = "equirectangular",
    scenes: Sequence[str] = SCENES,
    height: float = 1.0,
    split: str = "train",
) -> Path:
    """Coloured panoramas that brighten ahead and roll with turns, in the files of `wiw collect navigation`."""
    folder.mkdir(parents=True, exist_ok=True)
    segments = [_make_segment(scene, number, frames) for number, scene in enumerate(scenes)]
    schema = navigation_schema(False, {})
    write_frames(folder / "frames.parquet", schema, [build_table(each, schema) for each in segments])
    rows = [_list_segment(each, group) for group, each in enumerate(segments)]
    write_segment_list(folder / SEGMENTS, rows)
    camera = {"projection": projection, "size": [64, 128], "height_m": height}
    files = {"frames.parquet": describe_file(folder / "frames.parquet", frames * len(scenes))}
    meta = {"format": FORMAT, "split": split, "camera": camera, "files": files}
    (folder / META).write_text(json.dumps(meta))
    (folder / MANIFEST).write_text(json.dumps({"what": "navigation"}))
    return folder


def _make_segment(scene: str, number: int, frames: int) -> NavigationSegment:
    random = np.random.default_rng(number)
    room = np.kron(random.integers(40, 180, (4, 8, 3)), np.ones((16, 16, 1))).astype(np.uint8)
    actions = np.concatenate([[0], random.integers(1, 4, frames - 1)]).astype(np.int8)
    heading = np.cumsum(np.select([actions == 2, actions == 3], [8, -8], 0))
    steps = np.cumsum(actions == 1)
    shown = [np.roll(np.clip(room + 6 * k, 0, 255).astype(np.uint8), h, 1) for k, h in zip(steps, heading, strict=True)]
    return NavigationSegment(
        scene=scene,
        pass_index=0,
        island=0,
        segment=number,
        seed=0,
        height=1.0,
        actions=actions,
        poses=np.tile(np.eye(4), (frames, 1, 1)),
        sources=np.arange(frames, dtype=np.int32),
        rolls=np.zeros(frames, np.int32),
        encoded_images=tuple(encode_color(image, True) for image in shown),
        encoded_depths=None,
    )


def _list_segment(segment: NavigationSegment, group: int) -> dict[str, Any]:
    counts = {"forward": 0, "turn_left": 0, "turn_right": 0}
    return {
        "scene": segment.scene,
        "pass": 0,
        "island": 0,
        "segment": segment.segment,
        "file": "frames.parquet",
        "row_group": group,
        "frames": len(segment),
        "pictures": len(segment),
        **counts,
        "ending": "reached",
    }


def tiny_recipe(name: str, **changes: Any) -> PostTrainingRecipe:
    """The shipped recipe with clips and batches as small as the tiny networks."""
    small = {
        "frames": FRAMES.get(name, 5),
        "size": SIZES.get(name, (32, 64)),
        "batch": 4,
        "rows": 2,
        "clips": 4,
        "epochs": 2,
        "precision": "float32",
    }
    if load_recipe(name).lora:
        small["lora"] = 4
    return load_recipe(name, options={**small, **changes})


def save_stock(folder: Path, name: str) -> Path:
    """Write tiny random weights of what a model is trained from below a folder, once."""
    base = name.removesuffix("-action")
    if not (folder / base).exists():
        if base == "nwm":
            TinyNWM().save_pretrained(folder / base)
        else:
            tiny_pipelines.save(base, folder / base)
    return folder / base


def make_trainer(name: str, data: Path, weights: Path, **changes: Any) -> PostTrainer:
    """A trainer at its first step."""
    family = find_family(name)
    corpus, recipe = family.fit(open_corpus(data, "all"), tiny_recipe(name, **changes))
    loaded = family.load(corpus, recipe, PretrainedWeights(str(weights), device="cpu"))
    return PostTrainer(loaded.model, corpus.clips(loaded.recipe.frames), loaded.recipe)


def with_nightly(names: Sequence[str], always: Sequence[str]) -> list[Any]:
    """Names as parameters of a test; those that are not in `always` are run nightly."""
    return [pytest.param(name, marks=[] if name in always else [pytest.mark.nightly]) for name in names]


def read_log(out: Path) -> list[dict[str, Any]]:
    """The lines of a training's log."""
    return [json.loads(line) for line in (out.with_name(f"{out.name}.log") / "metrics.jsonl").read_text().splitlines()]


def require_same_bytes_when_stopped_at_sample(
    call: int, step: int, train: Callable[[Path], Any], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Train once, and once with Ctrl-C while the model is sampled for the `call`-th time, in the validation at a step:
    checkpoint and log are the same.
    """
    train(folder / "whole")
    stock, calls = TrainingSampler.__call__, []

    def stop(self: Any, *asked: Any) -> Any:
        calls.append(len(calls))
        if len(calls) == call:
            os.kill(os.getpid(), signal.SIGINT)
        return stock(self, *asked)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in a shell's background ignores it
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(TrainingSampler, "__call__", stop)
        train(folder / "stopped")
    signal.signal(signal.SIGINT, handler)
    assert torch.load(folder / "stopped.checkpoint", weights_only=True)["step"] == step
    train(folder / "stopped")
    assert contents(folder / "whole") == contents(folder / "stopped")
    logs = [[{**line, "seconds": 0} for line in read_log(folder / name)] for name in ("whole", "stopped")]
    assert logs[0] == logs[1]


def require_sampling_unnoticed(plain: PostTrainer, sampled: PostTrainer, sample: Callable[[], Any]) -> None:
    """Train two equal trainers, one of which is sampled before and after its steps: the same weights to the last bit,
    random states and modes of networks.
    """
    before = torch.random.get_rng_state()
    for _ in range(plain.steps_per_epoch * 2):
        plain.train_step(1e-3)
        sample()
        sampled.train_step(1e-3)
    sample()
    assert torch.equal(torch.random.get_rng_state(), before)
    assert all(torch.equal(value, sampled.trained[key]) for key, value in plain.trained.items())
    modes = [
        [layer.training for network in trainer.model.list_networks() for layer in network.modules()]
        for trainer in (plain, sampled)
    ]
    assert modes[0] == modes[1]


def run_in_a_process(work: Callable[..., Any], *arguments: Any, **options: Any) -> int:
    """Call a function in a process of its own; return the exit code (negative: the signal).

    The process is forked, as it would import for seconds. Beside an accelerator autograd does not survive a fork.
    """
    context = multiprocessing.get_context("spawn" if torch.accelerator.is_available() else "fork")
    process = context.Process(target=work, args=arguments, kwargs=options, daemon=True)
    process.start()
    process.join(300)
    assert process.exitcode is not None, "it has not ended"
    return process.exitcode


def train_until_killed(step: int, *arguments: Any, **options: Any) -> None:
    """Post-train, with the state written after each step, and die at one of them, before its state is written."""

    def die(now: int, *_: Any) -> None:
        if now == step:
            os.kill(os.getpid(), signal.SIGKILL)

    cv2.setNumThreads(0)  # threads of a forked process are not there
    with single_thread():
        post_train(*arguments, seconds=0, on_step=die, **options)
