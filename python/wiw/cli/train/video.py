# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME-action`: post-training of video generators and of NWM, one command each."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from wiw.cli.bars import Bars
from wiw.cli.options import Options
from wiw.cli.stop import announce_resume
from wiw.cli.train.corpus import TrackerName, describe_steps, require_data
from wiw.cli.train.progress import TrainingProgress
from wiw.cli.train.small_networks import Count, check_counts, check_seed, drop_none
from wiw.errors import ArgumentError
from wiw.networks import resolve_device
from wiw.ray_cluster import HERE, Engine
from wiw.training.launcher import ProcessLayout
from wiw.training.save_signal import hold_save_signal

if TYPE_CHECKING:
    from wiw.training.post_training.recipe import PostTrainingRecipe

VIDEO: Mapping[str, str] = {
    "svd-action": "Stable Video Diffusion",
    "ltx-action": "LTX-Video",
    "wan2.1-action": "Wan2.1",
    "wan2.2-5b-action": "Wan2.2 5B",
    "wan2.2-a14b-action": "Wan2.2 A14B",
    "cosmos-predict2-action": "Cosmos-Predict2",
    "nwm-action": "Navigation World Models",
}
"""Pretrained models that can be post-trained to follow actions: titles by name."""
RUN_AS: Mapping[str, str] = {"nwm-action": "nwm"}
"""World models whose name differs from the name they are trained under."""
GIVEN_AS: Mapping[str, str] = {"nwm-action": "weights"}
"""Options by which they take the checkpoint, where it is not `checkpoint`."""
ALSO_ARM = " or `wiw collect manipulation`"
ONE_PROCESS = ProcessLayout()


def make_command(name: str) -> Callable[..., int]:
    """Return the command that post-trains one of `VIDEO`."""

    def train_video(
        *,
        data: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
        out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
        weights: Annotated[str | None, arg(metavar="DIR|HUB", help_behavior_hint="")] = None,
        recipe: Annotated[Path | None, arg(metavar="YAML", help_behavior_hint="")] = None,
        option: Options = (),
        device: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None,
        part: Literal["train", "all"] = "train",
        validation: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
        decisions: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
        tracker: TrackerName | None = None,
        epochs: Count = None,
        seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None,
        cache: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
        encode_only: bool = False,
        workers: Count = None,
        place: Annotated[Engine, arg(name="")] = HERE,
        layout: Annotated[ProcessLayout, arg(name="")] = ONE_PROCESS,
        dry_run: bool = False,
    ) -> int:
        with hold_save_signal():
            check_counts(epochs=epochs, workers=workers)
            check_seed(seed)
            numbers = drop_none({"epochs": epochs, "seed": seed})
            parts: dict[str, Any] = {"weights": weights, "device": device, "part": part}
            if encode_only:
                unused = {"--out": out, "--validation": validation, "--decisions": decisions, "--tracker": tracker}
                _require_encoding(unused, layout, dry_run)
                return _encode(name, data, cache, recipe, option, numbers, parts, workers or 1, place)
            if workers is not None or place != HERE:
                raise ArgumentError("train: --workers and --engine are for --encode-only; --gpus is for training")
            parts |= {"cache": cache, "validation": validation, "decisions": decisions, "tracker": tracker}
            return _post_train(name, out or Path(name), data, recipe, option, numbers, parts, layout, dry_run)

    train_video.__doc__ = (
        HELP.replace("TITLE", VIDEO[name])
        .replace("NAME", name)
        .replace("RUN", RUN_AS.get(name, name))
        .replace("GIVEN", GIVEN_AS.get(name, "checkpoint"))
    )
    return train_video


HELP = """Post-train TITLE, starting from pretrained weights, to follow actions.

    $ wiw collect navigation --scenes apartments:train:80 --out data
    $ wiw train NAME --data data --out runs/mine
    $ wiw run imagenav --world-model RUN --world-model-option GIVEN=runs/mine
    $ wiw train NAME --data data --weights /models/pretrained --option clips=1600 --out runs/short
    $ wiw train NAME --data data --gpus 8 --out runs/mine
    $ wiw train NAME --data data --option shard=true --nodes 2 --gpus 8 --partition gpu --out runs/mine
    $ wiw train NAME --data data --cache latents --encode-only --engine ray --workers 8 --worker-gpus 1
    $ wiw train NAME --data data --cache latents --out runs/mine

    It learns to follow an agent's actions from a dataset of `wiw collect navigation` or, except for nwm-action, gripper
    poses from one of `wiw collect manipulation`. This requires a GPU; docs/post-training.md explains recipes and
    requirements. Repeat an interrupted command to resume it; SIGUSR1 writes the checkpoint at once.

    Args:
        data: Dataset of `wiw collect navigation` or `wiw collect manipulation`.
        out: Folder for the checkpoint: new, or that of an interrupted training. Default: NAME.
        weights: Pretrained weights to start from: a folder written by save_pretrained, or a name on the Hugging Face
            hub. Default: those of the world model.
        recipe: YAML file that overrides values of the built-in recipe.
        option: Override a value of the recipe, such as rate=2e-5, clips=1600 or batch=8; may be repeated. See
            `wiw.training.post_training.recipe.PostTrainingRecipe`.
        device: Torch device. Default: the GPU if there is one.
        part: Part of the dataset to train on: train holds out one in twenty scenes, or demonstrations, for validation.
        validation: Another dataset, with other scenes or demonstrations, for validation during training: PSNR and SSIM
            after 1, 4, 8 and 14 actions, and the control gap. Default: what --part train holds out.
        decisions: File of `wiw collect decisions`, with which the validation of a model for navigation also measures
            how well its ranking of the plans agrees with the true one.
        tracker: Experiment tracker that plots loss and validation; requires its package. OUT.log/metrics.jsonl has the
            same data in any case.
        epochs: Number of epochs: how often each clip is used, on average. Default: 1.
        seed: Seed of the order of clips and of the weights. Default: that of the recipe, 0.
        cache: Folder for clips as encoded by the frozen networks, for later epochs and other trainings. Default: none.
        encode_only: Only encode the training clips into --cache; train nothing.
        workers: Number of processes that encode clips for --encode-only. Default: 1.
        place: Where these processes run; with engine ray, all machines must see --data and --cache.
        layout: Processes of the training.
        dry_run: For several GPUs: print the command to run on each machine; train nothing.
    """


def _post_train(
    name: str,
    out: Path,
    data: Path | None,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    parts: Mapping[str, Any],
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
        parts: pretrained weights and device; part of the data; validation data; folder of encoded clips.
        layout: how many processes run, and where.
        dry_run: whether to print torchrun's command and train nothing.

    Returns:
        The exit code; if there are several processes, that of the first one that failed.

    Raises:
        ArgumentError: no data, or a recipe whose steps cannot be split among the processes; see also
            `wiw.training.post_training.train.post_train`.
        DependencyError, InfrastructureError: see `wiw.training.launcher.submit_job`.
    """
    _require_packages(name)
    folder = require_data(name, data, ALSO_ARM)
    is_launched = dry_run or layout != ONE_PROCESS
    device = (parts.get("device") or "cuda") if is_launched else resolve_device(parts.get("device"))
    chosen = _choose_recipe(name, recipe, pairs, numbers, device)
    if is_launched:  # each process chooses for the machine that it runs on
        flags = {**numbers, **parts, "data": folder, "recipe": recipe, "out": out}
        options = [*flags.items(), *(("option", pair) for pair in pairs)]
        given = [part for key, value in options if value is not None for part in (f"--{key}", str(value))]
        return _launch(["train", name, *given], chosen, layout, out, dry_run)
    return _train(name, folder, out, chosen, parts)


def _require_packages(name: str) -> None:
    from wiw.registry import WORLD_MODELS

    WORLD_MODELS.find(RUN_AS.get(name, name)).requires.require()


def _train(name: str, data: Path, out: Path, recipe: PostTrainingRecipe, parts: Mapping[str, Any]) -> int:
    from wiw.training.post_training import distributed
    from wiw.training.post_training.train import post_train

    began = time.monotonic()
    with distributed.join_processes(), announce_resume(distributed.is_main()):
        with TrainingProgress(recipe.batch, "clips") as progress:
            card = post_train(
                name, data, out, recipe=recipe, on_step=progress, on_validation=progress.show_validation, **parts
            )
        if distributed.is_main():
            print(f"{describe_steps(card, recipe.batch)}, {time.monotonic() - began:.0f} s")
            print(f"log         {out}.log")
            print(f"checkpoint  {out}")
            print(f"run it:     {_write_command(out, card['run'])}")
    return 0


def _require_encoding(unused: Mapping[str, Any], layout: ProcessLayout, dry_run: bool) -> None:
    """Refuse options of a training that encoding its clips does not read, `unused` and those of processes."""
    given = [flag for flag, value in unused.items() if value is not None]
    given += ["--gpus, --nodes or --partition"] if layout != ONE_PROCESS else []
    given += ["--dry-run"] if dry_run else []
    if given:
        raise ArgumentError(
            f"train: {given[0]} has no effect with --encode-only, which trains nothing; leave it out (--workers and "
            "--engine say where clips are encoded)"
        )


def _encode(
    name: str,
    data: Path | None,
    cache: Path | None,
    recipe: Path | None,
    pairs: Sequence[str],
    numbers: Mapping[str, Any],
    parts: Mapping[str, Any],
    workers: int,
    place: Engine,
) -> int:
    """Encode the clips of a model's training into a folder; arguments as of `_post_train`.

    Raises:
        ArgumentError: no data or no folder; see also `wiw.training.post_training.encode_clips.encode_clips`.
    """
    from wiw.training.post_training.encode_clips import choose_encoding_device, encode_clips

    folder = require_data(name, data, ALSO_ARM)
    if cache is None:
        raise ArgumentError("train: --encode-only writes encoded clips into a folder; name it with --cache")
    device = choose_encoding_device(place, parts.get("device"))
    chosen, began = _choose_recipe(name, recipe, pairs, numbers, device), time.monotonic()
    with announce_resume(), Bars() as bars:

        def show(done: int, total: int) -> None:
            bars.show("clips", done, total, f"{done}/{total}")

        count = encode_clips(name, folder, cache, recipe=chosen, workers=workers, place=place, progress=show, **parts)
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
    name: str, file: Path | None, pairs: Sequence[str], numbers: Mapping[str, Any], device: str
) -> PostTrainingRecipe:
    """Return the recipe with what files and options say, in a precision for a device unless they name one."""
    from wiw.mapping_files import read_yaml_mapping
    from wiw.runs.part_options import parse_options
    from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
    from wiw.training.post_training.train import choose_precision

    options = {**numbers, **parse_options(pairs, PostTrainingRecipe, "--option")}
    chosen = load_recipe(name, file, options)
    named = {*options, *(read_yaml_mapping(file, "a recipe, `name: value` lines") if file else ())}
    return chosen if "precision" in named else choose_precision(chosen, device)


def _write_command(out: Path, run: Mapping[str, Any]) -> str:
    """Return the command that runs a checkpoint."""
    options = {run["checkpoint"]: out, **run["options"]}
    pairs = [shlex.quote(f"{key}={value}") for key, value in options.items()]
    shown = " ".join(f"--world-model-option {pair}" for pair in pairs)
    return f"wiw run {run['task']} --world-model {run['world_model']} {shown}"
