# SPDX-License-Identifier: Apache-2.0
"""`wiw quality`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from wiw.ray_cluster import HERE, Engine


def quality(
    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)")]],
    /,
    *,
    scorer: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="COMMAND|laion")] = (),
    frames: Annotated[int, arg(metavar="N")] = 200,
    arms: Annotated[str | None, arg(metavar="A,B,...")] = None,
    lpips: Annotated[str | None, arg(metavar="auto|FOLDER")] = None,
    out: Annotated[Path | None, arg(metavar="FOLDER")] = None,
    deadline: Annotated[float, arg(metavar="SECONDS")] = 300.0,
    workers: Annotated[int, arg(metavar="N")] = 1,
    place: Annotated[Engine, arg(name="")] = HERE,
) -> int:
    """Do better-looking frames help more? Compare success with visual quality and controllability of imagined frames.

    $ wiw run imagenav --arms copy,warp,warpnet,oracle --keep-images all --out runs/four
    $ wiw quality runs/four                                    # sharpness, colourfulness, SSIM to the true frames
    $ wiw quality runs/four --lpips auto                       # controllability as in the paper: 1 - LPIPS
    $ wiw quality runs/four --scorer "python my_scorer.py"     # any scorer, run in a separate process
    $ wiw quality runs/four runs/more --arms four/warp,svd     # arms from several runs on the same episodes

    Quality is how good a frame looks on its own; controllability is how close it is to what would really have been
    seen, which is known for runs with --fidelity or with an oracle arm. Frames are scored as the run keeps them (what
    the reviser saw, 160 pixels high), at the same places and for the same plans in every arm, so the run must keep
    images (`wiw run --keep-images`). Writes quality.html, .svg, .png and .json: a table, rank correlations over the
    arms, and the paper's two figures.

    A scorer is any command. It is started once. Its first line on standard output identifies it; then it reads paths of
    PNG files from standard input, one per line, and answers each with one line, in any order:

    {"scorer": "my-musiq", "version": "1.0", "licence": "MIT", "scores": {"musiq": [0, 100]}}
    {"path": "/tmp/wiw-quality-x/5f3a.png", "scores": {"musiq": 61.5}}

    Flush each line, print anything else to standard error, exit with code 0. If "aesthetic" [1, 10] and "musiq" [0,
    100] are both given, the paper's q = (10 aesthetic + MUSIQ) / 2 is computed as well. Scores are stored next to the
    run, in quality.sqlite: after Ctrl-C the same command scores what is missing. See docs/quality.md.

    Args:
        runs: Folders of runs: one, or several with the same task, seed and episodes.
        scorer: A command, or laion or laion:FOLDER (LAION's aesthetic predictor, with your own copy of its weights);
            may be repeated. Sharpness and colourfulness are always computed.
        frames: Number of frames to score in each arm.
        arms: Arms to compare; RUN/ARM if several runs have an arm of that name. Default: all with a world model.
        lpips: Weights of LPIPS (see `wiw run --lpips`). Default: none, SSIM only.
        out: Folder to write. Default: quality in the first run's folder.
        deadline: Seconds that a scorer may be silent.
        workers: Ray actors that score frames, each with its own scorers.
        place: Where frames are scored.
    """
    from wiw.cli.bars import Bars
    from wiw.studies.quality import quality as score

    names = None if arms is None else [name.strip() for name in arms.split(",") if name.strip()]
    with Bars() as bars:
        found = score(
            runs, scorer, frames=frames, arms=names, lpips=lpips, out=out, deadline=deadline, workers=workers,
            place=place, watch=bars.show,
        )  # fmt: skip
    found.summary()
    for path in found.save():
        print(path)
    return 0
