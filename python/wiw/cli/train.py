# SPDX-License-Identifier: Apache-2.0
"""`wiw train`."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.options import Options
from wiw.cli.stop import announce_resume
from wiw.cli.train_pocket import train_pocket
from wiw.cli.train_video import RUN_AS, VIDEO, TrackerName, VideoName, encode_video, train_video
from wiw.errors import ArgumentError
from wiw.ray_cluster import HERE, Engine
from wiw.training.launcher import ProcessLayout, require_single_process

ONE_PROCESS = ProcessLayout()
DEFAULT_SCENES, DEFAULT_VAL, DEFAULT_PLAYS, DEFAULT_WORKERS = "apartments:train:80", "apartments:val:20", 2000, 2
SCENES = {
    "recogniser": "apartments:train:160",
    "perception": "apartments:train:160",
    "navigator": "apartments:train:200",
}
"""Training scenes of the networks that do not use `DEFAULT_SCENES`."""
ON_SCENES = ("recogniser", "warpnet", "perception", "navigator")
ON_PLAYS, ON_DEMONSTRATIONS = ("armnet",), ("armnet", "diffuser")
ON_DATA = (*VIDEO, "pocket")
USES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "scenes": (ON_SCENES, "does not train on scenes"),
    "val": ((*ON_SCENES, "pocket"), "is not measured on scenes"),
    "places": (ON_SCENES, "does not train on scenes"),
    "categories": (("recogniser",), "has no categories"),
    "plays": (ON_PLAYS, "does not train on plays"),
    "demonstrations": (ON_DEMONSTRATIONS, "does not train on demonstrations"),
    "workers": ((*ON_SCENES, *ON_PLAYS, *VIDEO), "prepares its data in one process"),
    "encode-only": (VIDEO, "has no frozen networks that encode clips"),
    "engine": (VIDEO, "prepares its data on this machine"),
    "cache": ((*ON_SCENES, *ON_PLAYS, *ON_DATA), "caches no training data"),
    "minutes": ((*ON_SCENES, *ON_PLAYS, "diffuser"), "has no time limit, but --option clips=N"),
    "data": (ON_DATA, "trains on other data"),
    "weights": ((*VIDEO, "recogniser"), "begins with random weights"),
    "recipe": (ON_DATA, "reads no recipe"),
    "option": (ON_DATA, "reads no recipe"),
    "device": (VIDEO, "trains on the CPU"),
    "part": (ON_DATA, "trains on other data"),
    "validation": (ON_DATA, "is evaluated on --val, if at all"),
    "decisions": (ON_DATA, "is evaluated on --val, if at all"),
    "tracker": (ON_DATA, "reports to no tracker"),
    "gpus": (VIDEO, "trains in one process"),
    "nodes": (VIDEO, "trains in one process"),
    "partition": (VIDEO, "trains in one process"),
    "dry-run": (VIDEO, "trains in one process"),
}
"""For each option that not all networks use: those that do, and why the others refuse it."""


def train(
    what: Positional[
        Annotated[
            Literal["recogniser", "navigator", "warpnet", "pocket", "perception", "armnet", "diffuser", VideoName],
            arg(metavar="WHAT"),
        ]
    ] = "recogniser",
    /,
    *,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
    data: Annotated[Path | None, arg(metavar="DIR")] = None,
    weights: Annotated[str | None, arg(metavar="DIR|HUB")] = None,
    recipe: Annotated[Path | None, arg(metavar="YAML")] = None,
    option: Options = (),
    device: Annotated[str | None, arg(metavar="NAME")] = None,
    part: Literal["train", "all"] | None = None,
    validation: Annotated[Path | None, arg(metavar="DIR")] = None,
    decisions: Annotated[Path | None, arg(metavar="FILE")] = None,
    tracker: TrackerName | None = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    val: Annotated[str | None, arg(metavar="SPEC")] = None,
    categories: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    demonstrations: Annotated[Path | None, arg(metavar="DIR")] = None,
    epochs: Annotated[int | None, arg(metavar="N")] = None,
    minutes: Annotated[float | None, arg(metavar="MIN")] = None,
    places: Annotated[int | None, arg(metavar="N")] = None,
    plays: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="N")] = 0,
    workers: Annotated[int | None, arg(metavar="N")] = None,
    cache: Annotated[Path | None, arg(metavar="DIR")] = None,
    encode_only: bool = False,
    place: Annotated[Engine, arg(name="")] = HERE,
    layout: Annotated[ProcessLayout, arg(name="")] = ONE_PROCESS,
    dry_run: bool = False,
) -> int:
    """Train a network: recogniser, navigator, warpnet, pocket, perception, armnet, diffuser or a video model
    (NAME-action).

    recogniser: the policy of Active Recognition; it recognises the object in a red box from any number of real and
    imagined views. Trained on scenes.
    navigator: the policy of Image-Goal Navigation that estimates, from a panorama and the goal image, how far the goal
    is and in which direction. Trained on scenes.
    warpnet: a world model of navigation; it predicts the panorama that is seen from a place nearby. Trained on scenes.
    pocket: a world model of navigation, too: a small video diffusion model that draws all views of a plan together.
    Trained on a dataset of `wiw collect navigation`, without pretrained weights.
    perception: the labeller of question answering; it gives each pixel of a view a category and a state, on or off,
    open or closed. Colour words are calibrated along with it. Trained on scenes.
    armnet: a world model of manipulation; it predicts the front view after each gripper pose of a plan. Trained on
    simulated play at the tables of the manipulation tasks, and on demonstrations if there are any.
    diffuser: the 3D diffusion policy of manipulation. Trained on demonstrations.
    svd-action, ltx-action, wan2.1-action, wan2.2-5b-action, wan2.2-a14b-action, cosmos-predict2-action: pretrained
    video generators, post-trained to follow actions of navigation or poses of a gripper. Trained on a dataset of `wiw
    collect navigation` or `wiw collect manipulation`, on a GPU; docs/post-training.md explains recipes and needs.
    nwm-action: Navigation World Models, post-trained on front views of a navigation dataset.

    $ wiw train recogniser --out recogniser.safetensors
    $ wiw train recogniser --scenes house.glb --val other.glb --categories chair bed --out house.safetensors
    $ wiw train navigator --out navigator.safetensors
    $ wiw run imagenav --policy navigator --policy-option weights=navigator.safetensors
    $ wiw train warpnet --out warpnet.safetensors
    $ wiw run imagenav --world-model warpnet --world-model-option weights=warpnet.safetensors
    $ wiw train perception --out perception.safetensors
    $ wiw train armnet --out armnet.safetensors
    $ wiw collect manipulation --episodes 400 --frames 16 --depth --wrist --out demos
    $ wiw train diffuser --demonstrations demos --out diffuser.safetensors
    $ wiw collect navigation --scenes apartments:train:80 --out data
    $ wiw train pocket --data data --out pocket.safetensors
    $ wiw train ltx-action --data data --out runs/ltx
    $ wiw train wan2.1-action --data data --weights /models/wan2.1 --option clips=1600 --option lora=16 --out runs/wan
    $ wiw train ltx-action --data data --gpus 8 --out runs/ltx
    $ wiw train ltx-action --data data --cache latents --encode-only --engine ray --workers 8 --worker-gpus 1
    $ wiw train ltx-action --data data --cache latents --out runs/ltx
    $ wiw train wan2.2-5b-action --data data --option shard=true --nodes 2 --gpus 8 --partition gpu --out runs/wan5b
    $ wiw run imagenav --world-model ltx-action --world-model-option checkpoint=runs/ltx
    $ wiw train nwm-action --data data --out runs/nwm
    $ wiw train svd-action --data demos --out runs/svd-arm

    First the training data is prepared from scenes or plays and cached, so that an interrupted command does not
    prepare it again. Training then takes 15 to 30 minutes on two idle cores; perception takes one to two hours,
    pocket takes two to three hours, diffuser takes an hour or two; less with --minutes, or with --option clips=N for
    pocket. An interrupted training of navigator, perception, pocket, armnet, diffuser or a video model resumes from its
    checkpoint beside FILE; repeat the command. pocket and video models also write it at SIGUSR1.

    The file also holds the recipe and the figures on held-out data: for recogniser, accuracy and calibration error on
    one half of the val scenes, after calibration on the other half; for navigator, how well it tells near pairs of
    places of the val scenes from far ones and how far its bearings are off, beside the matcher's similarity; for
    warpnet, PSNR and SSIM on the val scenes, beside copy and warp; for pocket, PSNR on windows of the val scenes,
    beside what has learnt nothing, and how much of it is lost where it is told another window's places; for
    perception, accuracy and IoU of categories, accuracy of states and of colour words on the val scenes; for armnet,
    errors on held-out plays, beside copy and a table where nothing but the arm moves; for diffuser, how often one of
    ten paths is the expert's, for one in twenty demonstrations that it is not trained on. The weights shipped with wiw
    were trained by this command with its defaults; those of perception for four epochs of a
    schedule that was first laid out for six (docs/perception.md), those of navigator for three of four
    (docs/navigation-tasks.md), those of pocket on 16 800 clips, those of recogniser by an earlier recipe
    (docs/results.md).

    Args:
        what: recogniser, navigator, warpnet, pocket, perception, armnet, diffuser or a video model.
        out: Weights, a safetensors file of a few MB. Default: WHAT.safetensors. For video models a new folder. Default:
            WHAT.
        data: Dataset for pocket and video models: a folder of `wiw collect navigation`; for video models also of `wiw
            collect manipulation`.
        weights: Pretrained weights that a video model begins with: a folder as save_pretrained writes it, or a name on
            the Hugging Face hub. Default: those of the world model. For recogniser a file of this command, whose
            training goes on. Default: none.
        recipe: YAML file with numbers of the recipe of pocket or a video model, on top of the shipped ones.
        option: Number of such a recipe, such as rate=2e-5, clips=1600 or batch=8; may be given again. See
            `wiw.training.post_training.recipe.PostTrainingRecipe` and `wiw.training.pocket.recipe.PocketRecipe`.
        device: Of torch, for video models. Default: the GPU if there is one.
        part: Part of the dataset for pocket and video models: train leaves out one in twenty scenes, or demonstrations,
            for validation. Default: train.
        validation: Another dataset of the same command, of other scenes or demonstrations, on which pocket or a video
            model is validated while it trains: PSNR and SSIM after 1, 4, 8 and 14 actions, and the control gap.
            Default: those that --part train leaves out.
        decisions: File of `wiw collect decisions`, by which validation of pocket, or of a video model that moves, also
            measures how well its order of the plans agrees with the true one.
        tracker: Program that draws loss and validation of pocket or a video model; needs its package.
            OUT.log/metrics.jsonl has the same in any case.
        scenes: Training scenes of recogniser, navigator, warpnet and perception: apartments:train[:N], a mesh, a Gazebo
            world or scans, as in `wiw run`. Default: apartments:train:160; 80 of them for warpnet, 200 for navigator.
        val: Held-out scenes of recogniser, navigator, warpnet, pocket and perception; none may be trained on.
            recogniser splits them, or the samples of a single one, into halves for calibration and evaluation. Default:
            apartments:val:20.
        categories: What recogniser tells apart. Default: the built-in list of 26 categories.
        demonstrations: Folder of `wiw collect manipulation`: with depth for diffuser, which learns to see by the wrist
            camera too if they have its views; additional data for armnet.
        epochs: How often each sample is used, on average. Default: 25 for recogniser, 6 for warpnet, 1 for pocket, 4
            for navigator, perception and armnet, 400 for diffuser.
        minutes: Train fewer epochs if all of them would take longer than this.
        places: Places sampled in each scene, for recogniser (default: 8), perception (default: 12) and navigator
            (default: 24, and up to three near each), or walks recorded in each scene, for warpnet (default: 24).
        plays: Simulated plays of armnet, of eight gripper poses each. Default: 2000.
        seed: Seed of the training data and of the weights.
        workers: Processes that prepare training data from scenes or plays, or with engine ray encode clips. Default: 2,
            for video models 1.
        cache: Folder of prepared training data; it can be deleted at any time. Default: $WIW_CACHE/looks. Of clips as
            a video model's frozen networks encode them, for later epochs and other trainings. Default: none.
        encode_only: Encode the clips of a video model's training into --cache, and train nothing.
        place: Where the processes of --encode-only are; with engine ray, all machines see --data and --cache.
        layout: Processes of a video model's training.
        dry_run: Print the command that runs on each machine, for several GPUs, and train nothing.
    """
    from wiw.scenes.store import folder

    _check_numbers(epochs=epochs, minutes=minutes, places=places, plays=plays, seed=seed, workers=workers)
    options: dict[str, Any] = {
        "scenes": scenes,
        "val": val,
        "categories": categories or None,
        "demonstrations": demonstrations,
    }
    options |= {"places": places, "plays": plays, "workers": workers, "cache": cache, "minutes": minutes}
    options |= {"data": data, "weights": weights, "recipe": recipe, "option": option or None}
    options |= {"device": device, "part": part}
    options |= {"validation": validation, "decisions": decisions, "tracker": tracker}
    options |= {"gpus": None if layout.gpus == 1 else layout.gpus, "nodes": None if layout.nodes == 1 else layout.nodes}
    options |= {"partition": layout.partition, "dry-run": dry_run or None}
    options |= {"encode-only": encode_only or None, "engine": None if place == HERE else place.engine}
    _check_use(what, _drop_none(options))
    if what in VIDEO and encode_only:
        numbers = _drop_none({"epochs": epochs, "seed": seed or None})
        given: dict[str, Any] = {"weights": weights, "device": device, "part": part or "train"}
        return encode_video(what, data, cache, recipe, option, numbers, given, workers or 1, place)
    if what in VIDEO:
        _require_no_encoding(workers, place)
        _require_torch(what)
        numbers = _drop_none({"epochs": epochs, "seed": seed or None})
        given = {"weights": weights, "device": device, "part": part or "train", "cache": cache}
        given |= {"validation": validation, "decisions": decisions, "tracker": tracker}
        return train_video(what, out or Path(what), data, recipe, option, numbers, given, layout, dry_run)
    require_single_process(what, "run the command without torchrun")  # each would train alike and write the same file
    out = out or Path(f"{what}.safetensors")
    _require_torch(what)
    _check_out(out)
    source = _DataOptions(
        scenes=scenes or SCENES.get(what, DEFAULT_SCENES),
        val=DEFAULT_VAL if val is None else val,
        seed=seed,
        cache=cache or folder().parent / "looks",
        workers=DEFAULT_WORKERS if workers is None else workers,
    )
    rules, lengths = _drop_none({"places": places}), _drop_none({"epochs": epochs})
    if what in ON_SCENES:
        _check_scenes(source.scenes, source.val)
    with announce_resume():
        if what == "recogniser":
            _train_recogniser(out, source, weights, categories, minutes, rules, lengths)
        elif what == "diffuser":
            _train_diffuser(out, demonstrations, minutes, {**lengths, "seed": seed})
        elif what == "armnet":
            _train_armnet(out, source, minutes, DEFAULT_PLAYS if plays is None else plays, demonstrations, lengths)
        elif what == "pocket":
            numbers = _drop_none({"epochs": epochs, "seed": seed or None})
            given = {"part": part or "train", "validation": validation, "decisions": decisions, "tracker": tracker}
            train_pocket(out, data, source.cache, source.val, recipe, option, numbers, given, _show_bar)
        elif what == "perception":
            _train_perception(out, source, minutes, rules, lengths)
        elif what == "navigator":
            _train_navigator(out, source, minutes, places, lengths)
        else:
            _train_warpnet(out, source, minutes, rules, lengths)
    print(f"weights   {out} ({out.stat().st_size / 2**20:.2f} MB)")
    return 0


def _require_no_encoding(workers: int | None, place: Engine) -> None:
    if workers is not None or place != HERE:
        raise ArgumentError("train: --workers and --engine are for --encode-only; --gpus is for training")


@dataclass(frozen=True)
class _DataOptions:
    """Where training data comes from, and how it is prepared."""

    scenes: str
    val: str
    seed: int
    cache: Path
    workers: int

    @property
    def gathering(self) -> dict[str, Any]:
        """Keyword arguments of the functions in `wiw.training.gather`."""
        return {"folder": self.cache, "workers": self.workers, "bar": _show_bar}


def _require_torch(what: str) -> None:
    if what == "recogniser":
        from wiw.perception.recogniser import require_torch

        require_torch()
    elif what == "diffuser":
        from wiw.policies.diffuser import require_torch

        require_torch()
    elif what == "navigator":
        from wiw.policies.navigator.estimator import require_torch

        require_torch()
    elif what == "perception":
        from wiw.perception.learned_labeller import require_torch

        require_torch()
    else:
        from wiw.registry import WORLD_MODELS
        from wiw.world_models import devices

        devices.require(WORLD_MODELS.find(RUN_AS.get(what, what)).requires)


def _train_recogniser(
    out: Path,
    data: _DataOptions,
    weights: str | None,
    categories: tuple[str, ...],
    minutes: float | None,
    rule_options: dict[str, Any],
    recipe_options: dict[str, Any],
) -> None:
    from wiw.datasets.ar import CATEGORIES
    from wiw.perception.recogniser import Recogniser
    from wiw.training import recogniser as training
    from wiw.training.gather import gather_glimpse_sets, gather_hard_sets
    from wiw.training.glimpse_sets import GlimpseSetRules, merge_glimpse_sets, split_in_half

    names, rules, recipe = (
        categories or CATEGORIES,
        GlimpseSetRules(**rule_options),
        training.Recipe(seed=data.seed, **recipe_options),
    )
    start = None if weights is None else Recogniser.load(weights)
    looks = gather_glimpse_sets(data.scenes, names, data.seed, rules, **data.gathering)
    hard = gather_hard_sets(data.scenes, names, data.seed, **data.gathering)
    as_they_are = replace(rules, reshape=1.0)
    held_out = gather_glimpse_sets(data.val, names, data.seed, as_they_are, **data.gathering)
    calibration, held_out = split_in_half(held_out)
    held_out_hard = gather_hard_sets(data.val, names, data.seed, **data.gathering)
    samples = merge_glimpse_sets([looks, *[hard] * recipe.hard])
    with _StepBar() as steps:
        network, recipe = training.train(
            samples, names, recipe, minutes, steps, None if start is None else start.network
        )
    card = {"scenes": data.scenes, "val": data.val, "sets": len(looks), "hard_sets": len(hard)}
    card |= {"looks": asdict(rules), "recipe": asdict(recipe), "began_with": None if start is None else start.card}
    calibrated = training.calibrate(network, names, calibration, held_out, card, held_out_hard)
    calibrated.save(out)
    _report_recogniser(calibrated.card, calibrated.temperature)


def _train_warpnet(
    out: Path, data: _DataOptions, minutes: float | None, rule_options: dict[str, Any], recipe_options: dict[str, Any]
) -> None:
    from wiw.training import warpnet as training
    from wiw.training.gather import gather_walks
    from wiw.training.walks import WalkRules
    from wiw.world_models.warpnet.model import WarpNet
    from wiw.world_models.warpnet.weights import load, save

    rules, recipe = WalkRules(**rule_options), training.Recipe(seed=data.seed, **recipe_options)
    walks = gather_walks(data.scenes, data.seed, rules, **data.gathering)
    with _StepBar() as steps:
        network, recipe = training.train(walks, recipe, minutes, steps)
    card: dict[str, Any] = {"scenes": data.scenes, "val": data.val, "ways": len(walks)}
    card |= {"walks": asdict(rules), "recipe": asdict(recipe)}
    save(out, network, card)  # before the evaluation, which takes another minute
    card["held_out"] = training.evaluate(WarpNet(out), data.val, data.seed, bar=_show_bar)
    save(out, load(out)[0], card)
    _report_warpnet(card)


def _train_perception(
    out: Path, data: _DataOptions, minutes: float | None, rule_options: dict[str, Any], recipe_options: dict[str, Any]
) -> None:
    from dataclasses import replace

    from wiw.networks import single_thread
    from wiw.perception.labeller_weights import load, save
    from wiw.perception.scene_labels import CATEGORIES
    from wiw.training import color_naming
    from wiw.training import perception as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.gather import gather_views
    from wiw.training.labelled_views import HELD_OUT_FIELD, ViewRules

    rules, recipe = ViewRules(**rule_options), training.Recipe(seed=data.seed, **recipe_options)
    views = gather_views(data.scenes, data.seed, rules, **data.gathering, change=True)
    held_out_rules = replace(rules, fields=(HELD_OUT_FIELD, HELD_OUT_FIELD))
    held_out = gather_views(data.val, data.seed, held_out_rules, **data.gathering, change=True)
    card: dict[str, Any] = {"scenes": data.scenes, "val": data.val, "views": len(views), "sampling": asdict(rules)}
    identity = {**card, "recipe": asdict(recipe), "minutes": minutes}
    checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), identity)
    with single_thread():
        with _StepBar() as steps:
            network, recipe = training.train(views, recipe, minutes, steps, checkpoint)
        namer = color_naming.calibrate(views, data.seed)
    card |= {"recipe": asdict(recipe), "categories": list(CATEGORIES), "states": training.find_possible_states(views)}
    save(out, network, card)  # before the evaluation, which takes another minute
    colors = out.with_suffix(".colors.json")
    namer.save(colors)
    network = load(out)[0]  # as it is stored, in half precision
    card["held_out"] = training.evaluate(network, card["states"], held_out, data.seed)
    card["held_out"]["colors"] = color_naming.evaluate(namer.load(colors), held_out)
    save(out, network, card)
    checkpoint.remove()
    _report_perception(card)
    print(f"colours   {colors}")


def _train_navigator(
    out: Path, data: _DataOptions, minutes: float | None, places: int | None, recipe_options: dict[str, Any]
) -> None:
    from wiw.networks import single_thread
    from wiw.policies.navigator.weights import load, save
    from wiw.training import navigator as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.gather import gather_goal_places
    from wiw.training.goal_places import PlaceRules

    rules, recipe = PlaceRules(**_drop_none({"anchors": places})), training.Recipe(seed=data.seed, **recipe_options)
    scenes = gather_goal_places(data.scenes, data.seed, rules, **data.gathering)
    held_out = gather_goal_places(data.val, data.seed, rules, **data.gathering)
    card: dict[str, Any] = {"scenes": data.scenes, "val": data.val, "places": sum(map(len, scenes))}
    card |= {"sampling": asdict(rules)}
    checkpoint = Checkpoint(
        out.with_name(f"{out.name}.checkpoint"), {**card, "recipe": asdict(recipe), "minutes": minutes}
    )
    with single_thread(), _StepBar() as steps:
        network, recipe = training.train(scenes, recipe, minutes, steps, checkpoint)
    card |= {"recipe": asdict(recipe), **training.measure_prior(scenes, recipe)}
    save(out, network, card)  # before the evaluation, which takes another minute
    card["held_out"] = training.evaluate(load(out)[0], card, held_out, data.seed)  # as stored, in half precision
    save(out, network, card)
    checkpoint.remove()
    _report_navigator(card)


def _train_diffuser(
    out: Path, demonstrations: Path | None, minutes: float | None, recipe_options: dict[str, Any]
) -> None:
    from wiw.datasets.demonstrations import Demonstrations
    from wiw.envs.sensors import Sensors
    from wiw.errors import ArgumentError
    from wiw.networks import single_thread
    from wiw.policies.diffuser.weights import save
    from wiw.policies.diffuser.workspace import PinholeCamera
    from wiw.training import diffuser as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.diffuser_paths import PATHS, measure_paths

    if demonstrations is None:
        raise ArgumentError(
            "diffuser trains on demonstrations; give a folder of `wiw collect manipulation --depth` by --demonstrations"
        )
    collection, recipe = Demonstrations(demonstrations), training.Recipe(**recipe_options)
    if collection.config.get("size") != Sensors.size:
        raise ArgumentError(
            f"--demonstrations: diffuser needs views of {Sensors.size} x {Sensors.size} pixels, got demonstrations of "
            f"{collection.config.get('size')}; collect with --size {Sensors.size}"
        )
    camera = PinholeCamera(collection.camera.intrinsics, collection.camera.T_world_camera)
    own, held_out = training.extract_samples(
        _show_bar(collection, "reading", len(collection)), camera, collection.wrist_intrinsics
    ).hold_out()
    card: dict[str, Any] = {"demonstrations": collection.config, "moments": len(own), "held out": len(held_out)}
    identity = {**card, "recipe": asdict(recipe), "minutes": minutes}
    checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), identity)
    with single_thread(), _StepBar() as steps:
        network, recipe = training.train(own, recipe, minutes, steps, checkpoint)
        found = measure_paths(network, held_out) if len(held_out) else {}
    save(out, network, {**card, "recipe": asdict(recipe), "found": found})
    checkpoint.remove()
    print(f"{len(collection)} demonstrations, {len(own)} samples, {recipe.epochs} epochs")
    if found:
        near = ", ".join(f"one of {count} for {100 * found[f'near/{count}']:.0f} %" for count in PATHS)
        print(
            f"held out  a path is the expert's, of {len(held_out)} samples: {near}; the nearest of {max(PATHS)} is "
            f"{1000 * found['off']:.0f} mm off, two paths end {1000 * found['spread']:.0f} mm apart"
        )


def _train_armnet(
    out: Path,
    data: _DataOptions,
    minutes: float | None,
    count: int,
    demonstrations: Path | None,
    recipe_options: dict[str, Any],
) -> None:
    from wiw.datasets.demonstrations import read_manifest
    from wiw.networks import single_thread
    from wiw.training import armnet as training
    from wiw.training.armnet_events import evaluate_events
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.plays import gather_plays, merge_plays, read_demonstration_plays
    from wiw.world_models.armnet.weights import load, save

    recipe = training.Recipe(seed=data.seed, **recipe_options)
    plays = gather_plays(count, data.seed, **data.gathering)
    held_out = gather_plays(training.HELD_OUT, data.seed + training.HELD_OUT_SEED_OFFSET, **data.gathering)
    card: dict[str, Any] = {"plays": len(plays), "demonstrations": 0}
    if demonstrations is not None:
        demonstrated = read_demonstration_plays(demonstrations)
        card |= {"demonstrations": len(demonstrated), "collection": read_manifest(demonstrations)}
        plays = merge_plays([plays, demonstrated])
    identity = {**card, "recipe": asdict(recipe), "minutes": minutes}
    checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), identity)
    with single_thread(), _StepBar() as steps:
        network, recipe = training.train(plays, recipe, minutes, steps, checkpoint)
    card["recipe"] = asdict(recipe)
    save(out, network, card)  # before the evaluation, which takes another minute
    network = load(out)[0]  # as it is stored, in half precision
    card["held_out"] = training.evaluate(network, held_out) | {"events": evaluate_events(network, held_out)}
    save(out, network, card)
    checkpoint.remove()
    _report_armnet(card)


def _drop_none(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _check_numbers(
    *,
    epochs: int | None,
    minutes: float | None,
    places: int | None,
    plays: int | None,
    seed: int,
    workers: int | None,
) -> None:
    """Refuse numbers that are out of range."""
    counts = {"epochs": epochs, "places": places, "plays": plays, "workers": workers}
    for name, count in _drop_none(counts).items():
        if count < 1:
            raise ArgumentError(f"--{name}: expected 1 or more, got {count}")
    if minutes is not None and not (minutes > 0 and math.isfinite(minutes)):
        raise ArgumentError(f"--minutes: expected a number above 0, got {minutes}")
    if not 0 <= seed < 2**63:
        raise ArgumentError(f"--seed: expected 0 to 2**63 - 1, got {seed}")


def _check_use(what: str, given: Mapping[str, Any]) -> None:
    """Refuse options that the network does not use."""
    for name in given:
        users, reason = USES[name]
        if what not in users:
            instead = "use --plays instead" if (what, name) == ("armnet", "places") else "leave it out"
            raise ArgumentError(f"--{name}: {what} {reason}; {instead}")


def _check_out(out: Path) -> None:
    """Check that the file can be written, before the minutes that training takes."""
    from wiw.errors import FileError

    if not out.absolute().parent.is_dir() or out.is_dir():
        raise FileError(f"{out}: cannot be written; choose a file in a folder that exists by --out")


def _check_scenes(scenes: str, val: str) -> None:
    """Check that no scene is both trained and evaluated on, whatever its path or the edits of an apartment."""
    from wiw.errors import ArgumentError
    from wiw.scenes import absolute, resolve, strip_edits

    trained = {strip_edits(absolute(name)) for name in resolve(scenes)}
    shared = next((name for name in resolve(val) if strip_edits(absolute(name)) in trained), None)
    if shared is not None:
        raise ArgumentError(
            f"--val: expected held-out scenes that are not among --scenes, got {shared} in both; choose others"
        )


def _report_recogniser(card: dict[str, Any], temperature: float) -> None:
    print(f"{card['sets']} glimpse sets, {card['recipe']['epochs']} epochs; held out: {card['held_out_sets']} sets")
    for name, accuracy in card["accuracy"].items():
        hard = card["accuracy_hard"].get(name)
        print(
            f"  {name:<20} accuracy {100 * accuracy:5.1f} %"
            + (f", hard {100 * hard:5.1f} %" if hard is not None else "")
        )
    error = card["calibration_error"]
    print(f"calibration error {error['before']:.3f}, at temperature {temperature:.2f} {error['after']:.3f}")


def _report_warpnet(card: dict[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['ways']} walks, {card['recipe']['epochs']} epochs; held out: {held_out['ways']} walks")
    print(f"{'steps of 0.2 m ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [f"{held_out['psnr'][name][n]:8.1f} {held_out['ssim'][name][n]:6.3f}" for n in held_out["psnr"][name]]
        print(f"  {name:<18}" + "".join(cells))
    print("PSNR in dB and SSIM of whole panoramas, weighted by latitude")


def _report_navigator(card: dict[str, Any]) -> None:
    held_out, other = card["held_out"], "the matcher's similarity"
    print(f"{card['places']} places, {card['recipe']['epochs']} epochs; held out: {held_out['pairs']} pairs")
    auc = {name: "-" if value is None else f"{value:.3f}" for name, value in held_out["auc"].items()}
    print(f"AUC within 2 m: network {auc['network']}, {other} {auc['similarity']}, both {auc['both']}")
    for name, row in held_out["bearing"].items():
        if not row["pairs"]:
            continue
        print(
            f"  bearing, {name:<5} m: median error {row['network']:3.0f} degrees, {other} {row['similarity']:3.0f}; "
            f"within 45: {_to_percent(row['within_45'])} of {row['pairs']}"
        )


def _report_perception(card: dict[str, Any]) -> None:
    held_out = card["held_out"]
    plain, colors = held_out["plain"], held_out["colors"]
    kinds = {"with depth": plain, "without": held_out["no_depth"], "degraded too": held_out["degraded"]}
    print(f"{card['views']} views, {card['recipe']['epochs']} epochs; held out: {held_out['views']} views")
    print(f"{'':<20}" + "".join(f"{name:>14}" for name in kinds))
    for name, key in (("pixel accuracy", "pixel_accuracy"), ("mean IoU", "mean_iou"), ("states", "state_accuracy")):
        print(f"  {name:<18}" + "".join(f"{_to_percent(part[key]):>14}" for part in kinds.values()))
    print(f"  {'colours of things':<18}{_to_percent(colors['accuracy']):>14}")
    print("IoU by category: " + ", ".join(f"{name} {value:.2f}" for name, value in plain["iou"].items() if name))
    for name, values in plain["states"].items():
        print(f"  {name:<18}" + ", ".join(f"{state} {_to_percent(value)}" for state, value in values.items()))


def _to_percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"


def _report_armnet(card: dict[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['plays']} plays, {card['recipe']['epochs']} epochs; held out: {held_out['plays']} plays")
    print(f"{'poses ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [
            f"{held_out['changed'][name][n]:8.1f} {held_out['psnr'][name][n]:6.1f}" for n in held_out["psnr"][name]
        ]
        print(f"  {name:<18}" + "".join(cells))
    print("mean absolute error (of 255) of changed pixels, and PSNR in dB of the window around the table")
    print(f"{'thing':<20}{'the next pose':>30}{'all poses in a row':>30}")
    events = held_out["events"]
    for name, one_pose in events["one_pose"].items():
        cells = [_format_event(figures) for figures in (one_pose, events["free_running"].get(name, {}))]
        print(f"  {name:<18}" + "".join(f"{cell:>30}" for cell in cells))
    print("mean absolute error (of 255) of each thing, arm alone -> armnet; sharpness; lamps of the right colour")


def _format_event(figures: Mapping[str, float]) -> str:
    if not figures:
        return "-"
    right = f" {100 * figures['right']:3.0f} %" if "right" in figures else ""
    return f"{figures['arm']:.1f} -> {figures['armnet']:.1f} {figures['sharpness']:.2f}{right}"


def _show_bar(items: Any, text: str, total: int) -> Any:
    from rich.progress import track

    return track(items, text, total, console=_console(), disable=not sys.stderr.isatty() or not total)


def _console() -> Any:
    from rich.console import Console

    return Console(stderr=True)


class _StepBar:
    """A progress bar of training steps."""

    def __enter__(self) -> _StepBar:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        columns = TextColumn("training"), BarColumn(), TextColumn("loss {task.fields[loss]:.3f}"), TimeRemainingColumn()
        self._bars = Progress(*columns, console=_console(), disable=not sys.stderr.isatty())
        self._task = self._bars.add_task("", loss=float("nan"))
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def __call__(self, step: int, steps: int, loss: float) -> None:
        self._bars.update(self._task, completed=step, total=steps, loss=loss)
