# SPDX-License-Identifier: Apache-2.0
"""`wiw compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.options import JudgeName

Run = Positional[Annotated[Path, arg(metavar="RUN")]]
Arm = Annotated[str | None, arg(metavar="NAME")]


def compare(
    first: Run,
    second: Run,
    /,
    *,
    arm: Arm = None,
    other: Arm = None,
    judge: JudgeName = None,
    unlike_budgets: bool = False,
) -> int:
    """Compare two runs on the same episodes, the second minus the first.

    $ wiw compare runs/old runs/new                          # every arm that both runs have
    $ wiw compare runs/old /elsewhere/new --arm warp         # one arm
    $ wiw compare runs/a runs/b --arm warp --other mine      # mine from the second run minus warp from the first
    $ wiw compare runs/a runs/b --judge rules+llm            # with the marks that `wiw judge` added to both

    Episodes are compared in pairs, so the runs must have the same task, seed, scenes and episodes, and the same budget
    of decisions and actions; otherwise the error says what differs. Other differences, such as the policy's weights or
    the version of wiw, are listed below the table.

    Args:
        first: Folder of a run.
        second: Folder of the run to compare with it.
        arm: Arm of both runs, or of the first. Default: all arms they share.
        other: Arm of the second run, if it has a different name there.
        judge: Judge whose marks are compared, by name or digest. Default: each run's own. Different judges are refused.
        unlike_budgets: Compare the runs even if their episodes have different budgets of decisions or actions.
    """
    from wiw.errors import ArgumentError
    from wiw.report.tables import print_summary
    from wiw.studies.compare import compare as compare_runs

    if other is not None and arm is None:
        raise ArgumentError(f"compare: --other {other} is an arm of the second run; name one of the first with --arm")
    print_summary(compare_runs(first, second, arm, other, judge=judge, unlike_budgets=unlike_budgets))
    return 0
