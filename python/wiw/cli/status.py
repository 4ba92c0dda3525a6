# SPDX-License-Identifier: Apache-2.0
"""`wiw status`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.terminal import printable


def status(runs: Positional[Annotated[tuple[Path, ...], arg(metavar="RUN")]], /) -> int:
    """Show how far runs are: shards, ended episodes, errors, time left. Only reads, also while runs are going on.

    $ wiw status runs/first
    $ wiw status runs/a runs/b

    States: done; running (by a process of this machine); on HOST (run by another machine when it was last written);
    stopped. The time left is estimated from the episodes that have ended since the present process began.

    Args:
        runs: Folders of runs, or folders that hold the folders of shards.
    """
    from wiw.runs.status import status as read_status

    print("\n\n".join(printable(str(read_status(run))) for run in runs))
    return 0
