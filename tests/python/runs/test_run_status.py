# SPDX-License-Identifier: Apache-2.0
"""How far a run is, read while it is written."""

from __future__ import annotations

import os
import platform
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from locations import PYTHON_TESTS

import wiw
from wiw.cli import main
from wiw.errors import StoreError
from wiw.runs.processes import describe_process, is_running
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.rows import to_json
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, resume_run
from wiw.studies.run_log import load_run

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"


def begin(out, scenes="", **options):
    options = {"salt": "s", "progress": False, **options}
    evaluate(TaskRecipe(TASK, {"scenes": scenes}), AgentRecipe("heuristic"), 6, out=out, **options)


def set_session(run, seconds_ago, ended, **changes):
    """Write when and where the present process began."""
    with RunStore.read(run) as store:
        begun = datetime.now(timezone.utc) - timedelta(seconds=seconds_ago)
        session = {**describe_process(), "begun": begun.isoformat(timespec="seconds"), "ended": ended, **changes}
        info = {**store.info, "session": session}
    with closing(sqlite3.connect(store_path(run))) as file, file:
        file.execute("UPDATE run SET info = ?", (to_json(info),))


def test_shards_episodes_errors_and_shards_without_a_store(tmp_path, capsys):
    begin(tmp_path / "run/1", shard="1/3", scenes="broken")
    begin(tmp_path / "run/3", shard="3/3", scenes="broken", arms=["none"])
    found = wiw.status(tmp_path / "run")
    with closing(load_run(tmp_path / "run/1")) as log:
        assert wiw.status(log) == wiw.status(tmp_path / "run/1")
    assert [(str(s.shard), s.ended, s.total, s.errors, s.state) for s in found.stores] == [
        ("1/3", 2, 2, 1, "done"),
        ("3/3", 2, 2, 0, "done"),
    ]
    assert (found.ended, found.total, found.errors, found.seconds_left) == (4, 6, 1, None)
    assert [str(shard) for shard in found.missing] == ["2/3"]
    assert main(["status", str(tmp_path / "run"), str(tmp_path / "run/1")]) == 0
    shown = capsys.readouterr().out
    assert "no store yet: shards 2/3" in shown and "67 %" in shown and "4/6" in shown
    with pytest.raises(StoreError, match="no run at"):
        wiw.status(tmp_path / "nothing")


def test_a_finished_shard_has_nothing_to_run_and_is_judged_by_its_own_episodes(tmp_path):
    begin(tmp_path / "1", shard="1/3", scenes="broken")
    log = load_run(tmp_path / "1")
    (line,) = log.numbers().arms
    assert (line.done, line.errors, line.pending, line.total) == (1, 1, 0, 2) and log.complete
    assert ["1 of 2 episodes of none" in reason for reason in log.numbers().invalid] == [True]
    shown = " ".join(str(log.numbers()).split())
    assert "Shard 1/3: 2 of the run's 6 episodes" in shown and "still to run" not in shown
    assert "Most frequent error, 1 of 1: " in shown and "no such scene" in shown
    report = " ".join(log.report(tmp_path / "x.html").read_text().split())
    assert "Most frequent error, 1 of 1: " in report and "Shard 1/3" in report


def test_a_run_that_a_rule_has_stopped_is_done(tmp_path):
    evaluate(
        TaskRecipe(TASK), AgentRecipe("heuristic"), 60, out=tmp_path, until="width<80", look_every=4, progress=False
    )
    found, log = wiw.status(tmp_path), load_run(tmp_path)
    assert found.total == found.ended == log.store.info["stopped"]["episodes"] < 60
    (store,) = found.stores
    assert (store.state, found.seconds_left) == ("done", 0.0)
    assert [line.pending for line in log.numbers().arms] == [0] and "still to run" not in str(log.numbers())


def test_runs_that_share_a_folder_are_added_up(tmp_path, capsys):
    begin(tmp_path / "runs/a")
    begin(tmp_path / "runs/b", shard="1/2")
    begin(tmp_path / "runs/c", shard="1/2")  # the same shard again
    for folder, ended in (("runs", 12), ("runs/a", 6), ("runs/b", 3)):
        assert wiw.status(tmp_path / folder).ended == ended
    assert wiw.status(tmp_path / "runs").total == 12 and wiw.status(tmp_path / "runs/b").total == 6
    assert wiw.status(tmp_path / "runs").missing == ()
    assert main(["status"]) == 2 and "expected at least one run" in capsys.readouterr().err


def test_a_shard_that_is_being_created_has_no_store_yet(tmp_path):
    begin(tmp_path / "run/1", shard="1/3")
    for number, statement in ((2, ""), (3, "PRAGMA journal_mode = WAL")):
        (tmp_path / f"run/{number}").mkdir()
        with closing(sqlite3.connect(store_path(tmp_path / f"run/{number}"))) as file:
            file.execute(statement)
        store_path(tmp_path / f"run/{number}").touch()
    assert [str(shard) for shard in wiw.status(tmp_path / "run").missing] == ["2/3", "3/3"]
    assert wiw.merge([tmp_path / "run"], tmp_path / "merged").pending == {"none": 4}
    store_path(tmp_path / "run/3").write_bytes(b"no store at all " * 300)
    with pytest.raises(StoreError, match="run/3"):
        wiw.status(tmp_path / "run")


def test_time_left_follows_from_the_present_process(tmp_path):
    begin(tmp_path / "run")
    with RunStore.resume(tmp_path / "run") as store:
        store.discard("none", [3, 4, 5])
    set_session(tmp_path / "run", 100, 1)  # two episodes in 100 s
    (store,) = wiw.status(tmp_path / "run").stores
    assert store.state == "running" and store.seconds_left == pytest.approx(150, abs=5)
    set_session(tmp_path / "run", 100, 3)  # none since
    assert wiw.status(tmp_path / "run").seconds_left is None
    set_session(tmp_path / "run", 100, 1, host="another")
    (store,) = wiw.status(tmp_path / "run").stores
    assert (store.state, store.host) == ("elsewhere", "another") and "on another" in str(wiw.status(tmp_path / "run"))
    set_session(tmp_path / "run", 100, 1, started=1)  # a later process has the number of one that is gone
    (store,) = wiw.status(tmp_path / "run").stores
    assert store.state == "stopped" and store.seconds_left is None


def test_errors_that_are_tried_again_have_not_ended_when_a_session_begins(tmp_path):
    """Else no time left could be told until as many had ended again."""
    begin(tmp_path / "run")
    with closing(sqlite3.connect(store_path(tmp_path / "run"))) as file, file:
        file.execute("UPDATE outcome SET status = 'error' WHERE episode >= 2")
    resume_run(tmp_path / "run", progress=False, retry_errors=True).close()
    with RunStore.read(tmp_path / "run") as store:
        assert store.info["session"]["ended"] == 2 and store.count_ended() == (6, 0)


def test_a_process_is_told_from_a_later_one_with_its_number():
    own = describe_process()
    assert is_running(own) and not is_running({**own, "started": own["started"] + 1})
    with subprocess.Popen([sys.executable, "-c", "pass"]) as child:
        while Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
            time.sleep(0.01)
        stat = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
        session = {"host": platform.node(), "process": child.pid, "started": int(stat[19])}
        assert not is_running(session)  # has ended, though nobody has waited for it
    assert not is_running({**session, "process": 2**22 + 1})


def test_a_run_is_watched_while_another_process_writes_it(tmp_path):
    program = f"""
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.evaluate import evaluate
evaluate(TaskRecipe({TASK!r}, {{"scenes": "slow"}}), AgentRecipe("heuristic"), 6, out={str(tmp_path / "run")!r},
         progress=False, live=1, arms=["none", "heuristic+none"])
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    seen = []
    with subprocess.Popen([sys.executable, "-c", program], env=environment) as writer:
        while writer.poll() is None:
            if store_path(tmp_path / "run").exists():
                try:
                    seen.append(wiw.status(tmp_path / "run"))
                except StoreError as error:  # its first transaction is not written yet
                    assert not seen, error
            time.sleep(0.02)
    assert writer.returncode == 0
    ended = [each.ended for each in seen]
    assert ended == sorted(ended) and len(set(ended)) > 3
    assert "running" in {store.state for each in seen for store in each.stores}
    (last,) = wiw.status(tmp_path / "run").stores
    assert (last.ended, last.total, last.state, last.seconds_left) == (12, 12, "done", 0.0)
    resume_run(tmp_path / "run", progress=False).close()
