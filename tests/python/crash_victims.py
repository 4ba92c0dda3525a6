# SPDX-License-Identifier: Apache-2.0
"""Processes to be killed. A server imports everything once and forks a victim a job, so that jobs start at once.

On its standard input the server reads a job a line, JSON {"what", "out", "kill_after", ...}; it kills the victim after
so many seconds, or lets it end where none are given, and answers [exit code (negative: the signal), what went wrong].
"""

from __future__ import annotations

import contextlib
import importlib
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


class Victims:
    """The test's side."""

    def __init__(self):
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path]), "OPENBLAS_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
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


def evaluate(out, episodes=EPISODES, reported=None, keep_images=2, shard=None, scratch=None, **_):
    """Begins a run or goes on with it; names each episode in `reported` once the store has said that it is kept."""
    from fakes import LineAgent, LineTask

    from wiw.runs.rows import OutcomeRow
    from wiw.runs.store import RunStore
    from wiw.studies.evaluate import run_arms

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


WORK = {"evaluate": evaluate, "report": report, "export": export}
IMPORTS = (
    *("fakes", "wiw.loop.scheduler", "wiw.studies.evaluate"),
    *("wiw.report.export", "wiw.report.page", "wiw.report.site", "wiw.report.recording"),
    *("pyarrow.parquet", "pyarrow.pandas_compat", "pandas", "rerun"),
)
"""All that victims need, imported once: a victim is to die at its work, and imports take ten times as long."""


def live(job, said):
    """The victim's whole life; what went wrong goes to the pipe `said`."""
    if "most_bytes" in job:
        resource.setrlimit(resource.RLIMIT_FSIZE, (job["most_bytes"],) * 2)
    imported = set(sys.modules)
    try:
        WORK[job["what"]](**job)
        late = [name for name in sys.modules if name not in imported and name.startswith("wiw.")]
        if late:
            raise ImportError(f"imported by a victim, not by the server: {late}")
    except BaseException as error:
        os.write(said, f"{type(error).__name__}: {error}".encode())
        os._exit(1)
    os._exit(0)


def serve():
    import cv2

    cv2.setNumThreads(1)
    for name in IMPORTS:
        with contextlib.suppress(ModuleNotFoundError):  # of an extra
            importlib.import_module(name)

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
