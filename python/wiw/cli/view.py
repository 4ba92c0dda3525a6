# SPDX-License-Identifier: Apache-2.0
"""`wiw view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def view(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
) -> int:
    """Write pages to walk through a run: all episodes with filters, and every decision of each on a timeline.

    $ wiw view runs/first
    $ wiw view runs/first --out pages

    A page shows what the agent saw, what it imagined for each plan, beside what would really have been seen where the
    run knows it, scores, choice, cost, and the way on the map. Pictures are there for the episodes that keep them:
    `wiw run --keep-images all` keeps those of every decision. Also works while the run is going on.

    Args:
        run: The run's folder.
        out: Folder to write, new or with an older view; `view` in the run's folder if not given.
    """
    from wiw.report.site import write_view
    from wiw.studies.run_log import load_run

    log = load_run(run)
    site = write_view(log, out or log.path / "view")
    megabytes = site.size / 1e6
    print(f"{site.episodes} episodes, {site.pictures} pictures of {megabytes:.1f} MB\nview    {site.index}")
    return 0
