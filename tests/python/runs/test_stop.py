# SPDX-License-Identifier: Apache-2.0
"""Processes end with their exit codes although a model's thread is still inside compiled code."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from wiw.runs.store import RunStore
from wiw.studies.run_log import load_run

BUSY = """
from pathlib import Path
import numpy as np
import wiw

class Busy(wiw.WorldModel):
    accepts = wiw.accepts("image", size=(32, 64))

    def rollout(self, observations, controls, seeds):
        Path({mark!r}).touch()
        {work}

def with_torch():
    import torch
    layer, batch = torch.nn.Conv2d(8, 8, 3, padding=1), torch.zeros(1, 8, 256, 256)
    while True:  # always inside torch, or just about to go in
        layer(batch)

def with_opencv():
    import cv2
    image = np.zeros((512, 512), np.uint8)
    while True:
        cv2.GaussianBlur(image, (15, 15), 3.0)
"""


def start_run(tmp_path: Path, work: str, *options: object) -> subprocess.Popen[str]:
    (tmp_path / "busy.py").write_text(BUSY.format(mark=str(tmp_path / "mark"), work=work))
    wiw = ["env", "--default-signal=INT", sys.executable, "-m", "wiw.cli"]  # jobs in the background ignore SIGINT
    model = ["--world-model", f"{tmp_path / 'busy.py'}:Busy", "--policy", "heuristic", "--revision", "matcher"]
    given = ["--scenes", os.environ["ROOMS"], "--episodes", 1, "--no-report", "--out", tmp_path / "run", *options]
    return subprocess.Popen(
        [*wiw, "run", "imagenav", *model, *map(str, given)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(autouse=True)
def rooms(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROOMS", two_rooms)


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75), (signal.SIGUSR2, 75)])
def test_a_run_that_is_stopped_inside_a_model_says_so(tmp_path: Path, sent: int, code: int) -> None:
    process = start_run(tmp_path, "with_opencv()")
    while not (tmp_path / "mark").exists() and process.poll() is None:
        time.sleep(0.02)
    time.sleep(0.5)  # the model has entered its library
    process.send_signal(sent)
    _, shown = process.communicate(timeout=120)
    assert process.returncode == code, shown
    assert "wiw resume" in shown and "terminate called" not in shown and "Traceback" not in shown
    assert RunStore.exists(tmp_path / "run")


def test_a_run_whose_calls_outlive_the_deadline_is_invalid_and_ends(tmp_path: Path) -> None:
    process = start_run(tmp_path, "with_torch()", "--deadline", 0.3)
    said, shown = process.communicate(timeout=300)
    assert process.returncode == 1, shown
    assert "1 infrastructure error, excluded from scores" in shown and str(tmp_path / "run") in said
    assert [episode["kind"] for episode in load_run(tmp_path / "run").episodes] == ["world_model/deadline"]


ENDING = """
import atexit, sys, threading, time
from wiw.cli.stop import end_process
atexit.register(print, "handled")
threading.Thread(target=time.sleep, args=(600,), daemon={daemon}).start()
sys.stdout.write("written ")
end_process({code})
"""


LEAVING = """
from wiw.cli.stop import end_process
class Last:
    def __del__(self):
        print("shut down")
last = Last()
end_process(0)
"""


@pytest.mark.parametrize(("processes", "said"), [("1", "shut down\n"), ("2", "")])
def test_processes_of_torchrun_end_without_a_shutdown(processes: str, said: str) -> None:
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "WORLD_SIZE": processes}
    done = subprocess.run([sys.executable, "-c", LEAVING], env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, said, "")


@pytest.mark.parametrize("daemon", [True, False])
def test_ending_runs_exit_handlers_flushes_and_waits_for_no_thread(daemon: bool) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ENDING.format(daemon=daemon, code=7)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (7, "written handled\n", "")
