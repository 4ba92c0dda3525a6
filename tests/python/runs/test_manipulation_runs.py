# SPDX-License-Identifier: Apache-2.0
"""Runs of the manipulation task: everything that a run of any task can do."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from locations import PYTHON_TESTS
from pressing_policy import Pressing

import wiw
from wiw.cli import main
from wiw.render import resolve_backend
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.store import RunStore
from wiw.studies.evaluate import evaluate, resume_run
from wiw.studies.run_log import load_run
from wiw.tabletop.base import make_action
from wiw.tasks.manipulation import TABLETOP_TASKS, Manipulation
from wiw.types import Proposal

POLICY = f"{PYTHON_TESTS / 'pressing_policy.py'}:Pressing"
SHORT = {"tasks": "push_buttons,slide_block", "actions": 1}
FLAGS = ["--tasks", "push_buttons,slide_block", "--task-option", "actions=1", "--candidates", "2", "--horizon", "1"]
ARMS = ["none", "copy", "oracle", "placebo-swapped:oracle"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of each of two tasks, by all reference arms, with fidelity."""
    out = tmp_path_factory.mktemp("runs") / "first"
    command = ["run", "manipulation", *FLAGS, "--policy", POLICY, "--episodes", "4", "--arms", ",".join(ARMS)]
    assert main([*command, "--fidelity", "--keep-images", "0", "--no-report", "--out", str(out)]) == 0
    return out


def collect_outcomes(path: Path) -> dict[Any, Any]:
    """What was decided and what came of it, by arm and episode."""
    log = load_run(path)
    ends = {(e["arm"], e["episode"]): (e["status"], e["metrics"]) for e in log.episodes}
    plans = {(d["arm"], d["episode"], d["decision"]): (d["actions"], d["scores"]) for d in log.decisions}
    return {**ends, **plans}


def test_a_run_has_all_arms_and_episodes_of_each_task_in_turn(run: Path) -> None:
    log = load_run(run)
    assert log.arms == ARMS and len(log.episodes) == 16 and all(e["status"] == "done" for e in log.episodes)
    with RunStore.read(run) as store:
        assert [episode.info["task"] for episode in store.episodes()] == ["push_buttons", "slide_block"] * 2
    assert all(e["metrics"]["poses"] <= 1 and e["metrics"]["actions"] == 1 for e in log.episodes)
    lines = log.summary().arms
    assert [line.done for line in lines] == [4] * 4
    assert all(line.estimates["success"].scenes == 4 for line in lines)


def test_imagination_is_measured_against_a_fork(run: Path) -> None:
    """The oracle is true to the last bit, another episode's future is not."""
    errors = {arm: [] for arm in ARMS[1:]}
    for decision in load_run(run).decisions:
        if decision["arm"] != "none":
            errors[decision["arm"]] += decision["fidelity"]["psnr"]
    assert min(errors["oracle"]) > 60
    assert max(errors["copy"]) < 60 and max(errors["placebo-swapped:oracle"]) < 40


def test_a_run_is_verified_compared_and_exported(run: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["verify", str(run), "--episodes", "2"]) == 0
    assert "everything is as recorded" in capsys.readouterr().out
    assert main(["compare", str(run), str(run)]) == 0
    assert main(["export", str(run), "--csv", str(tmp_path / "tables")]) == 0


def test_two_processes_decide_as_one(run: Path, tmp_path: Path) -> None:
    agent = AgentRecipe(POLICY, "oracle", candidates=2, horizon=1)
    evaluate(
        TaskRecipe("manipulation", SHORT),
        agent,
        4,
        seed=0,
        out=tmp_path / "two",
        workers=2,
        progress=False,
        live=1,
        fidelity=True,
        keep_images=0,
    )
    one = {key: value for key, value in collect_outcomes(run).items() if key[0] == "oracle"}
    assert collect_outcomes(tmp_path / "two") == one and len(one) == 8


def test_a_run_that_was_stopped_goes_on(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write, left = RunStore.write, [3]

    def stopping(store: RunStore, row: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        write(store, row)

    agent = AgentRecipe(POLICY, "oracle", candidates=2, horizon=1)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(RunStore, "write", stopping)
        evaluate(
            TaskRecipe("manipulation", SHORT),
            agent,
            4,
            seed=0,
            out=tmp_path,
            progress=False,
            live=1,
            fidelity=True,
            keep_images=0,
        )
    with RunStore.read(tmp_path) as store:
        assert 0 < len(store.outcomes()) < 4
    resume_run(tmp_path, progress=False)
    assert collect_outcomes(tmp_path) == {
        key: value for key, value in collect_outcomes(run).items() if key[0] == "oracle"
    }


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--scenes", "apartments:val"], "scenes: only for tasks in which an agent walks"),
        (["--motion", "slide"], "motion: only for"),
        (["--per-scene", "2"], "per_scene: only for"),
        (["--episode-file", "x.json", "--scene-folder", "y"], "episode_file, scene_folder: only for"),
        (["--tasks", "juggle"], "push_buttons, slide_block, insert_peg, stack_cups, got juggle"),
        (["--tasks", "slide_block,slide_block"], "different ones"),
        (["--preset", "official"], "choose from default, paper"),
        (["--task-option", "actions=0"], "must be positive"),
        (["--task-option", "decisions=3"], "unknown rule 'decisions'; expected one of actions"),
    ],
)
def test_what_does_not_apply_is_refused(flags: list[str], said: str, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "run"
    assert main(["run", "manipulation", "--policy", POLICY, "--out", str(out), *flags]) == 2
    assert said in capsys.readouterr().err and not out.exists()


def test_other_tasks_have_no_tasks(capsys: Any) -> None:
    assert main(["run", "imagenav", "--tasks", "push_buttons", "--policy", "heuristic"]) == 2
    assert "unknown option 'tasks'" in capsys.readouterr().err
    assert main(["episodes", "manipulation"]) == 2
    assert "determined by the seed" in capsys.readouterr().err


def test_a_run_has_as_many_episodes_as_the_preset_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert Manipulation().default_episodes == 200 and Manipulation("slide_block").default_episodes == 50
    own = tmp_path / "mine.yaml"
    own.write_text("episodes: 1\nactions: 1\n")
    agent = AgentRecipe(POLICY, candidates=1, horizon=1)
    log = evaluate("manipulation", agent, out=tmp_path / "run", progress=False, tasks="push_buttons", preset=str(own))
    assert len(log.episodes) == 1
    recorded = json.loads(
        sqlite3.connect(tmp_path / "run" / "run.sqlite").execute("SELECT info FROM run").fetchone()[0]
    )
    assert recorded["task"]["options"]["preset"] == str(own)


def test_gymnasium_knows_the_task() -> None:
    env = wiw.make("Manipulation-v0", tasks=["stack_cups"], seed=4, depth=False)
    observation, info = env.reset(options={"episode": 1})
    assert {*observation} == {"front", "pose", "joints", "held"} and "cup" in info["instruction"]
    assert env.unwrapped.task.tasks == ("stack_cups",) and [*TABLETOP_TASKS] == list(Manipulation().tasks)
    assert np.ptp(observation["front"]) > 100


def test_a_run_says_which_renderer_drew_it() -> None:
    assert Manipulation(backend="cpu").describe()["backend"] == "cpu"
    assert Manipulation.make_portable({"tasks": "all"}) == {"tasks": "all", "backend": resolve_backend("auto")}


@pytest.mark.nightly
def test_failures_have_a_stage_to_blame(tmp_path: Path) -> None:
    """One push is within four poses of one who is told the truth; two are not, whoever is told."""
    agent = AgentRecipe(POLICY, "copy", candidates=2)
    options = {"tasks": "push_buttons", "actions": 4, "seed": 3}
    log = evaluate(TaskRecipe("manipulation", options), agent, 2, seed=3, out=tmp_path, progress=False, keep_images=0)
    assert [episode["metrics"]["success"] for episode in log.episodes] == [0.0, 0.0]
    found = wiw.blame(tmp_path, progress=False)["copy"]
    assert found.verdicts["beyond"] == 1 and sum(found.verdicts.values()) == 2


def test_a_guide_knows_what_plans_are_worth() -> None:
    env = Manipulation("stack_cups").environment()
    env.begin(env.task.episode(1))
    guide, bench = env.guide(), env.table.bench
    still, plan = bench.pose[None], guide.suggest_plan(5)
    before = bench.pose
    assert len(plan) == 5 and guide.evaluate_plan(plan) > guide.evaluate_plan(still) > -20
    np.testing.assert_array_equal(bench.pose, before)
    while not env.table.is_success():
        env.run(env.guide().suggest_plan(5))
    assert env.guide().evaluate_plan(bench.pose[None]) == 0.0

    env = Manipulation("push_buttons").environment()
    env.begin(env.task.episode(0))
    kind, setup = env.table.kind, env.table.setup
    wrong = kind.plan_expert(env.observation.places, setup.objects[2:])
    assert not env.run(wrong).terminated
    assert env.guide().evaluate_plan(env.table.bench.pose[None]) < -100
    assert len(env.guide().suggest_plan(5)) == 1


class Sinking(Pressing):
    """Into the table, and up again."""

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        ways = np.array([make_action(0.2, 0.35, height, 1.0) for height in (-0.2, 0.2, -0.2)])
        return [[Proposal(ways)] for _ in situations]


def test_refused_ways_are_on_record(tmp_path: Path) -> None:
    task = Manipulation("slide_block", actions=6)
    log = evaluate(task, wiw.Agent(Sinking()), 1, out=tmp_path, progress=False)
    assert [decision["refused"] for decision in log.decisions] == [["collision"] * 2] * 2
    (episode,) = log.episodes
    assert episode["metrics"]["refused"] == 4.0 and episode["metrics"]["poses"] == 6.0


def test_intervals_say_that_every_episode_has_a_table_of_its_own(run: Path) -> None:
    summary = load_run(run).summary()
    assert "over 4 episodes, each in its own scene" in str(summary)
    assert set(summary.kinds) == {"push_buttons", "slide_block"}
    assert all(estimate.n == 2 for found in summary.kinds.values() for estimate in found.values())
