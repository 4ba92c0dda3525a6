# SPDX-License-Identifier: Apache-2.0
"""`wiw train`."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg

from wiw.cli.stop import begun_again

TRAIN, VAL, PLAYS = "apartments:train:80", "apartments:val:20", 2000
"""What is learnt from and measured on where nothing else is asked for."""
SEEING, PLAYING = ("recogniser", "warpnet"), ("armnet",)
USES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "scenes": (SEEING, "looks at no scenes"),
    "val": (SEEING, "looks at no scenes"),
    "places": (SEEING, "looks at no scenes"),
    "categories": (("recogniser",), "recognises nothing"),
    "plays": (PLAYING, "plays at no tables"),
    "demonstrations": ((*PLAYING, "diffuser"), "learns from scenes"),
    "cache": ((*SEEING, *PLAYING), "looks at no scenes and plays at no tables"),
}
"""By flag: what has a use for it, and why the rest has none."""


def train(
    what: Positional[
        Annotated[Literal["recogniser", "warpnet", "armnet", "diffuser"], arg(metavar="WHAT")]
    ] = "recogniser",
    /,
    *,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    val: Annotated[str | None, arg(metavar="SPEC")] = None,
    categories: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    demonstrations: Annotated[Path | None, arg(metavar="DIR")] = None,
    epochs: Annotated[int | None, arg(metavar="N")] = None,
    minutes: Annotated[float | None, arg(metavar="MIN")] = None,
    places: Annotated[int | None, arg(metavar="N")] = None,
    plays: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int, arg(metavar="N")] = 0,
    workers: Annotated[int, arg(metavar="N")] = 2,
    cache: Annotated[Path | None, arg(metavar="DIR")] = None,
) -> int:
    """Trains a network on generated apartments or on scenes of your own, at the table of an arm, or on demonstrations.

    recogniser: the policy of Active Recognition, which tells what is in a red box from any number of real and imagined
    views. warpnet: a world model that shows what a panorama would look like from near by. armnet: a world model that
    shows what the front view of an arm would look like after it has gone to each pose of a plan. diffuser: the 3D
    diffusion policy of manipulation.

    $ wiw train recogniser --out recogniser.safetensors
    $ wiw train recogniser --scenes house.glb --val other.glb --categories chair bed --out house.safetensors
    $ wiw train warpnet --out warpnet.safetensors
    $ wiw run imagenav --world-model warpnet --world-model-option weights=warpnet.safetensors
    $ wiw train armnet --out armnet.safetensors
    $ wiw collect manipulation --episodes 120 --frames 16 --depth --out demos
    $ wiw train diffuser --demonstrations demos --out diffuser.safetensors

    recogniser and warpnet look around all scenes first, armnet plays at the tables of the manipulation tasks, mostly
    badly; a command that was stopped does not do so again. Then they train: a quarter of an hour to half of one on two
    idle cores. diffuser learns from demonstrations, for a night (--minutes makes it shorter).

    Recipe and figures on what was not learnt from are kept in the file: the recogniser's accuracy and calibration error
    on one half of the val scenes, its confidence being calibrated on the other; warpnet's PSNR and SSIM there beside
    those of copy and warp; armnet's errors on plays of its own beside those of copy and of a table on which nothing but
    the arm moves. diffuser is not measured. The weights that come with the package were made by this command as it
    stands.

    Args:
        what: recogniser, warpnet, armnet or diffuser.
        out: Weights, as safetensors of a few MB; WHAT.safetensors if not given.
        scenes: To learn from: apartments:train[:N], a mesh or a Gazebo world; apartments:train:80 if not given.
        val: To measure on, and for the recogniser to calibrate with: it halves them, or the looks of a single one;
            apartments:val:20 if not given.
        categories: What there is to recognise; the built-in list if none is given.
        demonstrations: Of `wiw collect manipulation`: for diffuser to learn from, with depth; for armnet beside plays.
        epochs: How often each look is shown, on average; 25 for the recogniser, 6 for warpnet, 4 for armnet, 400 for
            diffuser if not given.
        minutes: Fewer epochs where so many would take longer than this to train.
        places: From which a scene is looked at, or that it is walked through from; 16 and 24 if not given.
        plays: For armnet: at tables, of eight poses each; 2000 if not given.
        seed: The looks are a function of it and the scenes, the weights of it, the looks and the epochs.
        workers: Processes that look around.
        cache: Where looks and plays are kept; $WIW_CACHE/looks if not given. Deleting it is always safe.
    """
    from wiw.scenes.store import folder

    out = out or Path(f"{what}.safetensors")
    flags = {"scenes": scenes, "val": val, "categories": categories or None, "demonstrations": demonstrations}
    _check_use(what, _given(**flags, places=places, plays=plays, cache=cache))
    _require_torch(what)
    _check_out(out)
    from_where = TRAIN if scenes is None else scenes, VAL if val is None else val
    asked = _Asked(*from_where, seed, cache or folder().parent / "looks", workers)
    if what in SEEING:
        _check_scenes(asked.scenes, asked.val)
    with begun_again():
        if what == "recogniser":
            _recogniser(out, asked, categories, minutes, _given(places=places), _given(epochs=epochs))
        elif what == "diffuser":
            _diffuser(out, demonstrations, minutes, _given(epochs=epochs, seed=seed))
        elif what == "armnet":
            _armnet(out, asked, minutes, PLAYS if plays is None else plays, demonstrations, _given(epochs=epochs))
        else:
            _warpnet(out, asked, minutes, _given(places=places), _given(epochs=epochs))
    print(f"weights   {out} ({out.stat().st_size / 2**20:.2f} MB)")
    return 0


@dataclass(frozen=True)
class _Asked:
    """From where, and how, what is learnt from is gathered."""

    scenes: str
    val: str
    seed: int
    cache: Path
    workers: int

    @property
    def gathering(self) -> dict[str, Any]:
        return {"folder": self.cache, "workers": self.workers, "bar": _bar}


def _require_torch(what: str) -> None:
    if what == "recogniser":
        from wiw.perception.recogniser import require_torch

        require_torch()
    elif what == "diffuser":
        from wiw.policies.diffuser import require_torch

        require_torch()
    else:
        from wiw.registry import WORLD_MODELS
        from wiw.world_models import devices

        devices.require(WORLD_MODELS.find(what).requires)


def _recogniser(
    out: Path,
    asked: _Asked,
    categories: tuple[str, ...],
    minutes: float | None,
    rule: dict[str, Any],
    how: dict[str, Any],
) -> None:
    from wiw.datasets.ar import CATEGORIES
    from wiw.training import recogniser as training
    from wiw.training.gather import gathered
    from wiw.training.looks import LookRules, halves

    names, rules, recipe = categories or CATEGORIES, LookRules(**rule), training.Recipe(seed=asked.seed, **how)
    looks = gathered(asked.scenes, names, asked.seed, rules, **asked.gathering)
    calibration, held_out = halves(gathered(asked.val, names, asked.seed, rules, **asked.gathering))
    with _Steps() as steps:
        network, recipe = training.train(looks, names, recipe, minutes, steps)
    card = {"scenes": asked.scenes, "val": asked.val, "sets": len(looks)}
    card |= {"looks": asdict(rules), "recipe": asdict(recipe)}
    made = training.calibrated(network, names, calibration, held_out, card)
    made.save(out)
    _report(made.card, made.temperature)


def _warpnet(out: Path, asked: _Asked, minutes: float | None, rule: dict[str, Any], how: dict[str, Any]) -> None:
    from wiw.training import warpnet as training
    from wiw.training.gather import gathered_walks
    from wiw.training.walks import WalkRules
    from wiw.world_models.warpnet.model import WarpNet
    from wiw.world_models.warpnet.weights import load, save

    rules, recipe = WalkRules(**rule), training.Recipe(seed=asked.seed, **how)
    walks = gathered_walks(asked.scenes, asked.seed, rules, **asked.gathering)
    with _Steps() as steps:
        network, recipe = training.train(walks, recipe, minutes, steps)
    card: dict[str, Any] = {"scenes": asked.scenes, "val": asked.val, "ways": len(walks)}
    card |= {"walks": asdict(rules), "recipe": asdict(recipe)}
    save(out, network, card)  # before measuring, which takes another minute
    card["held_out"] = training.measured(WarpNet(out), asked.val, asked.seed, bar=_bar)
    save(out, load(out)[0], card)
    _report_warpnet(card)


def _diffuser(out: Path, demonstrations: Path | None, minutes: float | None, how: dict[str, Any]) -> None:
    from wiw.datasets.demonstrations import Demonstrations
    from wiw.envs.sensors import Sensors
    from wiw.errors import ArgumentError
    from wiw.networks import one_thread
    from wiw.policies.diffuser.sight import Lens
    from wiw.policies.diffuser.weights import save
    from wiw.training import diffuser as training
    from wiw.training.checkpoint import Checkpoint

    if demonstrations is None:
        raise ArgumentError("diffuser learns from demonstrations: give a folder of `wiw collect` with --demonstrations")
    shown, recipe = Demonstrations(demonstrations), training.Recipe(**how)
    if shown.config.get("size") != Sensors.size:
        raise ArgumentError(
            f"--demonstrations: diffuser is run on views of {Sensors.size} pixels a side, got demonstrations of "
            f"{shown.config.get('size')}; collect with --size {Sensors.size}"
        )
    lens = Lens(shown.camera.intrinsics, shown.camera.T_world_camera)
    moments = training.moments(_bar(shown, "looking", len(shown)), lens)
    card: dict[str, Any] = {"demonstrations": shown.config, "moments": len(moments)}
    asked = {**card, "recipe": asdict(recipe), "minutes": minutes}
    checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), asked)
    with one_thread(), _Steps() as steps:
        network, recipe = training.train(moments, recipe, minutes, steps, checkpoint)
    save(out, network, {**card, "recipe": asdict(recipe)})
    checkpoint.remove()
    print(f"{len(shown)} demonstrations, {len(moments)} paths, {recipe.epochs} epochs")


def _armnet(
    out: Path, asked: _Asked, minutes: float | None, count: int, demonstrations: Path | None, how: dict[str, Any]
) -> None:
    from wiw.datasets.demonstrations import read_manifest
    from wiw.networks import one_thread
    from wiw.training import armnet as training
    from wiw.training.checkpoint import Checkpoint
    from wiw.training.plays import demonstrated, gathered_plays, merged
    from wiw.world_models.armnet.weights import load, save

    recipe = training.Recipe(seed=asked.seed, **how)
    plays = gathered_plays(count, asked.seed, **asked.gathering)
    held_out = gathered_plays(training.HELD_OUT, asked.seed + training.OTHERS, **asked.gathering)
    card: dict[str, Any] = {"plays": len(plays), "demonstrations": 0}
    if demonstrations is not None:
        shown = demonstrated(demonstrations)
        card |= {"demonstrations": len(shown), "collection": read_manifest(demonstrations)}
        plays = merged([plays, shown])
    asked_for = {**card, "recipe": asdict(recipe), "minutes": minutes}
    checkpoint = Checkpoint(out.with_name(f"{out.name}.checkpoint"), asked_for)
    with one_thread(), _Steps() as steps:
        network, recipe = training.train(plays, recipe, minutes, steps, checkpoint)
    card["recipe"] = asdict(recipe)
    save(out, network, card)  # before measuring, which takes another minute
    network = load(out)[0]  # as it is kept, in half precision
    card["held_out"] = training.measured(network, held_out)
    save(out, network, card)
    checkpoint.remove()
    _report_armnet(card)


def _given(**options: Any) -> dict[str, Any]:
    """Those that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _check_use(what: str, given: Mapping[str, Any]) -> None:
    """That nothing is asked for in vain."""
    from wiw.errors import ArgumentError

    for name in given:
        users, why = USES[name]
        if what not in users:
            instead = "give --plays in place of it" if (what, name) == ("armnet", "places") else "leave it out"
            raise ArgumentError(f"--{name}: {what} {why}; {instead}")
    if given.get("plays", 1) < 1:
        raise ArgumentError(f"--plays: expected 1 or more, got {given['plays']}")


def _check_out(out: Path) -> None:
    """What would otherwise be found out after minutes."""
    from wiw.errors import FileError

    if not out.absolute().parent.is_dir() or out.is_dir():
        raise FileError(f"{out}: cannot be written there; choose a file in a folder that exists with --out")


def _check_scenes(scenes: str, val: str) -> None:
    """Likewise."""
    from wiw.errors import ArgumentError
    from wiw.scenes import resolve

    shared = sorted(set(resolve(scenes)) & set(resolve(val)))
    if shared:
        raise ArgumentError(f"--val: expected scenes that are not learnt from, got {shared[0]} in both; choose others")


def _report(card: dict[str, Any], temperature: float) -> None:
    print(f"{card['sets']} sets of looks, {card['recipe']['epochs']} epochs; held out: {card['held_out_sets']} sets")
    for name, accuracy in card["accuracy"].items():
        print(f"  {name:<20} accuracy {100 * accuracy:5.1f} %")
    error = card["calibration_error"]
    print(f"calibration error {error['before']:.3f}, at temperature {temperature:.2f} {error['after']:.3f}")


def _report_warpnet(card: dict[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['ways']} ways, {card['recipe']['epochs']} epochs; held out: {held_out['ways']} ways")
    print(f"{'steps of 0.2 m ahead':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [f"{held_out['psnr'][name][n]:8.1f} {held_out['ssim'][name][n]:6.3f}" for n in held_out["psnr"][name]]
        print(f"  {name:<18}" + "".join(cells))
    print("PSNR in dB and SSIM of whole panoramas, weighted by latitude")


def _report_armnet(card: dict[str, Any]) -> None:
    held_out = card["held_out"]
    print(f"{card['plays']} plays, {card['recipe']['epochs']} epochs; held out: {held_out['plays']} plays")
    print(f"{'poses gone to':<20}" + "".join(f"{steps:>15}" for steps in held_out["psnr"]["copy"]))
    for name in held_out["psnr"]:
        cells = [
            f"{held_out['changed'][name][n]:8.1f} {held_out['psnr'][name][n]:6.1f}" for n in held_out["psnr"][name]
        ]
        print(f"  {name:<18}" + "".join(cells))
    print("mean absolute error, of 255, where things have changed, and PSNR in dB of the window around the table")


def _bar(items: Any, text: str, total: int) -> Any:
    from rich.progress import track

    return track(items, text, total, console=_console(), disable=not sys.stderr.isatty() or not total)


def _console() -> Any:
    from rich.console import Console

    return Console(stderr=True)


class _Steps:
    """A bar of training steps."""

    def __enter__(self) -> _Steps:
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
