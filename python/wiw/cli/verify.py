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
    """Run some episodes of a run again, in all its arms, and compare what is decided and measured with the record.

    $ wiw verify runs/first
    $ wiw verify runs/first --episodes 10 --seed 1

    Says which decision differs first, and in what. Exit code 0 if nothing does, 1 otherwise.

    Args:
        run: The run's folder.
        episodes: How many, drawn at random; all if the run has fewer.
        seed: Of that draw.
    """
    from wiw.runs.verify import verify as check

    found = check(run, episodes, seed)
    print(found)
    return 0 if found.same else 1
