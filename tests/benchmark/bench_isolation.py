# SPDX-License-Identifier: Apache-2.0
"""A call of a world model in a process of its own beside the same call in this process.

The model computes its frames and waits until 50 ms have gone by, as for a GPU. Calls alternate; what is compared is the
whole call as a run makes it (checked and within its deadline), and the CPU time of both processes, each by its 10th
percentile, which other work on the machine changes least. Target: at most 2 % of the 50 ms more.

python tests/benchmark/bench_isolation.py
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import wiw
from wiw.action import FORWARD
from wiw.isolation.models import IsolatedModel
from wiw.loop.attempts import Attempted
from wiw.types import Conditioning, Control

SECONDS, CALLS, WARM = 0.05, 40, 5
BATCHES = ((3, 5, (144, 256)), (12, 5, (144, 256)), (3, 5, (288, 512)), (3, 5, (480, 480)), (1, 14, (480, 480)))
"""Rows, frames, height and width: a decision of one and of four live episodes; views of video models."""


class Waiting(wiw.WorldModel):
    """Repeats the observation, and answers `seconds` after it was asked."""

    def __init__(self, height: int, width: int, seconds: float = SECONDS) -> None:
        self.accepts = wiw.accepts(control="image", view="perspective", size=(height, width))
        self.seconds = seconds

    accepts = wiw.accepts(control="image", view="perspective", size=(480, 480))

    def rollout(self, observations, controls, seeds):
        until = time.perf_counter() + self.seconds
        frames = np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)
        time.sleep(max(0.0, until - time.perf_counter()))
        return frames


def cpu_seconds(model: wiw.WorldModel) -> float:
    """Return the CPU time so far of this process and of the model's own."""
    own = time.process_time()
    if not isinstance(model, IsolatedModel):
        return own
    process = model._process
    assert process is not None and process._process is not None
    fields = Path(f"/proc/{process._process.pid}/schedstat").read_text().split()
    return own + int(fields[0]) / 1e9


def measure(rows: int, frames: int, size: tuple[int, int]) -> None:
    """Print both calls at one size."""
    steps = frames - 1
    image = np.random.default_rng(0).integers(0, 256, (rows, *size, 3), np.uint8)
    poses = np.zeros((steps, 3)), np.stack([np.eye(4)] * steps)
    controls = [Control(np.full(steps, FORWARD, np.int8), *poses, length=steps) for _ in range(rows)]
    seeds = np.arange(rows, dtype=np.uint64)
    options = {"height": size[0], "width": size[1]}
    models = [wiw.world_model(f"{__file__}:Waiting", isolate=isolate, **options) for isolate in (False, True)]
    walls, cpus = [[], []], [[], []]
    asked = [Attempted(model) for model in models]
    for _ in range(CALLS):
        for place, (model, own) in enumerate(zip(models, asked, strict=True)):
            begin, cpu = time.perf_counter(), cpu_seconds(model)
            own.rollout(Conditioning(image), controls, seeds)
            walls[place].append(time.perf_counter() - begin)
            cpus[place].append(cpu_seconds(model) - cpu)
    wall, cpu = ([1e3 * float(np.percentile(own[WARM:], 10)) for own in each] for each in (walls, cpus))
    more = wall[1] - wall[0]
    print(
        f"{rows:3} x {frames:2} frames of {size[0]}x{size[1]} ({rows * frames * size[0] * size[1] * 3 / 1e6:5.1f} MB): "
        f"in process {wall[0]:6.2f} ms, isolated {wall[1]:6.2f} ms: {more / SECONDS / 10:+5.2f} % of 50 ms; "
        f"CPU {cpu[0]:5.2f} and {cpu[1]:5.2f} ms"
    )


if __name__ == "__main__":
    for batch in BATCHES:
        measure(*batch)
