# SPDX-License-Identifier: Apache-2.0
"""`wiw blame`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.stop import stoppable


def blame(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    arm: Annotated[str | None, arg(metavar="A,B,...")] = None,
    episodes: Annotated[int | None, arg(metavar="N")] = None,
    workers: Annotated[int | None, arg(metavar="N")] = None,
    retry_failed: bool = False,
) -> int:
    """Which stage of the loop the failures of a run are due to: imagination, scoring or proposals.

    $ wiw blame runs/first
    $ wiw blame runs/first --arm warp
    $ wiw blame runs/first --arm none,warp --episodes 20 --workers 2

    Every failed episode is run again, with the same random numbers, four times: with the oracle as the world model,
    with plans scored by where they truly lead, with a plan from the true map among the proposals, and with all three.
    What turns failure into success says which stage to work on:

      imagination  the true futures would have sufficed: a better world model helps
      scoring      a good plan was among the proposals, and neither its true future nor anything else told the agent
      proposals    no good plan was proposed; the agent would have recognised one
      joint        only all three together mend it
      beyond       not even they do: the budget, the actions, or the answer

    Ctrl-C and SIGTERM lose nothing: the same command goes on, and so does one with more episodes. What was run is kept
    in RUN/blame, a run of its own for `wiw view RUN/blame`; `wiw report RUN` and `wiw view RUN` show what was found.

    Args:
        run: The run's folder.
        arm: One arm or several; all if not given.
        episodes: Most failed episodes of an arm, drawn at random; all if not given.
        workers: Processes; as many as the run was begun with if not given. Results do not depend on it.
        retry_failed: Whether to run episodes again whose infrastructure failed under a swap.
    """
    from wiw.studies.attribute import attribute

    arms = None if arm is None else [name.strip() for name in arm.split(",") if name.strip()]
    found = stoppable(lambda: attribute(run, arms, episodes, workers, retry_failed=retry_failed), run, "blame")
    found.summary()
    print(f"\nepisodes  {found.save()}")
    broken = sum(len(line.broken) for line in found.arms)
    if broken:
        print(f"Once the infrastructure is mended:  wiw blame {run} --retry-failed", file=sys.stderr)
    return 1 if broken else 0
