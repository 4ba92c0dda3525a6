# SPDX-License-Identifier: Apache-2.0
"""`wiw export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import JudgeName

Folder = Annotated[Path | None, arg(metavar="DIR")]


def export(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    csv: Folder = None,
    parquet: Folder = None,
    rerun: Annotated[Path | None, arg(metavar="FILE.rrd")] = None,
    judge: JudgeName = None,
) -> int:
    """Write a run as plain tables for other programs, or as a recording for the Rerun viewer.

    $ wiw export runs/first --csv tables
    $ wiw export runs/first --parquet tables --rerun first.rrd

    Tables: arms, episodes, outcomes, decisions and candidates; for tasks that have them also kinds, anytime,
    anytime_differences, twins and judgements (by all judges). An interrupted export leaves no partial file.

    Args:
        run: The run's folder.
        csv: New folder for CSV files.
        parquet: New folder for Parquet files; requires pyarrow.
        rerun: Recording for `rerun FILE.rrd`, with the images that the run kept; requires rerun-sdk.
        judge: Judge whose marks are exported, by name or digest (see `wiw judge`). Default: the run's own.
    """
    from wiw.studies.run_log import load_run

    for path in load_run(run, judge).export(csv, parquet, rerun):
        print(path)
    return 0
