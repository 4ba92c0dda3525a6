# SPDX-License-Identifier: Apache-2.0
"""`wiw power`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from wiw.analysis.power import Power

Number = Annotated[float, arg(metavar="X")]
Count = Annotated[int, arg(metavar="N")]
USUAL = (5.0, 10.0, 15.0, 20.0, 30.0)


def power(
    difference: Positional[Annotated[float | None, arg(metavar="POINTS")]] = None,
    /,
    *,
    scenes: Annotated[int | None, arg(metavar="N")] = None,
    base: Number = 20.0,
    losses: Number = 2.0,
    correlation: Number = 0.05,
    per_scene: Count = 5,
    chance: Number = 0.8,
    arms: Count = 1,
) -> int:
    """Compute how many episodes a run needs to show that one arm succeeds more often than another, or what it can show.

      $ wiw power                        # for differences from 5 to 30 points
      $ wiw power 10                     # +10 points, e.g. from 20 to 30 %
      $ wiw power 10 --arms 4            # as one of four arms compared with the same base
      $ wiw power -5 --base 50         # an arm that is 5 points worse
      $ wiw power --scenes 40            # the least difference that 40 scenes of 5 episodes can show

    Arms are compared on the same episodes, so only episodes count in which one succeeds and the other fails: won or
    lost. 30 % won and 20 % lost give the same difference as 12 % won and 2 % lost, but far weaker evidence, so --losses
    matters as much as the difference. Scenes count more than episodes: with a correlation above 0, more episodes of
    the same scenes soon stop helping.

    The defaults are near what 210 episodes in 42 generated apartments gave: 18 % without a world model; with the
    oracle 36 % won and 2 % lost; differences correlate within an apartment by -0.06 to 0.06.

    Args:
        difference: Percentage points of success rate; a table of usual values if neither it nor --scenes is given.
        scenes: Number of scenes; computes the smallest difference that they can show.
        base: Success rate of the arm compared with, percent.
        losses: Percent of episodes that the better arm loses.
        correlation: Correlation between the differences of two episodes of a scene.
        per_scene: Episodes in each scene.
        chance: Power: the probability of showing the difference if there is one.
        arms: Number of arms compared with the same base; their p values are Holm-adjusted.
    """
    from wiw.analysis.power import power as plan

    def plan_power(points: float | None, scenes: int | None = None) -> Power:
        return plan(
            points, scenes=scenes, base=base, losses=losses, correlation=correlation, per_scene=per_scene,
            chance=chance, arms=arms,
        )  # fmt: skip

    if difference is not None or scenes is not None:
        print(plan_power(difference, scenes))
        return 0
    _table([plan_power(points) for points in USUAL if base + points + losses <= 100], chance)
    return 0


def _table(plans: Sequence[Power], chance: float) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=f"Needed to show a difference with a chance of {100 * chance:g} %",
        title_justify="left",
        box=box.SIMPLE_HEAD,
    )
    for column in ("points", "won/lost %", "scenes", "episodes", "by interval %", "by test %"):
        table.add_column(column, justify="right")
    for one in plans:
        table.add_row(
            f"{one.difference:+g}",
            f"{one.wins:g}/{one.losses:g}",
            str(one.scenes),
            str(one.episodes),
            f"{100 * one.by_interval:.0f}",
            f"{100 * one.by_test:.0f}",
        )
    Console().print(table)
