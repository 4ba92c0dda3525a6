# SPDX-License-Identifier: Apache-2.0
"""Processes to be killed. A server imports everything once and forks a victim a job, so that jobs start at once.

On its standard input the server reads a job a line, JSON {"what", "out", "kill_after", ...}; it kills the victim after
so many seconds, or lets it end where none are given, and answers [exit code (negative: the signal), what went wrong].
A job's "limits" are of the operating system, by their names in `resource`. Its "fault" is [number of the call that
fails, of those that write below the folder "below", 0 for none; way], for servers that have loaded `failing_writes.c`;
a victim that ends well answers with the number of such calls.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import itertools
import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
EPISODES = 8
FAULTS = ("full", "input/output error", "torn", "killed in the middle")
"""Ways in which a write fails, numbered as in `failing_writes.c`."""


def build_faults(folder):
    """Compile what makes writes fail; return the library."""
    library = folder / "failing_writes.so"
    command = ["cc", "-O1", "-shared", "-fPIC", "-o", library, HERE / "failing_writes.c", "-ldl"]
    subprocess.run(command, check=True)
    return library


class Victims:
    """The test's side."""

    def __init__(self, faults=None, imports=(), **environment):
        own = {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]), "OPENBLAS_NUM_THREADS": "1"}
        own |= {} if faults is None else {"LD_PRELOAD": str(faults)}
        self._server = subprocess.Popen(
            [sys.executable, __file__, *imports],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **own, **environment},
        )
        assert self._line() == "ready"

    def run(self, what, out, **options):
        self._server.stdin.write(json.dumps({"what": what, "out": str(out), **options}) + "\n")
        self._server.stdin.flush()
        code, self.said = json.loads(self._line())
        return code

    def _line(self):
        line = self._server.stdout.readline().strip()
        assert line, "the server of victims has died"
        return line

    def close(self):
        self._server.stdin.close()
        self._server.wait(20)


def evaluate(out, episodes=EPISODES, reported=None, keep_images=2, shard=None, scratch=None, jumps=False, **_):
    """Begins a run or goes on with it; names each episode in `reported` once the store has said that it is kept.

    The clock jumps by thirty years at each row where asked."""
    from fakes import LineAgent, LineTask

    from wiw.runs.rows import OutcomeRow
    from wiw.runs.store import RunStore
    from wiw.studies.evaluate import run_arms

    if jumps:
        write_row, clock = RunStore.write, itertools.cycle((10**9, -(10**9), 0))

        def write_and_jump(store, row):
            write_row(store, row)
            ctypes.CDLL(None).jump_clock(ctypes.c_long(next(clock)))

        RunStore.write = write_and_jump
    if reported is not None:
        log, write = os.open(reported, os.O_WRONLY | os.O_CREAT | os.O_APPEND), RunStore.write

        def write_and_tell(store, row):
            write(store, row)
            if isinstance(row, OutcomeRow):
                os.write(log, f"{row.arm} {row.result.episode}\n".encode())

        RunStore.write = write_and_tell
    arms = {"none": LineAgent(0.5), "warp": LineAgent(0.8)}
    place = {"out": out, "shard": shard, "scratch": scratch, "salt": ""}
    run_arms(LineTask(), arms, episodes, **place, progress=False, resume=True, keep_images=keep_images)


def report(out, target, **_):
    from wiw.studies.run_log import load_run

    load_run(out).report(target)


def export(out, target, kind, **_):
    from wiw.studies.run_log import load_run

    log = load_run(out)
    if kind == "view":
        log.view(target)
    else:
        log.export(**{kind: target})


def merge(out, parts, scratch, **_):
    import wiw

    wiw.merge(parts, out, scratch)


def collect(out, scene, **_):
    from wiw.training.collect_navigation import collect_navigation

    rules = {"min_samples": 4, "spacing": 3.0, "leaf_ratio": 0.5}
    collect_navigation(out, scene, rules=rules, size=(18, 32), seed=3, backend="cpu", lossless=True)


def train(out, **_):
    import torch
    from test_train_navigator import SMALL, marked_places

    from wiw.policies.navigator import weights
    from wiw.training import navigator
    from wiw.training.checkpoint import Checkpoint

    torch.set_num_threads(1)
    target = Path(out) / "weights.safetensors"
    checkpoint = Checkpoint(target.with_suffix(".checkpoint"), {"recipe": vars(SMALL)}, seconds=0)
    network, recipe = navigator.train([marked_places(12)], SMALL, checkpoint=checkpoint)
    weights.save(target, network, vars(recipe))
    checkpoint.remove()


def post_train(out, data, validation, weights, **_):
    import torch
    from post_training_parts import tiny_recipe

    from wiw.training.post_training.train import post_train

    torch.set_num_threads(1)
    recipe = tiny_recipe("ltx-action", epochs=3, validate_every=2, validate_clips=1)
    options = {"weights": weights, "device": "cpu", "part": "all", "validation": validation, "seconds": 0}
    post_train("ltx-action", data, Path(out) / "ltx", recipe=recipe, **options)


WORK = {function.__name__: function for function in (evaluate, report, export, merge, collect, train, post_train)}
IMPORTS = (
    *("fakes", "wiw.loop.scheduler", "wiw.studies.evaluate"),
    *("wiw.report.export", "wiw.report.page", "wiw.report.site", "wiw.report.recording"),
    *("pyarrow.parquet", "pyarrow.pandas_compat", "pandas", "rerun"),
)
"""All that victims need, imported once: a victim is to die at its work, and imports take ten times as long."""


def live(job, said):
    """The victim's whole life; what went wrong goes to the pipe `said`."""
    for name, most in job.get("limits", {}).items():
        resource.setrlimit(getattr(resource, name), (most,) * 2)
    if "fault" in job:
        number, way = job["fault"]
        ctypes.CDLL(None).fail_write(os.fsencode(job["below"]), number, FAULTS.index(way))
    imported = set(sys.modules)
    try:
        WORK[job["what"]](**job)
        late = [name for name in sys.modules if name not in imported and name.startswith("wiw.")]
        if late:
            raise ImportError(f"imported by a victim, not by the server: {late}")
    except BaseException as error:
        os.write(said, f"{type(error).__name__}: {error}".encode())
        os._exit(1)
    if "fault" in job:
        os.write(said, str(ctypes.CDLL(None).count_writes()).encode())
    os._exit(0)


def serve():
    import cv2

    cv2.setNumThreads(1)
    for name in (*IMPORTS, *sys.argv[1:]):
        with contextlib.suppress(ModuleNotFoundError):  # of an extra
            importlib.import_module(name)
    gc.freeze()  # or each victim's first collection would go through, and copy, all that was imported

    print("ready", flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        heard, said = os.pipe()
        victim = os.fork()
        if victim == 0:
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            os.dup2(2, 1)
            live(job, said)
        os.close(said)
        if "kill_after" in job:
            time.sleep(job["kill_after"])
            os.kill(victim, signal.SIGKILL)  # a victim that has ended is there until it is waited for
        with os.fdopen(heard, "rb") as pipe:
            message = pipe.read().decode()
        _, status = os.waitpid(victim, 0)
        print(json.dumps([os.waitstatus_to_exitcode(status), message]), flush=True)


if __name__ == "__main__":
    serve()
