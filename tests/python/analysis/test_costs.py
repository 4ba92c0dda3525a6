# SPDX-License-Identifier: Apache-2.0
"""The cost ledger: what was asked, what it took, and that both add up."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

import wiw
from wiw.analysis.costs import COLUMNS, LOST_COLUMNS, PRICE_COLUMN, Costs, cost_columns
from wiw.cli.app import main
from wiw.errors import ArgumentError
from wiw.loop.attempts import TRIES
from wiw.runs.store import RunStore
from wiw.studies.evaluate import run_arms


class Counted(wiw.WorldModel):
    """Repeats the observation; fails once; counts what reaches it over all instances."""

    accepts = wiw.accepts(control="trajectory", size=(64, 64), view="perspective", best_batch=3)
    version = "1"
    calls: ClassVar[int] = 0
    rows: ClassVar[int] = 0

    def rollout(self, observations, controls, seeds):
        Counted.calls += 1
        Counted.rows += len(controls)
        if Counted.calls == 2:
            raise ConnectionError("once")
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


@pytest.fixture(scope="module")
def log(two_rooms, tmp_path_factory):
    """Three arms: without a model, with one, and with the same one out of a cache."""
    from wiw.loop import attempts

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attempts, "PAUSES", (0.0, 0.0))
        cache = tmp_path_factory.mktemp("cache")
        agent = wiw.Agent("heuristic", Counted(), reviser="matcher", candidates=3)
        agents = {"none": wiw.Agent("heuristic"), "asked": agent, "cached": agent}
        task = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=2)
        options = {"progress": False, "live": 2, "cache": cache}
        return run_arms(task, agents, 3, out=tmp_path_factory.mktemp("run") / "r", **options)


def test_the_ledger_adds_up(log) -> None:
    none, asked, cached = log.costs()
    assert [none["arm"], asked["arm"], cached["arm"]] == ["none", "asked", "cached"]
    decisions = [row for row in log.decisions if row["arm"] == "asked"]
    assert asked["decisions"] == len(decisions) == asked["asked_consultations"]
    assert asked["asked_rows"] == sum(row["calls"]["rows"] for row in decisions)
    assert asked["spent_calls"] == pytest.approx(Counted.calls) and asked["spent_rows"] == pytest.approx(Counted.rows)
    assert asked["spent_retries"] == pytest.approx(1)
    assert cached["asked_rows"] == asked["asked_rows"] == pytest.approx(cached["spent_cached_rows"])
    assert cached.get("spent_calls", 0.0) == 0.0 and cached["seconds_cache"] > 0
    assert "asked_rows" not in none and none["spent_vlm_tokens"] == asked["spent_vlm_tokens"] == 0
    stages = [value for name, value in asked.items() if name.startswith("seconds_") and name != "seconds_per_success"]
    assert asked["seconds"] == pytest.approx(sum(stages)) and asked["seconds_environment"] > 0
    for line in log.costs():
        assert line["seconds"] <= sum(row["seconds"] for row in log.episodes if row["arm"] == line["arm"])


class Moody(wiw.WorldModel):
    """Repeats the observation; from its fourth call on it fails all tries of one question."""

    accepts = wiw.accepts(control="trajectory", size=(64, 64), view="perspective")

    def __init__(self) -> None:
        self._asked: list[int] = []

    def fingerprint(self) -> str:
        return "moody"

    def rollout(self, observations, controls, seeds):
        self._asked.append(len(controls))
        if 3 < len(self._asked) <= 3 + TRIES:
            raise ConnectionError("not now")
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


@pytest.mark.parametrize("live", [1, 3])
def test_what_failed_attempts_took_is_booked_apart(two_rooms, tmp_path, monkeypatch, capsys, live) -> None:
    monkeypatch.setattr("wiw.loop.attempts.PAUSES", (0.0, 0.0))
    model, task = Moody(), wiw.make("ImageNav-v0", scenes=two_rooms, decisions=2)
    agent = wiw.Agent("heuristic", model, reviser="matcher", candidates=3)

    def run(**options):
        log = wiw.evaluate(task, agent, 3, out=tmp_path / "run", progress=False, live=live, **options)
        (line,) = log.costs()
        assert line["spent_calls"] + line["lost_calls"] == pytest.approx(len(model._asked))
        assert line["spent_rows"] + line["lost_rows"] == pytest.approx(sum(model._asked))
        return line, [row["episode"] for row in log.episodes if row["status"] == "error"]

    line, failed = run()
    assert len(failed) == (live == 1)  # more at a time: each is run again by itself
    assert line["lost_calls"] >= TRIES and line["lost_seconds"] > 0 and line["spent_retries"] == 0
    with RunStore.resume(tmp_path / "run") as store:
        store.discard("moody", failed)
    assert main(["report", str(tmp_path / "run")]) == 0 and "lost calls" in capsys.readouterr().out
    after, failed = run(resume=True)
    assert not failed and after["lost_calls"] >= line["lost_calls"] + (live == 1)  # what the failed one had done before


def test_a_success_has_its_price() -> None:
    costs = Costs("warp", 4, 2.0, 20, {"rows": 60.0, "consultations": 20.0}, {"calls": 5.0}, {"world_model": 3.0})
    assert costs.as_dict()["rollouts_per_success"] == 30.0 and costs.as_dict()["seconds_per_success"] == 1.5
    assert "15.0" in costs.cells(COLUMNS) and "30.0" in costs.cells(COLUMNS)
    none = Costs("none", 4, 0.0, 20, {}, {}, {"propose": 1.0})
    assert math.isinf(none.per_success(1.0)) and none.cells(COLUMNS)[-2:] == ["–", "∞"]
    assert none.cells(LOST_COLUMNS) == ["0.0", "0.00"]


def test_dollars_are_a_column_where_a_price_is_known() -> None:
    free = Costs("none", 4, 2.0, 20, {}, {"vlm_tokens": 10.0}, {})
    paid = Costs("warp", 4, 2.0, 20, {}, {"vlm_tokens": 10.0, "vlm_usd": 0.05}, {})
    for missing, shown in (("vlm_uncounted", ["≥2", "≥0.0125"]), ("vlm_unpriced", ["2", "≥0.0125"])):
        partly = replace(paid, spent={**paid.spent, missing: 1.0})
        assert partly.cells([("tokens", ""), ("$", "")]) == shown
    assert PRICE_COLUMN not in cost_columns([free]) and PRICE_COLUMN in cost_columns([free, paid])
    assert [line.cells([PRICE_COLUMN]) for line in (free, paid)] == [["–"], ["0.0125"]]


def test_tokens_of_a_policy_are_counted(two_rooms, tmp_path) -> None:
    from wiw.policies.heuristic import Heuristic

    class Wordy(Heuristic):
        def propose(self, situations, candidates, horizon):
            self.tokens += 100 * len(situations)
            return super().propose(situations, candidates, horizon)

    task = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=2)
    log = wiw.evaluate(task, wiw.Agent(Wordy()), 2, out=tmp_path / "run", progress=False)
    assert log.costs()[0]["spent_vlm_tokens"] == 100 * log.costs()[0]["decisions"]


def test_table_and_report_show_the_ledger(log, capsys) -> None:
    assert main(["report", str(log.path)]) == 0
    shown = capsys.readouterr().out
    assert "Costs per episode" in shown and "rollouts / success" in shown and "100 %" in shown
    assert "lost calls" not in shown
    page = (log.path / "report.html").read_text()
    assert '<section id="costs">' in page and "rollouts / success" in page
    with pytest.raises(ArgumentError, match="seconds, calls or spent"):
        log.store.totals("note")
