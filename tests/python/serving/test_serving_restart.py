# SPDX-License-Identifier: Apache-2.0
"""`wiw serve` is killed in the midst of a run and started again, and nothing is lost; told to end, it ends in order."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from locations import PYTHON_TESTS

import wiw
from wiw.cli import main
from wiw.runs.recipes import AgentRecipe
from wiw.runs.store import RunStore
from wiw.tasks.imagenav import ImageNav
from wiw.types import Conditioning, Control

MODELS = PYTHON_TESTS / "served_models.py"
KILLS = (2, 5)
"""Calls of the model within which its server is killed."""


class Served:
    """A server process, which can be killed and started again at the same port."""

    def __init__(self, calls: Path):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.calls, self.address, self.exits = calls, f"remote:ws://127.0.0.1:{self.port}", []
        calls.touch()
        self.start()

    def start(self):
        command = [sys.executable, "-m", "wiw.cli", "serve", f"{MODELS}:Fading", "--port", str(self.port)]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "CALLS": str(self.calls)}
        environment |= {"PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1", "COLUMNS": "200"}
        self.process = subprocess.Popen(
            command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )

    @property
    def called(self):
        return len(self.calls.read_text().splitlines())

    def end(self, number):
        self.process.send_signal(number)
        self.said, _ = self.process.communicate(timeout=60)
        self.exits.append(self.process.returncode)


@pytest.fixture
def server(tmp_path):
    served = Served(tmp_path / "calls")
    yield served
    if served.process.poll() is None:
        served.end(signal.SIGKILL)


def kill_and_restart(server, done):
    for calls in KILLS:
        while server.called < calls:
            if done.wait(0.01):
                return
        server.end(signal.SIGKILL)
        time.sleep(0.3)
        server.start()


def run(address, scene, out):
    agent = AgentRecipe("heuristic", address, "matcher")
    return wiw.evaluate(ImageNav(scenes=scene, decisions=3), agent, 3, out=out, progress=False, keep_images=3)


def facts(out):
    """All that a run found out, and what it asked; not how long that took."""
    with RunStore.read(out) as store:
        decisions = [{k: v for k, v in row.items() if k not in ("seconds", "arm")} for row in store.decisions()]
        outcomes = [{k: v for k, v in row.items() if k not in ("seconds", "arm")} for row in store.outcomes()]
        pictures = [store.images(row["arm"], row["episode"], row["decision"]) for row in store.decisions()]
        return decisions, outcomes, pictures, store.info["built"]


def test_a_server_killed_in_mid_run_and_started_again_loses_nothing(server, two_rooms, tmp_path):
    run(server.address, two_rooms, tmp_path / "undisturbed")
    server.calls.write_text("")
    done = threading.Event()
    killer = threading.Thread(target=kill_and_restart, args=(server, done))
    server.end(signal.SIGTERM)  # what it knows would answer all
    assert server.exits == [0]
    server.start()
    killer.start()
    try:
        log = run(server.address, two_rooms, tmp_path / "killed")
    finally:
        done.set()
        killer.join()
    assert server.exits == [0, -signal.SIGKILL, -signal.SIGKILL]
    assert facts(tmp_path / "killed") == facts(tmp_path / "undisturbed")
    assert [episode["status"] for episode in log.episodes] == ["done"] * 3
    assert all(decision["spent"].get("retries", 0) == 0 for decision in log.decisions)


def test_sigterm_finishes_what_was_taken_and_says_what_was_done(server):
    model = wiw.world_model(server.address, patience=60.0)
    seen = Conditioning(np.zeros((6, 48, 48, 3), np.uint8))
    plan = Control(np.ones(5, np.int8), np.zeros((5, 3)), np.tile(np.eye(4), (5, 1, 1)), length=5)
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(model.rollout, seen, [plan] * 6, np.arange(6, dtype=np.uint64))
        while server.called < 1:
            time.sleep(0.01)
        server.end(signal.SIGTERM)
        assert len(answer.result(30)) == 6
    model.close()
    assert server.exits == [0]
    assert f"remote:ws://127.0.0.1:{server.port}" in server.said and "finishing" in server.said
    assert "perspective 48x48" in server.said and "Traceback" not in server.said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["oracle"], "needs the simulator"),
        (["none"], "expected a world model"),
        (["wrap"], "Did you mean warp"),
        (["copy", "--host", "0.0.0.0"], "set WIW_TOKEN"),
        (["copy", "--port", "99999"], "expected a port"),
    ],
)
def test_what_cannot_be_served_is_said(arguments, said, capsys, monkeypatch):
    monkeypatch.delenv("WIW_TOKEN", raising=False)
    assert main(["serve", *arguments]) == 2
    assert said in capsys.readouterr().err
