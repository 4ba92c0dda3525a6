# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied home: no row is lost, whatever lies in either place."""

from __future__ import annotations

import errno
import logging
import os
import shlex
import shutil
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fakes import LineTask

import wiw
from wiw.cli.stop import Terminated, stoppable
from wiw.errors import FileError, StoreError
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
