# SPDX-License-Identifier: Apache-2.0
"""No policy or world model learns which episode it is in; each cheat wins without the firewall, and loses with it."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from cheats import LiveEnvironmentFinder, find_episodes_by_odometry, invert_seeds
from locations import PYTHON_TESTS

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.loop.keys import draw_salt, make_key
from wiw.registry import POLICIES
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.compare import compare
from wiw.studies.evaluate import evaluate, resume_run
from wiw.studies.run_log import load_run
from wiw.tasks.imagenav import ImageNav
from wiw.types import Conditioning, Control, Episode, Key, Proposal
from wiw.world_models.oracle import Oracle

TASK = f"{PYTHON_TESTS / 'fakes.py'}:line_task"
PLAN = np.array([FORWARD, TURN_LEFT, FORWARD], np.int8)


@pytest.mark.parametrize("isolate", [False, True])
def test_a_model_finds_the_live_environment_only_in_the_process_of_the_run(two_rooms: str, isolate: bool) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, depth=False)
    env.reset(options={"episode": 0})
    shown = Conditioning(env.observation.panorama[None], simulators=[env.fork()])
    controls = [Control(PLAN, np.zeros((3, 3)), np.stack([np.eye(4)] * 3), length=3)]
    truth = Oracle().rollout(shown, controls, np.zeros(1, np.uint64))
    model = wiw.world_model(f"{PYTHON_TESTS / 'cheats.py'}:LiveEnvironmentFinder", isolate=isolate)
    found = model.rollout(Conditioning(shown.image), controls, np.zeros(1, np.uint64))
    assert np.array_equal(found, truth) == (not isolate)
    assert LiveEnvironmentFinder.accepts.needs == ()
    env.close()


class Recorder(wiw.WorldModel):
    """Notes the seeds that it is handed."""

    accepts = wiw.accepts(control="trajectory", view="perspective", size=(8, 16))
    version = "1"

    def __init__(self) -> None:
        self._seeds: list[int] = []

    def rollout(self, observations, controls, seeds):
        self._seeds += seeds.tolist()
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, 1)


class Unseeded(Recorder):
    accepts = wiw.accepts(control="trajectory", view="perspective", size=(8, 16), seeded=False)


class Walker(wiw.Policy):
    """Goes forward, or turns and then goes forward."""

    def propose(self, situations, candidates, horizon):
        plans = ([FORWARD] * 3, [FORWARD, FORWARD, TURN_LEFT])
        return [[Proposal(np.array(plan)) for plan in plans] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.arange(len(plans), 0, -1.0) for plans in proposals]


def run(out, model="none", policy="heuristic", episodes=5, **options):
    options = {"progress": False, "live": 3, **options}
    return evaluate(TaskRecipe(TASK), AgentRecipe(policy, model), episodes, out=out, **options)


def record_seeds(out, salt, model=Recorder):
    made = model()
    run(out, made, Walker(), salt=salt, cache="off").close()
    return made._seeds


def test_seeds_invert_to_episode_decision_and_candidate_only_without_a_salt(tmp_path: Path) -> None:
    plain = record_seeds(tmp_path / "plain", "")
    assert len(invert_seeds(plain, 0)) == len(plain) > 20
    salted = record_seeds(tmp_path / "salted", draw_salt())
    assert len(salted) == len(plain) and not invert_seeds(salted, 0)
    assert record_seeds(tmp_path / "one", "s") == record_seeds(tmp_path / "two", "s") != salted  # so arms are paired
    assert set(record_seeds(tmp_path / "three", "s", Unseeded)) == {0}


@pytest.mark.parametrize("salt", ["", None])
def test_a_key_and_the_command_line_do_not_tell_the_episode(two_rooms, tmp_path, monkeypatch, capsys, salt) -> None:
    monkeypatch.setattr("wiw.loop.keys.draw_salt", draw_salt)  # that of conftest draws none
    name = f"{PYTHON_TESTS / 'cheats.py'}:EpisodeRegenerator"
    flags = ["--scenes", two_rooms, "--seed", "3", "--episodes", "2", "--policy", name]
    command = [
        "run",
        "imagenav",
        *flags,
        "--no-report",
        "--out",
        str(tmp_path),
        *(() if salt is None else ("--salt", salt)),
    ]
    monkeypatch.setattr(sys, "argv", ["wiw", *command])
    before = POLICIES.find(name).known
    assert main(command) == 0
    capsys.readouterr()
    log = load_run(tmp_path)
    succeeded = [row["metrics"]["success"] for row in log.episodes]
    assert (POLICIES.find(name).known - before, succeeded) == ((2, [1.0, 1.0]) if salt == "" else (0, [0.0, 0.0]))
    assert len(log.store.salt) == (0 if salt == "" else 32)


def test_odometry_does_not_tell_where_it_begins(two_rooms: str) -> None:
    env = wiw.make("ImageNav-v0", scenes=two_rooms, depth=False)
    seen = []
    for place, yaw in (((-3.0, 0.0, 0.5), 0.3), ((1.0, 0.0, 0.7), 2.9), ((-2.7, 0.0, -0.3), 4.0)):
        env.begin(Episode("x", two_rooms, place, yaw, (3.0, 0.0, 1.0), 0.0, 1.0, {"goal_yaw": 0.0}))
        seen.append([env.run(np.array([action])).observation.odometry.tobytes() for action in PLAN])
    assert seen[0] == seen[1] == seen[2]
    env.close()


@pytest.mark.parametrize("rounded", [True, False])
def test_which_of_known_episodes_it_is_does_not_show_in_odometry(two_rooms: str, monkeypatch, rounded: bool) -> None:
    if not rounded:
        monkeypatch.setattr("wiw.envs.episode_state.round_odometry", np.copy)
    task, plan = ImageNav(scenes=two_rooms), np.array([TURN_LEFT, FORWARD, TURN_RIGHT, TURN_RIGHT, FORWARD], np.int8)
    known = task.episodes(12)
    env = task.environment()
    env.begin(known[3])
    seen = [env.run(plan[[k]]).observation.odometry for k in range(len(plan))]
    assert all(np.linalg.norm(seen[k][:2] - seen[k - 1][:2]) > 0.19 for k in (1, 4)), "a step was refused"
    matching = find_episodes_by_odometry(task, known, plan, seen)
    assert len(matching) > 9 if rounded else matching == [3]


def test_keys_name_episodes_and_tell_nothing() -> None:
    salted = [make_key(seed, episode, "s") for seed in (0, 1) for episode in range(200)]
    assert len(set(salted)) == len({key.seed for key in salted}) == len({key.episode for key in salted}) == 400
    assert all(0 <= number < 2**64 for key in salted for number in (key.seed, key.episode))
    assert make_key(3, 4) == Key(3, 4) and make_key(3, 4, "s") != make_key(3, 4, "t")
    assert make_key(3, 4, "s").at(2) == Key(make_key(3, 4, "s").seed, make_key(3, 4, "s").episode, 2)
    assert len({draw_salt() for _ in range(50)}) == 50


def test_a_run_keeps_its_salt_and_every_later_command_has_it(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("wiw.loop.keys.draw_salt", draw_salt)
    one, other = (run(tmp_path / name) for name in ("one", "other"))
    assert one.store.salt != other.store.salt
    assert one.store.episodes() == other.store.episodes()  # they are chosen by the seed alone
    assert compare(one, other).differences
    assert wiw.verify(tmp_path / "one", 5).same and wiw.verify(tmp_path / "other", 5).same
    facts = [[row["metrics"] for row in log.episodes] for log in (one, other)]
    assert facts[0] != facts[1]
    again = run(tmp_path / "again", salt=one.store.salt)
    assert [row["metrics"] for row in again.episodes] == facts[0]
    with pytest.raises(StoreError, match="salt: the run has"):
        run(tmp_path / "one", resume=True, salt="another")
    assert resume_run(tmp_path / "one", progress=False).store.salt == one.store.salt


def test_shards_have_one_salt(tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="--salt"):
        run(tmp_path / "none", shard="1/2")
    for number, salt in ((1, "s"), (2, "t")):
        run(tmp_path / "unlike" / str(number), shard=f"{number}/2", salt=salt).close()
    with pytest.raises(StoreError, match='salt: "s" and "t"'):
        wiw.merge([tmp_path / "unlike"], tmp_path / "merged")
    for number in (1, 2):
        run(tmp_path / "like" / str(number), shard=f"{number}/2", salt="s").close()
    assert wiw.merge([tmp_path / "like"], tmp_path / "merged").complete
    assert load_run(tmp_path / "merged").store.salt == "s" and wiw.verify(tmp_path / "merged", 5).same


@pytest.mark.parametrize(("model", "hits"), [(Unseeded, True), (Recorder, False)])
def test_rollouts_of_models_without_seeds_serve_runs_of_any_salt(tmp_path: Path, model, hits: bool) -> None:
    for salt in ("s", "t"):
        made = model()
        run(tmp_path / salt, made, Walker(), salt=salt, cache=tmp_path / "cache").close()
    assert (made._seeds == []) == hits
