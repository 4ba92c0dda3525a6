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

    Also works during the run.

    Args:
        run: The run's folder.
        out: Where to write; report.html in the run's folder if not given.
        episodes: How many to show with pictures, the most telling first; all that kept them (see `wiw run
            --keep-images`) if not given.
        max_mb: Most megabytes of the file: pictures are made smaller, then episodes left out, until it fits.
        judge: Judge whose marks are shown, by name or digest (see `wiw judge`); the run's own if not given.
    """
    from wiw.report.tables import print_costs, print_fidelity
    from wiw.studies.run_log import load_run

    log = load_run(run, judge)
    log.summary()
    print_costs(log)
    print_fidelity(log)
    print(f"\nreport  {log.report(out, episodes=episodes, max_mb=max_mb)}")
    return 0
