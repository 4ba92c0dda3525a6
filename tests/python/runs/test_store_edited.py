# SPDX-License-Identifier: Apache-2.0
"""A run store that somebody has edited: each reader of it ends in a `StoreError` that names the place, or reads it."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from fakes import LineAgent, LineTask

from wiw.errors import ArgumentError, StoreError
from wiw.report.export import tables
from wiw.runs.store import DECISION_JSON
from wiw.studies.evaluate import resume_run, run_arms
from wiw.studies.run_log import load_run

ODD = (
    "",
    "{",
    "null",
    "1",
    '"x"',
    "[]",
    "{}",
    "[1]",
    "[null]",
    '{"a": "b"}',
    '[["a"]]',
    "[" * 5000 + "]" * 5000,
    b"\0",
)
"""What stands where something else is expected; the last is no text at all."""
TEXTS = {
    "run": ("config", "info"),
    "episode": ("info", "episode_id", "scene"),
    "outcome": ("metrics", "details"),
    "decision": (*DECISION_JSON, "note"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    run_arms(LineTask(), {"none": LineAgent(0.5), "warp": LineAgent(0.8)}, 2, out=out, progress=False)
    return out


def edit_store(whole: Path, folder: Path, table: str, column: str, value: Any) -> Path:
    shutil.copytree(whole, folder)
    with sqlite3.connect(folder / "run.sqlite") as other:
        where = "" if table == "run" else "WHERE episode = 0"
        other.execute(f"UPDATE {table} SET {column} = ? {where}", (value,))
    other.close()
    return folder


def read_all(run: Path, report: bool) -> None:
    """Everything that reads a store."""
    log = load_run(run)
    try:
        log.numbers()
        log.table(), log.costs(), log.fidelity(), log.blame(), repr(log)
        tables(log)
        assert log.complete is not None
        if report:
            log.report()
    finally:
        log.close()
    resume_run(run, progress=False)


@pytest.mark.parametrize(("table", "column"), [(table, column) for table in TEXTS for column in TEXTS[table]])
def test_an_edited_text_is_read_or_named(whole: Path, tmp_path: Path, table: str, column: str) -> None:
    refused, columns = 0, [(table, column) for table in TEXTS for column in TEXTS[table]]
    for number, value in enumerate(ODD):
        run = edit_store(whole, tmp_path / str(number), table, column, value)
        try:
            read_all(run, report=number == columns.index((table, column)) % len(ODD))
        except StoreError as error:
            assert str(run) in str(error)
            refused += "objects in memory" not in str(error)
        except ArgumentError:
            pytest.fail("an edited store is no wrong argument")
    assert refused >= (1 if column in ("episode_id", "scene", "note") else 5)


@pytest.mark.parametrize(
    ("table", "column"),
    [("episode", "start_x"), ("episode", "geodesic"), ("outcome", "seconds"), ("decision", "before_yaw")],
)
def test_an_edited_number_is_named(whole: Path, tmp_path: Path, table: str, column: str) -> None:
    run = edit_store(whole, tmp_path / "run", table, column, "far")
    with pytest.raises(StoreError, match=rf"{table} \(.*{column}: expected float, got str"):
        read_all(run, report=True)


@pytest.mark.parametrize(("number", "said"), [("1e999", "inf"), ("NaN", "nan"), ("9" * 400, "9")])
def test_a_number_that_is_not_finite_is_named(whole: Path, tmp_path: Path, number: str, said: str) -> None:
    run = edit_store(whole, tmp_path / "run", "outcome", "metrics", f'{{"success": 1, "decisions": {number}}}')
    with pytest.raises(StoreError, match=f"metrics: decisions: expected a finite number, got {said}"):
        read_all(run, report=True)


@pytest.mark.parametrize("name", ["task", "seed", "episodes", "arms"])
def test_a_config_that_lacks_something_is_named(whole: Path, tmp_path: Path, name: str) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    with sqlite3.connect(run / "run.sqlite") as other:
        other.execute(f"UPDATE run SET config = json_remove(config, '$.{name}')")
    with pytest.raises(StoreError, match=f"config: value: '{name}' is missing"):
        read_all(run, report=False)
