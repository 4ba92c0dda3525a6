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


def one(task: TaskRecipe, model: type[wiw.WorldModel], policy: str, folder: Path, live: int) -> tuple[float, int]:
    """CPU seconds and model calls of a run."""
    Generator.calls, begin = 0, time.process_time()
    out = Path(tempfile.mkdtemp(dir=folder))
    agent = Agent("heuristic", model(), revision=policy)
    wiw.evaluate(task, agent, EPISODES, out=out, progress=False, live=live, keep_images=0, cache=folder / "cache")
    return time.process_time() - begin, Generator.calls


def main() -> None:
    """Prints, for each kind of model and number of live episodes, the second run's share of the first one's time."""
    task = TaskRecipe("imagenav", {"scenes": "apartments:val:1", "decisions": DECISIONS})
    print(f"\nThe same run from the cache, model of {SECONDS:g} s a batch (target: 0 calls, at most 3 %)")
    for model in (Generator, Panoramas):
        for live in (1, 4):
            shares, calls = [], 0
            for _ in range(REPEATS):
                with tempfile.TemporaryDirectory() as folder:
                    first, asked = one(task, model, "matcher", Path(folder), live)
                    second, calls = one(task, model, "matcher", Path(folder), live)
                    shares.append(100 * second / (first + SECONDS * asked))
            print(
                f"  {model.__name__:10} live={live}: {spread(shares)} % of the time, {asked} calls first, then {calls}"
            )


if __name__ == "__main__":
    main()
