# SPDX-License-Identifier: Apache-2.0
"""Damaged bytes of every kind that wiw reads are read, or refused by an error of its own; nothing crashes or hangs."""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from locations import PYTHON_TESTS, TESTS
from readers import MOST_BYTES, READERS, damage

MOST_SECONDS = 10
FEW, MANY = 40, int(os.environ.get("WIW_FUZZ_ROUNDS", "5000"))


def read_damaged(names: list[str], folder: Path, begin: int, count: int) -> None:
    """Read damaged bytes and print what came of each: "read", or the name of the error."""
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
    for name in names:
        reader = READERS[name]
        own = folder / name
        own.mkdir(exist_ok=True)
        sample = reader.make_sample(own)
        reader.read(sample, own)
        for number in range(begin, count):
            data = damage(sample, random.Random(f"{name} {number}"), reader.structure)
            print(f"{name}: {number}:", end=" ", flush=True)
            signal.alarm(MOST_SECONDS)
            try:
                reader.read(data, own)
                print("read")
            except MemoryError:
                print("MemoryError")
            except BaseException as error:
                if not reader.refuses(error):
                    raise
                print(type(error).__name__)
            signal.alarm(0)


def check_readers(names: list[str], folder: Path, count: int) -> None:
    code = "import sys; from pathlib import Path; from test_readers_mutated import read_damaged; "
    code += f"read_damaged({names!r}, Path({str(folder)!r}), 0, {count})"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(PYTHON_TESTS), str(TESTS), *sys.path])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"{done.returncode} at {lines[-1:]}: {done.stderr[-3000:]}"
    for name in names:
        own = [line for line in lines if line.startswith(f"{name}: ")]
        assert len(own) == count and (name in LENIENT or any("Error" in line for line in own)), name


LENIENT = ("rollout", "announcement", "names of objects")
"""Readers that treat what is damaged as what is not there, or take any text."""


def test_damaged_bytes_are_read_or_refused(tmp_path: Path) -> None:
    check_readers(list(READERS), tmp_path, FEW)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", READERS)
def test_many_damaged_bytes_are_read_or_refused(name: str, tmp_path: Path) -> None:
    check_readers([name], tmp_path, MANY)
