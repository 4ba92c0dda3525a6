# SPDX-License-Identifier: Apache-2.0
"""Failures are blamed on the stage that fails, and on no other."""

from __future__ import annotations

import gzip
import json
import re
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import LineAgent, LineTask
from locations import PYTHON_TESTS, TESTS

import wiw
from wiw.analysis.blame import EpisodeBlame, _estimate_recovery, read_blame
from wiw.analysis.blame_schemes import LOOP
from wiw.cli import main
from wiw.errors import ArgumentError, FileError, StoreError
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.store import RunStore
from wiw.runs.store_file import store_path
from wiw.studies.blame import _with_ground_truth
from wiw.studies.evaluate import evaluate, resume_run, run_arms

PARTS = PYTHON_TESTS / "blame_parts.py"
EPISODES = 2


def part(name: str) -> str:
    return f"{PARTS}:{name}"


AGENTS = {
    "liar": AgentRecipe("matcher", part("Liar")),
    "oracle": AgentRecipe("matcher", "oracle"),
    "noise": AgentRecipe(part("Noise"), "copy", candidates=5),
    "spinner": AgentRecipe(part("Spinner"), "copy"),
}


@pytest.fixture(scope="module")
def fresh(two_rooms: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that nobody has looked at yet."""
    folder = tmp_path_factory.mktemp("blame") / "run"
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "backend": "cpu", "radius": 1.5, "decisions": 10})
    run_arms(task, AGENTS, EPISODES, out=folder, progress=False, keep_images=1, live=EPISODES).close()
    return folder


@pytest.fixture(scope="module")
def blamed(fresh: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("blamed") / "run"
    shutil.copytree(fresh, folder)
    return wiw.blame(folder, progress=False)


@pytest.fixture
def run(fresh: Path, tmp_path: Path) -> Path:
    shutil.copytree(fresh, tmp_path / "run")
    return tmp_path / "run"


def change(run: Path, statement: str, *values: Any) -> None:
    with sqlite3.connect(store_path(run)) as store:
        assert store.execute(statement, values).rowcount > 0


def success_by_episode(run: Path, arm: str) -> dict[int, bool]:
    return {row["episode"]: bool(row["metrics"]["success"]) for row in wiw.load_run(run).episodes if row["arm"] == arm}


def again(run: Path) -> dict[tuple[str, int], Any]:
    with RunStore.read(run / "blame") as store:
        return {(row["arm"], row["episode"]): row for row in store.outcomes()}


def test_all_three_swaps_are_the_ceiling(blamed: Any) -> None:
    for line in blamed.arms:
        assert line.recovery["all"].value == 100 and line.verdicts["beyond"] == 0


def test_a_world_model_that_lies_is_to_blame(blamed: Any) -> None:
    with_truth, line = success_by_episode(blamed.run, "oracle"), blamed["liar"]
    assert line.failures and sum(with_truth.values())
    for one in line.episodes:  # the very run of the arm "oracle"
        assert one.success["imagination"] == with_truth[one.episode]
        assert (one.verdict == "imagination") == with_truth[one.episode]


def test_a_scorer_of_noise_is_to_blame(blamed: Any) -> None:
    line = blamed["noise"]
    assert line.failures and line.verdicts["scoring"] == line.failures


def test_a_proposer_that_only_turns_is_to_blame(blamed: Any) -> None:
    line = blamed["spinner"]
    assert line.failures == line.verdicts["proposals"] == EPISODES
    assert line.recovery["scoring"].value == line.recovery["imagination"].value == 0


def test_the_oracle_is_not_told_the_truth_twice(blamed: Any) -> None:
    assert set(blamed["oracle"].recovery) == {*LOOP.reruns} - {"imagination"}
    assert not any(arm == "oracle/imagination" for arm, _ in again(blamed.run))


def test_an_oracle_with_an_error_is_told_the_truth(two_rooms: str, tmp_path: Path) -> None:
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "backend": "cpu", "radius": 1.5, "decisions": 2})
    agent = AgentRecipe("matcher", "oracle", model_options={"size": [64, 128]})
    evaluate(task, agent, 1, arms=["error-ignored@1"], out=tmp_path / "run", progress=False, keep_images=0).close()
    change(tmp_path / "run", "UPDATE outcome SET metrics = json_set(metrics, '$.success', 0.0)")
    line = wiw.blame(tmp_path / "run", progress=False)["error-ignored@1"]
    assert set(line.recovery) == set(LOOP.reruns)
    with RunStore.read(tmp_path / "run/blame") as reruns:
        agents = {name.partition("/")[2]: agent for name, agent in reruns.info["agents"].items()}
    assert {rerun: agent["error"] for rerun, agent in agents.items()} == {
        "imagination": None, "scoring": "ignored@1", "proposals": "ignored@1", "all": None
    }  # fmt: skip


def test_the_oracle_of_a_rerun_keeps_view_and_size() -> None:
    recipe = AgentRecipe("matcher", "warp", model_options={"view": "perspective", "size": [48, 48]})
    told = _with_ground_truth(recipe, ("imagination",))
    assert (told.model, told.model_options) == ("oracle", {"view": "perspective", "size": [48, 48]})
    own = replace(recipe, model="model.py:Mine", model_options={"view": "mine", "scale": 2})
    assert _with_ground_truth(own, ("imagination",)).model_options == {}
    assert _with_ground_truth(recipe, ("scoring",)).model_options == recipe.model_options


def test_a_part_of_a_success_mends_no_failure(blamed: Any, tmp_path: Path) -> None:
    shutil.copytree(blamed.run, tmp_path / "run")
    reruns = tmp_path / "run/blame"
    change(reruns, "UPDATE outcome SET metrics = json_set(metrics, '$.success', 0.5) WHERE arm LIKE 'noise/%'")
    with RunStore.read(tmp_path / "run") as store:
        found = read_blame(store)
    assert found is not None and found["noise"].verdicts["beyond"] == found["noise"].failures


def test_intervals_of_recoveries_are_over_apartments() -> None:
    scenes = ["apartments:val/1", "apartments:val/1?remove:tv_1", "apartments:val/2"]
    examined = [EpisodeBlame("x", i, scene, {"all": bool(i)}) for i, scene in enumerate(scenes)]
    assert _estimate_recovery(examined, "all", 0).scenes == 2


def test_every_failure_and_only_failures_are_run_again(blamed: Any) -> None:
    rows = again(blamed.run)
    for arm in AGENTS:
        failed = {episode for episode, good in success_by_episode(blamed.run, arm).items() if not good}
        assert {episode for name, episode in rows if name == f"{arm}/all"} == failed
    assert all(row["status"] == "done" for row in rows.values())


def test_it_comes_out_the_same_in_workers_and_again(blamed: Any, run: Path) -> None:
    assert wiw.blame(run, ["spinner"], workers=2, progress=False)["spinner"] == blamed["spinner"]
    assert wiw.verify(run / "blame", episodes=1).same


def test_a_stopped_attribution_goes_on_where_it_was(blamed: Any, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = RunStore.write

    def stop(store: RunStore, row: Any) -> None:
        written(store, row)
        if len(store.outcomes()) == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunStore, "write", stop)
        with pytest.raises(KeyboardInterrupt):
            wiw.blame(run, "spinner", progress=False)
    kept = again(run)
    assert len(kept) == 3
    assert wiw.blame(run, "spinner", progress=False)["spinner"] == blamed["spinner"]
    assert {key: row["seconds"] for key, row in kept.items()}.items() <= {
        key: row["seconds"] for key, row in again(run).items()
    }.items()


def test_some_episodes_then_more_and_nothing_twice(run: Path, blamed: Any) -> None:
    found = wiw.blame(run, "spinner", episodes=1, progress=False)
    some, before = found["spinner"], again(run)
    assert (len(some.episodes), some.remaining) == (1, EPISODES - 1)
    assert f"{EPISODES - 1} of {EPISODES} failures have not been rerun" in found.notes()[0]
    whole = wiw.blame(wiw.load_run(run), "spinner", progress=False)["spinner"]
    assert {one.episode for one in some.episodes} < {one.episode for one in whole.episodes}
    assert whole == blamed["spinner"] and before.items() <= again(run).items()


def test_a_run_that_has_gained_arms_is_blamed_further(two_rooms: str, tmp_path: Path) -> None:
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "backend": "cpu", "radius": 0.1, "decisions": 1})
    arms = {"spinner": AGENTS["spinner"], "oracle": AGENTS["oracle"]}
    for names in (["spinner"], ["spinner", "oracle"]):
        own = {name: arms[name] for name in names}
        options = {"resume": len(own) > 1, "more_arms": True, "salt": "s", "progress": False}
        run_arms(task, own, 2, out=tmp_path / "run", **options).close()
        found = wiw.blame(tmp_path / "run", names[-1], episodes=1, progress=False)
        assert [line.arm for line in found.arms] == names[-1:]
    assert [line.arm for line in wiw.blame(tmp_path / "run", episodes=1, progress=False).arms] == list(arms)


def test_infrastructure_is_not_blamed_but_named(
    two_rooms: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    broken = tmp_path / "broken"
    monkeypatch.setenv("WIW_TEST_FRAIL", str(broken))
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 2, "backend": "cpu"})
    run = tmp_path / "run"
    evaluate(task, AgentRecipe(part("Spinner"), part("Frail")), 3, out=run, progress=False, keep_images=0).close()
    change(run, "UPDATE outcome SET status = 'error', metrics = '{}' WHERE episode = 1")
    broken.touch()
    assert main(["blame", str(run)]) == 1
    shown = capsys.readouterr()
    assert (
        "1 episode ended with an infrastructure error in the run, so no stage is blamed for them: 1."
        in shown.out.replace("\n", " ")
    )
    assert "--retry-errors" in shown.err
    (line,) = wiw.load_run(run).blame()
    assert line["errors"] == [1] and line["examined"] == 0 and set(line["rerun_errors"]) == {0, 2}
    assert "no server" in line["rerun_errors"][0]
    broken.unlink()
    found = wiw.blame(run, progress=False, retry_errors=True)["Frail"]
    assert not found.rerun_errors and len(found.episodes) == 2


@pytest.mark.parametrize(
    ("mended", "verdict"),
    [
        ({"imagination": True, "scoring": True, "proposals": True, "all": True}, "imagination"),
        ({"imagination": False, "scoring": True, "proposals": True, "all": False}, "scoring"),
        ({"scoring": False, "proposals": True, "all": True}, "proposals"),
        ({"scoring": False, "proposals": False, "all": True}, "joint"),
        ({"imagination": False, "scoring": False, "proposals": False, "all": False}, "beyond"),
    ],
)
def test_the_least_that_mends_is_to_blame(mended: dict[str, bool], verdict: str) -> None:
    assert EpisodeBlame("x", 0, "s", mended).verdict == verdict


def test_what_is_shown_and_kept(blamed: Any, capsys: Any, tmp_path: Path) -> None:
    assert main(["blame", str(blamed.run), "--arm", "noise,liar"]) == 0
    shown = capsys.readouterr().out
    assert all(word in shown for word in (*LOOP.reruns, *LOOP.verdicts, "noise", "liar"))
    kept = json.loads((blamed.run / "blame.json").read_text())
    assert {line["arm"] for line in kept["arms"]} == {"noise", "liar"}
    assert all(one["verdict"] in LOOP.verdicts for one in kept["episodes"])
    log = wiw.load_run(blamed.run)
    lines = {line["arm"]: line for line in log.blame()}
    assert lines["noise"]["mended_all"] == 100 and lines["noise"]["blame_scoring"] == blamed["noise"].failures
    page = log.report(tmp_path / "report.html").read_text()
    assert 'id="blame"' in page and "Failures by the stage whose ground truth" in page
    view = log.view(tmp_path / "view")
    pages = "".join(path.read_text() for path in (view.parent / "episodes").glob("*.html"))
    assert len(re.findall("to blame: scoring", pages)) >= blamed["noise"].failures


def test_a_run_without_it_shows_nothing_of_it(run: Path, tmp_path: Path) -> None:
    log = wiw.load_run(run)
    assert log.blame() == [] and 'id="blame"' not in log.report(tmp_path / "report.html").read_text()


def test_what_cannot_be_attributed_says_why(run: Path, two_rooms: str, tmp_path: Path, capsys: Any) -> None:
    with pytest.raises(ArgumentError, match=r"no arm 'wrap' in .*; it has liar, oracle"):
        wiw.blame(run, "wrap")
    assert main(["blame", str(run), "--arm", "wrap"]) == 2 and "no arm 'wrap'" in capsys.readouterr().err
    with pytest.raises(ArgumentError, match="episodes of at least 1, got 0"):
        wiw.blame(run, episodes=0)
    with pytest.raises(StoreError, match="no run at"):
        wiw.blame(tmp_path / "nothing")
    change(run, "UPDATE outcome SET metrics = json_set(metrics, '$.success', 1.0) WHERE arm = 'noise'")
    with pytest.raises(ArgumentError, match=r"noise in .* has no failure to explain"):
        wiw.blame(run, "noise")
    change(run, "UPDATE run SET wiw_version = '0.0.1'")
    with pytest.raises(StoreError, match=r"was started by wiw 0\.0\.1"):
        wiw.blame(run, "liar")
    assert not (run / "blame").exists()


def test_a_scene_that_is_gone_and_objects_in_memory(two_rooms: str, tmp_path: Path) -> None:
    scene = tmp_path / "rooms.obj"
    shutil.copy(two_rooms, scene)
    task = TaskRecipe("imagenav", {"scenes": str(scene), "decisions": 1, "backend": "cpu"})
    evaluate(task, AgentRecipe(part("Spinner")), 1, out=tmp_path / "run", progress=False).close()
    scene.unlink()
    with pytest.raises(FileError, match=r"rooms\.obj"):
        wiw.blame(tmp_path / "run", progress=False)
    assert not (tmp_path / "run/blame").exists()
    run_arms(LineTask(budget=1), {"none": LineAgent(0.0)}, 1, out=tmp_path / "memory", progress=False).close()
    with pytest.raises(StoreError, match="objects in memory"):
        wiw.blame(tmp_path / "memory")


def test_a_task_must_say_what_progress_is(tmp_path: Path) -> None:
    fake = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
    task = TaskRecipe(fake, {})
    evaluate(task, AgentRecipe("heuristic", horizon=1), 6, out=tmp_path / "run", progress=False).close()
    with pytest.raises(ArgumentError, match="does not define the true value of a plan"):
        wiw.blame(tmp_path / "run")


def test_another_run_in_the_same_folder_and_resume(run: Path) -> None:
    wiw.blame(run, "spinner", episodes=1, progress=False)
    with pytest.raises(StoreError, match="wiw blame"):
        resume_run(run / "blame")
    change(run, "UPDATE run SET created = '2001-01-01T00:00:00+00:00'")
    assert wiw.load_run(run).blame() == []
    with pytest.raises(StoreError, match="attributes"):
        wiw.blame(run, "spinner")


@pytest.fixture
def old_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run with schema version 7, of whose two failures one was rerun; recipes said `revision` and `swaps` then."""
    folder = tmp_path / "old"
    for name, place in (("blamed_run_schema_7", folder), ("blame_schema_7", folder / "blame")):
        dump = gzip.decompress((TESTS / "data" / f"{name}.sql.gz").read_bytes()).decode()
        place.mkdir()
        with closing(sqlite3.connect(store_path(place))) as connection:
            connection.executescript(dump)
            ((version,),) = connection.execute("SELECT wiw_version FROM run")
    monkeypatch.setattr(wiw, "__version__", version)
    return folder


def test_reruns_begun_by_an_earlier_version_are_read(old_run: Path) -> None:
    with RunStore.read(old_run / "blame") as store:
        agents = [arm["agent"] for arm in store.config["arms"]]
        assert [agent["ground_truth"] for agent in agents] == [list(rerun.stages) for rerun in LOOP.reruns.values()]
        assert {agent["reviser"] for agent in agents} == {"climber"}
        built = store.info["built"]
    assert built["copy/scoring"]["revision"]["ground_truth"] == "scoring" and "swaps" not in built["copy/scoring"]


def test_what_an_earlier_version_found_reads_as_before(old_run: Path, tmp_path: Path) -> None:
    """To the byte: other tasks than question answering have the stages that they had."""
    data = TESTS / "data"
    with RunStore.read(old_run) as store:
        found = read_blame(store)
    assert found is not None and found.to_json() == (data / "blame_schema_7.json").read_text()
    page = wiw.load_run(old_run).report(tmp_path / "report.html").read_text()
    assert (data / "blame_schema_7.html").read_text() in page


def test_a_run_of_an_earlier_benchmark_is_not_continued(old_run: Path) -> None:
    task = TaskRecipe("imagenav", {"scenes": "apartments:val:1", "backend": "cpu", "decisions": 1})
    agent = AgentRecipe("heuristic", "copy", "climber")
    change(old_run, "DELETE FROM outcome WHERE episode = 1")
    with pytest.raises(StoreError, match="version 1 of the benchmark"):
        evaluate(task, agent, 2, arms=["copy"], out=old_run, resume=True, progress=False)
    with pytest.raises(StoreError, match="version 1 of the benchmark"):
        wiw.blame(old_run, progress=False)


def test_an_agent_that_has_changed_is_refused(run: Path) -> None:
    info = json.loads(sqlite3.connect(store_path(run)).execute("SELECT info FROM run").fetchone()[0])
    info["built"]["spinner"]["horizon"] = 99
    change(run, "UPDATE run SET info = ?", json.dumps(info))
    with pytest.raises(StoreError, match=r"horizon: the run has 99, now 5"):
        wiw.blame(run, "spinner", progress=False)


def test_the_summary_reads_well(blamed: Any) -> None:
    assert "noise: " in str(blamed) and "scoring" in str(blamed)
    with pytest.raises(KeyError, match="were"):
        blamed["nobody"]
    assert np.isfinite(blamed["noise"].recovery["all"].low)
