# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied home: no row is lost, whatever lies in either place."""

from __future__ import annotations

import errno
import logging
import os
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fakes import LineTask

import wiw
from wiw.cli.stop import Terminated, raise_on_stop_signals, stoppable
from wiw.errors import ArgumentError, FileError, StoreError
from wiw.runs import scratch, store_log
from wiw.runs.rows import OutcomeRow
from wiw.runs.status import _read_time
from wiw.runs.store import RunStore, find_resume_command, leave_resumable
from wiw.runs.store_log import has_log
from wiw.types import EpisodeResult

COUNT = 60
CONFIG = {"task": {"task": "line"}, "seed": 0, "episodes": COUNT, "arms": [{"name": "none", "agent": {}}]}
INFO: dict[str, Any] = {"pictures": [], "task": None, "agents": {"none": None}, "live": 1, "workers": 1, "limits": {}}

FILL = {"a": "b" * 500}
"""What makes an outcome take a good part of a page."""


def create(home: Path, scratch: Path | None = None, **info: Any) -> RunStore:
    return RunStore.create(home, CONFIG, {**INFO, **info}, LineTask().episodes(COUNT), scratch)


def write(store: RunStore, episodes: Iterable[int]) -> None:
    for number in episodes:
        result = EpisodeResult(number, f"{number:04d}", "line/0", "done", {"success": 1.0}, 1.5, details=FILL)
        store.write(OutcomeRow("none", result))


@contextmanager
def full_home() -> Iterator[None]:
    """While this lasts, nothing can be copied home."""

    def fill(source: Path, target: Path) -> None:
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_log.shutil, "copyfile", fill)
        yield


def leave_rows(home: Path, local: Path, episodes: Iterable[int]) -> Path:
    """Record episodes that are not copied home, as where a process is killed; return the file that has them."""
    store = RunStore.resume(home, scratch=local) if RunStore.exists(home) else create(home, local)
    store.begin_session()
    write(store, episodes)
    with full_home(), pytest.raises(FileError):
        store.close()
    return store.path


def count(run: Path) -> int:
    """Return how many episodes have ended, in a file that SQLite finds whole."""
    with closing(sqlite3.connect(run / "run.sqlite")) as file:
        assert file.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    with RunStore.read(run) as store:
        return store.count_ended()[0]


def test_a_log_that_a_reader_kept_is_not_applied_to_the_copy(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    with create(home) as store:
        write(store, range(20))
        reader = RunStore.read(home)
    assert (home / "run.sqlite-wal").stat().st_size > 0
    reader.close()
    with RunStore.resume(home, scratch=local) as store:
        write(store, range(20, 50))
    assert count(home) == 50 and sorted(path.name for path in home.iterdir()) == ["run.lock", "run.sqlite"]


def test_a_run_that_was_killed_is_resumed_on_another_disk_with_its_log(tmp_path: Path) -> None:
    with create(tmp_path / "begun") as store:
        write(store, range(20))
        shutil.copytree(tmp_path / "begun", tmp_path / "run")  # as a killed process leaves it
    with RunStore.resume(tmp_path / "run", scratch=tmp_path / "local") as store:
        assert store.count_ended() == (20, 0)
        write(store, range(20, 50))
    assert count(tmp_path / "run") == 50


def test_a_reader_sees_its_file_while_copies_replace_it(tmp_path: Path) -> None:
    home = tmp_path / "run"
    with create(home) as store:
        write(store, range(20))
    with RunStore.read(home) as reader:
        with RunStore.resume(home, scratch=tmp_path / "local") as store:
            write(store, range(20, 50))
        assert reader.count_ended() == (20, 0)
        with RunStore.resume(home) as store:
            write(store, range(50, 60))
    assert count(home) == 60


def test_a_log_that_another_program_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, connect = tmp_path / "run", sqlite3.connect
    with create(home) as store:
        write(store, range(20))
        reader = connect(home / "run.sqlite")
        reader.execute("BEGIN")
        reader.execute("SELECT count(*) FROM outcome").fetchone()
        write(store, range(20, 30))
    monkeypatch.setattr(sqlite3, "connect", lambda *names, **options: connect(*names, **{**options, "timeout": 0.05}))
    with closing(reader), pytest.raises(StoreError, match=r"run\.sqlite has transactions in the log.*close it"):
        RunStore.resume(home, scratch=tmp_path / "local")
    with RunStore.resume(home, scratch=tmp_path / "local") as store:
        assert store.count_ended() == (30, 0)


def test_a_copy_does_not_replace_what_another_program_has_written_home(tmp_path: Path) -> None:
    home = tmp_path / "run"
    with create(home, tmp_path / "local") as store:
        store.begin_session()
        write(store, range(5))
        with closing(sqlite3.connect(home / "run.sqlite")) as other:
            other.execute("PRAGMA journal_mode = WAL")
            with other:
                other.execute("UPDATE run SET info = '{}'")
            with pytest.raises(StoreError, match="another program"):
                store._copy.copy(store._connection)
    assert count(home) == 5


def test_a_log_without_a_store_is_not_applied_to_a_merged_run(tmp_path: Path) -> None:
    with create(tmp_path / "other") as store:
        write(store, range(20))
        (tmp_path / "merged").mkdir()
        shutil.copy(tmp_path / "other/run.sqlite-wal", tmp_path / "merged")
    with create(tmp_path / "part", salt="s") as store:
        write(store, range(5))
    wiw.merge([tmp_path / "part"], tmp_path / "merged", tmp_path)
    assert count(tmp_path / "merged") == 5
    assert not (tmp_path / "merged/run.sqlite-wal").exists()


def test_a_log_that_just_goes_counts_as_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create(tmp_path / "run").close()
    path = tmp_path / "run/run.sqlite"
    monkeypatch.setattr(Path, "exists", lambda *_, **__: True)  # and it is gone right after
    assert not has_log(path)
    assert _read_time(path).timestamp() == pytest.approx(path.stat().st_mtime, abs=1e-3)


def test_an_error_before_the_first_copy_of_a_row_leaves_the_rows(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    store = create(home, local, task={"name": "line"})
    with full_home_after_begin(store), pytest.raises(FileError) as caught, leave_resumable(store):
        try:
            write(store, range(5))
            raise ValueError("no weights")
        finally:
            store.close()
    assert str(store.path) in str(caught.value) and "expected" in str(caught.value)
    command = f"wiw resume {home} --scratch {local}"
    assert command in str(caught.value)
    assert caught.value.__notes__ == [
        f"Everything recorded is kept in {store.path}. Once the cause is fixed:  {command}"
    ]
    with pytest.raises(StoreError, match=f"already holds a run.*{command}"):
        create(home, local)
    with RunStore.resume(home, scratch=local) as again:
        assert again.count_ended() == (5, 0)
    assert count(home) == 5 and not list(local.iterdir())


@contextmanager
def full_home_after_begin(store: RunStore) -> Iterator[None]:
    store.begin_session()
    with full_home():
        yield


def test_an_error_before_any_row_leaves_no_run_behind(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    store = create(home, local, task={"name": "line"})
    with pytest.raises(ValueError, match="no weights"), leave_resumable(store):
        try:
            store.begin_session()
            raise ValueError("no weights")
        finally:
            store.close()
    assert not home.exists() and not list(local.iterdir())


def test_a_run_that_was_never_copied_begins_again_or_goes_on(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    store = create(home, local, task={"name": "line"})
    with full_home(), pytest.raises(FileError), leave_resumable(store), store:
        store.begin_session()
    assert not RunStore.exists(home)
    with RunStore.resume(home, scratch=local) as again:
        assert again.count_ended() == (0, 0)
    shutil.rmtree(home)
    with full_home(), pytest.raises(FileError):
        create(home, local).close()
    create(home, local).close()
    assert RunStore.exists(home)


def test_a_copy_that_fails_meanwhile_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(scratch, "PERIOD", 0.0)
    home = tmp_path / "run"
    with create(home, tmp_path / "local") as store:
        store.begin_session()
        with full_home(), caplog.at_level(logging.WARNING, "wiw.runs"):
            write(store, range(2))
        assert count(home) == 0 and "quota" in caplog.text and str(store.path) in caplog.text
        write(store, [2])
        assert count(home) == 3


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run's folder that two machines see, on which nothing can be locked."""

    def find_network(path: Path) -> str | None:
        return "nfs4" if path.parent == tmp_path / "run" else None

    for module in ("store", "store_file", "store_log"):
        monkeypatch.setattr(f"wiw.runs.{module}.find_network", find_network)
    return tmp_path / "run"


@contextmanager
def another_machine() -> Iterator[None]:
    """While this lasts, processes are on another machine, and do not see the first one's disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wiw.runs.processes.platform.node", lambda: "two")
        patch.setattr(RunStore, "_find_left", lambda path: None)
        yield


def start_twice(home: Path) -> tuple[RunStore, RunStore]:
    """Return the stores of a process on a node that was lost after two episodes, and of the one in its place."""
    first = create(home, home.with_name("one"), task={"name": "line"})
    first.begin_session()
    write(first, range(2))
    assert first._copy is not None
    first._copy.copy(first._connection)
    with another_machine():
        second = RunStore.resume(home, scratch=home.with_name("two"))
        second.begin_session()
    return first, second


@pytest.mark.parametrize("ends", [False, True], ids=["goes on", "ends"])
def test_a_process_that_comes_back_does_not_replace_the_store_of_its_successor(
    shared: Path, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    first, second = start_twice(shared)
    write(second, range(2, 6))
    second.close()
    write(first, range(2, 4))
    monkeypatch.setattr(scratch, "PERIOD", 0.0)
    with pytest.raises(scratch.SupersededError) as caught, leave_resumable(first), first:
        if not ends:
            write(first, range(4, 5))
    assert f"process {os.getpid()} on two" in str(caught.value) and not hasattr(caught.value, "__notes__")
    assert f"wiw merge {shared} {first.path} --out NEW" in str(caught.value)
    assert count(shared) == 6
    with RunStore.read(first.path) as kept:
        assert kept.count_ended() == (4 if ends else 5, 0)


def test_a_process_goes_on_whose_predecessor_came_back(shared: Path) -> None:
    first, second = start_twice(shared)
    with pytest.raises(scratch.SupersededError), first:
        write(first, range(2, 4))
    write(second, range(2, 6))
    second.close()
    assert count(shared) == 6


def test_two_processes_that_create_a_run_at_once_do_not_share_it(shared: Path) -> None:
    first, second = (create(shared, shared.with_name(name)) for name in ("one", "two"))
    first.begin_session()
    with another_machine(), pytest.raises(scratch.SupersededError, match="written by another process"), second:
        second.begin_session()
    write(first, range(3))
    first.close()
    assert count(shared) == 3


def test_what_a_superseded_process_left_is_set_aside_and_can_be_merged(
    shared: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = start_twice(shared)
    write(first, range(10, 15))
    with pytest.raises(scratch.SupersededError):
        first.close()
    write(second, range(2, 4))
    second.close()
    with (
        caplog.at_level(logging.WARNING, "wiw.runs"),
        RunStore.resume(shared, scratch=shared.with_name("one")) as store,
    ):
        assert store.count_ended() == (4, 0)
        write(store, range(4, 6))
    aside = first.path.with_name("run-1.sqlite")
    assert f"{aside} has 5 finished episodes" in caplog.text and count(shared) == 6
    assert wiw.merge([shared, aside], shared.with_name("both"), shared.parent).ended == 11


def test_what_a_superseded_process_left_is_dropped_where_its_successor_has_it(shared: Path) -> None:
    first, second = start_twice(shared)
    with pytest.raises(scratch.SupersededError):
        first.close()
    write(second, range(2, 4))
    second.close()
    with RunStore.resume(shared, scratch=shared.with_name("one")) as store:
        assert store.count_ended() == (4, 0)
    assert not list(shared.with_name("one").iterdir())


@pytest.mark.parametrize("way", ["as printed", "without a folder", "with another folder"])
def test_rows_that_a_process_left_are_taken_in(tmp_path: Path, way: str) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    leave_rows(home, local, range(5))
    assert count(home) == 0
    assert find_resume_command(home) == f"wiw resume {home} --scratch {local}"
    folder = {"as printed": local, "without a folder": None, "with another folder": tmp_path / "other"}[way]
    with RunStore.resume(home, scratch=folder) as store:
        assert store.count_ended() == (5, 0)
        write(store, range(5, 10))
    assert count(home) == 10 and not list(local.iterdir())


def test_errors_and_decisions_that_a_process_left_are_taken_in(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    store = create(home, local)
    store.begin_session()
    store.write(OutcomeRow("none", EpisodeResult(0, "0000", "line/0", "error", error="disk")))
    with full_home(), pytest.raises(FileError):
        store.close()
    with RunStore.resume(home, scratch=local) as again:
        assert again.count_ended() == (1, 1)


def test_a_judge_marks_what_a_process_left(tmp_path: Path) -> None:
    home = tmp_path / "run"
    leave_rows(home, tmp_path / "local", range(5))
    with RunStore.annotate(home) as store:
        assert store.count_ended() == (5, 0)


def test_a_process_that_still_writes_is_not_robbed(tmp_path: Path) -> None:
    home = tmp_path / "run"
    with create(home, tmp_path / "local") as store:
        store.begin_session()
        write(store, range(5))
        with pytest.raises(StoreError, match="being written by another process"):
            RunStore.resume(home)
    assert count(home) == 5


def test_a_new_run_does_not_replace_rows_of_an_earlier_one(tmp_path: Path) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    left = leave_rows(home, local, range(5))
    shutil.rmtree(home)
    with pytest.raises(StoreError, match=f"{left} has rows.*wiw resume {home} --scratch {local}"):
        create(home, local)
    create(home).close()
    with closing(sqlite3.connect(home / "run.sqlite")) as file, file:
        file.execute("UPDATE run SET created = '2020-01-01T00:00:00+00:00'")
    with pytest.raises(StoreError, match=f"{left} has rows of another run"):
        RunStore.resume(home, scratch=local)
    shutil.rmtree(home)
    with RunStore.resume(home, scratch=local) as store:
        assert store.count_ended() == (5, 0)
    assert count(home) == 5


def test_a_left_store_that_cannot_be_read_now_is_not_discarded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, local = tmp_path / "run", tmp_path / "local"
    left = leave_rows(home, local, range(5))
    with monkeypatch.context() as patch:

        def fail(store: sqlite3.Connection) -> None:
            raise sqlite3.OperationalError("disk I/O error")

        patch.setattr(scratch, "_count_rows", fail)
        with pytest.raises(StoreError, match="disk I/O error"):
            RunStore.resume(home, scratch=local)
    assert left.exists()


@pytest.mark.parametrize(("given", "shown"), [("auto", "auto"), ("my disk", "'{}/my disk'")])
def test_a_stopped_run_is_continued_where_it_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], given: str, shown: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLURM_TMPDIR", str(tmp_path / "job"))
    home = tmp_path / "run"

    def work() -> None:
        with create(home, Path(given)) as store:
            store.begin_session()
            raise Terminated

    with pytest.raises(Terminated):
        stoppable(work, home)
    said = capsys.readouterr().err
    assert f"wiw resume {home} --scratch {shown.format(tmp_path)}\n" in said
    assert RunStore.exists(shlex.split(said.partition(":  ")[2])[2])


def test_a_run_without_a_scratch_folder_is_continued_without(tmp_path: Path) -> None:
    home = tmp_path / "run"
    with create(home, tmp_path / "local") as store:
        store.begin_session()
    with RunStore.resume(home) as store:
        store.begin_session()
    assert find_resume_command(home) == f"wiw resume {home}"
    assert find_resume_command(tmp_path / "none") == f"wiw resume {tmp_path / 'none'}"


WRITER = """
import hashlib, shutil, sys, time
from pathlib import Path
from test_scratch import create, write
from wiw.cli import stop

copyfile = shutil.copyfile

def copy_slowly(source, target):
    print("copying", flush=True)
    time.sleep({copying})
    copyfile(source, target)

def work():
    with create(Path(sys.argv[1]), Path(sys.argv[2])) as store:
        store.begin_session()
        write(store, range(5))
        shutil.copyfile = copy_slowly
        print("begun", flush=True)
        {work}

stop.GRACE = 0.5
try:
    with stop.raise_on_stop_signals():
        work()
except stop.Terminated:
    stop.end_process(75)
"""
BUSY = "hashlib.pbkdf2_hmac('sha256', b'a', b'b', 1 << 30)"
"""Takes minutes, in which Python handles no signal, but its other threads go on."""


def start_writer(tmp_path: Path, work: str, copying: float, **environment: str) -> subprocess.Popen[str]:
    code = WRITER.format(work=work, copying=copying)
    process = subprocess.Popen(
        ["env", "--default-signal=INT", sys.executable, "-c", code, str(tmp_path / "run"), str(tmp_path / "local")],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    if work == BUSY:
        begun = read_cpu_ticks(process)
        while read_cpu_ticks(process) < begun + 20:  # 0.2 s: it is in the call
            time.sleep(0.01)
    return process


def read_cpu_ticks(process: subprocess.Popen[str]) -> int:
    """Return how long a process has computed, in hundredths of a second."""
    return int(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11])


def test_a_stop_waits_for_the_store_to_be_copied(tmp_path: Path) -> None:
    process = start_writer(tmp_path, "time.sleep(600)", copying=2.5)
    process.send_signal(signal.SIGTERM)
    _, shown = process.communicate(timeout=60)
    assert (process.returncode, shown) == (75, "")
    assert count(tmp_path / "run") == 5 and not list((tmp_path / "local").iterdir())


def test_a_stop_copies_the_store_though_its_process_does_not_react(tmp_path: Path) -> None:
    process = start_writer(tmp_path, BUSY, copying=0)
    process.send_signal(signal.SIGTERM)
    _, shown = process.communicate(timeout=60)
    assert process.returncode == 75 and "stopped at once" in shown
    assert count(tmp_path / "run") == 5


@pytest.mark.parametrize("work", ["time.sleep(600)", BUSY])
def test_a_copy_that_takes_too_long_ends_and_leaves_the_one_before(tmp_path: Path, work: str) -> None:
    process = start_writer(tmp_path, work, copying=600, WIW_STOP_SECONDS="1.5")
    process.send_signal(signal.SIGTERM)
    _, shown = process.communicate(timeout=60)
    assert process.returncode == 75 and "stopped at once" in shown
    assert count(tmp_path / "run") == 0
    with RunStore.resume(tmp_path / "run") as store:
        assert store.count_ended() == (5, 0)


def test_a_copy_that_fails_at_a_stop_is_said(tmp_path: Path) -> None:
    process = start_writer(tmp_path, BUSY, copying=0)
    (tmp_path / "run/run.sqlite").unlink()
    (tmp_path / "run/run.sqlite").mkdir()
    process.send_signal(signal.SIGTERM)
    _, shown = process.communicate(timeout=60)
    assert process.returncode == 75 and "is a folder" in shown and str(tmp_path / "local") in shown


def test_a_second_ctrl_c_ends_a_copy_at_once(tmp_path: Path) -> None:
    process = start_writer(tmp_path, "time.sleep(600)", copying=600)
    process.send_signal(signal.SIGINT)
    assert process.stdout is not None and process.stdout.readline() == "copying\n"
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode != 0 and count(tmp_path / "run") == 0


def test_seconds_for_stopping_are_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("soon", "nan", "-1", "inf"):
        monkeypatch.setenv("WIW_STOP_SECONDS", text)
        with (
            pytest.raises(ArgumentError, match=f"WIW_STOP_SECONDS={text}: expected a number of seconds"),
            raise_on_stop_signals(),
        ):
            pass
