# SPDX-License-Identifier: Apache-2.0
"""Decision-level fidelity: what replaying every plan in the simulator says of a world model."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kendalltau

import wiw
from wiw.errors import ArgumentError
from wiw.experiments.fidelity import FidelityObserver
from wiw.experiments.gating import Gated
from wiw.experiments.ground_truth import TruePlans, TrueScores
from wiw.experiments.placebos import ShuffledPlacebo
from wiw.loop.scheduler import run_episodes
from wiw.metrics import rank_agreement
from wiw.tasks.imagenav import ImageNav


class Records:
    def __init__(self) -> None:
        self.found = []

    def decision(self, record) -> None:
        self.found.append(record.decision)

    def episode(self, result) -> None:
        assert result.status == "done", result.error

    def record_restart(self, episodes) -> None:
        raise AssertionError

    def record_lost(self, spent) -> None:
        raise AssertionError


def decisions(two_rooms: str, agent: wiw.Agent, decisions: int = 2, live: int = 2):
    task = ImageNav(scenes=two_rooms, decisions=decisions)
    records = Records()
    run_episodes(task, agent, list(enumerate(task.episodes(2))), seed=0, live=live, sink=records)
    return records.found


def test_the_oracle_is_wholly_true(two_rooms: str) -> None:
    for decision in decisions(two_rooms, wiw.Agent("matcher", "oracle", observers=[FidelityObserver()])):
        truth = decision.fidelity
        np.testing.assert_allclose(truth.scores, decision.scores)
        assert truth.regret(decision.chosen) == 0 and (math.isnan(truth.rank) or truth.rank == 1)
        made = np.array([not rollout.real.all() for rollout in decision.rollouts])
        assert (truth.psnr[made] == 100).all() and np.isnan(truth.psnr[~made]).all()
        for imagined, true in zip(decision.rollouts, truth.rollouts, strict=True):
            np.testing.assert_array_equal(imagined.frames, true.frames)


def test_measuring_changes_no_decision_and_the_better_model_is_truer(two_rooms: str) -> None:
    means = {}
    for model in ("copy", "warp"):
        plain = decisions(two_rooms, wiw.Agent("matcher", model))
        measured = decisions(two_rooms, wiw.Agent("matcher", model, observers=[FidelityObserver()]))
        assert all(decision.fidelity is None for decision in plain)
        for one, other in zip(plain, measured, strict=True):
            np.testing.assert_array_equal(one.scores, other.scores)
            np.testing.assert_array_equal(one.actions, other.actions)
            assert one.calls == other.calls
            assert other.fidelity.regret(other.chosen) >= 0
        means[model] = np.nanmean(np.concatenate([decision.fidelity.psnr for decision in measured]))
    assert means["warp"] > means["copy"] + 3


def test_what_is_replayed_are_the_plans_themselves_whatever_the_model_is_asked(two_rooms: str) -> None:
    """A model that is asked for other plans, or not asked, and policies that are given the truth."""
    model = Gated(ShuffledPlacebo(wiw.world_model("oracle")), 0.4)
    policy = wiw.policy("matcher")
    agent = wiw.Agent(TruePlans(policy), model, reviser=TrueScores(policy), observers=[FidelityObserver()])
    found = decisions(two_rooms, agent, decisions=3)
    imagined = [decision for decision in found if decision.rollouts is not None]
    assert 0 < len(imagined) < len(found)
    assert all(decision.fidelity is None for decision in found if decision.rollouts is None)
    errors = np.concatenate([decision.fidelity.psnr for decision in imagined])
    assert np.nanmin(errors) < 40
    for decision in imagined:
        assert [len(true.frames) for true in decision.fidelity.rollouts] == [len(p.actions) for p in decision.proposals]


def test_nothing_is_measured_without_a_model(two_rooms: str) -> None:
    found = decisions(two_rooms, wiw.Agent("matcher", observers=[FidelityObserver()]))
    assert found and all(decision.fidelity is None and "replay" not in decision.seconds for decision in found)


def test_without_a_simulator() -> None:
    agent = wiw.Agent("matcher", "copy", observers=[FidelityObserver()])
    image = wiw.types.Observation(
        np.zeros((576, 1024, 3), np.uint8), np.zeros((480, 480, 3), np.uint8), np.zeros(3),
        np.ones((576, 1024), np.float32),
    )  # fmt: skip
    goal = wiw.types.Goal("imagenav", image=np.zeros((480, 480, 3), np.uint8))
    with pytest.raises(ArgumentError, match=r"simulator .*fidelity"):
        agent.decide(image, goal, wiw.types.Key(0, 0))


@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3)), min_size=2, max_size=8))
def test_rank_agreement_is_kendalls_tau_b(pairs) -> None:
    a, b = (np.array(column, float) for column in zip(*pairs, strict=True))
    expected = kendalltau(a, b).statistic
    assert rank_agreement(a, b) == pytest.approx(expected, nan_ok=True)


def test_a_run_keeps_it_and_reports_it(two_rooms: str, tmp_path: Path) -> None:
    task = ImageNav(scenes=two_rooms, decisions=2)
    log = wiw.evaluate(
        task, wiw.Agent("matcher"), 2, out=tmp_path / "run", arms=["none", "copy", "oracle"], fidelity=True,
        progress=False,
    )  # fmt: skip
    lines = {line["arm"]: line for line in log.fidelity()}
    assert set(lines) == {"copy", "oracle"} and lines["oracle"]["psnr"] == 100 > lines["copy"]["psnr"]
    assert lines["oracle"]["regret"] == 0 and lines["oracle"]["best"] == 100
    row = next(row for row in log.decisions if row["arm"] == "copy")
    assert len(row["fidelity"]["scores"]) == len(row["proposals"]) and row["seconds"]["replay"] > 0
    assert {"true/0", "imagined/0"} <= set(log.store.images("copy", row["episode"], row["decision"]))
    page = log.report().read_text()
    assert 'id="fidelity"' in page
    assert 'id="fidelity"' not in wiw.evaluate(
        task, wiw.Agent("matcher", "copy"), 1, out=tmp_path / "plain", progress=False
    ).report().read_text()  # fmt: skip
