# SPDX-License-Identifier: Apache-2.0
"""Nothing is lost: runs are killed at random moments, and the disk is full at each of their writes in turn."""

from __future__ import annotations

import importlib.util
import os
import random
import shutil
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
from crash_victims import EPISODES, Victims, evaluate
from locations import PYTHON_TESTS

import wiw
from wiw.errors import FileError, StoreError
from wiw.files import _place, atomic_file, atomic_folder
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.studies.run_log import load_run

KILLS = [(26, 4, 16, 4), pytest.param((1500, 200, 300, 50), marks=[pytest.mark.nightly, pytest.mark.timeout(7200)])]
"""Kills of runs, of each of two shards, of exports, and of collections: 54 for every change, 2,250 nightly."""


def facts(run):
    """Everything a run found out, without how long it took."""
    with RunStore.read(run) as store:
        rows = [{k: v for k, v in row.items() if k != "seconds"} for row in [*store.outcomes(), *store.decisions()]]
        keys = [(row["arm"], row["episode"], row["decision"]) for row in store.decisions()]
        return rows, [store.images(*key) for key in keys], store.episodes(), store.config


def whole(run):
    """Whether SQLite finds nothing wrong; the episodes that have ended."""
    with RunStore.read(run) as store:
        (row,) = store._rows("PRAGMA integrity_check")
        assert row == {"integrity_check": "ok"}
        assert store._rows("PRAGMA foreign_key_check") == []
        return {(row["arm"], row["episode"]) for row in store.outcomes()}


@pytest.fixture(scope="module")
def victims():
    server = Victims()
    yield server
    server.close()


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    out = tmp_path_factory.mktemp("reference") / "run"
    evaluate(out)
    return out


def seconds(victims, what, out, **options):
    begin = time.monotonic()
    assert victims.run(what, out, **options) == 0, victims.said
    return time.monotonic() - begin


@pytest.mark.parametrize("kills_of", KILLS)
def test_runs_killed_at_random_moments_lose_no_ended_episode(victims, reference, tmp_path, kills_of):
    expected, draw, kills, runs = facts(reference), random.Random(0), 0, 0
    whole_time = max(seconds(victims, "evaluate", tmp_path / f"warm{i}") for i in range(2))
    while kills < kills_of[0]:
        out, reported = tmp_path / f"run{runs}", tmp_path / f"reported{runs}"
        runs, left, here = runs + 1, 1.0, 0
        while here < 7:
            after = draw.uniform(0, left * whole_time)
            if victims.run("evaluate", out, reported=str(reported), kill_after=after) == 0:
                whole_time *= 0.9  # the machine has become faster
                break
            kills, here = kills + 1, here + 1
            kept = whole(out) if RunStore.exists(out) else set()
            told = {(a, int(e)) for a, e in map(str.split, reported.read_text().splitlines())} if kept else set()
            assert told <= kept
            left = max(0.15, 1 - len(kept) / (2 * EPISODES))
        assert victims.run("evaluate", out) == 0
        assert facts(out) == expected
        shutil.rmtree(out, ignore_errors=True)
    assert runs >= kills_of[0] / 7


@pytest.mark.parametrize("kills_of", KILLS)
def test_shards_killed_at_random_moments_are_merged_into_the_run_of_one_process(victims, reference, tmp_path, kills_of):
    """One shard writes in its own folder, the other on a disk of its own that is copied after each episode."""
    draw, kills, parts = random.Random(2), 0, [{"shard": "1/2"}, {"shard": "2/2", "scratch": str(tmp_path / "disk")}]
    whole_time = seconds(victims, "evaluate", tmp_path / "warm", **parts[1])
    for number, part in enumerate(parts):
        for _ in range(kills_of[1]):
            kills += (
                victims.run("evaluate", tmp_path / f"run/{number}", kill_after=draw.uniform(0, whole_time), **part) != 0
            )
        assert victims.run("evaluate", tmp_path / f"run/{number}", **part) == 0, victims.said
    assert kills >= 2  # a run that is nearly done may end before its kill
    assert wiw.merge([tmp_path / "run"], tmp_path / "merged").complete
    assert facts(tmp_path / "merged") == facts(reference) and list((tmp_path / "disk").iterdir()) == []


def contents(target):
    files = [target] if target.is_file() else sorted(path for path in target.rglob("*") if path.is_file())
    return {str(path.relative_to(target)): path.read_bytes() for path in files}


def kinds():
    found = {"csv": "tables", "view": "pages"}
    found |= {"parquet": "columns"} if importlib.util.find_spec("pyarrow") else {}
    return found | ({"rerun": "run.rrd"} if importlib.util.find_spec("rerun") else {})


@pytest.mark.parametrize("kills_of", KILLS)
def test_exports_killed_at_random_moments_leave_all_or_nothing(victims, reference, tmp_path, kills_of):
    before, draw, kills = store_path(reference).read_bytes(), random.Random(1), dict.fromkeys(kinds(), 0)
    for kind, name in kinds().items():
        whole_copy = tmp_path / f"whole-{name}"
        most = seconds(victims, "export", reference, kind=kind, target=str(whole_copy))
        expected, target, tries = contents(whole_copy), tmp_path / kind / name, 0
        while kills[kind] < kills_of[2] / len(kinds()):
            after = draw.uniform(0, most)
            if victims.run("export", reference, kind=kind, target=str(target), kill_after=after) == 0:
                most *= 0.9
            else:
                kills[kind] += 1
            if target.exists():
                assert same(kind, contents(target), expected)
                shutil.rmtree(target) if target.is_dir() else target.unlink()
            tries += 1
            assert tries < 200 + kills_of[2]
        assert victims.run("export", reference, kind=kind, target=str(target)) == 0
        assert [path.name for path in target.parent.iterdir()] == [name]  # what the killed had begun is swept away
    assert store_path(reference).read_bytes() == before


@pytest.mark.parametrize("kills_of", KILLS)
def test_collections_killed_at_random_moments_lose_a_segment_at_most(tmp_path, two_rooms, kills_of):
    pytest.importorskip("pyarrow", reason="needs wiw[export]")
    victims, draw, kills, datasets = Victims(imports=("wiw.training.collect_navigation",)), random.Random(3), 0, 0
    whole_time = seconds(victims, "collect", tmp_path / "whole", scene=two_rooms)
    expected = contents(tmp_path / "whole")
    while kills < kills_of[3]:
        out, kept, here = tmp_path / f"data{datasets}", {}, 0
        datasets += 1
        while here < 5 and victims.run("collect", out, scene=two_rooms, kill_after=draw.uniform(0, whole_time)) != 0:
            kills, here = kills + 1, here + 1
            parts = {path: path.stat().st_mtime_ns for path in out.glob("parts/*/*.parquet")}
            finished = len(list(out.glob("data/*.parquet")))
            assert finished or kept.items() <= parts.items(), "a complete segment was recorded again, or lost"
            kept = parts
        whole_time *= 0.9 if here < 5 else 1.0  # the machine may have become faster
        assert victims.run("collect", out, scene=two_rooms) == 0, victims.said
        assert contents(out) == expected
        shutil.rmtree(out)
    victims.close()


def same(kind, found, expected):
    """Recordings are cut into parts by the clock; that one is whole shows in its last bytes, which mark its end."""
    if kind == "rerun":
        ((_, data),), ((_, wanted),) = found.items(), expected.items()
        return data[:4] == wanted[:4] and data.endswith(wanted[-12:]) and b"FOOT" in wanted[-12:]
    return found == expected


def test_a_disk_that_is_full_sooner_or_later_is_said_and_mended(victims, tmp_path):
    """The limit on file size makes the first write beyond it fail, and with it every later one, as a full disk does."""
    small = {"episodes": 2, "keep_images": 1}
    evaluate(tmp_path / "whole", **small)
    expected, told = facts(tmp_path / "whole"), set()
    out, enough = tmp_path / "run", 8
    while (
        victims.run("evaluate", out, **small, limits={"RLIMIT_FSIZE": 4096 * enough}) != 0
    ):  # the log grows beyond the store
        shutil.rmtree(out, ignore_errors=True)
        enough *= 2
    shutil.rmtree(out, ignore_errors=True)
    for page in sorted({0, 1, 2, *np.linspace(3, enough, 16).astype(int).tolist()}):
        if victims.run("evaluate", out, **small, limits={"RLIMIT_FSIZE": 4096 * page}) == 0:
            shutil.rmtree(out, ignore_errors=True)
            continue
        assert victims.said.startswith("StoreError: ") and str(out) in victims.said and "make room" in victims.said
        if RunStore.exists(out):
            told.add(len(whole(out)))
        assert victims.run("evaluate", out, **small) == 0
        assert facts(out) == expected
        shutil.rmtree(out, ignore_errors=True)
    assert len(told) >= 4 and 0 in told


def test_a_full_disk_leaves_what_was_written_before_readable(victims, tmp_path):
    """A file system of 300 kB, where the machine lets us make one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", disk]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("making a small file system needs root and the right to mount")
    try:
        assert victims.run("evaluate", disk / "run", episodes=40) == 1
        assert "full" in victims.said and f"wiw resume {disk / 'run'}" in victims.said
        kept = whole(disk / "run")
        assert kept
        subprocess.run(["mount", "-o", "remount,size=20m", disk], check=True)
        assert victims.run("evaluate", disk / "run", episodes=40) == 0
        assert kept < whole(disk / "run")
    finally:
        subprocess.run(["umount", "-l", disk], check=True)


def test_a_report_that_does_not_fit_leaves_the_old_one(victims, reference, tmp_path):
    (tmp_path / "report.html").write_text("old")
    assert victims.run("report", reference, target=str(tmp_path / "report.html"), limits={"RLIMIT_FSIZE": 8192}) == 1
    assert victims.said.startswith("FileError: ") and "report.html: cannot be written" in victims.said
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


@pytest.mark.parametrize("share", [0.02, 0.1, 0.35, 0.6, 0.9, 0.999])
def test_a_store_cut_short_is_named_with_what_to_do(reference, tmp_path, share):
    data = store_path(reference).read_bytes()
    path = tmp_path / "run.sqlite"
    path.write_bytes(data[: int(share * len(data))])
    for use in (load_run, RunStore.resume):
        with pytest.raises(StoreError, match=r"run\.sqlite.*(malformed|not a database|truncated).*restore run\.sqlite"):
            use(tmp_path)


def test_a_store_of_another_version_says_which_wiw_wrote_it(reference, tmp_path):
    shutil.copy(store_path(reference), tmp_path / "run.sqlite")
    with sqlite3.connect(tmp_path / "run.sqlite") as other:
        other.execute("PRAGMA user_version = 99")
        other.execute("UPDATE run SET wiw_version = '9.9'")
    with pytest.raises(StoreError, match=r"run\.sqlite was written by wiw 9\.9 with schema version 99.*use the one"):
        load_run(tmp_path)
    with pytest.raises(StoreError, match="schema version 99"):
        RunStore.resume(tmp_path)


def test_a_store_that_could_not_be_opened_is_not_held(reference, tmp_path):
    """An error on the way leaves no lock behind, so that the next try may write."""
    shutil.copy(store_path(reference), tmp_path / "run.sqlite")
    with pytest.raises(StoreError, match="a different configuration") as kept:
        RunStore.resume(tmp_path, {"seed": 5})
    RunStore.resume(tmp_path).close()
    assert kept.value.__traceback__ is not None


def test_files_are_whole_or_not_there(tmp_path):
    target, folder = tmp_path / "a.txt", tmp_path / "tables"
    (tmp_path / f".a.txt.{_place()}-999999999.part").write_text("of a writer that was killed")
    with atomic_file(target) as draft:
        draft.write_text("first")
        assert not target.exists()
    with pytest.raises(ZeroDivisionError), atomic_file(target) as draft:
        draft.write_text("half")
        raise ZeroDivisionError
    with atomic_folder(folder) as draft:
        (draft / "x").write_text("x")
        assert not folder.exists()
    with pytest.raises(FileError, match=r"tables is not empty.*choose another"), atomic_folder(folder):
        pass
    assert target.read_text() == "first" and sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "tables"]


STUCK = """
import ctypes, sys
sys.path.insert(0, {here!r})
from fakes import LineEnv, LineTask

class Env(LineEnv):
    def run(self, actions):
        if self.actions >= 6:  # C code that no signal handler interrupts: it waits for a mutex that it holds
            open({mark!r}, "w").close()
            mutex, library = ctypes.create_string_buffer(64), ctypes.CDLL(None)
            library.pthread_mutex_lock(mutex)
            library.pthread_mutex_lock(mutex)
        return super().run(actions)

class Stuck(LineTask):
    def environment(self, depth=False):
        return Env(self)

def task(scenes="", seed=0, preset="", backend="", **rules):
    return Stuck(seed=seed)
"""


def test_sigterm_ends_a_run_within_5_seconds_whatever_it_is_doing(tmp_path):
    mark, out = tmp_path / "stuck", tmp_path / "run"
    (tmp_path / "stuck.py").write_text(STUCK.format(here=str(PYTHON_TESTS), mark=str(mark)))
    command = [sys.executable, "-m", "wiw.cli", "run", f"{tmp_path / 'stuck.py'}:task", "--policy", "heuristic"]
    process = subprocess.Popen(
        [*command, "--out", out, "--episodes", "3", "--live", "1"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stderr=subprocess.PIPE,
        text=True,
    )
    while not mark.exists() and process.poll() is None:
        time.sleep(0.02)
    process.terminate()
    begin = time.monotonic()
    _, shown = process.communicate(timeout=30)
    assert process.returncode == 75 and time.monotonic() - begin < 5.5, shown
    assert "wiw resume" in shown and "Traceback" not in shown
    assert whole(out) == set() and RunStore.exists(out)
