# SPDX-License-Identifier: Apache-2.0
"""A run may be resumed with other settings as far as no score depends on them."""

from dataclasses import fields

import pytest
from locations import PYTHON_TESTS

from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.loop.attempts import Attempted
from wiw.runs.config import ResumeConfig, RunConfig
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.evaluate import evaluate, resume_run
from wiw.studies.run_log import load_run

SLOW = """
import os
import time
from pathlib import Path

import numpy as np
import wiw


class Slow(wiw.WorldModel):
    accepts, version = wiw.accepts(control="image"), "1"

    def rollout(self, observations, controls, seeds):
        if Path(os.environ["WIW_TEST_SLOW"]).exists():
            time.sleep(60)
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), axis=1)
"""


def test_a_run_is_resumed_with_another_deadline_and_cache(tmp_path, two_rooms, monkeypatch, capsys):
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "is_slow").touch()
    monkeypatch.setenv("WIW_TEST_SLOW", str(tmp_path / "is_slow"))
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))
    task = TaskRecipe("imagenav", {"scenes": two_rooms, "backend": "cpu", "decisions": 1})
    agent = AgentRecipe("heuristic", f"{tmp_path}/slow.py:Slow", "matcher")
    out = tmp_path / "run"
    first = evaluate(task, agent, 1, out=out, progress=False, deadline=1.0)
    assert [(row["status"], row["kind"]) for row in first.episodes] == [("error", "world_model/deadline")]
    first.close()
    deadlines = []
    made = Attempted.__init__

    def record(self, model, deadline=300.0, **options):
        deadlines.append(deadline)
        made(self, model, deadline, **options)

    monkeypatch.setattr(Attempted, "__init__", record)
    (tmp_path / "is_slow").unlink()
    arguments = ["--retry-errors", "--deadline", "90", "--cache", str(tmp_path / "cache"), "--live", "2"]
    assert main(["resume", str(out), *arguments, "--no-report"]) == 0
    log = load_run(out)
    assert deadlines == [90.0] and [row["status"] for row in log.episodes] == ["done"]
    limits, (change,) = log.store.info["limits"], log.store.info["resumed_with"]
    assert (limits["deadline"], limits["cache"], log.store.info["live"]) == (90.0, str(tmp_path / "cache"), 2)
    assert {**change, "time": ""} == {"time": "", "deadline": 90.0, "cache": str(tmp_path / "cache"), "live": 2}
    log.close()
    resume_run(out, progress=False).close()  # keeps them
    again = evaluate(task, agent, 1, out=out, resume=True, progress=False, deadline=120.0, live=2)
    assert again.store.info["limits"]["deadline"] == 120.0 and again.store.info["limits"]["cache"] == "auto"


def test_what_scores_or_measurements_depend_on_stays_when_a_run_is_resumed(tmp_path, capsys):
    fake = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
    task, agent = TaskRecipe(fake, {}), AgentRecipe("heuristic", horizon=1)
    evaluate(task, agent, 1, out=tmp_path / "run", progress=False).close()
    for name, value in (("seed", 3), ("fidelity", True), ("candidates", 2), ("preset", "official")):
        with pytest.raises(
            ArgumentError, match=f"'{name}' is fixed once a run has started; .*deadline.*start a new run"
        ):
            resume_run(tmp_path / "run", **{name: value})
    with pytest.raises(SystemExit) as stop:
        main(["resume", str(tmp_path / "run"), "--seed", "3"])
    assert stop.value.code == 2
    with pytest.raises(ArgumentError, match="deadline above 0, got -1"):
        resume_run(tmp_path / "run", deadline=-1)
    with pytest.raises(StoreError, match="fidelity: the run has false, now true"):
        evaluate(task, agent, 1, out=tmp_path / "run", resume=True, progress=False, fidelity=True)
    assert "resumed_with" not in load_run(tmp_path / "run").store.info


def test_settings_of_a_resumed_run_are_settings_of_runs():
    assert {field.name for field in fields(ResumeConfig)} < {field.name for field in fields(RunConfig)}
