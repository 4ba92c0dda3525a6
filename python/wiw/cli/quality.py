# SPDX-License-Identifier: Apache-2.0
"""`wiw quality`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg

from wiw.ray_cluster import HERE, Engine


def quality(
    runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]")]],
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
    """Does looking better help more? Visual quality and controllability of imagined frames, against success.

    $ wiw run imagenav --arms copy,warp,warpnet,oracle --keep-images all --out runs/four
    $ wiw quality runs/four                                    # sharpness, colourfulness, SSIM to the true frames
    $ wiw quality runs/four --lpips auto                       # controllability as in the paper: 1 - LPIPS
    $ wiw quality runs/four --scorer "python my_scorer.py"     # any scorer, in a process of its own
    $ wiw quality runs/four runs/more --arms four/warp,svd     # arms of several runs on the same episodes

    Quality is what a frame looks like by itself; controllability is how near it is to what would really have been seen,
    known of runs with --fidelity or with an arm oracle. Frames are scored as the run keeps them (what the reviser saw,
    160 pixels high), the same places and plans of every arm, so pictures must be kept (`wiw run --keep-images`). Writes
    quality.html, .svg, .png and .json: a table, rank correlations over the arms, and the paper's two figures.

    A scorer is any command. It is started once. Its first line on the standard output says who it is; then it reads
    paths of PNG files, one a line, from the standard input, and answers each by a line, in any order:

    {"scorer": "my-musiq", "version": "1.0", "licence": "MIT", "scores": {"musiq": [0, 100]}}
    {"path": "/tmp/wiw-quality-x/5f3a.png", "scores": {"musiq": 61.5}}

    Flush each line, print anything else to the standard error, end with exit code 0. Where "aesthetic" [1, 10] and
    "musiq" [0, 100] are both given, the paper's q = (10 aesthetic + MUSIQ) / 2 is computed as well. Scores are stored
    beside the run, in quality.sqlite: after Ctrl-C the same command scores what is missing. docs/quality.md has more.

    Args:
        runs: Folders of runs: one, or several of the same task, seed and episodes.
        scorer: A command, or laion or laion:FOLDER (LAION's aesthetic predictor, with your own copy of its weights).
            May be given several times. Sharpness and colourfulness are always there.
        frames: To score of each arm.
        arms: To compare; all that imagine if not given. RUN/ARM where several runs have an arm of that name.
        lpips: Weights of LPIPS (see `wiw run --lpips`); SSIM alone if not given.
        out: Where to write; quality in the first run's folder if not given.
        deadline: Seconds that a scorer may be silent.
        workers: Actors of Ray that score frames, each with scorers of its own.
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
