# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import sqlite3
from dataclasses import replace

import pytest
from fakes import LineAgent, LineTask
from locations import PYTHON_TESTS

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.policies.vlm.policy import _get_role_options
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.runs.store_file import store_path
from wiw.studies.evaluate import evaluate, run_arms

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"


def begin(out, episodes=5, **options):
    return evaluate(TaskRecipe(TASK, options), AgentRecipe("heuristic"), episodes, out=out, progress=False, live=3)


@pytest.fixture
def run(tmp_path):
    begin(tmp_path / "run")
    return tmp_path / "run"


def change(run, statement, *values):
    with sqlite3.connect(store_path(run)) as store:
        assert store.execute(statement, values).rowcount == 1
        return store


def test_a_run_comes_out_again_as_it_was_recorded(run, capsys):
    before = store_path(run).read_bytes()
    found = wiw.verify(run, episodes=3)
    assert wiw.verify(wiw.load_run(run), episodes=3) == found
    assert found.same and len({check.episode for check in found.checks}) == 3
    assert len({check.recorded for check in found.checks}) == 3 and all(
        len(check.recorded) == 64 for check in found.checks
    )
    assert {check.episode for check in wiw.verify(run, episodes=99).checks} == set(range(5))
    chosen = [tuple(c.episode for c in wiw.verify(run, 2, seed).checks) for seed in (0, 0, 1, 2, 3)]
    assert chosen[0] == chosen[1] and len(set(chosen)) > 1
    assert main(["verify", str(run), "--episodes", "2"]) == 0
    assert "everything is as recorded" in capsys.readouterr().out and store_path(run).read_bytes() == before


def test_models_of_roles_are_replayed_too(tmp_path):
    """Their servers may be gone, and would be asked, and paid, again."""
    roles = {"revise": {"vlm": "http://gone:8000/v1", "model": "b"}, "answer": {"model": "c"}}
    recipe = AgentRecipe("vlm", policy_options={"vlm": {"vlm": "http://x/v1", "model": "a", "roles": roles}})
    replayed = recipe.replaying(tmp_path).policy_options["vlm"]
    assert (replayed["vlm"], replayed["cache"], replayed["model"]) == (f"replay:{tmp_path}", "off", "a")
    other = {"vlm": f"replay:{tmp_path / 'run.sqlite'}", "model": "b"}
    assert replayed["roles"] == {"revise": other, "answer": {"model": "c"}}
    same = replace(recipe, policy_options={"vlm": {"vlm": "http://gone:8000/v1", "model": "a", "roles": roles}})
    assert same.replaying(tmp_path).policy_options["vlm"]["roles"]["revise"] == {"model": "b"}
    assert "gone" in str(recipe.policy_options)  # the recipe itself is as it was


def test_a_role_at_another_server_is_replayed_with_its_own_options(tmp_path):
    """With those of the main server it would be asked in another way than in the run, and no answer found."""
    given = {"top_logprobs": 5}
    roles = {"revise": {"vlm": "http://y/v1", "model": "internvl3-78b-awq"}, "answer": {"model": "internvl3-78b-awq"}}
    options = {"vlm": "http://x/v1", "model": "a", **given, "roles": roles}
    replayed = AgentRecipe("vlm", policy_options={"vlm": options}).replaying(tmp_path).policy_options["vlm"]
    for role, expected in (("revise", 20), ("answer", 5)):
        live = _get_role_options(roles[role], options["vlm"], given)
        assert live["top_logprobs"] == expected
        assert _get_role_options(replayed["roles"][role], replayed["vlm"], given) == live


def test_with_a_world_model_pictures_and_several_arms(two_rooms, tmp_path):
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 2})
    evaluate(task, AgentRecipe("matcher"), 2, out=tmp_path / "run", arms=["none", "warp"], progress=False)
    found = wiw.verify(tmp_path / "run", episodes=1)
    assert found.same and [check.arm for check in found.checks] == ["none", "warp"]


def test_fidelity_that_was_measured_for_lpips_alone_is_measured_again(two_rooms, tmp_path):
    """The weights of LPIPS may be missing here, and its numbers are not compared."""
    task, run = TaskRecipe("imagenav", {"scenes": two_rooms, "decisions": 1}), tmp_path / "run"
    evaluate(task, AgentRecipe("matcher", "copy"), 1, out=run, progress=False, fidelity=True).close()
    change(run, "UPDATE run SET info = json_set(info, '$.limits.fidelity', json('false'), '$.limits.lpips', '/gone')")
    assert wiw.verify(run).same


@pytest.mark.parametrize(
    ("statement", "where"),
    [
        ("UPDATE decision SET executed = '[1,1,1,1]' WHERE episode = 3 AND decision = 2", "decision 2: executed"),
        ("UPDATE decision SET after_x = after_x + 1e-9 WHERE episode = 3 AND decision = 1", "decision 1: after_x"),
        (
            "UPDATE outcome SET metrics = json_set(metrics, '$.spl', 1.5) WHERE episode = 3",
            "outcome: spl: recorded 1.5",
        ),
        ("DELETE FROM decision WHERE episode = 3 AND decision = 0", "decision 1: now decision 0"),
    ],
)
def test_what_differs_first_is_named(run, capsys, statement, where):
    change(run, statement)
    assert main(["verify", str(run), "--episodes", "5"]) == 1
    shown = capsys.readouterr().out
    assert f"none episode 3: DIFFERS at {where}" in shown and shown.count("DIFFERS") == 1
    assert "1 of 5 differ" in shown


def test_pictures_that_differ_are_named(run):
    change(run, "UPDATE image SET jpeg = x'00' WHERE episode = 0 AND decision = 1 AND name = 'panorama'")
    (wrong,) = [check for check in wiw.verify(run, episodes=5).checks if not check.same]
    assert wrong.difference.startswith("decision 1: picture panorama: recorded ")


def test_timings_and_true_strips_are_not_compared(run):
    change(run, "UPDATE decision SET seconds = '{\"propose\":99}' WHERE episode = 0 AND decision = 0")
    change(run, "INSERT INTO image VALUES ('none', 0, 0, 'true/0', x'00')")
    assert wiw.verify(run, episodes=5).same


def test_an_agent_that_says_otherwise_is_the_first_difference(run):
    info = json.loads(sqlite3.connect(store_path(run)).execute("SELECT info FROM run").fetchone()[0])
    info["built"]["none"]["horizon"] = 99
    change(run, "UPDATE run SET info = ?", json.dumps(info))
    found = wiw.verify(run, episodes=1)
    assert not found.same and found.checks[0].difference == "agent: horizon: recorded 99, now 5"


def test_what_cannot_be_verified_says_why(run, tmp_path):
    run_arms(LineTask(), {"none": LineAgent()}, 1, out=tmp_path / "memory", progress=False)
    with pytest.raises(StoreError, match="objects in memory"):
        wiw.verify(tmp_path / "memory")
    with pytest.raises(ArgumentError, match="episodes of at least 1, got 0"):
        wiw.verify(run, episodes=0)
    with sqlite3.connect(store_path(run)) as store:
        store.execute("DELETE FROM outcome")
    with pytest.raises(StoreError, match="no finished episode"):
        wiw.verify(run)
