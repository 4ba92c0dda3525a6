# SPDX-License-Identifier: Apache-2.0
"""`wiw status`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.terminal import printable
from wiw.errors import ArgumentError

Runs = Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)")]


def status(runs: Positional[Runs], /) -> int:
    """Show the progress of runs: shards, finished episodes, errors, time left. Read-only, so safe during a run.

    $ wiw status runs/first
    $ wiw status runs/a runs/b

    States: done; running (by a process on this machine); on HOST (run by another machine when last written); stopped.
    The time left is estimated from the episodes finished since the current process started.

    Args:
        runs: Folders of runs, or folders that contain the folders of shards.
    """
    if not runs:
        raise ArgumentError("status: expected at least one run, as in `wiw status runs/first`; got none")
    print("\n\n".join(printable(_describe(run)) for run in runs))
    return 0


def _describe(run: Path) -> str:
    """Return a run's progress, and the states of the jobs submitted for it."""
    from wiw.errors import StoreError
    from wiw.runs.status import status as read_status
    from wiw.runs.submission import find_states

    jobs = [
        f"job {job.id}  {job.state}  {' '.join(job.arguments[:2])} {_name_shard(job.arguments)}"
        for job in find_states(run)
    ]
    try:
        return "\n".join([str(read_status(run)), *jobs])
    except StoreError as error:
        if not jobs:
            raise
        return "\n".join([str(error), *jobs])


def _name_shard(arguments: Sequence[str]) -> str:
    return arguments[arguments.index("--shard") + 1] if "--shard" in arguments else ""
