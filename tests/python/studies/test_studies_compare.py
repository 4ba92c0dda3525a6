# SPDX-License-Identifier: Apache-2.0
import gc
import io
import shutil
import sqlite3
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from fakes import LineAgent, LineTask, PictureTask
from rich.console import Console

import wiw
from wiw.analysis.statistics import compute_p_value, estimate_difference
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.metrics.metric import SUCCESS
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import run_arms
from wiw.studies.run_log import load_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs in two places: the arm "warp" is better in the second."""
    folder = tmp_path_factory.mktemp("runs")
    arms = {"copy": LineAgent(0.3), "oracle": LineAgent(1.0)}
    old, new = folder / "old", folder / "elsewhere" / "new"
    run_arms(LineTask(), {**arms, "warp": LineAgent(0.4)}, 16, out=old, progress=False)
    run_arms(LineTask(), {"warp": LineAgent(0.8), **arms, "mine": LineAgent(0.9)}, 16, out=new, progress=False)
    return old, new


def success(run, arm):
    rows = [row for row in load_run(run).episodes if row["arm"] == arm]
    return [row["metrics"]["success"] for row in rows], [row["scene"] for row in rows]


def test_common_arms_are_paired_by_episode(runs):
    found = wiw.compare(*runs)
    assert [(d.arm, d.base) for d in found.differences if d.metric == "success"] == [
        (f"{arm} · new", f"{arm} · old") for arm in ("copy", "oracle", "warp")
    ]
    (theirs, scenes), (ours, _) = success(runs[1], "warp"), success(runs[0], "warp")
    shown = found.difference("warp · new", "warp · old")
    assert shown.estimate == estimate_difference(theirs, ours, scenes, SUCCESS)
    assert shown.p_value == compute_p_value(theirs, ours, scenes, SUCCESS) and shown.p_adjusted == pytest.approx(
        min(1, 3 * shown.p_value)
    )
    assert shown.estimate.value > 20
    assert found.difference("copy · new", "copy · old").estimate.value == 0


def test_it_says_what_differs_between_the_agents(runs):
    remarks = wiw.compare(*runs).remarks()
    assert remarks[0] == "copy: the same agent in both runs." and remarks[2] == "warp: drive 0.4 -> 0.8."


def test_it_says_where_random_numbers_differ(tmp_path):
    for name, salt in (("one", "a"), ("two", "a"), ("three", "b")):
        run_arms(LineTask(), {"warp": LineAgent(0.4)}, 4, out=tmp_path / name, progress=False, salt=salt)
    assert "salt" not in " ".join(wiw.compare(tmp_path / "one", tmp_path / "two").remarks())
    assert "give both runs the same --salt" in wiw.compare(tmp_path / "one", tmp_path / "three").remarks()[-1]


def test_an_arm_that_was_not_begun_is_compared_as_it_was_configured(runs, tmp_path):
    stopped = tmp_path / "stopped"
    shutil.copytree(runs[0], stopped)
    with sqlite3.connect(store_path(stopped)) as store:
        store.execute("DELETE FROM decision WHERE arm = 'warp'")
        store.execute("DELETE FROM outcome WHERE arm = 'warp'")
        store.execute("UPDATE run SET info = json_remove(info, '$.built.warp')")
    assert "warp: the same agent in both runs." in wiw.compare(runs[0], stopped).remarks()
    assert "warp: drive 0.4 -> 0.8." in wiw.compare(stopped, runs[1]).remarks()


def test_arms_of_two_names(runs):
    found = wiw.compare(*runs, arm="warp", other="mine")
    assert [line.name for line in found.arms] == ["warp · old", "mine · new"]
    assert list(found.groups()[0].rows) == ["mine - warp"]
    assert found.utility("mine · new").value == load_run(runs[1]).numbers().utility("mine").value
    with pytest.raises(ArgumentError, match=r"no arm 'mine' in .*old; it has copy, oracle, warp"):
        wiw.compare(*runs, arm="mine")
    with pytest.raises(ArgumentError, match="also name one of the first with arm="):
        wiw.compare(*runs, other="mine")


def test_it_shows_itself(runs, capsys):
    found = wiw.compare(*runs)
    with Console(width=100, file=io.StringIO(), record=True) as console:
        console.print(found)
    for shown in (str(found), console.export_text(), found._repr_html_()):
        assert "new minus old" in shown and "drive 0.4" in shown and "…" not in shown
    assert main(["compare", *map(str, runs), "--arm", "warp"]) == 0
    shown = capsys.readouterr().out
    assert "warp · old" in shown and "copy ·" not in shown


def test_runs_of_one_name_are_told_apart(runs, tmp_path):
    run_arms(LineTask(), {"none": LineAgent(0.5)}, 16, out=tmp_path / "x" / "new", progress=False)
    found = wiw.compare(runs[1], tmp_path / "x" / "new", arm="warp", other="none")
    assert [line.name for line in found.arms] == ["warp · elsewhere/new", "none · x/new"]
    with pytest.raises(ArgumentError, match="none in common"):
        wiw.compare(runs[1], tmp_path / "x" / "new")


@dataclass
class Moved(LineTask):
    """The same task, whose episode 3 is changed."""

    change: tuple = ()

    def describe(self):
        return LineTask(self.seed, self.budget).describe()

    def episodes(self, count):
        found = super().episodes(count)
        return [*found[:3], replace(found[3], **dict(self.change)), *found[4:]]


@pytest.mark.parametrize(
    ("task", "count", "seed", "message"),
    [
        (
            LineTask(budget=12),
            16,
            None,
            r"different budgets: task.budget is 15 in the first and 12 in the second.*--unlike-budgets",
        ),
        (LineTask(seed=1), 16, None, "task.seed is 0 in the first and 1"),
        (LineTask(), 16, 7, r"seed is 0 in the first and 7 in the second.*--seed 0"),
        (LineTask(), 12, None, r"episodes is 16 in the first and 12 in the second.*--episodes 16"),
        (Moved(change=(("scene", "line/x"),)), 16, None, r'episode 3: scene is "line/1" in the first and "line/x"'),
        (Moved(change=(("start_yaw", 1.0),)), 16, None, "episode 3: start_yaw is 0.0 in the first and 1.0"),
        (Moved(change=(("geodesic", 9.0),)), 16, None, r"episode 3: shortest path is .*the scene itself has changed"),
    ],
)
def test_unlike_runs_are_refused_by_the_first_difference(runs, tmp_path, task, count, seed, message, capsys):
    run_arms(task, {"warp": LineAgent(0.5)}, count, seed=seed, out=tmp_path / "run", progress=False)
    with pytest.raises(StoreError, match=message):
        wiw.compare(runs[0], tmp_path / "run")
    assert main(["compare", str(runs[0]), str(tmp_path / "run")]) == 2
    assert "cannot compare" in capsys.readouterr().err


class Planner(LineAgent):
    """Says how long its plans are and how much of them it carries out."""

    def __init__(self, horizon, execute):
        super().__init__(0.5)
        self.numbers = {"horizon": horizon, "execute": execute}

    def describe(self):
        return {**super().describe(), **self.numbers}


@pytest.mark.parametrize(("horizon", "execute", "count"), [(10, 8, 8), (5, -1, 4), (7, 0, 7)])
def test_unlike_budgets_are_refused_unless_they_are_asked_for(tmp_path, horizon, execute, count, capsys):
    """More primitives per decision would show as points of success; a longer plan alone does not."""
    runs = [tmp_path / name for name in ("short", "long", "other")]
    for run, numbers in zip(runs, [(5, 3), (horizon, execute), (10, 3)], strict=True):
        run_arms(LineTask(), {"warp": Planner(*numbers)}, 8, out=run, progress=False)
    message = f"different budgets: warp executes 3 and {count} actions per decision"
    with pytest.raises(StoreError, match=message):
        wiw.compare(runs[0], runs[1])
    assert main(["compare", *map(str, runs[:2]), "--unlike-budgets"]) == 0
    assert f"executes 3 and {count} actions" in " ".join(capsys.readouterr().out.split())
    assert not any("BUDGETS" in line for line in wiw.compare(runs[0], runs[2]).remarks())


def test_scenes_may_lie_elsewhere(runs, tmp_path):
    """Two machines keep the same scene in two folders."""
    copies = [tmp_path / name for name in ("here", "there")]
    for copy, folder in zip(copies, ("/data/scans", "/home/me"), strict=True):
        run_arms(LineTask(), {"warp": LineAgent(0.5)}, 4, out=copy, progress=False)
        with sqlite3.connect(copy / "run.sqlite") as store:
            store.execute("UPDATE episode SET scene = ?", (f"{folder}/house.glb",))
    assert wiw.compare(*copies).difference("warp · there", "warp · here").estimate.n == 4


def test_goals_may_be_unknown_and_their_pictures_lie_elsewhere(tmp_path):
    copies = [tmp_path / name for name in ("here", "there")]
    for copy, folder in zip(copies, ("/data", "/home/me/data"), strict=True):
        run_arms(PictureTask(picture=f"{folder}/goals/0.png"), {"warp": LineAgent(0.5)}, 4, out=copy, progress=False)
    assert wiw.compare(*copies).difference("warp · there", "warp · here").estimate.n == 4


def test_runs_that_it_opens_are_closed(runs):
    def count() -> int:
        found = [each for each in Path("/proc/self/fd").iterdir() if each.is_symlink()]
        return sum("run.sqlite" in str(each.readlink()) for each in found)

    gc.collect()
    gc.disable()
    try:
        before = count()
        wiw.compare(*runs)
        assert count() == before
        with pytest.raises(ArgumentError):
            wiw.compare(*runs, arm="nobody")
        assert count() == before
    finally:
        gc.enable()


def test_infrastructure_errors_leave_their_pair_out(runs, tmp_path):
    run_arms(LineTask(broken=("0002",)), {"warp": LineAgent(0.5)}, 16, out=tmp_path / "run", progress=False)
    found = wiw.compare(runs[0], tmp_path / "run")
    assert found.difference("warp · run", "warp · old").estimate.n == 15
    assert found["warp · run"].errors == 1


def test_a_run_that_a_rule_stopped_has_nothing_left_to_run(tmp_path):
    arms = {"none": LineAgent(0.1), "warp": LineAgent(0.9)}
    paths = tmp_path / "whole", tmp_path / "stopped"
    for path, rule in zip(paths, ("width<1", "width<100"), strict=True):
        run_arms(LineTask(), arms, 20, out=path, progress=False, until=rule, look_every=10).close()
    found = wiw.compare(*paths)
    assert {line.name: (line.done, line.pending) for line in found.arms} == {
        "none · whole": (20, 0),
        "none · stopped": (10, 0),
        "warp · whole": (20, 0),
        "warp · stopped": (10, 0),
    }
    whole, stopped = found.looks.split(" stopped was checked")
    assert (
        whole == "whole was checked as it ran, to stop once width<1; it was never stopped, as the rule held at no look."
    )
    assert stopped.startswith(" as it ran, to stop once width<100; it stopped at 10 of 20 episodes: none ")
