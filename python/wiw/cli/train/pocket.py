# SPDX-License-Identifier: Apache-2.0
"""`wiw train pocket`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg

from wiw.cli.options import Options
from wiw.cli.train.corpus import TrackerName, describe_steps, require_data
from wiw.cli.train.on_clips import train_and_measure
from wiw.cli.train.small_networks import VAL_SCENES, Count, check_counts, check_seed, drop_none, write_weights
from wiw.training.preparation import Preparation
from wiw.training.save_signal import hold_save_signal


def train_pocket(
    *,
    data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    out: Annotated[Path, arg(metavar="FILE")] = Path("pocket.safetensors"),
    val: Annotated[str, arg(metavar="SPEC")] = VAL_SCENES,
    recipe: Annotated[Path | None, arg(metavar="YAML", help_behavior_hint="")] = None,
    option: Options = (),
    part: Literal["train", "all"] = "train",
    validation: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    decisions: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    tracker: TrackerName | None = None,
    device: Annotated[str | None, arg(metavar="DEVICE", help_behavior_hint="")] = None,
    epochs: Count = None,
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None,
    cache: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
) -> int:
    """Train pocket, a world model for navigation: a small video diffusion model that generates all views of a plan
    together. It starts from random weights.

    $ wiw collect navigation --scenes apartments:train:80 --out data
    $ wiw train pocket --data data --out pocket.safetensors
    $ wiw train pocket --data data --option clips=1600 --out short.safetensors
    $ wiw run imagenav --world-model pocket --world-model-option weights=pocket.safetensors

    Training takes two hours on two idle cores (more beside other programs), minutes on a GPU, less with --option
    clips=N. Repeat an interrupted command to resume it; finished weights are never replaced. SIGUSR1 writes the
    checkpoint at once. FILE also holds the recipe, PSNR on windows of the val scenes, next to baselines without
    learning, and how much of it is lost when given another window's places. The weights shipped with wiw were trained
    on one epoch of 34,932 clips, on a CPU.

    Args:
        data: Dataset of `wiw collect navigation`.
        out: File for the weights (safetensors).
        val: Held-out scenes for evaluation; none may be trained on.
        recipe: YAML file that overrides values of the built-in recipe.
        option: Override a value of the recipe, such as rate=2e-5, clips=1600 or batch=8; may be repeated. See
            `wiw.training.pocket.recipe.PocketRecipe`.
        part: Part of the dataset to train on: train holds out one in twenty scenes for validation.
        validation: Another dataset, with other scenes, for validation during training: PSNR and SSIM after 1, 4, 8 and
            14 actions, and the control gap. Default: the scenes that --part train holds out.
        decisions: File of `wiw collect decisions`, with which validation also measures how well the model's ranking of
            the plans agrees with the true one.
        tracker: Experiment tracker that plots loss and validation; requires its package. OUT.log/metrics.jsonl has the
            same data in any case.
        device: Where to train: cpu, cuda, cuda:1, ... Default: the GPU if there is one.
        epochs: Number of epochs: how often each clip is used, on average. Default: 1.
        seed: Seed of the order of clips and of the weights. Default: that of the recipe, 0.
        cache: Folder for prepared training data, which can be deleted at any time. Default: $WIW_CACHE/looks.
    """
    from wiw.runs.part_options import parse_options
    from wiw.training.pocket.recipe import PocketRecipe
    from wiw.training.post_training.recipe import load_recipe
    from wiw.world_models.pocket.model import Pocket

    check_counts(epochs=epochs)
    check_seed(seed)
    Pocket.requires.require()
    with hold_save_signal(), write_weights("pocket", out):
        from wiw.training.pocket import held_out

        numbers = drop_none({"epochs": epochs, "seed": seed})
        options = {**numbers, **parse_options(option, PocketRecipe, "--option")}
        chosen = load_recipe("pocket", recipe, options, kind=PocketRecipe)
        watched: dict[str, Any] = {
            "part": part,
            "validation": validation,
            "decisions": decisions,
            "tracker": tracker,
            "device": device,
        }
        folder = require_data("pocket", data)
        card = train_and_measure(
            "pocket", out, folder, Preparation(cache=cache).folder, val, chosen, watched, held_out.evaluate
        )
        _report(card)
        print(f"log       {out}.log")
    return 0


def _report(card: Mapping[str, Any]) -> None:
    print(describe_steps(card, card["recipe"]["batch"]))
    for kind, found in card["held_out"].items():
        print(f"{f'{kind}: steps of 0.2 m ahead':<30}" + "".join(f"{step:>8}" for step in found["psnr"]["copy"]))
        for name, values in found["psnr"].items():
            print(f"  {name:<28}" + "".join(f"{values[step]:8.1f}" for step in values))
        if found["gap"]:
            print(f"  {'control gap':<28}" + "".join(f"{value:8.1f}" for value in found["gap"].values()))
    print("PSNR in dB of whole panoramas, weighted by latitude; the gap is the loss when given another window's places")
