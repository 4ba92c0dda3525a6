# SPDX-License-Identifier: Apache-2.0
"""`wiw scale`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from wiw.cli.numbers import parse_numbers
from wiw.cli.parts import AgentFlags, TaskFlags
from wiw.cli.stop import stoppable
from wiw.loop.config import PlanConfig
from wiw.runs.config import RunConfig, name_folder

Values = Annotated[str | None, arg(metavar="A,B,...")]
AGENT, TASK, SEARCH, SETTINGS = AgentFlags(world_model="warp"), TaskFlags(), PlanConfig(), RunConfig(keep_images=0)
"""The defaults of the command line."""


def scale(
    task: Positional[Annotated[str, arg(metavar="TASK")]] = "imagenav",
    /,
    *,
    parts: Annotated[AgentFlags, arg(name="")] = AGENT,
    candidates: Values = None,
    imagine_fraction: Values = None,
    rules: Annotated[TaskFlags, arg(name="")] = TASK,
    search: Annotated[PlanConfig, arg(name="")] = SEARCH,
    config: Annotated[RunConfig, arg(name="")] = SETTINGS,
) -> int:
    """Measure success against the number of futures that a world model imagines, always on the same episodes.

    $ wiw scale imagenav --world-model warp --candidates 1,2,4,8
    $ wiw scale imagenav --world-model my_model.py:MyModel --imagine-fraction 0,0.25,0.5,0.75,1

    The amounts are nested: a smaller number of candidates takes the first of the largest number, and a smaller share of
    decisions is a subset of a larger one. Writes scale.json and scale.svg next to the run, which works with `wiw
    resume` and `wiw report` like any other.

    Args:
        task: See `wiw list`.
        parts: The agent.
        candidates: Numbers of plans imagined at each decision. Default: 1,2,4,8, unless --imagine-fraction is given.
        imagine_fraction: Shares of decisions, from 0 to 1, for which the world model is consulted.
        rules: The task's episodes and rules.
        search: The search's other parameters, the same for all amounts.
        config: Settings of the run; if the cache is a folder, all amounts share it.
    """
    from wiw.studies.scale import scale as run_scale

    recipe, agent = rules.make_recipe(task, config.seed), parts.make_recipe(task, rules.preset, search)
    folder = Path(config.out or name_folder("scale"))
    settings, kept = replace(config, out=folder), config.keep_images
    counts, shares = (
        parse_numbers(candidates, int, "candidates"),
        parse_numbers(imagine_fraction, float, "imagine-fraction"),
    )
    found = stoppable(lambda: run_scale(recipe, agent, counts, shares, config=settings, keep_images=kept), folder)
    found.summary()
    for path in found.save():
        print(path)
    problems = found.log.numbers().invalid
    for reason in problems:
        print(f"INVALID RUN, do not report: {reason}")
    return 1 if problems else 0
