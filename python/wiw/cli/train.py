# SPDX-License-Identifier: Apache-2.0
"""`wiw train`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Positional, arg


def train(
    what: Positional[Annotated[Literal["recogniser"], arg(metavar="WHAT")]] = "recogniser",
    /,
    *,
    out: Annotated[Path, arg(metavar="FILE")] = Path("recogniser.safetensors"),
    scenes: Annotated[str, arg(metavar="SPEC")] = "apartments:train:80",
    val: Annotated[str, arg(metavar="SPEC")] = "apartments:val:20",
    categories: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    epochs: Annotated[int, arg(metavar="N")] = 25,
    minutes: Annotated[float | None, arg(metavar="MIN")] = None,
    places: Annotated[int, arg(metavar="N")] = 16,
    seed: Annotated[int, arg(metavar="N")] = 0,
    workers: Annotated[int, arg(metavar="N")] = 2,
    cache: Annotated[Path | None, arg(metavar="DIR")] = None,
) -> int:
    """Trains the recogniser of Active Recognition: what is in a red box, from any number of real and imagined views.

    $ wiw train recogniser --out recogniser.safetensors
    $ wiw train recogniser --scenes house.glb --val other.glb --categories chair bed --out house.safetensors

    Looks around all scenes first, which a command that was stopped does not do again, then trains: about a quarter of
    an hour on two idle cores. The confidence's temperature is fitted on one half of the val scenes; accuracy and
    calibration error are those on the other half. Recipe and figures are kept in the file. The weights that come with
    the package were made by this command as it stands.

    Args:
        what: recogniser.
        out: Weights, as safetensors of about 1 MB.
        scenes: To learn from: apartments:train[:N], a mesh or a Gazebo world.
        val: To calibrate with and to measure on: at least two scenes, or one whose looks are halved.
        categories: What there is to recognise; the built-in list if none is given.
        epochs: How often each look is shown, on average.
        minutes: Fewer epochs where so many would take longer than this to train.
        places: From which a scene is looked at.
        seed: The looks are a function of it and the scenes, the weights of it, the looks and the epochs.
        workers: Processes that look around.
        cache: Where looks are kept; $WIW_CACHE/looks if not given. Deleting it is always safe.
    """
    from dataclasses import asdict

    from wiw.datasets.ar import CATEGORIES
    from wiw.perception.recogniser import require_torch

    require_torch()
    _check(out, scenes, val)
    from wiw.scenes.store import folder
    from wiw.training import recogniser as training
    from wiw.training.gather import gathered
    from wiw.training.looks import LookRules, halves

    names, rules = categories or CATEGORIES, LookRules(places=places)
    kept = cache or folder().parent / "looks"
    looks = gathered(scenes, names, seed, rules, kept, workers, _bar)
    calibration, held_out = halves(gathered(val, names, seed, rules, kept, workers, _bar))
    with _Steps() as steps:
        network, recipe = training.train(looks, names, training.Recipe(epochs=epochs, seed=seed), minutes, steps)
    card = {"scenes": scenes, "val": val, "sets": len(looks), "looks": asdict(rules), "recipe": asdict(recipe)}
    made = training.calibrated(network, names, calibration, held_out, card)
    made.save(out)
    _report(made.card, made.temperature, out)
    return 0


def _check(out: Path, scenes: str, val: str) -> None:
    """What would otherwise be found out after minutes."""
    from wiw.errors import ArgumentError, FileError
    from wiw.scenes import resolve

    if not out.absolute().parent.is_dir() or out.is_dir():
        raise FileError(f"{out}: cannot be written there; choose a file in a folder that exists with --out")
    shared = sorted(set(resolve(scenes)) & set(resolve(val)))
    if shared:
        raise ArgumentError(f"--val: expected scenes that are not learnt from, got {shared[0]} in both; choose others")


def _report(card: dict[str, Any], temperature: float, out: Path) -> None:
    print(f"{card['sets']} sets of looks, {card['recipe']['epochs']} epochs; held out: {card['held_out_sets']} sets")
    for name, accuracy in card["accuracy"].items():
        print(f"  {name:<20} accuracy {100 * accuracy:5.1f} %")
    error = card["calibration_error"]
    print(f"calibration error {error['before']:.3f}, at temperature {temperature:.2f} {error['after']:.3f}")
    print(f"weights   {out} ({out.stat().st_size / 2**20:.2f} MB)")


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
