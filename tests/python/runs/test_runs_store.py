# SPDX-License-Identifier: Apache-2.0
import gzip
import inspect
import json
import math
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from fakes import LineTask
from locations import TESTS

import wiw
from wiw import benchmark
from wiw.errors import ArgumentError, ContractError, StoreError
from wiw.runs import store as store_module
from wiw.runs.execute import _StoreWriter
from wiw.runs.hidden_secrets import hide_secrets
from wiw.runs.judges import JudgedRow, JudgeRecord
from wiw.runs.progress import SilentBoard, Tracker
from wiw.runs.recipes import AgentRecipe
from wiw.runs.rows import AgentRow, OutcomeRow, decision_row, decode_jpeg, encode_jpeg, outcome_row, strip, to_json
from wiw.runs.run import Records
from wiw.runs.store import SCHEMA_VERSION, RunStore
from wiw.studies.run_log import load_run
from wiw.types import Decision, DecisionRecord, EpisodeResult, Goal, Observation, Proposal, Rollout, Truth

ARMS = [{"name": "none", "agent": {"policy": "line"}}, {"name": "warp", "agent": {"policy": "line", "model": "warp"}}]
CONFIG = {"task": {"task": "line"}, "seed": 0, "episodes": 3, "arms": ARMS}
INFO = {"pictures": [0], "task": None, "agents": {}, "live": 1, "workers": 1, "limits": {}}


def record(episode, index, rollouts=True):
    panorama = np.full((32, 64, 3), 120, np.uint8)
    frames = np.zeros((5, 24, 24, 3), np.uint8)
    decision = Decision(
        np.array([1, 1, 2]),
        2,
        (Proposal([1, 1, 2], 0.5, "straight"), Proposal([2])),
        (Rollout(frames, np.zeros(5, bool)),) * 2 if rollouts else None,
        np.array([0.25, np.nan]),
        0,
        Observation(panorama, panorama, np.zeros(3)),
        Goal("line", image=panorama),
        None,
        {"propose": 0.1},
        {"rows": 2},
        "a note",
    )
    before = Truth(np.array([1.0, 0.0, 2.0]), 0.5, 3.0, float("inf"))
    return DecisionRecord(episode, index, decision, np.array([1, 1]), before, before, np.zeros((3, 3)))


def make_result(episode, **metrics):
    return EpisodeResult(episode, f"{episode:04d}", "line/0", "done", {"success": 1.0, "actions": 4.0, **metrics}, 1.5)


@pytest.fixture
def run(tmp_path):
    with RunStore.create(tmp_path / "run", CONFIG, INFO, LineTask().episodes(3)) as store:
        yield store


def test_what_is_written_is_read_back(run):
    run.write(decision_row("warp", record(0, 0), with_images=True))
    run.write(OutcomeRow("warp", make_result(0)))
    with RunStore.read(run.path.parent) as reader:
        (decision,) = reader.decisions("warp", 0)
        (outcome,) = reader.outcomes()
        images = reader.images("warp", 0, 0)
        assert reader.episodes() == LineTask().episodes(3)
        assert reader.config == CONFIG and reader.wiw_version == wiw.__version__
    assert decision["actions"] == [1, 1, 2] and decision["executed"] == [1, 1] and decision["chosen"] == 0
    assert decision["proposals"][0] == {"actions": [1, 1, 2], "prior": 0.5, "note": "straight"}
    assert decision["scores"] == [0.25, None]
    assert decision["before_geodesic"] == float("inf") and decision["before_z"] == 2.0
    assert outcome["metrics"] == {"success": 1.0, "actions": 4.0} and outcome["scene"] == "line/0"
    assert sorted(images) == ["goal", "imagined/0", "imagined/1", "panorama"]
    assert decode_jpeg(images["imagined/0"]).shape == (160, 5 * 160, 3)


def test_the_file_is_plain_sqlite_in_wal_mode(run):
    with sqlite3.connect(run.path) as other:
        assert other.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        names = {row[0] for row in other.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    assert {"run", "episode", "outcome", "decision", "image"} <= names


def test_pictures_only_where_wanted_and_goal_once(run):
    assert not decision_row("warp", record(1, 0), with_images=False).images
    assert "goal" not in decision_row("warp", record(0, 1), with_images=True).images
    assert set(decision_row("none", record(0, 1, rollouts=False), with_images=True).images) == {"panorama"}


def test_partial_episodes_are_discarded_on_resume_and_never_shown(run, tmp_path):
    run.write(decision_row("warp", record(0, 0), with_images=True))
    run.write(OutcomeRow("warp", make_result(0)))
    run.write(decision_row("warp", record(1, 0), with_images=True))
    assert len(run.decisions()) == 1
    run.close()
    with RunStore.resume(tmp_path / "run", CONFIG) as store:
        assert store.pending("warp") == [1, 2] and store.pending("none") == [0, 1, 2]
        assert store.images("warp", 1, 0) == {} and store.images("warp", 0, 0) != {}
        store.write(decision_row("warp", record(1, 0), with_images=True))


def test_episodes_with_errors_are_pending_only_when_asked(run):
    run.write(OutcomeRow("warp", EpisodeResult(1, "0001", "line/0", "error", error="disk")))
    assert run.pending("warp") == [0, 2] and run.pending("warp", retry_errors=True) == [0, 1, 2]


def test_half_a_surrogate_pair_is_written_out(run):
    """File names in other encodings and cut-off replies have them; none may end a run, or be lost."""
    run.write(OutcomeRow("warp", EpisodeResult(1, "0001", "line/0", "error", error="no file caf\udce9.png")))
    cut = replace(record(1, 0).decision, note="\ud83d")
    run.write(decision_row("warp", replace(record(1, 0), decision=cut), with_images=False))
    judge = JudgeRecord({"judge": "strict", "\udce9": 1})
    run.add_judge(judge)
    run.write_judged(JudgedRow(judge.digest, "warp", 1, {}, {}, "no mark \udce9", "judge/empty"))
    (failed,) = run.recorded_outcomes()
    assert failed["error"] == r"no file caf\udce9.png" and run.decisions()[0]["note"] == r"\ud83d"
    assert run.judged_outcomes(judge.digest)["warp", 1]["error"] == r"no mark \udce9"


@pytest.fixture
def old_run(tmp_path, monkeypatch):
    """A run of two episodes with schema version 7, in which the second ended with an error, called "failed" then."""
    dump = gzip.decompress((TESTS / "data" / "run_schema_7.sql.gz").read_bytes()).decode()
    folder = tmp_path / "old"
    folder.mkdir()
    with closing(sqlite3.connect(folder / "run.sqlite")) as connection:
        connection.executescript(dump)
        ((version,),) = connection.execute("SELECT wiw_version FROM run")
    monkeypatch.setattr(wiw, "__version__", version)
    monkeypatch.setattr(benchmark, "VERSION", benchmark.FIRST)
    return folder


def version_and_statuses(folder):
    with closing(sqlite3.connect(folder / "run.sqlite")) as connection:
        ((version,),) = connection.execute("PRAGMA user_version")
        return version, [status for (status,) in connection.execute("SELECT status FROM outcome ORDER BY episode")]


def test_a_store_of_an_older_schema_is_read_as_it_lies(old_run):
    log = load_run(old_run)
    assert [row["status"] for row in log.episodes] == ["done", "error"]
    assert log.numbers()["none"].errors == 1 and log.numbers()["none"].done == 1 and len(log.decisions) == 5
    assert log.store.pending("none") == [] and log.store.pending("none", retry_errors=True) == [1]
    assert "no such scene" in log.report().read_text()
    assert log.store.judges == [] and log.store.judged_outcomes("any") == {}
    log.close()
    assert version_and_statuses(old_run) == (7, ["done", "failed"])


def test_a_store_of_an_older_schema_is_updated_when_marks_are_added(old_run):
    with RunStore.annotate(old_run) as store:
        store.add_judge(JudgeRecord({"judge": "strict"}))
        store.write_judged(JudgedRow(store.judges[0].digest, "none", 0, {"success": 0.0}, {}))
    with RunStore.read(old_run) as store:
        store.use_judge("strict")
        assert [row["metrics"].get("success") for row in store.outcomes()] == [0.0, None]
        assert store.recorded_outcomes()[0]["metrics"]["success"] == 1.0
    assert version_and_statuses(old_run) == (SCHEMA_VERSION, ["done", "error"])


def test_marks_are_written_once_and_errors_replaced(run):
    run.write(OutcomeRow("warp", EpisodeResult(0, "0000", "line/0", "done", {"success": 1.0})))
    judge = JudgeRecord({"judge": "strict"})
    run.add_judge(judge)
    for row in (
        JudgedRow(judge.digest, "warp", 0, {}, {}, "no mark", "judge/empty"),
        JudgedRow(judge.digest, "warp", 0, {"success": 0.0}, {}),
        JudgedRow(judge.digest, "warp", 0, {"success": 1.0}, {}),
        JudgedRow(judge.digest, "warp", 0, {}, {}, "no mark", "judge/empty"),
    ):
        run.write_judged(row)
    (found,) = run.judged_outcomes(judge.digest).values()
    assert found["status"] == "done" and found["metrics"] == {"success": 0.0} and not found["error"]


def test_a_store_of_an_older_schema_is_updated_when_it_is_resumed(old_run):
    with RunStore.resume(old_run) as store:
        assert store.pending("none", retry_errors=True) == [1] and len(store.decisions()) == 5
        store.discard("none", [1])
        store.write(OutcomeRow("none", EpisodeResult(1, "0001", "line/0", "error", error="disk")))
    assert version_and_statuses(old_run) == (SCHEMA_VERSION, ["done", "error"])
    with RunStore.read(old_run) as store:
        assert [row["error"] for row in store.outcomes()] == ["", "disk"]
    with closing(sqlite3.connect(old_run / "run.sqlite")) as connection, pytest.raises(sqlite3.IntegrityError):
        connection.execute("UPDATE outcome SET status = 'failed'")


@pytest.mark.parametrize("scratch", [None, "disk"])
def test_a_run_that_another_version_must_continue_keeps_its_schema(old_run, tmp_path, monkeypatch, scratch):
    """That version reads no newer one."""
    begun_with = wiw.__version__
    monkeypatch.setattr(wiw, "__version__", "99")
    with pytest.raises(StoreError, match=f"was started by wiw {begun_with}, this is 99.*install that version"):
        RunStore.resume(old_run, scratch=None if scratch is None else tmp_path / scratch)
    assert version_and_statuses(old_run) == (7, ["done", "failed"])


@pytest.mark.parametrize("version", [6, SCHEMA_VERSION + 1])
def test_a_store_of_an_unknown_schema_is_refused(old_run, version):
    with closing(sqlite3.connect(old_run / "run.sqlite")) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    for open_store in (RunStore.read, RunStore.resume):
        with pytest.raises(StoreError, match=f"schema version {version}; .*reads versions 7 to {SCHEMA_VERSION}"):
            open_store(old_run)


def test_two_writers_are_refused(run):
    with pytest.raises(StoreError, match="another process"):
        RunStore.resume(run.path.parent)


def test_an_existing_run_is_not_overwritten(run):
    with pytest.raises(StoreError, match="wiw resume"):
        RunStore.create(run.path.parent, CONFIG, INFO, [])


def test_a_creation_that_was_cut_off_is_done_again(tmp_path):
    (tmp_path / "run.sqlite").touch()
    with pytest.raises(StoreError, match="interrupted"):
        RunStore.read(tmp_path)
    with RunStore.create(tmp_path, CONFIG, INFO, LineTask().episodes(2)) as store:
        assert store.pending("none") == [0, 1]


def test_another_configuration_is_refused_by_name(run, tmp_path):
    run.close()
    with pytest.raises(StoreError, match=r"seed: the run has 0, now 1"):
        RunStore.resume(tmp_path / "run", {**CONFIG, "seed": 1})


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("PRAGMA user_version = 99", "schema version 99"),
        ("UPDATE run SET wiw_version = '0.0.1'", r"wiw 0\.0\.1"),
        ("PRAGMA application_id = 1", "not a run store"),
    ],
)
def test_another_version_is_refused(run, tmp_path, statement, message):
    run.close()
    with sqlite3.connect(tmp_path / "run" / "run.sqlite") as other:
        other.execute(statement)
    with pytest.raises(StoreError, match=message):
        RunStore.resume(tmp_path / "run", CONFIG)


@pytest.mark.parametrize("version", [6, 7, 10, SCHEMA_VERSION, 99])
def test_a_store_without_a_column_of_its_schema_is_refused(run, tmp_path, version):
    """Damage may leave text that is still SQL."""
    run.close()
    with sqlite3.connect(tmp_path / "run" / "run.sqlite") as other:
        other.execute("ALTER TABLE run RENAME COLUMN wiw_version TO wiv_version")
        other.execute(f"PRAGMA user_version = {version}")
    unknown, known = "does not say which run", "table run: expected a column wiw_version TEXT, got none"
    with pytest.raises(StoreError, match=f"{unknown if version in (6, 99) else known}.*restore run.sqlite"):
        RunStore.read(tmp_path / "run")


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("UPDATE outcome SET arm = 'mine'", r"outcome \(arm mine, episode 0\): expected an arm of the run: none, warp"),
        ("UPDATE outcome SET metrics = '{\"success\": null}'", "success: expected int or float or bool, got NoneType"),
        ("UPDATE run SET info = json_set(info, '$.tables', 5)", "info: tables: expected dict, got int"),
        ("UPDATE run SET info = json_set(info, '$.tables.cuts', 'x')", r"info: tables\.cuts: expected list, got str"),
        ("UPDATE run SET info = json_set(info, '$.departures', json('[\"x\"]'))", r"departures\[0\]: expected dict"),
        ("UPDATE run SET info = json_set(info, '$.stopped', json('{}'))", "stopped: 'episodes' is missing"),
    ],
)
def test_a_store_edited_by_hand_is_refused_by_its_summary(run, tmp_path, statement, message):
    run.write(OutcomeRow("warp", make_result(0)))
    run.close()
    with sqlite3.connect(tmp_path / "run" / "run.sqlite") as other:
        other.execute("UPDATE run SET info = json_set(info, '$.tables', json('{}'))")
        other.execute(statement)
    with pytest.raises(StoreError, match=f"{message}.*edited: restore it"):
        load_run(tmp_path / "run").numbers()


def test_a_success_may_be_a_truth_value(run, tmp_path):
    """Tasks of users may give one."""
    for arm, success in (("none", False), ("warp", True)):
        run.write(outcome_row(arm, make_result(0, success=success)))
    found = load_run(tmp_path / "run").numbers()
    assert found["warp"].estimates["success"].value == 100.0 and found["none"].estimates["success"].value == 0.0


def test_metrics_that_are_not_finite_are_summarised_as_such(run, tmp_path):
    for arm, value in (("none", 0.5), ("warp", math.nan)):
        for episode in range(2):
            run.write(OutcomeRow(arm, make_result(episode, spl=value)))
    found = load_run(tmp_path / "run").numbers()
    assert math.isnan(found["warp"].estimates["spl"].value) and found["none"].estimates["spl"].value == 50.0
    (difference,) = (each for each in found.differences if each.metric == "spl")
    assert math.isnan(difference.estimate.value) and difference.wins == difference.losses == 0


def test_damaged_and_missing_stores_are_named(tmp_path):
    (tmp_path / "run.sqlite").write_bytes(b"not a database, but long enough to be looked at" * 40)
    with pytest.raises(StoreError, match=r"run\.sqlite.*not a database"):
        RunStore.read(tmp_path)
    with pytest.raises(StoreError, match="no run at"):
        load_run(tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"note": None}, "note: expected str, got NoneType"),
        ({"chosen": 2}, "expected .* one of them chosen"),
        ({"spent": {"calls": "many"}}, "spent: calls: expected"),
        (
            {"proposals": (Proposal(np.array([1]), note=None), Proposal(np.array([2])))},
            r"proposals: \[0\]\.note: expected",
        ),
    ],
)
def test_a_decision_that_could_not_be_read_again_is_refused_before_it_is_written(change, said):
    """It would make all others of the run unreadable."""
    good = record(0, 0)
    bad = replace(good, decision=replace(good.decision, **change))
    with pytest.raises(ContractError, match=f"arm warp, episode 0, decision 0: cannot be recorded: {said}"):
        decision_row("warp", bad, with_images=False)
    with pytest.raises(ContractError, match="arm warp, episode 1: cannot be recorded: metrics: success: expected"):
        outcome_row("warp", EpisodeResult(1, "0001", "line/0", "done", {"success": "yes"}))
    for success in (2.0, -0.1, float("nan"), np.float32("inf")):
        with pytest.raises(ContractError, match="episode 1: cannot be recorded: success: expected 0 or 1, got"):
            outcome_row("warp", EpisodeResult(1, "0001", "line/0", "done", {"success": success}))


def test_keys_and_tokens_of_servers_are_in_no_record(tmp_path):
    """Reports show what a store says of agents and commands."""
    asking = {"vlm": {"vlm": "http://host/v1", "key": "SECRET", "tries": 2}}
    recipe = AgentRecipe(
        "vlm", "remote:ws://a:1", model_options={"token": "SECRET", "patience": 3.0}, policy_options=asking
    )
    for said in (recipe.describe(), recipe.to_json()):
        assert "SECRET" not in str(said)
        assert said["model_options"] == {"patience": 3.0} and said["policy_options"]["vlm"]["tries"] == 2
    assert recipe.policy_options["vlm"]["key"] == "SECRET"  # it is asked with
    own = AgentRecipe("p.py:P", "m.py:M", model_options={"token": "t"}, policy_options={"p.py:P": {"key": "k"}})
    assert own.to_json()["model_options"] == {"token": "t"} and own.to_json()["policy_options"] == own.policy_options
    command = ["wiw", "run", "--policy-option", "key=SECRET", "--arms", "a=remote:ws://b?token=SECRET&patience=3,none"]
    with RunStore.create(tmp_path / "told", CONFIG, {**INFO, "command": command}, LineTask().episodes(1)) as store:
        assert store.info["command"][3:] == ["key=***", "--arms", "a=remote:ws://b?token=***&patience=3,none"]


def test_workers_that_build_different_agents_end_the_run(run):
    """As where the weights on another machine differ, or a file is replaced."""
    writer = _StoreWriter(run, Tracker({}, 1, SilentBoard()))
    for arm, weights in (("warp", "a"), ("none", "b"), ("warp", "a")):
        writer.write(AgentRow(arm, {"model": {"weights": weights, "sizes": (1, 2)}}))
    differ = 'arm \'warp\': expected the same agent from every worker, .*weights: the run has "a", now "b"'
    with pytest.raises(StoreError, match=differ):
        writer.write(AgentRow("warp", {"model": {"weights": "b", "sizes": (1, 2)}}))
    assert {arm: said["model"]["weights"] for arm, said in run.info["built"].items()} == {"warp": "a", "none": "b"}


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        (["--policy-option", "key=a,b&c d"], ["--policy-option", "key=***"]),
        (["--world-model-option=token=a,b"], ["--world-model-option=token=***"]),
        (["--arms", "a=svd?steps=3,token=b?token=c"], ["--arms", "a=svd?steps=3,token=b?token=***"]),
        (["--token", "SECRET", "key"], ["--token", "***", "key"]),
        (["--policy-option", "tries=2"], ["--policy-option", "tries=2"]),
        (["--task-option", "categories=[bed, key]"], ["--task-option", "categories=[bed, key]"]),
        (["remote:ws://b?token=SECRET&x", "{key: 'SECRET"], ["remote:ws://b?token=***&x", "{key: ***"]),
    ],
)
def test_secrets_in_commands_are_hidden_whatever_they_consist_of(given, shown):
    assert hide_secrets(given) == shown


@pytest.mark.parametrize(
    "roles",
    [
        '{answer: {vlm: "http://h/v1", model: mock, key: SECRET}}',
        '{"answer": {"key": "SECRET", "model": "mock"}}',
        "{answer: {? key : 'SECRET', model: mock}}",
        '{answer: {"k\\x65y": SECRET}}',
        "\nanswer:\n  model: mock\n  key: >\n    SECRET",
        "{answer: &a {key: [SECRET, 1], again: *a}}",
        "{[1, 2]: {key: SECRET}}",
    ],
)
def test_keys_of_roles_are_hidden_however_they_are_written(roles):
    option, text = hide_secrets(["--policy-option", f"roles={roles}"])
    assert option == "--policy-option" and text.startswith("roles=") and "***" in text and "SECRET" not in text


def test_records_become_data_frames(run):
    pytest.importorskip("pandas")
    run.write(decision_row("warp", record(0, 0), with_images=False))
    run.write(OutcomeRow("warp", make_result(0)))
    log = load_run(run.path.parent)
    assert list(log.episodes.to_pandas()["success"]) == [1.0]
    assert list(log.decisions.to_pandas()["arm"]) == ["warp"]
    assert log.table()[1]["success"] == 100.0 and log.table()[1]["n"] == 1
    assert not log.complete and "warp" in repr(log)
    (row,) = Records([{"steps": 3, "metrics": {"steps": 0.5, "success": 1.0}}]).to_pandas().to_dict("records")
    assert row == {"steps": 3, "metric_steps": 0.5, "success": 1.0}


def test_tables_as_text_are_not_shown_besides_in_a_notebook(run, monkeypatch):
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("rich.jupyter.display", lambda *shown: pytest.fail("shown besides"))
    assert "warp" in str(load_run(run.path.parent).numbers())


def test_many_records_print_in_a_line_and_few_in_full():
    few = Records([{"arm": "<a>", "metrics": {"success": 1.0}}])
    assert repr(few) == str(list(few)) and repr(Records()) == "[]"
    assert "<td>&lt;a&gt;</td><td>1.0</td>" in few._repr_html_() and "<p>1 record;" in few._repr_html_()
    many = Records([{"index": index, "plans": "x" * 1000} for index in range(720)])
    assert repr(many) == "Records(720 records; .to_pandas() for a DataFrame)"
    assert repr(Records(many[:9])) == "Records(9 records; .to_pandas() for a DataFrame)"
    assert "The first 20 of 720 records" in many._repr_html_() and len(many._repr_html_()) < 3000


def test_json_is_standard_and_refuses_what_it_cannot_hold():
    assert json.loads(to_json({"a": np.float32(0.5), "b": [np.nan, np.inf], "c": np.arange(2)})) == {
        "a": 0.5,
        "b": [None, None],
        "c": [0, 1],
    }
    with pytest.raises(ArgumentError, match="numbers, text"):
        to_json({"model": object()})


def test_strips_put_frames_side_by_side_and_views_above_one_another():
    frames = np.stack([np.full((8, 16, 3), 10 * k, np.uint8) for k in range(3)])
    flat = strip(frames, height=4)
    assert flat.shape == (4, 24, 3) and list(flat[0, ::8, 0]) == [0, 10, 20]
    assert strip(np.stack([frames, frames], axis=1), height=4).shape == (8, 24, 3)


def test_jpeg_keeps_colour_order():
    image = np.zeros((16, 16, 3), np.uint8)
    image[..., 0] = 200
    assert decode_jpeg(encode_jpeg(image))[8, 8].argmax() == 0


def test_queries_number_no_placeholders() -> None:
    """From Python 3.14 on, sqlite3 refuses them beside a sequence of values."""
    assert not re.findall(r"\?\d", inspect.getsource(store_module))


def list_plans(store, use):
    """Return how SQLite finds the rows of tables in each statement about one episode that `use` makes."""
    statements = []
    store._connection.set_trace_callback(statements.append)
    use()
    store._connection.set_trace_callback(None)
    return [
        step["detail"]
        for statement in statements
        if "episode = " in statement
        for step in store._connection.execute(f"EXPLAIN QUERY PLAN {statement}", [0] * statement.count("?"))
        if step["detail"].startswith(("SCAN", "SEARCH")) and "VIRTUAL TABLE" not in step["detail"]
    ]


def test_the_rows_of_an_episode_are_found_by_key_and_not_by_reading_the_table(run, tmp_path):
    with RunStore.create(tmp_path / "other", CONFIG, INFO, LineTask().episodes(3)) as other:
        for use in (
            lambda: run.decisions("warp", 0),
            lambda: run.images("warp", 0, 0),
            lambda: run.film("warp", 0),
            lambda: other.take_episodes(run, [("warp", 0)]),
            lambda: run.discard("warp", [0]),
        ):
            plans = list_plans(run, use)
            assert plans and all(plan.startswith("SEARCH") for plan in plans), plans


FULL = """
import os, resource
from wiw.errors import StoreError
from wiw.runs.store import RunStore
opened = [RunStore.read(RUN)]
resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 12,) * 2)
for open_store in (RunStore.read, RunStore.annotate):
    try:
        while True:
            opened.append(open_store(RUN))
    except StoreError as error:
        print(error)
"""


def test_a_process_that_may_open_no_more_files_is_told_so(run):
    program = FULL.replace("RUN", repr(str(run.path.parent)))
    run.close()
    shown = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout
    read, annotated = shown.splitlines()
    assert "unable to open" in read and "cannot write" in annotated
    for said in (read, annotated):
        assert re.search(r"as many open as it may, \d+\..* `ulimit -n \d+`", said) and "make room" not in said
