# SPDX-License-Identifier: Apache-2.0
"""`wiw report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import JudgeName


def report(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
    episodes: Annotated[int | None, arg(metavar="N")] = None,
    max_mb: Annotated[float | None, arg(metavar="N")] = None,
    judge: JudgeName = None,
) -> int:
    """Print the tables of a run and write its HTML report: one self-contained file.

    $ wiw report runs/first
    $ wiw report runs/first --out first.html --max-mb 1
    $ wiw report runs/first --judge rules+llm

    Also works while the run is still going.

    Args:
        run: The run's folder.
        out: File to write. Default: report.html in the run's folder.
        episodes: Number of episodes to show with images, the most informative first. Default: all that kept them (see
            `wiw run --keep-images`).
        max_mb: Maximum file size in megabytes: images are shrunk, then episodes dropped, until it fits.
        judge: Judge whose marks are shown, by name or digest (see `wiw judge`). Default: the run's own.
    """
    from wiw.report.tables import print_costs, print_fidelity
    from wiw.studies.run_log import load_run

    log = load_run(run, judge)
    written = log.report(out, episodes=episodes, max_mb=max_mb)
    log.summary()
    print_costs(log)
    print_fidelity(log)
    print(f"\nreport  {written}")
    return 0
