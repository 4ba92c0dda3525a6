# SPDX-License-Identifier: Apache-2.0
"""Environments of the run loop: their share of a decision, and one after another against all in one call.

The run loop carries out each live episode's plan by `Env.run`, one environment after another, whatever the task. The
first table is what that takes of a decision. The second compares it with `VectorEnv` of the C++ core: one call per
primitive for all environments, one call that renders all their views, and the same bookkeeping per episode. Both see
the same views; their ratio is measured in the same rounds. Episodes of one scene, whose views are one batch for the
renderer, are the best case for `VectorEnv`.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from harness import measure, report, spread

import wiw
from wiw._core import env as core_env
from wiw.action import FORWARD, TURN_LEFT
from wiw.envs import NavigationEnv
from wiw.envs.episode_state import image_names, make_observation
from wiw.loop import clock, rollout_cache, scheduler
from wiw.loop.agent import Agent
from wiw.runs.recipes import TaskRecipe
from wiw.types import Observation

LIVE, DECISIONS, REPEATS = (1, 4, 16), 5, 3
PLAN = (int(FORWARD), int(TURN_LEFT), int(TURN_LEFT))
"""Walks in a circle."""
SCENES = {"one scene": "apartments:val:1", "scenes as in a run": "apartments:val"}


def set_clock(read: Any) -> None:
    """Let the loop's ledger count by another clock."""
    for module in (clock, rollout_cache, scheduler):
        module.time = SimpleNamespace(perf_counter=read, time=time.time)


def measure_share(model: str, live: int) -> float:
    """Return the percentage of all stages that the environments take in a run."""
    task = TaskRecipe("imagenav", {"scenes": SCENES["scenes as in a run"], "decisions": DECISIONS})
    agent = Agent("matcher", None if model == "none" else wiw.world_model(model))
    with tempfile.TemporaryDirectory() as folder:
        log = wiw.evaluate(task, agent, max(LIVE), out=Path(folder) / "run", progress=False, live=live, keep_images=0)
        costs = log.costs()[0]
        log.close()
    return 100 * costs["seconds_environment"] / costs["seconds"]


def print_shares() -> None:
    """Print the environments' share of a decision by world model and number of live episodes."""
    print(
        f"\nimagenav, policy matcher: environments' share of a decision, %   ({REPEATS} runs of {max(LIVE)} episodes)"
    )
    print(f"  {'':18}{'by CPU time':>24}{'by wall time':>24}")
    for model in ("none", "warp"):
        for live in LIVE:
            shares: dict[Any, list[float]] = {time.process_time: [], time.perf_counter: []}
            for _ in range(REPEATS):
                for read, found in shares.items():
                    set_clock(read)
                    found.append(measure_share(model, live))
            columns = "".join(f"{spread(found, 1):>24}" for found in shares.values())
            print(f"  {f'{model}, {live} live':18}{columns}")
    set_clock(time.perf_counter)


class Together:
    """Environments that carry out a plan each through the core's VectorEnv, as `NavigationEnv.run` does by itself."""

    def __init__(self, envs: list[NavigationEnv]) -> None:
        self.task, self.states = envs[0].task, [env.state for env in envs]
        self.images = image_names(self.task, depth=True)
        self.core = core_env.VectorEnv([env.fork() for env in envs])

    def run(self) -> list[Observation]:
        """Carry out the plan in all of them and observe once, at its end."""
        for i, action in enumerate(PLAN):
            self.core.step(np.full(len(self.core), action, np.int8))
            for place, state in enumerate(self.states):
                state.record_primitive(self.task, action, self.core[place].position, at_decision=i + 1 == len(PLAN))
        return self.observe()

    def observe(self) -> list[Observation]:
        """Return all views, rendered in one call."""
        images = self.core.observe(self.images)
        return [
            make_observation(
                self.task, {name: of_all[place] for name, of_all in images.items()}, self.core[place].odometry, state
            )
            for place, state in enumerate(self.states)
        ]


def begin(scenes: str, count: int) -> list[NavigationEnv]:
    """Return environments at the start of the task's first episodes."""
    task = TaskRecipe("imagenav", {"scenes": scenes}).build()
    envs = [task.environment(depth=True) for _ in range(count)]
    for index, env in enumerate(envs):
        env.begin(task.episode(index))
    return envs


def print_comparison(scenes: str, count: int) -> None:
    """Print what a segment of three primitives takes in `count` environments, and its motion alone."""
    envs = begin(SCENES[scenes], count)
    together, moving = Together(begin(SCENES[scenes], count)), [env.fork() for env in envs]
    cases = {
        "Env.run, one after another": lambda: [env.run(PLAN) for env in envs],
        "VectorEnv": together.run,
        "motion alone, one after another": lambda: [env.step(action) for env in moving for action in PLAN],
    }
    for one, other in zip(cases["Env.run, one after another"](), together.run(), strict=True):
        assert np.array_equal(one.observation.panorama, other.panorama)
    timings = measure(cases, repeats=16)
    report(f"a segment of {len(PLAN)} primitives in {count} environments, {scenes}", cases, timings, "VectorEnv")


def main() -> None:
    """Print both tables."""
    for scenes in SCENES:
        for count in LIVE:
            print_comparison(scenes, count)
    print_shares()


if __name__ == "__main__":
    main()
