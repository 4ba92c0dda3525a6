# SPDX-License-Identifier: Apache-2.0
"""A run with a world model of 1 s a batch, and the same run again from the rollout cache.

The first run does not sleep: each call of its model counts as `SECONDS`, which is exact and spares the wait. All else
is measured: wall time, and CPU time of all threads, which other work on the machine changes little. Target: the second
run makes no call and takes at most 3 % of the wall time of the first. What it takes is what no cache of rollouts saves:
the simulator's pictures, the policy's thinking, the views that it is shown; the parts are printed beside the cache's.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
from harness import spread

import wiw
from wiw.loop import clock, rollout_cache, scheduler
from wiw.loop.agent import Agent
from wiw.runs.recipes import TaskRecipe

SECONDS, EPISODES, DECISIONS, REPEATS = 1.0, 8, 20, 3
STAGES = {
    "simulator": ("environment",),
    "policy": ("propose", "revise"),
    "views": ("platform",),
    "cache": ("cache",),
}


class Generator(wiw.WorldModel):
    """A video generator in all but its frames: 14 of 480x480, one batch a call."""

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(480, 480), frames=14, cacheable=True)
    version = "1"
    calls: ClassVar[int] = 0

    def rollout(self, observations, controls, seeds):
        Generator.calls += 1
        return np.repeat(observations.image[:, None], 14, 1)


class Panoramas(wiw.WorldModel):
    """The same for panoramas of any length."""

    accepts = wiw.accepts(control="trajectory", causal=True, cacheable=True)
    version = "1"

    def rollout(self, observations, controls, seeds):
        Generator.calls += 1
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


def count_stages_by_cpu() -> None:
    """Lets the loop's ledger count CPU time instead of wall time."""
    for module in (clock, rollout_cache, scheduler):
        module.time = SimpleNamespace(perf_counter=time.process_time, time=time.time)


def one(task: TaskRecipe, model: type[wiw.WorldModel], folder: Path, live: int) -> tuple[float, float, Mapping, int]:
    """CPU and wall seconds of a run, its costs, and model calls."""
    Generator.calls, cpu, wall = 0, time.process_time(), time.perf_counter()
    agent = Agent("heuristic", model(), reviser="matcher")
    out = Path(tempfile.mkdtemp(dir=folder))
    log = wiw.evaluate(task, agent, EPISODES, out=out, progress=False, live=live, keep_images=0, cache=folder / "cache")
    return time.process_time() - cpu, time.perf_counter() - wall, log.costs()[0], Generator.calls


def main() -> None:
    """Prints, for each kind of model and number of live episodes, the second run's share of the first one's time."""
    count_stages_by_cpu()
    task = TaskRecipe("imagenav", {"scenes": "apartments:val:1", "decisions": DECISIONS})
    print(f"\nThe same run from the cache, model of {SECONDS:g} s a batch (target: 0 calls, at most 3 % of wall time)")
    for model in (Generator, Panoramas):
        for live in (1, 4):
            shares: dict[str, list[float]] = {name: [] for name in ("CPU", "wall", *STAGES)}
            calls = asked = 0
            for _ in range(REPEATS):
                with tempfile.TemporaryDirectory() as folder:
                    first_cpu, first_wall, _, asked = one(task, model, Path(folder), live)
                    cpu, wall, costs, calls = one(task, model, Path(folder), live)
                shares["wall"].append(100 * wall / (first_wall + SECONDS * asked))
                whole = first_cpu + SECONDS * asked
                shares["CPU"].append(100 * cpu / whole)
                for name, stages in STAGES.items():
                    shares[name].append(100 * sum(costs.get(f"seconds_{stage}", 0.0) for stage in stages) / whole)
            parts = ", ".join(f"{name} {spread(shares[name])}" for name in STAGES)
            print(
                f"  {model.__name__}, {live} live: {calls} calls after {asked}; {spread(shares['wall'])} % of wall time"
            )
            print(f"    {spread(shares['CPU'])} % of CPU time: {parts}")


if __name__ == "__main__":
    main()
