# SPDX-License-Identifier: Apache-2.0
"""A served model of 1 s for one row and 1.2 s for 16: how fast a run of 32 live episodes has its rows computed.

The model sleeps, and so does the world, for as long as a decision takes to render; server and loop are the real ones,
each in processes of their own. Target: 92 % of 16 rows in 1.2 s with several workers, over 12 times what single rows
would reach.

python tests/benchmark/bench_serving.py         # as it is
python tests/benchmark/bench_serving.py 0.2     # all times scaled, which weighs what is not the model five times more
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.types import Proposal

HERE = Path(__file__)
sys.path.insert(0, str(HERE.parents[1] / "python"))
from fakes import LineTask  # noqa: E402

ROWS, ONE, FULL = 16, 1.0, 1.2
RENDERING = 0.03
"""Seconds of a decision outside the model: a panorama and a front view with depth, and their scoring."""
LAYOUTS = ((1, 32), (2, 16), (4, 8))
"""Workers, and episodes that each of them keeps live."""
DECISIONS, CANDIDATES = 8, 3
SCALE, CALLS = "BENCH_SCALE", "BENCH_CALLS"
"""Environment variables: factor of all times, and the file where the model notes its calls."""


class Generator(wiw.WorldModel):
    """A video generator in all but its frames."""

    accepts = wiw.accepts("trajectory", view="perspective", size=(120, 120), frames=14, best_batch=ROWS)

    def rollout(self, observations, controls, seeds):
        begin, rows = time.time(), len(controls)
        time.sleep(float(os.environ[SCALE]) * (ONE + (FULL - ONE) * (rows - 1) / (ROWS - 1)))
        with Path(os.environ[CALLS]).open("a") as calls:
            calls.write(f"{begin} {time.time()} {rows}\n")
        return np.repeat(observations.image[:, None], 14, 1)


class Walker(wiw.Policy):
    """Proposes as many different plans as it may, each of a row of its own, and likes all of them."""

    def propose(self, situations, candidates, horizon):
        turns = (TURN_LEFT, TURN_RIGHT, FORWARD)
        return [[Proposal([FORWARD, turn, *[turn] * 3]) for turn in turns[:candidates]] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.zeros(len(plans)) for plans in proposals]


def line_task(scale: float = 1.0) -> LineTask:
    """Corridors that nobody walks to the end of."""
    return LineTask(budget=3 * DECISIONS, delay=RENDERING * scale)


def calls_of_a_run(scale: float, workers: int, live: int, folder: Path) -> np.ndarray:
    """Begin, end and rows of each call of the model."""
    calls, said = folder / "calls", folder / "said"
    environment = {**os.environ, SCALE: str(scale), CALLS: str(calls), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "wiw.cli", "serve", f"{HERE}:Generator", "--port", "0"]
    with said.open("w") as output, subprocess.Popen(command, stdout=output, env=environment) as server:
        while "remote:" not in said.read_text():
            assert server.poll() is None, "the server has ended"
            time.sleep(0.1)
        address = next(word for word in said.read_text().split() if word.startswith("remote:"))
        agent = AgentRecipe(f"{HERE}:Walker", address, candidates=CANDIDATES, horizon=5, execute=3)
        task = TaskRecipe(f"{HERE}:line_task", {"scale": scale})
        wiw.evaluate(task, agent, 32, out=folder / "run", workers=workers, live=live, keep_images=0, progress=False)
        server.send_signal(signal.SIGTERM)
    return np.loadtxt(calls)


def rate(calls: np.ndarray) -> float:
    """Rows a second, from the first call's begin to the last one's end."""
    return calls[:, 2].sum() / (calls[-1, 1] - calls[0, 0])


def main() -> None:
    """Prints, for each layout, the share of the model's own throughput: of the whole run, and of its middle half."""
    scale = float(sys.argv[1]) if len(sys.argv) > 1 and HERE.name in sys.argv[0] else 1.0
    best = ROWS / (FULL * scale)
    print(f"\n32 live episodes on a model of {ONE * scale:g} s for 1 row and {FULL * scale:g} s for {ROWS}", end=" ")
    print(f"(load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; target with workers: at least 92 %)")
    print(f"  {'workers x live':16}{'rows a batch':>14}{'whole run':>12}{'middle half':>14}{'x single rows':>16}")
    for workers, live in LAYOUTS:
        with tempfile.TemporaryDirectory() as folder:
            calls = calls_of_a_run(scale, workers, live, Path(folder))
        middle = calls[len(calls) // 4 : len(calls) - len(calls) // 4]
        print(
            f"  {f'{workers} x {live}':16}{calls[:, 2].mean():14.1f}{rate(calls) / best:12.1%}"
            f"{rate(middle) / best:14.1%}{rate(calls) * ONE * scale:16.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
