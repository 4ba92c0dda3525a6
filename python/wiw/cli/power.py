# SPDX-License-Identifier: Apache-2.0
"""`wiw power`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

if TYPE_CHECKING:
    from wiw.analysis.pilot import Pilot
    from wiw.analysis.power import Power

Number = Annotated[float, arg(metavar="X")]
Count = Annotated[int, arg(metavar="N")]
MaybeNumber = Annotated[float | None, arg(metavar="X")]
MaybeCount = Annotated[int | None, arg(metavar="N")]
BASE, LOSSES = 20.0, 2.0
"""As in `wiw.analysis.power`, which takes a second to load."""
USUAL = (5.0, 10.0, 15.0, 20.0, 30.0)


def power(
    difference: Positional[Annotated[float | None, arg(metavar="POINTS")]] = None,
    /,
    *,
    scenes: Annotated[int | None, arg(metavar="N")] = None,
    task: Annotated[str | None, arg(metavar="TASK|all")] = None,
    pilot: Annotated[Path | None, arg(metavar="RUN")] = None,
    pilot_arms: Annotated[str | None, arg(metavar="ARM,BASE")] = None,
    base: MaybeNumber = None,
    losses: MaybeNumber = None,
    correlation: MaybeNumber = None,
    per_scene: MaybeCount = None,
    chance: Number = 0.8,
    arms: Count = 1,
) -> int:
    """Compute how many episodes a run needs to show that one arm succeeds more often than another, or what it can show.

    $ wiw power                        # for differences from 5 to 30 points
    $ wiw power 10                     # +10 points, e.g. from 20 to 30 %
    $ wiw power 10 --arms 4            # the same, for one of four arms compared with one base
    $ wiw power -5 --base 50           # an arm that is 5 points worse
    $ wiw power --scenes 40            # the smallest difference that 40 scenes of 5 episodes can show
    $ wiw power 5 --task all           # two models 5 points apart, with what was measured on each task
    $ wiw power 5 --pilot runs/first --pilot-arms mine,warp  # with what two arms of your own run show

    Arms are compared on the same episodes, so only those episodes count in which one succeeds and the other fails: won
    or lost. 30 % won and 20 % lost give the same difference as 12 % won and 2 % lost, but far weaker evidence, so
    --losses matters as much as the difference. Scenes matter more than episodes: with a correlation above 0, more
    episodes in the same scenes soon stop helping.

    Without --task or --pilot, the numbers are close to those measured on 210 episodes in 42 generated apartments: 19 %
    without a world model; 35 % won and 1 % lost with the oracle; correlations of -0.06 to 0.06 between differences
    within an apartment.

    Args:
        difference: Difference in success rate, in percentage points. If neither it nor --scenes is given, prints a
            table of typical values.
        scenes: Number of scenes, for computing the smallest difference that they can show.
        task: Take values not given below from two arms of this task in docs/results.md: imagenav, imagenav-near,
            imagenav-far, imagenav-beyond, ar, ar-foresight, aeqa or manipulation; all: one line per task.
        pilot: Take values not given below from two arms of this run.
        pilot_arms: The two arms of --pilot, as ARM,BASE.
        base: Success rate of the base arm in percent. Default: 20, unless --task or --pilot sets it.
        losses: Percent of episodes that the better of the two arms loses. Default: 2, likewise.
        correlation: Correlation between the differences in two episodes of a scene. Default: 0.05, likewise.
        per_scene: Episodes in each scene. Default: 5, likewise.
        chance: Power: the probability of showing a difference that exists.
        arms: Number of arms compared with the same base; their p values are Holm-adjusted.
    """
    from wiw.analysis.power import power as plan

    given = {"base": base, "losses": losses, "correlation": correlation, "per_scene": per_scene}
    own = {name: value for name, value in given.items() if value is not None}
    pilots = _find_pilots(task, pilot, pilot_arms)

    def plan_power(points: float | None, settings: Mapping[str, Any]) -> Power:
        return plan(points, scenes=scenes, chance=chance, arms=arms, **{**settings, **own})

    if task == "all":
        points = difference if difference is not None or scenes is not None else 5.0
        _print_tasks({name: partial(plan_power, points, one.settings()) for name, one in pilots.items()}, chance)
        return 0
    (found,) = pilots.values() or (None,)
    settings = {} if found is None else found.settings()
    if found is not None:
        print(f"pilot: {found.source}")
    if difference is not None or scenes is not None:
        print(plan_power(difference, settings))
        return 0
    usual = {"base": BASE, "losses": LOSSES, **settings, **own}
    fitting = [points for points in USUAL if usual["base"] + points + usual["losses"] <= 100] or USUAL[:1]
    _print_table([plan_power(points, settings) for points in fitting], chance)
    return 0


def _print_tasks(plans: Mapping[str, Callable[[], Power]], chance: float) -> None:
    """Print a line per task, and below it why there is none of a task.

    Raises:
        ArgumentError: there is none of any task.
    """
    from wiw.errors import ArgumentError

    found, refused = {}, {}
    for task, plan in plans.items():
        try:
            found[task] = plan()
        except ArgumentError as error:
            refused[task] = error
    if not found:
        raise next(iter(refused.values()))
    _print_table([*found.values()], chance, [*found])
    for task, why in refused.items():
        print(f"{task}: {why}")


def _find_pilots(task: str | None, run: Path | None, arms: str | None) -> dict[str, Pilot]:
    """Return pilots by task: none, one, or one per task.

    Raises:
        ArgumentError: options that do not go together, or a pilot that does not exist.
        StoreError: a run that cannot be read.
    """
    from wiw.analysis.pilot import PILOTS, find_pilot, read_pilot
    from wiw.errors import ArgumentError
    from wiw.runs.run import Run
    from wiw.runs.store import RunStore

    if (run is None) != (arms is None) or (run is not None and task is not None):
        given = [
            flag for flag, value in (("--pilot", run), ("--pilot-arms", arms), ("--task", task)) if value is not None
        ]
        raise ArgumentError(
            f"power: expected --pilot RUN with --pilot-arms ARM,BASE, or --task, or neither; got {' and '.join(given)}"
        )
    if run is not None and arms is not None:
        names = [name.strip() for name in arms.split(",")]
        if len(names) != 2:
            raise ArgumentError(f"power: expected --pilot-arms ARM,BASE, got '{arms}'")
        with RunStore.read(run) as store:
            return {"run": read_pilot(Run(store), *names)}
    if task == "all":
        return dict(PILOTS)
    return {} if task is None else {task: find_pilot(task)}


def _print_table(plans: Sequence[Power], chance: float, tasks: Sequence[str] = ()) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=f"Needed to show a difference with a chance of {100 * chance:g} % ({plans[0].interval})",
        title_justify="left",
        box=box.SIMPLE_HEAD,
    )
    if tasks:
        table.add_column("task", no_wrap=True)
    for column in ("points", "won/lost %", "scenes", "episodes", "interval %", "test %"):
        table.add_column(column, justify="right")
    for index, one in enumerate(plans):
        table.add_row(
            *tasks[index : index + 1],
            f"{one.difference:+g}",
            f"{one.won:g}/{one.lost:g}",
            str(one.scenes),
            str(one.episodes),
            f"{100 * one.by_interval:.0f}",
            f"{100 * one.by_test:.0f}",
        )
    Console().print(table)
