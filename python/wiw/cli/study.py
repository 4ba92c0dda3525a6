# SPDX-License-Identifier: Apache-2.0
"""`wiw study data-scaling`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

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
