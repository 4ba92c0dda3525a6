# SPDX-License-Identifier: Apache-2.0
"""A run with a world model of 1 s a batch, and the same run again from the rollout cache.

The first run does not sleep: each call of its model counts as `SECONDS`, which is exact and spares the wait. All else
is CPU time, with rendering, proposing and scoring, which no cache saves. Target: the second run makes no call and
takes at most 3 % of the time of the first.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
from harness import spread

import wiw
from wiw.evaluation.recipes import TaskRecipe
from wiw.loop.agent import Agent

SECONDS, EPISODES, DECISIONS, REPEATS = 1.0, 8, 20, 3


class Generator(wiw.WorldModel):
    """A video generator in all but its frames: 14 of 480x480, one batch a call."""

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(480, 480), frames=14, cacheable=True)
    calls: ClassVar[int] = 0

    def rollout(self, observations, controls, seeds):
        Generator.calls += 1
        return np.repeat(observations.image[:, None], 14, 1)


class Panoramas(wiw.WorldModel):
    """The same for panoramas of any length."""

    accepts = wiw.accepts(control="trajectory", causal=True, cacheable=True)

    def rollout(self, observations, controls, seeds):
        Generator.calls += 1
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


def one(task: TaskRecipe, model: type[wiw.WorldModel], folder: Path, live: int) -> tuple[float, float, int]:
    """CPU seconds of a run, seconds of it in the cache by the clock, and model calls."""
    Generator.calls, begin = 0, time.process_time()
    agent = Agent("heuristic", model(), revision="matcher")
    out = Path(tempfile.mkdtemp(dir=folder))
    log = wiw.evaluate(task, agent, EPISODES, out=out, progress=False, live=live, keep_images=0, cache=folder / "cache")
    return time.process_time() - begin, log.costs()[0].get("seconds_cache", 0.0), Generator.calls


def main() -> None:
    """Prints, for each kind of model and number of live episodes, the second run's share of the first one's time."""
    task = TaskRecipe("imagenav", {"scenes": "apartments:val:1", "decisions": DECISIONS})
    print(f"\nThe same run from the cache, model of {SECONDS:g} s a batch (target: 0 calls, at most 3 %)")
    for model in (Generator, Panoramas):
        for live in (1, 4):
            shares, own, calls = [], [], 0
            for _ in range(REPEATS):
                with tempfile.TemporaryDirectory() as folder:
                    first, _, asked = one(task, model, Path(folder), live)
                    second, cache, calls = one(task, model, Path(folder), live)
                    shares.append(100 * second / (first + SECONDS * asked))
                    own.append(100 * cache / (first + SECONDS * asked))
            print(
                f"  {model.__name__:10} live={live}: {spread(shares)} % of the time, the cache's own part "
                f"{spread(own)} %; {asked} calls in the first run, {calls} in the second"
            )


if __name__ == "__main__":
    main()
