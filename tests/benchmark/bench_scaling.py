# SPDX-License-Identifier: Apache-2.0
"""Scaling of runs over 1, 2, 4 and 8 workers: local processes, actors of Ray, and jobs of submitit's local executor.

Cost is known because it is sleep: a decision sleeps as long as it takes to render and to ask a language model, and the
served model as long as a video generator. What is measured is the rest: the loop, the store, the wire, the engine. Work
grows with the workers, so that all have as much to do each.

Environments: the share of a worker's time, from its first decision to the end of its last, that is sleep. Target: 90 %.
Model batching: the share of the rows that full batches would give, of one server. Target: 92 %.
Ray's own overhead: its processor time for a decision above that of local processes, with as many workers, as a share of
a decision. Target: at most 2 %. The clock says so too, on a machine with idle cores.

python tests/benchmark/bench_scaling.py              # all engines that are installed
python tests/benchmark/bench_scaling.py 2 8          # some numbers of workers
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import bench_serving
import numpy as np
from bench_serving import CANDIDATES, DECISIONS, FULL, ROWS, SCALE
from harness import optional

import wiw
from wiw.cli import main as run_wiw
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.submission import find_states

HERE = Path(__file__)
sys.path.insert(0, str(HERE.parents[1] / "python"))
from fakes import LineEnv, LineTask  # noqa: E402

WORKERS = (1, 2, 4, 8)
DECISION = 0.25
"""Seconds of a decision outside the world model: two panoramas, an observation, the policy."""
EPISODES = 8
"""Episodes of each worker; up to eight decisions each, one episode after the other."""
LIVE = 32
"""Episodes that share the served model, over all workers."""
SLEEPS = "BENCH_SLEEPS"
"""Environment variable: the file where the world notes its sleeps."""


class SleepingEnv(LineEnv):
    def run(self, actions: Any, answer: Any = None) -> Any:
        """Note which process slept, when and how long it was to sleep."""
        begin, work = time.time(), time.process_time()
        segment = super().run(actions, answer)
        with Path(os.environ[SLEEPS]).open("a") as sleeps:
            sleeps.write(f"{os.getpid()} {begin} {time.time()} {self.task.delay} {work}\n")
        return segment


class SleepingTask(LineTask):
    def environment(self, depth: bool = False) -> LineEnv:
        return SleepingEnv(self)


def sleeping_task(scenes: str = "", seed: int = 0, preset: str = "default", backend: str = "auto") -> LineTask:
    """Corridors, some of which are walked to the end in less than eight decisions."""
    return SleepingTask(budget=3 * DECISIONS, delay=DECISION)


# -- environments ------------------------------------------------------------------------------------------------------


def run_with(engine: str) -> Callable[[int, Path], None]:
    def run(workers: int, out: Path) -> None:
        task = TaskRecipe(f"{HERE}:sleeping_task")
        agent = AgentRecipe(f"{bench_serving.__file__}:Walker", candidates=CANDIDATES, horizon=5, execute=3)
        count = EPISODES * workers
        wiw.evaluate(
            task, agent, count, out=out, workers=workers, live=1, keep_images=0, progress=False, engine=engine
        ).close()

    return run


def run_as_jobs(workers: int, out: Path) -> None:
    """Shards as jobs of submitit's local executor: a process each, with a store each."""
    policy = f"{bench_serving.__file__}:Walker"
    asked = ["submit", f"{HERE}:sleeping_task", "--policy", policy, "--candidates", str(CANDIDATES), "--horizon", "5"]
    asked += ["--execute", "3", "--episodes", str(EPISODES * workers), "--live", "1", "--keep-images", "0"]
    asked += ["--shards", str(workers), "--cluster", "local", "--out", str(out)]
    with redirect_stdout(io.StringIO()):
        assert run_wiw(asked) == 0
    while any(job.state == "RUNNING" for job in find_states(out)):
        time.sleep(0.2)


def measure_environments(run: Callable[[int, Path], None], workers: int, folder: Path) -> dict[str, float]:
    """Return the share of the workers' time that was sleep, and seconds of a decision: by the clock, and of CPU."""
    sleeps = Path(os.environ[SLEEPS])
    sleeps.unlink(missing_ok=True)
    run(workers, folder / "run")
    noted = np.loadtxt(sleeps, ndmin=2)
    own = [noted[noted[:, 0] == process] for process in np.unique(noted[:, 0])]
    assert len(own) == workers, f"{len(own)} workers of {workers} had work"
    spans = [rows[:, 2].max() - rows[:, 1].min() for rows in own]
    work = sum(np.ptp(rows[:, 4]) for rows in own) / (len(noted) - workers)
    return {
        "environments": float(noted[:, 3].sum() / sum(spans)),
        "decision": float(sum(spans) / len(noted)),
        "work": float(work),
    }


# -- one served model --------------------------------------------------------------------------------------------------


def measure_batching(engine: str, workers: int, folder: Path, scale: float) -> float:
    """Return the share of full batches' rows a second that a served model reaches, over the middle of the run."""
    calls = folder / "calls"
    os.environ |= {SCALE: str(scale), bench_serving.CALLS: str(calls)}
    model, walker = (f"{bench_serving.__file__}:{name}" for name in ("Generator", "Walker"))
    task = TaskRecipe(f"{bench_serving.__file__}:line_task", {"scale": scale})
    given: dict[str, Any] = {"workers": workers, "live": LIVE // workers, "keep_images": 0, "progress": False}
    with serve(model, folder) as address:
        agent = AgentRecipe(walker, address, candidates=CANDIDATES, horizon=5, execute=3)
        wiw.evaluate(task, agent, LIVE, out=folder / "run", engine=engine, **given).close()
    noted = np.loadtxt(calls)
    middle = noted[len(noted) // 4 : len(noted) - len(noted) // 4]
    return float(bench_serving.rate(middle) / (ROWS / (FULL * scale)))


@contextmanager
def serve(model: str, folder: Path) -> Iterator[str]:
    """Serve a model from a process of its own; yield its address as a world model."""
    said = folder / "said"
    command = [sys.executable, "-m", "wiw.cli", "serve", model, "--port", "0"]
    with said.open("w") as output, subprocess.Popen(command, stdout=output, env={**os.environ}) as server:
        try:
            while "remote:" not in said.read_text():
                assert server.poll() is None, "the server has ended"
                time.sleep(0.1)
            yield next(word for word in said.read_text().split() if word.startswith("remote:"))
        finally:
            server.terminate()


# -- the table ---------------------------------------------------------------------------------------------------------


def list_engines() -> dict[str, tuple[Callable[[int, Path], None], str]]:
    """Ways of running that are installed: how environments are run, and the engine of a run with a server."""
    engines = {"processes": (run_with("processes"), "processes")}
    if optional("ray") is not None:
        engines["ray"] = (run_with("ray"), "ray")
    if optional("submitit") is not None:
        engines["submitit"] = (run_as_jobs, "")
    return engines


def measure_all(counts: Sequence[int], scale: float) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for workers in counts:
        for name, (run, engine) in list_engines().items():
            with tempfile.TemporaryDirectory() as folder:
                own = measure_environments(run, workers, Path(folder))
            row: dict[str, Any] = {"engine": name, "workers": workers, **own}
            if engine:
                with tempfile.TemporaryDirectory() as folder:
                    row["batching"] = measure_batching(engine, workers, Path(folder), scale)
            local = next(each for each in [*found, row] if (each["engine"], each["workers"]) == ("processes", workers))
            row |= {"overhead": (row["work"] - local["work"]) / DECISION, "load": os.getloadavg()[0]}
            found.append(row)
            batching = f"{row['batching']:.1%}" if "batching" in row else "-"
            print(
                f"  {workers:<9}{name:12}{row['environments']:14.1%}{1000 * row['decision']:15.1f}"
                f"{1000 * row['work']:15.1f}{batching:>16}{row['overhead']:+14.1%}{row['load']:8.1f}",
                flush=True,
            )
    return found


def main() -> None:
    """Print the table; with BENCH_OUT, write it to that file as JSON as well."""
    counts = [int(word) for word in sys.argv[1:]] or WORKERS
    scale = float(os.environ.get(SCALE, "1"))
    print(f"\ndecisions of {DECISION:g} s, a served model of {FULL * scale:g} s for {ROWS} rows", end="; ")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    heads = ("environments", "ms a decision", "ms of CPU", "model batching", "above local", "load")
    widths = (14, 15, 15, 16, 14, 8)
    print(f"  {'workers':9}{'engine':12}" + "".join(f"{head:>{w}}" for head, w in zip(heads, widths, strict=True)))
    folder = tempfile.TemporaryDirectory()
    os.environ |= {SLEEPS: str(Path(folder.name) / "sleeps"), "OMP_NUM_THREADS": "1"}  # Ray's processes get them now
    if (ray := optional("ray")) is not None:  # a cluster that has as many cores as workers: they sleep
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}
        ray.init(num_cpus=max(counts), object_store_memory=200_000_000, **quiet)
    found = measure_all(counts, scale)
    if (out := os.environ.get("BENCH_OUT")) is not None:
        Path(out).write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
