# SPDX-License-Identifier: Apache-2.0
"""Costs of a run: CPU time of `wiw run imagenav --arms none,warp,oracle`, and memory and time by live episodes.

The run goes beside one whose futures are drawn with 576x1024 pixels, as in version 1 of the benchmark, and beside that
of another checkout where its Python is named. Runs alternate, each in processes of its own with scenes that are
already cached; the least CPU time of each counts, which other work on the machine changes least.

python tests/benchmark/bench_run.py
python tests/benchmark/bench_run.py --against /path/to/another/checkout/.venv/bin/python
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROUNDS, EPISODES, SCENES = 2, 9, 3
ARMS = {
    "this": "none,warp,oracle",
    "this, futures of 576x1024": "none,warp=warp?size=[576,1024],oracle=oracle?size=[576,1024]",
}
LIVE, LIVE_EPISODES, LIVE_SCENES, LIVE_DECISIONS = (1, 4, 16, 64), 64, 4, 4


def children_seconds() -> float:
    """Return the CPU time so far of child processes that have ended, with their own."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_cpu_seconds(python: str, arms: str, episodes: int) -> float:
    """Return the CPU time of a run."""
    before = children_seconds()
    with tempfile.TemporaryDirectory() as folder:
        options = ["--arms", arms, "--episodes", str(episodes), "--scenes", f"apartments:val:{SCENES}", "--seed", "3"]
        command = [python, "-m", "wiw.cli", "run", "imagenav", *options, "--out", str(Path(folder, "run"))]
        subprocess.run(command, check=True, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return children_seconds() - before


def compare_runs(against: str | None) -> None:
    """Print the CPU time of whole runs."""
    runs = {name: (sys.executable, arms) for name, arms in ARMS.items()}
    if against is not None:
        runs["the other checkout"] = against, ARMS["this"]
    for python in dict.fromkeys(python for python, _ in runs.values()):
        run_cpu_seconds(python, "none", EPISODES)  # its scenes
    least = dict.fromkeys(runs, float("inf"))
    for _ in range(ROUNDS):
        for name, (python, arms) in runs.items():
            least[name] = min(least[name], run_cpu_seconds(python, arms, EPISODES))
    print(
        f"imagenav, none, warp and oracle, {EPISODES} episodes in {SCENES} apartments, least CPU time of {ROUNDS} runs"
    )
    for name, seconds in least.items():
        print(f"  {name:28} {seconds:7.1f} s  {seconds / least['this']:5.2f} x")


def measure_live(live: int) -> None:
    """Print the memory of this process and CPU time a decision with so many live episodes."""
    import wiw
    from wiw.loop.scheduler import run_episodes
    from wiw.tasks.imagenav import ImageNav

    task = ImageNav(
        scenes=f"apartments:val:{LIVE_SCENES}", per_scene=LIVE_EPISODES // LIVE_SCENES, decisions=LIVE_DECISIONS
    )

    class Sink:
        """Counts decisions, and keeps nothing."""

        decisions = 0

        def decision(self, record):
            self.decisions += 1

        def episode(self, result):
            assert result.status == "done", result.error

    def spend(count: int) -> float:
        sink, begin = Sink(), time.process_time()
        run_episodes(
            task, wiw.Agent("matcher", "warp"), list(enumerate(task.episodes(count))), seed=0, live=live, sink=sink
        )
        return (time.process_time() - begin) / sink.decisions

    spend(LIVE_EPISODES)  # scenes, tables and pools
    seconds = spend(LIVE_EPISODES)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"  {live:3} live: {peak:6.0f} MB at most, {1e3 * seconds:6.1f} ms CPU a decision", flush=True)


def main() -> None:
    """Measure what the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", metavar="PYTHON", help="Python of another checkout of wiw")
    parser.add_argument("--live", type=int, metavar="N", help="only this: N live episodes, in this process")
    given = parser.parse_args()
    if given.live is not None:
        measure_live(given.live)
        return
    compare_runs(given.against)
    print(f"matcher with warp, {LIVE_EPISODES} episodes in {LIVE_SCENES} apartments")
    for live in LIVE:
        subprocess.run([sys.executable, __file__, "--live", str(live)], check=True)


if __name__ == "__main__":
    main()
