# SPDX-License-Identifier: Apache-2.0
"""Costs of a run: CPU time of `wiw run imagenav --arms none,warp,oracle`, of one that starts with an empty cache, and
memory and time by live episodes.

The run goes beside one whose futures are drawn with 576x1024 pixels, as in version 1 of the benchmark, and both runs
beside those of another checkout where its Python is named. Runs alternate, each in processes of its own; the least CPU
time of each counts, which other work on the machine changes least.

python tests/benchmark/bench_run.py
python tests/benchmark/bench_run.py --cold
python tests/benchmark/bench_run.py --against /path/to/another/checkout/.venv/bin/python
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time

ROUNDS, EPISODES, SCENES = 2, 9, 3
ARMS = {
    "this": "none,warp,oracle",
    "this, futures of 576x1024": "none,warp=warp?size=[576,1024],oracle=oracle?size=[576,1024]",
}
COLD_EPISODES = 64
LIVE, LIVE_EPISODES, LIVE_SCENES, LIVE_DECISIONS = (1, 4, 16, 64), 64, 4, 4


def children_seconds() -> float:
    """Return the CPU time so far of child processes that have ended, with their own."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_cpu_seconds(python: str, *options: str, cold: bool = False) -> float:
    """Return the CPU time of a run of imagenav; `cold` gives it an empty cache."""
    before = children_seconds()
    with tempfile.TemporaryDirectory() as folder:
        command = [python, "-m", "wiw.cli", "run", "imagenav", *options, "--seed", "3", "--out", f"{folder}/run"]
        environment = {**os.environ, **({"WIW_CACHE": f"{folder}/cache"} if cold else {})}
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        subprocess.run(command, check=True, cwd=folder, env=environment, **quiet)
    return children_seconds() - before


def compare_runs(against: str | None) -> None:
    """Print the CPU time of whole runs whose scenes are cached."""
    few = ("--episodes", str(EPISODES), "--scenes", f"apartments:val:{SCENES}")
    runs = {name: (sys.executable, "--arms", arms, *few) for name, arms in ARMS.items()}
    if against is not None:
        runs["the other checkout"] = against, "--arms", ARMS["this"], *few
    for python in dict.fromkeys(command[0] for command in runs.values()):
        run_cpu_seconds(python, "--arms", "none", *few)  # its scenes
    print(f"imagenav, none, warp and oracle, {EPISODES} episodes in {SCENES} apartments")
    print_least(runs)


def compare_cold_runs(against: str | None) -> None:
    """Print the CPU time of runs that make their scenes."""
    options = "--arms", "none", "--episodes", str(COLD_EPISODES)
    runs = {"this": (sys.executable, *options)}
    if against is not None:
        runs["the other checkout"] = against, *options
    print(f"imagenav, none, {COLD_EPISODES} episodes, with an empty cache")
    print_least(runs, cold=True)


def print_least(runs: dict[str, tuple[str, ...]], cold: bool = False) -> None:
    """Print the least CPU time of each run, given as Python and options."""
    least = dict.fromkeys(runs, float("inf"))
    for _ in range(ROUNDS):
        for name, command in runs.items():
            least[name] = min(least[name], run_cpu_seconds(*command, cold=cold))
    for name, seconds in least.items():
        print(f"  {name:28} {seconds:7.1f} s  {seconds / least['this']:5.2f} x", flush=True)


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
    parser.add_argument("--cold", action="store_true", help="only the runs with an empty cache")
    parser.add_argument("--live", type=int, metavar="N", help="only this: N live episodes, in this process")
    given = parser.parse_args()
    if given.live is not None:
        measure_live(given.live)
        return
    if not given.cold:
        compare_runs(given.against)
    compare_cold_runs(given.against)
    if given.cold:
        return
    print(f"matcher with warp, {LIVE_EPISODES} episodes in {LIVE_SCENES} apartments")
    for live in LIVE:
        subprocess.run([sys.executable, __file__, "--live", str(live)], check=True)


if __name__ == "__main__":
    main()
