# SPDX-License-Identifier: Apache-2.0
"""`wiw report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def report(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    out: Annotated[Path | None, arg(metavar="FILE")] = None,
) -> int:
    """Print the tables of a run and write its HTML report: one self-contained file.

    $ wiw report runs/first
    $ wiw report runs/first --out first.html

    Also works during the run.

    Args:
        run: The run's folder.
        out: Where to write; report.html in the run's folder if not given.
    """
    from wiw.report.tables import print_costs, print_fidelity
    from wiw.studies.run_log import load_run

    log = load_run(run)
    log.summary()
    print_costs(log)
    print_fidelity(log)
    print(f"\nreport  {log.report(out)}")
    return 0
