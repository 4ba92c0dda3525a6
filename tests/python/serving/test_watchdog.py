# SPDX-License-Identifier: Apache-2.0
"""A server whose model does not return is told from one that is slow, and ends."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, RemoteError
from wiw.serving.background import serve_in_background
from wiw.serving.server import Server
from wiw.serving.watchdog import LEAST_STALL, Watchdog
from wiw.types import Conditioning, Control
from wiw.wire.address_book import read_addresses
from wiw.world_models.base import answer_deadline

SIZE = (8, 16)


class Gated(wiw.WorldModel):
    """Repeats the image once a gate opens."""

    accepts = wiw.accepts("image", size=SIZE, best_batch=4)

    def __init__(self) -> None:
        self.gate, self.begun = threading.Event(), threading.Event()

    def rollout(self, observations: Conditioning, controls: Any, seeds: Any) -> Any:
        self.begun.set()
        self.gate.wait(20)
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


def ask(model: wiw.WorldModel, seconds: float, seed: int = 0) -> None:
    control = Control(np.ones(2, np.int8), np.zeros((2, 3)), np.tile(np.eye(4), (2, 1, 1)), length=2)
    with answer_deadline(seconds):
        model.rollout(Conditioning(np.zeros((1, *SIZE, 3), np.uint8)), [control], np.array([seed], np.uint64))


def wait_for(condition: Callable[[], Any], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def test_only_a_call_that_lasts_too_long_is_a_hang() -> None:
    model = Gated()
    with serve_in_background(model) as server:
        client = wiw.world_model(f"remote:{server.address}")
        strict, lenient, endless = Watchdog(server, 0.3), Watchdog(server, 60.0), Watchdog(server, math.inf)
        assert not strict.find_hang(), "nobody has asked"
        with pytest.raises(RemoteError, match="busy or hung"):
            ask(client, 0.5)
        wait_for(strict.find_hang)
        expected = r"Gated has not returned from a call for \d+ s, expected at most 0 s; .*--stall"
        assert re.search(expected, strict.find_hang())
        assert not lenient.find_hang() and not endless.find_hang()
        model.gate.set()
        ask(client, 60.0)
        assert not strict.find_hang()
        client.close()


def test_without_a_time_the_deadlines_of_clients_count() -> None:
    model = Gated()
    model.gate.set()
    with serve_in_background(model) as server:
        watchdog = Watchdog(server)
        client = wiw.world_model(f"remote:{server.address}")
        ask(client, 10.0)
        assert watchdog.stall == LEAST_STALL
        ask(client, 2000.0, seed=1)
        ask(client, 10.0, seed=2)
        assert watchdog.stall == pytest.approx(4 * 0.95 * 2000, rel=0.05)
        client.close()


@pytest.mark.parametrize("stall", [0.0, -1.0, math.nan])
def test_times_that_are_none(stall: float) -> None:
    with pytest.raises(ArgumentError, match="serve: expected a stall of more than 0 seconds"):
        Watchdog(Server(Gated()), stall)


def test_the_command_refuses_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["serve", "copy", "--port", "0", "--stall", "0"]) == 2
    assert "expected a stall of more than 0 seconds" in capsys.readouterr().err


STUCK = """
import time
import wiw

class Stuck(wiw.WorldModel):
    accepts = wiw.accepts("image", size=(8, 16))

    def rollout(self, observations, controls, seeds):
        time.sleep(3600)
"""


def test_the_command_ends_with_a_reason_where_its_model_hangs(tmp_path: Path) -> None:
    (tmp_path / "stuck.py").write_text(STUCK)
    folder = tmp_path / "servers"
    folder.mkdir()
    served = f"{tmp_path / 'stuck.py'}:Stuck"
    command = [sys.executable, "-m", "wiw.cli", "serve", served, "--port", "0", "--stall", "1"]
    process = subprocess.Popen(
        [*command, "--announce", str(folder / "1.json")],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        wait_for(lambda: read_addresses(folder) or process.poll() is not None, 60.0)
        client = wiw.world_model(f"remote:{folder}")
        with pytest.raises(RemoteError):
            ask(client, 1.0)
        _, said = process.communicate(timeout=20)
        client.close()
    finally:
        process.kill()
    assert process.returncode == 2 and not read_addresses(folder), "nobody looks for it any more"
    assert "wiw serve: Stuck has not returned from a call for" in said and "Traceback" not in said
