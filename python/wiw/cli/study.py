# SPDX-License-Identifier: Apache-2.0
"""`wiw study data-scaling`, `wiw study errors`, and all studies that are commands of their own (`STUDIES`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg


def study_data_scaling(
    *,
    data: Annotated[Path | None, arg(metavar="DIR")] = None,
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/data-scaling"),
    small: bool = False,
    models: Annotated[str | None, arg(metavar="A,B")] = None,
    clips: Annotated[int | None, arg(metavar="N")] = None,
    sizes: Annotated[int | None, arg(metavar="N")] = None,
    size: Annotated[tuple[int, int] | None, arg(metavar="H W")] = None,
    seeds: Annotated[str | None, arg(metavar="A,B,...")] = None,
    held_out: Annotated[float | None, arg(metavar="SHARE")] = None,
    held_out_clips: Annotated[int | None, arg(metavar="N")] = None,
    decision_scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    decisions_per_scene: Annotated[int | None, arg(metavar="N")] = None,
    imagenav: Annotated[int, arg(metavar="EPISODES")] = 0,
    workers: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Does a world model get better with data, or with updates? Small models, trained on nested parts of a dataset.

    $ wiw study data-scaling --small --workers 2               # collects its own data; under an hour on two cores
    $ wiw collect navigation --scenes apartments:train:80 --out data --workers 4
    $ wiw study data-scaling --data data --workers 4           # 128 to 12,800 clips in 64x128; hours
    $ wiw study data-scaling --data data --models warpnet --seeds 0,1,2 --imagenav 100

    The paper trains on more and more clips for one epoch each, so more clips are also more updates. Three arms take
    this apart: one epoch, as in the paper; every size for as many updates as the largest; and the same number of clips
    from fewer scenes. plan.json says what is measured and how it is judged, before anything is trained: the error of
    held-out frames after 4 actions, and the regret of choices in stored decisions. The page has trends, fits with
    bootstrap intervals, and how much of the gain the smallest size has when it is trained as long as the largest.

    Writes data-scaling.html, .svg, .png and .json, and all weights, into the folder. After Ctrl-C the same command goes
    on; a training loses a minute at most. docs/data-scaling.md has what came out here.

    Args:
        data: Folder of `wiw collect navigation`, of panoramas with depth. If not given, 16 apartments are collected in
            128x256 into --out, which are enough for --small.
        out: New folder, or one that the same command began.
        small: Whether to take the numbers of the small version where no others are given: 32x64 pixels, 3,200 clips.
        models: Of warpnet and pocket; both if not given.
        clips: The largest size; the smallest is a hundredth of it. 12,800 if not given.
        sizes: How many sizes, evenly spaced in logarithm; 4 if not given.
        size: Height and width that panoramas are brought to; 64 128 if not given.
        seeds: Each draws other clips and scenes, and other weights to begin with; 0,1 if not given.
        held_out: Share of the dataset's scenes that is held out; 0.25 if not given.
        held_out_clips: Clips of these that models are measured on; 200 if not given.
        decision_scenes: Scenes of the stored decisions; apartments:val:40 if not given.
        decisions_per_scene: Decisions in each, fewer where there is no room; 30 if not given.
        imagenav: Episodes of ImageNav in which the models of the first seed are run too; none if 0.
        workers: Processes, each with one thread; the result does not depend on it.
    """
    from dataclasses import replace

    from wiw.cli.bars import Bars
    from wiw.cli.numbers import parse_numbers
    from wiw.cli.stop import announce_resume
    from wiw.studies.data_scaling import data_scaling
    from wiw.studies.data_scaling_plan import FULL, SMALL

    given: dict[str, Any] = {
        "models": None if models is None else [name.strip() for name in models.split(",")],
        "clips": clips,
        "sizes": sizes,
        "size": size,
        "seeds": parse_numbers(seeds, int, "seeds"),
        "held_out": held_out,
        "held_out_clips": held_out_clips,
        "decision_scenes": decision_scenes,
        "decisions_per_scene": decisions_per_scene,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    lists = {name: tuple(value) for name, value in changes.items() if isinstance(value, list)}
    settings = replace(SMALL if small else FULL, **changes | lists)
    with announce_resume(), Bars() as bars:
        found = data_scaling(data, out, settings, workers=workers, episodes=imagenav, watch=bars.show)
    found.summary()
    for path in found.save():
        print(path)
    return 0


def study_errors(
    *,
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/errors"),
    small: bool = False,
    tasks: Annotated[str | None, arg(metavar="A,B,...")] = None,
    kinds: Annotated[str | None, arg(metavar="A,B,...")] = None,
    doses: Annotated[int | None, arg(metavar="1|2|3")] = None,
    episodes: Annotated[int | None, arg(metavar="N")] = None,
    seed: Annotated[int | None, arg(metavar="N")] = None,
    scenes: Annotated[str | None, arg(metavar="SPEC")] = None,
    per_scene: Annotated[int | None, arg(metavar="N")] = None,
    preset: Annotated[str | None, arg(metavar="NAME|FILE")] = None,
    tier: Literal["near", "far", "beyond", "all"] | None = None,
    policy: Annotated[str | None, arg(metavar="NAME")] = None,
    size: Annotated[tuple[int, int] | None, arg(metavar="H W")] = None,
    fidelity_share: Annotated[float | None, arg(metavar="SHARE")] = None,
    lpips: Annotated[str | None, arg(metavar="auto|DIR")] = None,
    read_only: bool = False,
    workers: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Find which kind of error costs success: true futures are made worse by known doses, one error at a time.

    $ wiw study errors --small --workers 2                     # imagenav, four errors; about three minutes on two cores
    $ wiw study errors --tasks imagenav --size 144 256 --workers 4
    $ wiw study errors --tasks imagenav --preset foresight --tier beyond --size 144 256
    $ wiw study errors --workers 16 --lpips auto               # all tasks, errors and doses: hours
    $ wiw study errors --tasks ar --read-only                  # tables and page of what has been run so far

    There are errors of looks (blur, noise, tint, resolution), flicker, control (scale, direction, lag, drift, ignored)
    and content (missing, moved, invented, open); `wiw list errors` says what each does and the unit of its doses. All
    arms, none and oracle among them, run on the same episodes, and every number is paired with the oracle: success,
    regret of the choices, and how far frames and cameras were from the true ones. An error that makes no sense in a
    task is left out and named.

    Writes errors.html, .svg, .png and .json into the folder, beside ordinary runs that hold a few episodes each, of all
    arms. After Ctrl-C the same command goes on, and with more kinds, doses or tasks it adds these. Any run takes single
    errors as arms: `wiw run imagenav --arms none,error-blur@16,oracle`. docs/errors.md has what came out here.

    Args:
        out: New folder, or one that the same command began.
        small: Whether to take the numbers of the small version where no others are given.
        tasks: Of imagenav, ar, aeqa and manipulation; all if not given.
        kinds: Of the errors; all if not given.
        doses: How many doses of each, the largest ones; 3 if not given.
        episodes: Of each task; 100 if not given.
        seed: Of all randomness; 0 if not given.
        scenes: As in `wiw run`, of tasks in which an agent walks.
        per_scene: Episodes in a scene; 2 if not given, as intervals are over scenes.
        preset: Rules of the tasks, as in `wiw run`; each task's default if not given.
        tier: Of imagenav, as in `wiw run`.
        policy: The preset's, or else the task's own, if not given.
        size: Height and width of the oracle's frames; 576 1024, or 480 480 before a table, if not given. The policy
            matcher looks at 64x128, so that less is enough and several times faster.
        fidelity_share: Share of the decisions at which regret and distances are measured; 0.25 if not given.
        lpips: Weights of LPIPS (see `wiw run --lpips`); 1 - SSIM takes its place if not given.
        read_only: Whether to run nothing, and show what is there.
        workers: Processes; results do not depend on it.
    """
    from dataclasses import replace

    from wiw.cli.bars import Bars
    from wiw.cli.stop import announce_resume
    from wiw.studies.errors import FULL, SMALL, read_errors
    from wiw.studies.errors import study_errors as study

    texts = {"tasks": tasks, "kinds": kinds}
    given: dict[str, Any] = {
        name: tuple(part.strip() for part in text.split(",")) for name, text in texts.items() if text is not None
    }
    given |= {
        "doses": doses,
        "episodes": episodes,
        "seed": seed,
        "scenes": scenes,
        "per_scene": per_scene,
        "preset": preset,
        "tier": tier,
        "policy": policy,
        "size": size,
        "fidelity_share": fidelity_share,
    }
    changes = {name: value for name, value in given.items() if value is not None}
    settings = replace(SMALL if small else FULL, **changes)
    if read_only:
        found = read_errors(out, settings)
    else:
        with announce_resume(), Bars() as bars:
            found = study(out, settings, workers=workers, lpips=lpips, watch=bars.show)
    found.summary()
    for path in found.save():
        print(path)
    return 0


STUDIES: tuple[tuple[Callable[..., int], str, str], ...] = (
    (study_data_scaling, "data-scaling", "Does a world model get better with data, or with updates?"),
    (study_errors, "errors", "What kind of error of imagined futures costs success?"),
)
"""Studies with commands of their own: function, name and summary; the others are YAML files."""
