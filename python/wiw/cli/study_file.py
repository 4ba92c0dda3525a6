# SPDX-License-Identifier: Apache-2.0
"""`wiw study NAME` and `wiw study FILE.yaml`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, UseAppendAction, arg


def run_study(
    study: Positional[Annotated[str, arg(metavar="NAME|FILE.yaml")]],
    /,
    *,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
    set: Annotated[tuple[str, ...], UseAppendAction, arg(metavar="NAME=VALUE")] = (),
    small: bool = False,
    workers: Annotated[int, arg(metavar="N")] = 1,
) -> int:
    """Run a study: execute the runs listed in its file, and write a page with its figures and tables.

    $ wiw study front-vs-panorama --small
    $ wiw study vlm --set server=http://localhost:8000/v1 --set model=qwen2.5-vl-72b-awq --workers 2
    $ wiw study models --set arms=none,copy,warp,mine=my_model.py:MyModel,oracle --set episodes=100
    $ wiw study my.yaml --set episodes=100

    Writes study.html, study.json, study.yaml (the file with its variables filled in) and an SVG of each figure. Each
    run is a folder next to them, which works with `wiw report` and `wiw compare` like any other. After Ctrl-C the same
    command continues; for a finished study it only redraws the page, and runs or arms added since are run. `wiw list
    studies` lists the built-in ones, `wiw study --help` shows how to write one.

    Args:
        study: Name of a study, or path of a YAML file.
        out: Folder to write. Default: runs/study-NAME, with --small runs/study-NAME-small.
        set: Value of one of the study's variables, as YAML; may be repeated.
        small: Use the study's small values, for a quick look.
        workers: Number of processes; results do not depend on it.
    """
    from wiw.cli.stop import announce_resume
    from wiw.cli.study import STUDIES
    from wiw.errors import ArgumentError
    from wiw.studies.study import study as run
    from wiw.studies.study_file import list_studies, parse_variables
    from wiw.suggestions import did_you_mean

    known = sorted([*list_studies(), *(name for _, name, _ in STUDIES)])
    if Path(study).suffix not in (".yaml", ".yml") and study not in known:
        raise ArgumentError(
            f"study: no study '{study}'; choose from {', '.join(known)}, or give the path of a .yaml "
            f"file.{did_you_mean(study, known)}"
        )
    with announce_resume():
        found = run(study, out=out, variables=parse_variables(set), small=small, workers=workers)
    found.summary()
    for path in found.save():
        print(path)
    for reason in found.invalid:
        print(f"INVALID RUN, do not report: {reason}")
    return 1 if found.invalid else 0
