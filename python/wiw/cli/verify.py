# SPDX-License-Identifier: Apache-2.0
"""`wiw verify`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def verify(
    run: Positional[Annotated[Path, arg(metavar="RUN")]],
    /,
    *,
    episodes: Annotated[int, arg(metavar="K")] = 3,
    seed: Annotated[int, arg(metavar="N")] = 0,
) -> int:
    """Rerun some episodes of a run, in all its arms, and compare every decision and measurement with the record.

    $ wiw verify runs/first
    $ wiw verify runs/first --episodes 10 --seed 1

    Prints the first decision that differs, and how. Exit code 0 if nothing differs, 1 otherwise.

    Args:
        run: The run's folder.
        episodes: Number of episodes, sampled at random; all if the run has fewer.
        seed: Seed of that sample.
    """
    from wiw.runs.verify import verify as check

    found = check(run, episodes, seed)
    print(found)
    return 0 if found.same else 1
