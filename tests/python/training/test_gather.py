# SPDX-License-Identifier: Apache-2.0
"""Training data that several processes build, file by file."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from wiw.errors import ArgumentError, FileError, InfrastructureError
from wiw.training.gather import Arrays, Job, gather_arrays, require_held_out

SOURCES = {name: name for name in "abcd"}
SCRIPT = """
import os, sys, time
from pathlib import Path
from wiw.training.gather import Job, gather_arrays

def make(name):
    os.write(1, b"works\\n")
    time.sleep(600)

if __name__ == "__main__":
    job = Job("never ready", (), make, ("slow",))
    gather_arrays({"a": "a", "b": "b"}, job, Path(sys.argv[1]), 2, lambda items, text, total: items)
"""


def name_itself(name: str) -> Arrays:
    if name == "poison":
        os._exit(9)
    return {"name": np.array([ord(name)])}


def read_length(name: str) -> Arrays:
    return {"name": np.array([len(Path(name).read_text())])}


def gather(folder: Path, workers: int, *more: str) -> list[int]:
    job = Job("letters", ("name",), name_itself, ("letters",))
    sources = SOURCES | {name: name for name in more}
    found = gather_arrays(sources, job, folder, workers, lambda items, text, total: items)
    return [int(arrays["name"][0]) for arrays in found]


def test_no_scene_is_trained_and_measured_on_by_another_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a/house.obj", "b/house.obj"):
        Path(name).parent.mkdir()
        Path(name).write_text("")
    Path("link.obj").symlink_to("a/house.obj")
    Path("folder").symlink_to("a")
    for other in ("link.obj", "folder/house.obj", "b/../a/house.obj", str(tmp_path / "a/house.obj")):
        with pytest.raises(ArgumentError, match=f"got {other} in both"):
            require_held_out("a/house.obj", other)
        with pytest.raises(ArgumentError, match=r"got a/house\.obj in both"):
            require_held_out(other, "a/house.obj")
    with pytest.raises(ArgumentError, match="remove:tv_1 in both"):
        require_held_out("apartments:train:3", "apartments:train/2?remove:tv_1")
    require_held_out("a/house.obj", "b/house.obj")


@pytest.mark.nightly
def test_several_processes_build_what_one_does_in_the_same_order(tmp_path: Path) -> None:
    assert gather(tmp_path / "one", 1) == gather(tmp_path / "two", 2) == [ord(name) for name in SOURCES]
    assert {file.name for file in (tmp_path / "one").iterdir()} == {file.name for file in (tmp_path / "two").iterdir()}


def test_a_process_that_dies_is_an_error_and_what_is_built_stays(tmp_path: Path) -> None:
    assert len(gather(tmp_path, 1)) == 4
    with pytest.raises(InfrastructureError, match="a worker process died"):
        gather(tmp_path, 2, "poison", "e")
    assert 4 <= len(list(tmp_path.glob("*.npz"))) <= 5


def test_a_file_that_cannot_be_read_back_is_an_error(tmp_path: Path) -> None:
    job = Job("letters", ("name", "another field"), name_itself, ("letters",))
    with pytest.raises(FileError, match=r"letters: .*npz"):
        gather_arrays({"a": "a"}, job, tmp_path, 1, lambda items, text, total: items)


@pytest.mark.parametrize("edited", ["rooms.obj", "rooms.navmesh"])
def test_a_scene_that_has_changed_is_recorded_again(tmp_path: Path, edited: str) -> None:
    (tmp_path / "rooms.obj").write_text("four")
    job, name = Job("lengths", ("name",), read_length, ("lengths",)), str(tmp_path / "rooms.obj")

    def record() -> int:
        gather_arrays({name: name}, job, tmp_path / "cache", 1, lambda items, text, total: items)
        return len(list((tmp_path / "cache").glob("*.npz")))

    assert record() == record() == 1
    (tmp_path / edited).write_text("longer")
    assert record() == record() == 2


def test_workers_end_with_the_process_that_started_them(tmp_path: Path) -> None:
    """They hold its standard output, which is closed once all of them have ended."""
    script = tmp_path / "gather.py"
    script.write_text(SCRIPT)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path / "cache")], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    try:
        assert [process.stdout.readline() for _ in range(2)] == [b"works\n"] * 2
        process.terminate()
        process.communicate(timeout=30)
        assert process.returncode == -signal.SIGTERM
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
