# SPDX-License-Identifier: Apache-2.0
"""Nightly: a run under chaos, and one that lasts; `WIW_CHAOS_EPISODES` and `WIW_SOAK_EPISODES` say how long."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from locations import TESTS

SCRIPTS = TESTS / "reliability"
sys.path.insert(0, str(SCRIPTS))

pytestmark = [pytest.mark.nightly, pytest.mark.timeout(24 * 3600)]
NOISE = 16
"""Megabytes by which memory may differ between the middle and the end of a soak: what allocators keep."""
LEAK = 0.1
"""Megabytes by which what malloc has handed out may differ: 500 episodes take about 0.01, 100 scenes 0.001."""


def test_a_run_under_chaos_equals_a_quiet_one(tmp_path: Path) -> None:
    from chaos import run_chaos

    mount = ["mount", "-t", "tmpfs", "tmpfs", tmp_path]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("making a small file system needs root and the right to mount")
    subprocess.run(["umount", tmp_path], check=True)
    done = run_chaos(tmp_path / "chaos", int(os.environ.get("WIW_CHAOS_EPISODES", "60")), 2, 2.0, 0)
    assert sum(done["disturbances"].values()) >= 3


def test_nothing_grows_with_episodes_and_scenes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from soak import list_left, soak, switch_scenes, write_scenes

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    scenes = write_scenes(tmp_path, 8)
    held = soak(scenes, tmp_path, int(os.environ.get("WIW_SOAK_EPISODES", "1000")), minutes=24 * 60)
    for measured in (held, switch_scenes(scenes, 200)):
        assert set(list_left(measured).values()) == {0} and measured[-1].temporary == measured[0].temporary
        middle, end = measured[len(measured) // 2], measured[-1]
        assert end.megabytes - middle.megabytes < NOISE
        assert end.in_use - middle.in_use < LEAK, f"from {middle} to {end}"
