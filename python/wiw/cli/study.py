# SPDX-License-Identifier: Apache-2.0
"""`wiw study data-scaling` and `wiw study errors`: the studies with their own commands (`STUDIES`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import arg


def study_data_scaling(
    *,
    data: Annotated[Path | None, arg(metavar="DIR")] = None,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
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
    device: Annotated[str | None, arg(metavar="DEVICE", help_behavior_hint="")] = None,
) -> int:
    """Does a world model improve with data, or with updates? Train small models on nested subsets of a dataset.

    $ wiw study data-scaling --small --workers 2               # collects its own data; under an hour on two cores
    $ wiw collect navigation --scenes apartments:train:80 --out data --workers 4
    $ wiw study data-scaling --data data --workers 4 --out runs/full    # 128 to 12,800 clips in 64x128; hours
    $ wiw study data-scaling --data data --models warpnet --seeds 0,1,2 --imagenav 100 --out runs/warpnet

    The paper trains on more and more clips for one epoch each, so more clips also mean more updates. Three arms
    separate the two: one epoch, as in the paper; every size for as many updates as the largest; and the same number of
    clips from fewer scenes. Before anything is trained, plan.json records what is measured and how it is judged: the
    error of held-out frames after 4 actions, and the regret of choices in stored decisions. The page shows trends, fits
    with bootstrap intervals, and how much of the gain the smallest size achieves when trained as long as the largest.

    Writes data-scaling.html, .svg, .png and .json, and all weights, into the folder. After Ctrl-C the same command
    continues; a training loses a minute at most. docs/data-scaling.md has our results.

    Args:
        data: Folder of `wiw collect navigation`, with panoramas and depth. Default: collect 16 apartments at 128x256
            into --out, which is enough for --small.
        out: New folder, or one that the same command started. Default: runs/data-scaling, with --small
            runs/data-scaling-small.
        small: Use the small version's numbers where none are given: 32x64 pixels, 3,200 clips.
        models: Models to train, of warpnet and pocket. Default: both.
        clips: The largest number of clips; the smallest is a hundredth of it. Default: 12,800.
        sizes: Number of sizes, evenly spaced on a logarithmic scale. Default: 4.
        size: Height and width to which panoramas are resized. Default: 64 128.
        seeds: Seeds; each samples its own clips, scenes and initial weights. Default: 0,1.
        held_out: Share of the dataset's scenes that is held out. Default: 0.25.
        held_out_clips: Held-out clips that models are evaluated on. Default: 200.
        decision_scenes: Scenes of the stored decisions. Default: apartments:val:40.
        decisions_per_scene: Decisions per scene, fewer if there is no room. Default: 30.
        imagenav: Episodes of ImageNav in which to run the first seed's models as well; 0 for none.
        workers: Number of processes, each with one thread; on the CPU, results do not depend on it.
        device: Where to train: cpu, cuda, cuda:1, ... Default: the GPU if there is one, which all workers share. Models
            are evaluated on the CPU.
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
    folder = _choose_folder(out, "data-scaling", small)
    with announce_resume(), Bars() as bars:
        found = data_scaling(data, folder, settings, workers=workers, episodes=imagenav, device=device, watch=bars.show)
    found.summary()
    for path in found.save():
        print(path)
    return 0


def study_errors(
    *,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
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
    distances: Annotated[Path | None, arg(metavar="DIR")] = None,
    read_only: bool = False,
    workers: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Find out which kinds of error cost success, by degrading true futures with known doses of one error at a time.

    $ wiw study errors --small --workers 2                     # imagenav, four errors; about three minutes on two cores
    $ wiw study errors --tasks imagenav --size 144 256 --workers 4
    $ wiw study errors --tasks imagenav --preset foresight --tier beyond --size 144 256
    $ wiw study errors --workers 16 --lpips auto               # all tasks, errors and doses: hours
    $ wiw study errors --tasks ar --read-only                  # tables and page of everything run so far
    $ wiw study errors --tasks ar --episodes 8 --fidelity-share 1 --lpips auto --out runs/lpips
    $ wiw study errors --tasks ar --read-only --distances runs/lpips    # success of one study, distances of the other

    The errors concern looks (blur, noise, tint, resolution), flicker, control (scale, direction, lag, drift, ignored)
    and content (missing, moved, invented, open); `wiw list errors` explains each one and the unit of its doses. All
    arms, including none and oracle, run on the same episodes, and every number is paired with the oracle's: success,
    regret of the choices, and the distance of frames and cameras from the true ones. Errors that make no sense in a
    task are skipped and listed.

    Writes errors.html, .svg, .png and .json into the folder, next to ordinary runs with a few episodes of all arms
    each. After Ctrl-C the same command continues; with more kinds, doses or tasks it adds them. Any run accepts single
    errors as arms: `wiw run imagenav --arms none,error-blur@16,oracle`. docs/errors.md has our results.

    Args:
        out: New folder, or one that the same command started. Default: runs/errors, with --small runs/errors-small.
        small: Use the small version's numbers where none are given.
        tasks: Tasks, of imagenav, ar, aeqa and manipulation. Default: all.
        kinds: Kinds of error. Default: all.
        doses: Number of doses of each, counted from the largest. Default: 3.
        episodes: Episodes of each task. Default: 100.
        seed: Seed of all randomness. Default: 0.
        scenes: Scenes, as in `wiw run`, for tasks in which an agent walks.
        per_scene: Episodes per scene. Default: 2, as intervals are over scenes.
        preset: Preset of the tasks, as in `wiw run`. Default: each task's default.
        tier: Tier of imagenav, as in `wiw run`.
        policy: Policy. Default: the preset's, or else the task's.
        size: Height and width of the oracle's frames. Default: 576 1024, or 480 480 for manipulation. Policy matcher
            only looks at 64x128, so a smaller size is enough for it and several times faster.
        fidelity_share: Share of the decisions at which regret and distances are measured. Default: 0.25.
        lpips: Weights of LPIPS (see `wiw run --lpips`). Default: none, 1 - SSIM instead.
        distances: Folder of another study of the same tasks by the same agent, often of fewer episodes; show its
            distances and regret with the success of this one. Default: this one's own.
        read_only: Run nothing, and show what exists.
        workers: Number of processes; results do not depend on it.
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
    folder = _choose_folder(out, "errors", small)
    if read_only:
        found = read_errors(folder, settings, distances=distances)
    else:
        with announce_resume(), Bars() as bars:
            found = study(folder, settings, workers=workers, lpips=lpips, distances=distances, watch=bars.show)
    found.summary()
    for path in found.save():
        print(path)
    return 0


def _choose_folder(given: Path | None, name: str, small: bool) -> Path:
    """Return the folder of a study; the small version has one of its own, since the full one asks for other runs."""
    return Path("runs") / f"{name}{'-small' if small else ''}" if given is None else given


STUDIES: tuple[tuple[Callable[..., int], str, str], ...] = (
    (study_data_scaling, "data-scaling", "Does a world model improve with data, or with updates?"),
    (study_errors, "errors", "Which kinds of error in imagined futures cost success?"),
)
"""Studies with their own commands: function, name and summary; the others are YAML files."""
