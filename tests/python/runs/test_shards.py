# SPDX-License-Identifier: Apache-2.0
"""A run in shards: merged it is equal, row by row, to the run of one process."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from fakes import LineAgent, PictureTask
from locations import PYTHON_TESTS

import wiw
from wiw import file_systems
from wiw.cli import main
from wiw.errors import ArgumentError, FileError, StoreError
from wiw.runs import scratch, store_file, store_log
from wiw.runs.frame_scores import FrameScores
from wiw.runs.judges import JudgedRow, JudgeRecord
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.run import list_marks
from wiw.runs.shards import Shard
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, resume_run, run_arms
from wiw.studies.run_log import load_run
from wiw.vlm.cache import ReplyCache
from wiw.vlm.messages import Completion

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
TABLES = {
    "episode": "episode",
    "outcome": "arm, episode",
    "decision": "arm, episode, decision",
    "image": "arm, episode, decision, name",
    "film": "arm, episode",
    "scene_map": "scene",
    "lost": "arm, name",
}
"""By name, with the columns that order their rows."""
TIMES = {"outcome": ("seconds",), "decision": ("seconds", "spent", "calls")}
"""Columns that are not promised to be equal."""


def begin(out, episodes=7, agent="heuristic", **options):
    task = TaskRecipe(TASK, options.pop("task", {}))
    return evaluate(task, AgentRecipe(agent), episodes, out=out, progress=False, **{"live": 3, "salt": "s", **options})


def read_rows(run):
    """Return all rows of a store by table, but for what is not promised to be equal, and its config."""
    with closing(sqlite3.connect(store_path(run))) as store:
        store.row_factory = sqlite3.Row
        rows = {
            table: [
                {name: row[name] for name in row.keys() if name not in TIMES.get(table, ())}  # noqa: SIM118 - a Row
                for row in store.execute(f"SELECT * FROM {table} ORDER BY {order}")
            ]
            for table, order in TABLES.items()
        }
        return rows, store.execute("SELECT config FROM run").fetchone()[0]


def run_shards(folder, count, numbers=(), **options):
    own = numbers or range(1, count + 1)
    for number in own:
        begin(folder / str(number), shard=f"{number}/{count}", **options).close()
    return [folder / str(number) for number in own]


@pytest.mark.parametrize(("episodes", "count"), [(7, 1), (7, 2), (7, 3), (7, 7), (100, 8), (3, 2)])
def test_shards_are_a_partition_of_about_equal_parts(episodes, count):
    parts = [Shard(number, count).select(episodes) for number in range(1, count + 1)]
    assert [index for part in parts for index in part] == list(range(episodes))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert Shard.parse(str(Shard(count, count))) == Shard(count, count)


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/0", "a/b", "1/2/3", "-1/2", ""])
def test_no_shard_is_refused(tmp_path, text):
    with pytest.raises(ArgumentError, match=f"shard I/N .* got '{text}'"):
        begin(tmp_path / "run", shard=text)
    with pytest.raises(ArgumentError, match="with 2 episodes"):
        begin(tmp_path / "run", 2, shard="3/3")
    assert not (tmp_path / "run").exists()


def test_merged_shards_equal_the_run_of_one_process(tmp_path):
    begin(tmp_path / "whole").close()
    found = wiw.merge(run_shards(tmp_path / "parts", 3), tmp_path / "merged")
    assert (found.stores, found.ended, found.complete, found.repeated, found.unlike) == (3, 7, True, 0, ())
    assert read_rows(tmp_path / "merged") == read_rows(tmp_path / "whole")
    assert len(read_rows(tmp_path / "whole")[0]["image"]) > 0
    assert wiw.verify(tmp_path / "merged", episodes=7).same
    one, other = (load_run(tmp_path / name) for name in ("merged", "whole"))
    assert one.table() == other.table() and one.complete and one.store.shard is None
    assert one.store.created == min(each["created"] for each in one.store.info["merged"])
    assert [each["shard"] for each in one.store.info["merged"]] == ["1/3", "2/3", "3/3"]


def test_shards_of_episodes_whose_goal_is_not_known_are_merged(tmp_path):
    """Their pictures may lie in another folder on each machine, but have the same names."""
    shards = []
    for shard, name in (("1/2", "0.png"), ("2/2", "0.png"), ("2/2", "1.png")):
        shards.append(tmp_path / str(len(shards)))
        task = PictureTask(picture=f"/machine{len(shards)}/goals/{name}")
        run_arms(task, {"a": LineAgent()}, 4, out=shards[-1], shard=shard, salt="", progress=False)
    assert wiw.merge(shards[:2], tmp_path / "merged").complete
    with pytest.raises(StoreError, match=r'episode\[0\]\.info\.goal_image: "0.png" and "1.png"'):
        wiw.merge([shards[0], shards[2]], tmp_path / "other")


def test_a_merged_run_is_of_the_version_that_ran_its_parts(tmp_path):
    parts = run_shards(tmp_path / "parts", 2)
    for part in parts:
        with closing(sqlite3.connect(store_path(part))) as store, store:
            store.execute("UPDATE run SET wiw_version = '0.0.9', info = json_remove(info, '$.benchmark')")
    wiw.merge(parts, tmp_path / "merged")
    with RunStore.read(tmp_path / "merged") as merged:
        assert (merged.wiw_version, merged.benchmark) == ("0.0.9", 1)
    with pytest.raises(StoreError, match=r"0\.0\.9"):
        resume_run(tmp_path / "merged")


def test_with_world_models_pictures_and_scene_maps(tmp_path, two_rooms):
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1, "backend": "cpu"})

    def run(name, **options):
        given = {"salt": "s", "arms": ["none", "placebo-swapped"], "progress": False, "keep_images": 1}
        evaluate(task, AgentRecipe("matcher", candidates=2), 3, out=tmp_path / name, **given, **options).close()

    run("whole", live=2)
    for number in (1, 2):
        run(f"parts/{number}", shard=f"{number}/2", live=3)
    wiw.merge(str(tmp_path / "parts"), tmp_path / "merged")
    rows, config = read_rows(tmp_path / "merged")
    assert (rows, config) == read_rows(tmp_path / "whole")
    assert rows["image"] and rows["scene_map"]
    assert {row["episode"] for row in rows["image"]} == set(load_run(tmp_path / "merged").store.info["pictures"])


def test_the_command_line_runs_merges_and_compares(tmp_path, capsys):
    def run(*arguments):
        given = ["--policy", "heuristic", "--episodes", "5", "--salt", "s", *map(str, arguments)]
        assert main(["run", TASK, *given]) == 0
        return capsys.readouterr()

    run("--out", tmp_path / "whole", "--no-report")
    shown = [run("--out", tmp_path / "parts" / str(i), "--shard", f"{i}/2", "--resume") for i in (1, 2)]
    assert all("shard   " in each.err and "merge all shards with `wiw merge`" in each.out for each in shown)
    assert not list((tmp_path / "parts").rglob("report.html"))
    assert main(["merge", str(tmp_path / "parts"), "--out", str(tmp_path / "merged")]) == 0
    assert "5 episodes from 2 stores" in capsys.readouterr().out
    assert main(["report", str(tmp_path / "merged")]) == 0 and (tmp_path / "merged/report.html").exists()
    assert main(["verify", str(tmp_path / "merged")]) == 0
    assert main(["compare", str(tmp_path / "whole"), str(tmp_path / "merged")]) == 0
    assert read_rows(tmp_path / "merged") == read_rows(tmp_path / "whole")
    assert main(["merge", str(tmp_path / "parts"), "--out", str(tmp_path / "whole")]) == 2
    assert "already holds a run, which was not merged from these shards" in capsys.readouterr().err


@pytest.fixture
def merged(tmp_path):
    """A run that was merged, in its own folder, from two of its three shards, before the third began."""
    run_shards(tmp_path / "run", 3, numbers=(1, 2))
    assert not wiw.merge([tmp_path / "run"], tmp_path / "run").complete
    return tmp_path / "run"


def test_shards_that_go_on_after_a_merge_are_shown_and_merged_again(merged, tmp_path, capsys):
    """As `wiw submit` prints it, with the run's own folder as --out; before, the merged store hid its shards."""
    opened = load_run(merged)  # whoever has the replaced run open goes on to see it
    with RunStore.resume(merged / "2") as store:
        store.discard("none", [2])
    assert [(str(each.shard), each.ended, each.total) for each in wiw.status(merged).stores] == [
        ("1/3", 2, 2),
        ("2/3", 1, 2),
    ]
    resume_run(merged / "2", progress=False).close()
    begin(merged / "3", shard="3/3").close()
    found = wiw.status(merged)
    assert (found.ended, found.total, found.missing, len(found.stores)) == (7, 7, (), 3)
    assert main(["merge", str(merged), "--out", str(merged)]) == 0
    assert "7 episodes from 3 stores" in capsys.readouterr().out
    begin(tmp_path / "whole").close()
    (rows, config), (whole, same) = read_rows(merged), read_rows(tmp_path / "whole")
    assert rows.pop("lost") != whole.pop("lost"), "what the episode cost that was run again"
    assert (rows, config) == (whole, same) and len(opened.episodes) == 4
    assert [each["shard"] for each in load_run(merged).store.info["merged"]] == ["1/3", "2/3", "3/3"]
    assert wiw.merge([merged], merged).complete and wiw.merge([merged], tmp_path / "other").stores == 3
    assert {path.name for path in merged.iterdir()} <= {"1", "2", "3", "run.sqlite", "run.lock"}


def test_a_merged_run_has_the_episodes_of_shards_that_are_gone(merged, tmp_path):
    ended = len(load_run(merged).episodes)
    shutil.rmtree(merged / "1")
    assert wiw.status(merged).ended == ended == wiw.merge([merged], tmp_path / "copy").ended


def test_a_merge_that_cannot_be_written_says_that_nothing_is_lost(merged, tmp_path, monkeypatch):
    def fill(*_):
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(store_log.shutil, "copyfile", fill)
    with pytest.raises(FileError, match=r"the merged run cannot be written .*stores that were merged are as they were"):
        wiw.merge([merged], tmp_path / "copy")


def test_a_merged_run_that_was_resumed_is_not_replaced(merged):
    resume_run(merged, progress=False).close()
    before = read_rows(merged)
    assert [each.shard for each in wiw.status(merged).stores] == [None]
    with pytest.raises(StoreError, match="already holds a run, which was resumed or judged since"):
        wiw.merge([merged / "1", merged / "2"], merged)
    with pytest.raises(StoreError, match="already holds a run"):
        wiw.merge([merged], merged)
    assert read_rows(merged) == before


def test_a_merged_run_that_was_judged_is_not_replaced(merged, tmp_path):
    with RunStore.annotate(merged) as store:
        store.add_judge(JudgeRecord({"judge": "strict"}))
        store.write_judged(JudgedRow(store.judges[0].digest, "none", 0, {"success": 0.0}, {}))
    assert len(wiw.status(merged).stores) == 2  # they may go on, whoever judges
    with pytest.raises(StoreError, match="already holds a run, which was resumed or judged since"):
        wiw.merge([merged / "1", merged / "2"], merged)
    wiw.merge([merged], tmp_path / "other")
    assert len(list_marks(load_run(tmp_path / "other").store)) == 1


def test_a_merged_run_is_replaced_by_all_of_its_own_shards_alone(merged, tmp_path):
    before = read_rows(merged)
    again, others = run_shards(tmp_path / "again", 3), run_shards(tmp_path / "others", 3, seed=4)
    for store in again:
        edit(store, "UPDATE run SET created = '2020-01-01T00:00:00+00:00'")
    for stores in (again, others, [merged / "1"]):
        with pytest.raises(StoreError, match="already holds a run, which was not merged from these shards"):
            wiw.merge(stores, merged)
    assert read_rows(merged) == before


def test_a_merged_run_that_is_in_use_or_cannot_be_written_stays(merged, monkeypatch):
    before = read_rows(merged)
    with RunStore.annotate(merged), pytest.raises(StoreError, match="is being written by another process"):
        wiw.merge([merged], merged)

    def fail(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("wiw.runs.store_log.remove_log", fail)  # the last step before the file is replaced
    with pytest.raises(FileError, match="No space left"):
        wiw.merge([merged], merged)
    assert read_rows(merged) == before


def test_missing_episodes_are_named_and_can_be_run(tmp_path, capsys):
    parts = run_shards(tmp_path / "parts", 3)
    found = wiw.merge(parts[:2], tmp_path / "merged")
    assert not found.complete and dict(found.pending) == {"none": 3} and "wiw resume" in str(found)
    resume_run(tmp_path / "merged", progress=False).close()
    begin(tmp_path / "whole").close()
    assert read_rows(tmp_path / "merged") == read_rows(tmp_path / "whole")


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"seed": 5}, "seed: 0 and 5"),
        ({"episodes": 8}, "episodes: 7 and 8"),
        ({"task": {"seed": 4}}, "task.seed: 0 and 4"),
        ({"agent": "matcher"}, r"arms\[0\].agent.policy: \"heuristic\" and \"matcher\""),
        ({"fidelity": True}, "fidelity: false and true"),
    ],
)
def test_stores_of_unlike_runs_are_refused_and_the_difference_is_named(tmp_path, changed, named):
    begin(tmp_path / "1", shard="1/2").close()
    if changed.get("agent") == "matcher":  # is not made for this task
        begin(tmp_path / "2", shard="2/2").close()
        edit(tmp_path / "2", "UPDATE run SET config = replace(config, 'heuristic', 'matcher')")
    else:
        begin(tmp_path / "2", shard="2/2", **changed).close()
    with pytest.raises(StoreError, match=f"not from the same run: {named}"):
        wiw.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_shares_of_decisions_whose_fidelity_was_measured_must_be_equal(tmp_path):
    parts = run_shards(tmp_path, 2)
    edit(parts[1], "UPDATE run SET info = json_set(info, '$.limits.fidelity_share', 0.5)")
    with pytest.raises(StoreError, match=r"not from the same run: fidelity_share: 1\.0 and 0\.5"):
        wiw.merge(parts, tmp_path / "merged")


def test_unlike_agents_are_refused_though_the_first_store_has_not_begun_that_arm(tmp_path):
    parts = run_shards(tmp_path, 3)
    edit(parts[0], "UPDATE run SET info = json_remove(info, '$.built.none')")
    assert wiw.merge(parts, tmp_path / "merged").complete
    edit(parts[2], "UPDATE run SET info = json_set(info, '$.built.none.weights', 'others')")
    with pytest.raises(
        StoreError, match=r"2 and .*3 had different agents: agent none.weights: \"absent\" and \"others\""
    ):
        wiw.merge(parts, tmp_path / "again")


def test_stores_with_different_rules_for_stopping_are_refused(tmp_path):
    rules = {"a": "width<80", "b": "width<70", "c": None}
    for name, until in rules.items():
        begin(tmp_path / name, until=until).close()
    for other, named in (("b", r'until\.rule: "width<80" and "width<70"'), ("c", r"until: \{.*\} and null")):
        with pytest.raises(StoreError, match=f"not from the same run: {named}"):
            wiw.merge([tmp_path / "a", tmp_path / other], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_a_merged_run_was_stopped_where_its_parts_were(tmp_path):
    """A copy from before the stop does not hide it; stores that stopped at different looks are not of one run."""
    for name in ("before", "after"):
        begin(tmp_path / name, 40, until="width<80", look_every=4).close()
    stopped = load_run(tmp_path / "after").store.info["stopped"]
    last = stopped["episodes"] - 1
    assert last < 39
    edit(tmp_path / "before", f"DELETE FROM outcome WHERE episode = {last}")
    edit(tmp_path / "before", "UPDATE run SET info = json_remove(info, '$.stopped')")
    merged = wiw.merge([tmp_path / "before", tmp_path / "after"], tmp_path / "merged")
    assert load_run(tmp_path / "merged").store.info["stopped"] == stopped and merged.complete
    edit(
        tmp_path / "before",
        'UPDATE run SET info = json_set(info, \'$.stopped\', json(\'{"episodes": 4, "why": "x"}\'))',
    )
    with pytest.raises(StoreError, match=r"before and .*after are of one run .* different looks: x; and"):
        wiw.merge([tmp_path / "before", tmp_path / "after"], tmp_path / "again")


def test_a_merge_of_nothing_is_refused(tmp_path, capsys):
    assert main(["merge", "--out", str(tmp_path / "merged")]) == 2
    assert "expected at least one run" in capsys.readouterr().err and not (tmp_path / "merged").exists()


def edit(run, statement):
    with closing(sqlite3.connect(store_path(run))) as store, store:
        assert store.execute(statement).rowcount == 1


def test_an_episode_in_two_stores_counts_once(tmp_path):
    parts = run_shards(tmp_path / "parts", 2)
    shutil.copytree(parts[0], tmp_path / "copy")
    found = wiw.merge([*parts, tmp_path / "parts", tmp_path / "copy"], tmp_path / "merged")
    assert found.stores == 3  # named twice
    assert (found.ended, found.repeated, found.unlike) == (7, 3, ())
    edit(tmp_path / "copy", "UPDATE decision SET note = 'edited' WHERE episode = 1 AND decision = 0")
    found = wiw.merge([*parts, tmp_path / "copy"], tmp_path / "first")
    assert found.repeated == 2 and found.unlike == ('none episode 1: decision 0: note: recorded "", now "edited"',), (
        found.unlike
    )
    found = wiw.merge([tmp_path / "copy", *parts], tmp_path / "other")
    notes = [[row["note"] for row in read_rows(tmp_path / name)[0]["decision"]] for name in ("first", "other")]
    assert "edited" not in notes[0] and "edited" in notes[1]  # the first wins
    assert sum(load_run(tmp_path / "first").store.sum_lost_costs()["none"].values()) > 0  # work done twice


def test_unlike_records_of_built_in_parts_are_refused(tmp_path, two_rooms):
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1, "backend": "cpu"})
    evaluate(task, AgentRecipe("heuristic"), 1, out=tmp_path / "1", progress=False).close()
    shutil.copytree(tmp_path / "1", tmp_path / "2")
    assert wiw.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged").repeated == 1
    edit(tmp_path / "2", "UPDATE decision SET after_x = after_x + 1e-9")
    with pytest.raises(
        StoreError, match=r"none episode 0 has different records .* its parts guarantee equal ones .*: after_x"
    ):
        wiw.merge([tmp_path / "1", tmp_path / "2"], tmp_path / "again")


def test_an_episode_that_ended_without_an_error_is_preferred(tmp_path):
    part = run_shards(tmp_path / "parts", 1)[0]
    shutil.copytree(part, tmp_path / "broken")
    edit(tmp_path / "broken", "UPDATE outcome SET status = 'error', metrics = '{}', error = 'lost' WHERE episode = 2")
    wiw.merge([tmp_path / "broken", part], tmp_path / "merged")
    assert {row["status"] for row in load_run(tmp_path / "merged").episodes} == {"done"}


def test_a_shard_is_resumed_as_that_shard_alone(tmp_path):
    begin(tmp_path / "run", shard="1/2").close()
    with pytest.raises(StoreError, match='shard: the run has "1/2", now "2/2"'):
        begin(tmp_path / "run", shard="2/2", resume=True)
    begin(tmp_path / "run", shard="1/2", resume=True).close()
    log = resume_run(tmp_path / "run", progress=False)
    assert log.complete and len(log.episodes) == 3


@pytest.fixture
def network(tmp_path, monkeypatch):
    """A folder that the list of mounts says is a network file system."""
    folder = tmp_path / "net work"
    folder.mkdir()
    (tmp_path / "mountinfo").write_text(
        "22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw\n"
        f"40 22 0:50 / {str(folder).replace(' ', chr(92) + '040')} rw shared:7 master:2 - nfs4 server:/home rw\n"
        f"41 40 0:51 / {str(folder).replace(' ', chr(92) + '040')}/disk rw - xfs /dev/sdb1 rw\n"
    )
    monkeypatch.setattr(file_systems, "MOUNTS", tmp_path / "mountinfo")
    return folder


def test_network_file_systems_are_told_from_disks(network, tmp_path):
    places = (network, network / "not/there/yet", network / "disk/run", tmp_path, Path("/"))
    assert [file_systems.find_network(place) for place in places] == ["nfs4", "nfs4", None, None, None]
    assert file_systems.find_network(network.with_name("net")) is None  # a longer name is no folder in it


@pytest.mark.parametrize(
    ("kind", "found"),
    [
        *((kind, kind) for kind in ("gfs2", "fuse.daos", "fuse.mfs", "fuse.quobyte", "fuse.lizardfs")),
        *((kind, f"{kind}, taken for one") for kind in ("9p", "virtiofs", "fuse", "fuse.unheard-of")),
        *((kind, None) for kind in ("ext4", "tmpfs", "overlay", "fuseblk", "fuse.fuse-overlayfs")),
    ],
)
def test_what_may_be_shared_counts_as_a_network_file_system(tmp_path, monkeypatch, kind, found):
    """FUSE file systems that nobody has heard of, and folders of a host, such as WSL2's /mnt/c, may be shared."""
    mounts = f"22 1 8:1 / / rw shared:1 - ext4 /dev/sda1 rw\n40 22 0:50 / {tmp_path} rw - {kind} any rw\n"
    (tmp_path / "mountinfo").write_text(mounts)
    monkeypatch.setattr(file_systems, "MOUNTS", tmp_path / "mountinfo")
    assert file_systems.find_network(tmp_path / "run/run.sqlite") == found


@pytest.mark.parametrize(("kind", "found"), [("9p", None), ("virtiofs", None), ("fuse.own", None), ("nfs4", "nfs4")])
def test_the_root_folder_of_a_container_is_its_own(tmp_path, monkeypatch, kind, found):
    (tmp_path / "mountinfo").write_text(f"22 1 8:1 / / rw shared:1 - {kind} any rw\n")
    monkeypatch.setattr(file_systems, "MOUNTS", tmp_path / "mountinfo")
    assert file_systems.find_network(tmp_path) == found


def test_scores_of_frames_have_no_log_on_a_network_file_system(network):
    for folder, log in ((network, "delete"), (network / "disk", "wal")):
        folder.mkdir(exist_ok=True)
        with FrameScores(folder) as scores:
            scores.add_scorer("s", {}, "command")
            scores.write("s", "frame", {"sharpness": 1.0})
            assert scores.read("s", ["frame"]) == {"frame": {"sharpness": 1.0}}
        with closing(sqlite3.connect(scores.path)) as file:
            assert file.execute("PRAGMA journal_mode").fetchone() == (log,)


def test_cached_answers_have_no_log_on_a_network_file_system(network):
    for folder, log in ((network / "replies", "delete"), (network / "disk/replies", "wal")):
        cache = ReplyCache(folder)
        cache.put({"name": Completion("yes")})
        assert cache.get("name") == Completion("yes")
        with closing(sqlite3.connect(folder / "replies.sqlite")) as file:
            assert file.execute("PRAGMA journal_mode").fetchone() == (log,)


def test_a_store_on_a_network_file_system_is_refused_with_the_way_round(network, tmp_path):
    with pytest.raises(StoreError, match=r"network file system \(nfs4\).*--scratch /tmp.*wiw merge"):
        begin(network / "run")
    begin(network / "run", 3, scratch=tmp_path / "local").close()
    with pytest.raises(StoreError, match="network file system"):
        resume_run(network / "run", progress=False)
    assert resume_run(network / "run", progress=False, scratch=tmp_path / "local").complete
    assert load_run(network / "run").complete and wiw.verify(network / "run").same
    assert sorted(path.name for path in (network / "run").iterdir()) == ["run.sqlite"]  # neither log nor lock
    assert list((tmp_path / "local").iterdir()) == []
    assert wiw.merge([network / "run"], network / "merged").complete
    assert sorted(path.name for path in (network / "merged").iterdir()) == ["run.sqlite"]


def test_a_killed_shard_resumes_from_its_copy_or_from_what_is_left(tmp_path, network, monkeypatch):
    """The process is killed at decision 1 of episode 5; the copy is made after each episode, or only at the begin."""
    for period, kept in ((0.0, 5), (1e9, 0)):
        marker, folder = tmp_path / f"marker{kept}", network / f"run{kept}"
        program = f"""
import sys
sys.path.insert(0, {str(PYTHON_TESTS)!r})
from fakes import LineAgent, LineTask
from wiw.runs import scratch
from wiw.studies.evaluate import run_arms
scratch.PERIOD = {period}
run_arms(LineTask(), {{"none": LineAgent(kill=(5,), marker={str(marker)!r})}}, 8, out={str(folder)!r},
         progress=False, live=1, shard="1/1", salt="", scratch={str(tmp_path / "local")!r}, resume=True)
"""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        killed = subprocess.run([sys.executable, "-c", program], env=environment, check=False, timeout=100)
        assert killed.returncode == -signal.SIGKILL
        assert len(load_run(folder).episodes) == kept
        if kept:  # another machine, with a disk of its own
            shutil.rmtree(tmp_path / "local")
        subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=100)
        log = load_run(folder)
        assert log.complete and ("none" in log.store.sum_lost_costs()) == (kept == 0)  # decision 0 of episode 5
        assert log.store.info["session"]["ended"] == 5
        assert list((tmp_path / "local").iterdir()) == []


def test_a_copy_that_cannot_be_made_leaves_the_store_on_the_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(scratch, "PERIOD", 0.0)

    def fill(source, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        begin(tmp_path / "run", 2, scratch=tmp_path / "local").close()
        patch.setattr(store_log.shutil, "copyfile", fill)
        with pytest.raises(FileError, match="No space left"):
            begin(tmp_path / "run", 2, scratch=tmp_path / "local", resume=True)
    left = list((tmp_path / "local").rglob("run.sqlite"))
    assert len(left) == 1 and load_run(left[0].parent).complete
    assert begin(tmp_path / "run", 2, scratch=tmp_path / "local", resume=True).complete


def test_two_processes_do_not_share_a_scratch_copy(tmp_path):
    begin(tmp_path / "run", 2).close()
    local = tmp_path / "local"
    with (
        RunStore.resume(tmp_path / "run", scratch=local),
        pytest.raises(StoreError, match="being written by another process"),
    ):
        RunStore.resume(tmp_path / "run", scratch=local)
    with (
        RunStore.resume(tmp_path / "run"),
        pytest.raises(StoreError, match="being written by another process"),
    ):
        RunStore.resume(tmp_path / "run", scratch=local)  # which would be lost when the other one's is closed


def test_a_lock_that_its_holder_has_just_removed_holds_nothing(tmp_path, monkeypatch):
    """Else one process would hold the file that is gone, and another the one that has come in its place."""
    path, flock = tmp_path / "run.sqlite", fcntl.flock

    def remove_first(handle, how):
        monkeypatch.setattr(store_file.fcntl, "flock", flock)
        path.with_suffix(".lock").unlink()
        flock(handle, how)

    monkeypatch.setattr(store_file.fcntl, "flock", remove_first)
    with closing(store_file.lock_store(path)), pytest.raises(StoreError, match="being written by another process"):
        store_file.lock_store(path)


def test_a_merge_writes_where_temporary_files_belong(tmp_path, monkeypatch):
    """Also where it is told so in the word of the other commands."""
    parts = run_shards(tmp_path / "parts", 2)
    monkeypatch.chdir(tmp_path)
    assert wiw.merge(parts, tmp_path / "merged", scratch="auto").complete
    assert sorted(path.name for path in tmp_path.iterdir()) == ["merged", "parts"]


def test_a_merge_that_is_cut_off_leaves_nothing(tmp_path, monkeypatch):
    parts = run_shards(tmp_path / "parts", 2)

    def stop(store, source, episodes):
        raise KeyboardInterrupt

    monkeypatch.setattr(RunStore, "take_episodes", stop)
    with pytest.raises(KeyboardInterrupt):
        wiw.merge(parts, tmp_path / "merged", tmp_path / "local")
    assert not (tmp_path / "merged").exists() and list((tmp_path / "local").iterdir()) == []


def test_stores_that_are_still_written_can_be_merged(tmp_path):
    run_shards(tmp_path / "parts", 2)
    with RunStore.resume(tmp_path / "parts/1") as store:
        store.discard("none", [0])  # is run again just now
        assert dict(wiw.merge([tmp_path / "parts"], tmp_path / "merged").pending) == {"none": 1}


MERGE = """
import os, resource, sys
import wiw
resource.setrlimit(resource.RLIMIT_NOFILE, (len(os.listdir("/proc/self/fd")) + 30,) * 2)
print(wiw.merge([sys.argv[1]], sys.argv[2]).repeated)
"""


def test_a_run_has_more_stores_than_a_process_may_open_files(tmp_path):
    (first,) = run_shards(tmp_path / "parts", 1, episodes=2)
    for number in range(2, 41):
        shutil.copytree(first, first.with_name(str(number)))
    done = subprocess.run(
        [sys.executable, "-c", MERGE, tmp_path / "parts", tmp_path / "merged"],
        check=False,
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.stdout == "2\n", done.stderr
    (rows, config), (one, same) = read_rows(tmp_path / "merged"), read_rows(first)
    assert rows.pop("lost") != one.pop("lost"), "what the other copies cost"
    assert (rows, config) == (one, same)
