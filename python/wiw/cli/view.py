# SPDX-License-Identifier: Apache-2.0
"""`wiw view`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import JudgeName


def view(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    out: Annotated[Path | None, arg(metavar="DIR")] = None,
    judge: JudgeName = None,
) -> int:
    """Write HTML pages to browse a run: all episodes with filters, and a timeline of each episode's decisions.

    $ wiw view runs/first
    $ wiw view runs/first --out pages

    A page shows the agent's observation, the imagined frames of each plan (next to the true ones, if the run measured
    fidelity), scores, choice, cost, and the path on the map. Images are shown for the episodes that kept them; `wiw run
    --keep-images all` keeps them for every decision. Also works while the run is still going.

    Args:
        run: The run's folder.
        out: Folder to write, new or with an older view. Default: `view` in the run's folder.
        judge: Judge whose marks are shown, by name or digest (see `wiw judge`). Default: the run's own.
    """
    from wiw.report.site import write_view
    from wiw.studies.run_log import load_run

    log = load_run(run, judge)
    site = write_view(log, out or log.path / "view")
    megabytes = site.size / 1e6
    print(f"{site.episodes} episodes, {site.pictures} images, {megabytes:.1f} MB\nview    {site.index}")
    return 0
