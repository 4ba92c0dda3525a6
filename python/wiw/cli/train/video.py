# SPDX-License-Identifier: Apache-2.0
"""`wiw train NAME-action`: post-training of video generators and of NWM, a command each."""

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
from wiw.ray_cluster import HERE, Engine
from wiw.training.launcher import ProcessLayout

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
"""Pretrained models that are trained to follow actions: titles by name."""
RUN_AS: Mapping[str, str] = {"nwm-action": "nwm"}
"""World models that have another name than they are trained by."""
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
        seed: Annotated[int, arg(metavar="N")] = 0,
        cache: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
        encode_only: bool = False,
        workers: Count = None,
        place: Annotated[Engine, arg(name="")] = HERE,
        layout: Annotated[ProcessLayout, arg(name="")] = ONE_PROCESS,
        dry_run: bool = False,
    ) -> int:
        check_counts(epochs=epochs, workers=workers)
        check_seed(seed)
        numbers = drop_none({"epochs": epochs, "seed": seed or None})
        parts: dict[str, Any] = {"weights": weights, "device": device, "part": part}
        if encode_only:
            return _encode(name, data, cache, recipe, option, numbers, parts, workers or 1, place)
        if workers is not None or place != HERE:
            raise ArgumentError("train: --workers and --engine are for --encode-only; --gpus is for training")
        parts |= {"cache": cache, "validation": validation, "decisions": decisions, "tracker": tracker}
        return _post_train(name, out or Path(name), data, recipe, option, numbers, parts, layout, dry_run)

    train_video.__doc__ = (
        HELP.replace("TITLE", VIDEO[name]).replace("NAME", name).replace("RUN", RUN_AS.get(name, name))
    )
    return train_video


HELP = """Post-train TITLE, with pretrained weights, to follow actions.

    $ wiw collect navigation --scenes apartments:train:80 --out data
    $ wiw train NAME --data data --out runs/mine
    $ wiw run imagenav --world-model RUN --world-model-option checkpoint=runs/mine
    $ wiw train NAME --data data --weights /models/pretrained --option clips=1600 --out runs/short
    $ wiw train NAME --data data --gpus 8 --out runs/mine
    $ wiw train NAME --data data --option shard=true --nodes 2 --gpus 8 --partition gpu --out runs/mine
    $ wiw train NAME --data data --cache latents --encode-only --engine ray --workers 8 --worker-gpus 1
    $ wiw train NAME --data data --cache latents --out runs/mine

    It learns from a dataset of `wiw collect navigation` to follow an agent's actions or, but for nwm-action, from one
    of `wiw collect manipulation` to follow poses of a gripper. This needs a GPU; docs/post-training.md explains recipes
    and needs. Repeat an interrupted command to resume it; SIGUSR1 writes the checkpoint at once.

    Args:
        data: Dataset of `wiw collect navigation` or `wiw collect manipulation`.
        out: New folder of the checkpoint, or that of an interrupted training. Default: NAME.
        weights: Pretrained weights: a folder as save_pretrained writes it, or a name on the Hugging Face hub. Default:
            those of the world model.
        recipe: YAML file with numbers of the recipe, on top of the shipped ones.
        option: Number of the recipe, such as rate=2e-5, clips=1600 or batch=8; may be given again. See
            `wiw.training.post_training.recipe.PostTrainingRecipe`.
        device: Of torch. Default: the GPU if there is one.
        part: Part of the dataset: train leaves out one in twenty scenes, or demonstrations, for validation.
        validation: Another dataset, of other scenes or demonstrations, to validate on while it trains: PSNR and SSIM
            after 1, 4, 8 and 14 actions, and the control gap. Default: those that --part train leaves out.
        decisions: File of `wiw collect decisions`, by which validation of a model that moves also measures how well its
            order of the plans agrees with the true one.
        tracker: Program that draws loss and validation; needs its package. OUT.log/metrics.jsonl has the same in any
            case.
        epochs: How often each clip is used, on average. Default: 1.
        seed: Seed of the order of clips and of the weights.
        cache: Folder of clips as the frozen networks encode them, for later epochs and other trainings. Default: none.
        encode_only: Encode the clips of the training into --cache, and train nothing.
        workers: Processes that encode clips for --encode-only. Default: 1.
        place: Where they are; with engine ray, all machines see --data and --cache.
        layout: Processes of the training.
        dry_run: Print the command that runs on each machine, for several GPUs, and train nothing.
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
    """Post-train a model and print where its checkpoint is, or start several processes that do.

    Args:
        name: of the model.
        out: folder of the checkpoint.
        data: folder of the dataset.
        recipe: YAML file on top of the shipped recipe.
        pairs: KEY=VALUE of the recipe, on top of both.
        numbers: of the recipe that have flags of their own.
        parts: which pretrained weights, on which device; part of the data; what it is validated on; folder of encoded
            clips.
        layout: how many processes, where.
        dry_run: whether to print torchrun's command and to train nothing.

    Returns:
        The exit code: of the process that failed first if there are several.

    Raises:
        ArgumentError: no data, or a recipe whose steps the processes cannot share out; see also
            `wiw.training.post_training.train.post_train`.
        DependencyError, InfrastructureError: see `wiw.training.launcher.submit_job`.
    """
    _require_packages(name)
    folder = require_data(name, data, ALSO_ARM)
    chosen = _choose_recipe(name, recipe, pairs, numbers, parts)
    if dry_run or layout != ONE_PROCESS:
        flags = {**numbers, **parts, "data": folder, "recipe": recipe, "out": out}
        options = [*flags.items(), *(("option", pair) for pair in pairs)]
        given = [part for key, value in options if value is not None for part in (f"--{key}", str(value))]
        return _launch(["train", name, *given], chosen, layout, out, dry_run)
    return _train(name, folder, out, chosen, parts)


def _require_packages(name: str) -> None:
    from wiw.registry import WORLD_MODELS
    from wiw.world_models import devices

    devices.require(WORLD_MODELS.find(RUN_AS.get(name, name)).requires)


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
    from wiw.training.post_training.encode_clips import encode_clips

    folder = require_data(name, data, ALSO_ARM)
    if cache is None:
        raise ArgumentError("train: --encode-only writes encoded clips into a folder: name it with --cache")
    chosen, began = _choose_recipe(name, recipe, pairs, numbers, parts), time.monotonic()
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
    name: str, file: Path | None, pairs: Sequence[str], numbers: Mapping[str, Any], parts: Mapping[str, Any]
) -> PostTrainingRecipe:
    from wiw.runs.part_options import parse_options
    from wiw.training.post_training.recipe import PostTrainingRecipe, load_recipe
    from wiw.training.post_training.train import choose_precision

    options = {**numbers, **parse_options(pairs, PostTrainingRecipe, "--option")}
    chosen = load_recipe(name, file, options)
    return chosen if "precision" in options else choose_precision(chosen, parts.get("device"))


def _write_command(out: Path, run: Mapping[str, Any]) -> str:
    """Return the command that runs a checkpoint."""
    options = {run["checkpoint"]: out, **run["options"]}
    pairs = [shlex.quote(f"{key}={value}") for key, value in options.items()]
    shown = " ".join(f"--world-model-option {pair}" for pair in pairs)
    return f"wiw run {run['task']} --world-model {run['world_model']} {shown}"
