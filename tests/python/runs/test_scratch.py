# SPDX-License-Identifier: Apache-2.0
"""A store that is written on a local disk and copied home: no row is lost, whatever lies in either place."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fakes import LineTask

import wiw
from wiw.errors import StoreError
from wiw.runs.rows import OutcomeRow
from wiw.runs.status import _read_time
from wiw.runs.store import RunStore
from wiw.runs.store_log import has_log
from wiw.types import EpisodeResult

COUNT = 60
CONFIG = {"task": {"task": "line"}, "seed": 0, "episodes": COUNT, "arms": [{"name": "none", "agent": {}}]}
INFO: dict[str, Any] = {"pictures": [], "task": None, "agents": {"none": None}, "live": 1, "workers": 1, "limits": {}}


def create(home: Path, scratch: Path | None = None, **info: Any) -> RunStore:
    return RunStore.create(home, CONFIG, {**INFO, **info}, LineTask().episodes(COUNT), scratch)


def write(store: RunStore, episodes: Iterable[int]) -> None:
    for number in episodes:
        result = EpisodeResult(number, f"{number:04d}", "line/0", "done", {"success": 1.0}, 1.5, details={"": "b" * 500})
        store.write(OutcomeRow("none", result))


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
    assert not has_log(path) and _read_time(path).timestamp() == path.stat().st_mtime
