# SPDX-License-Identifier: Apache-2.0
"""Readers written in Python are fuzzed for a while, guided by their coverage: five minutes in all, hours nightly."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from locations import TESTS
from readers import READERS

COMPILED = {"glb", "link stl", "navmesh", "scene cache"}
"""Readers with nothing for Atheris to see, which `scripts/fuzz_compiled` guides."""
GUIDED = [name for name in READERS if name not in COMPILED]
FEW, MANY = 255 // len(GUIDED), int(os.environ.get("WIW_FUZZ_SECONDS", "600"))
"""Seconds of each reader, which takes some more to start."""


def fuzz(name: str, folder: Path, *options: str) -> None:
    """Fuzz a reader in a process of its own, and keep what fails in `folder`."""
    pytest.importorskip("atheris", reason="needs atheris, which has packages for Linux on x86 alone")
    code = TESTS / "reliability" / "fuzz_readers.py"
    command = [sys.executable, code, name, f"-artifact_prefix={folder}/", *options]
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # files there are written up to ten times as fast
    with TemporaryDirectory(dir=memory) as own:  # libFuzzer's end leaves them
        environment = {**os.environ, "TMPDIR": own}
        done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    kept = sorted(folder.glob("*-*"))  # crash-, timeout-, oom-
    assert done.returncode == 0, f"{name}: {kept}: {done.stdout[-3000:]}{done.stderr[-1000:]}"  # error, then progress
    runs = re.search(r"Done (\d+) runs", done.stderr)
    edges = re.findall(r"cov: (\d+)", done.stderr)
    assert runs and int(runs[1]) > 50, done.stderr[-3000:]
    assert int(edges[-1]) > 1, "no code of the reader was instrumented"


@pytest.mark.parametrize("name", GUIDED)
def test_guided_damage_is_read_or_refused(name: str, tmp_path: Path) -> None:
    fuzz(name, tmp_path, "-seed=1", f"-max_total_time={FEW}")


@pytest.mark.nightly
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("name", GUIDED)
def test_much_guided_damage_is_read_or_refused(name: str, tmp_path: Path) -> None:
    fuzz(name, tmp_path, f"-max_total_time={MANY}")
