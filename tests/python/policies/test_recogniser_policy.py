# SPDX-License-Identifier: Apache-2.0
"""The recogniser as a policy: it steers to where more is to be seen, and answers from real and imagined looks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import agent_for
from hypothesis import given
from hypothesis import strategies as st
from test_active_recognition import Sink

import wiw
from recognition_file import CHOICES, a_file
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.datasets.cameras import camera_pose
from wiw.datasets.visibility import visible_fraction
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.loop.scheduler import run_episodes
from wiw.policies.recogniser import steering
from wiw.policies.recogniser.policy import SHIPPED
from wiw.tasks.ar import AR
from wiw.types import Key, Proposal, Rollout

torch = pytest.importorskip("torch", reason="needs wiw[torch]")


def panorama_of(place: Any, position: Any, yaw: float, name: str) -> tuple[Any, Any, int]:
    thing = next(int(i["id"]) for i in place.scene.instances if i["name"] == name)
    shown = place.renderer.panorama(camera_pose(np.asarray(position, float), yaw), outputs=("depth", "instance"))
    return shown["instance"][0] == thing, shown["depth"][0], thing


# -- steering ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 1.2, -2.5])
def test_sight_is_where_the_thing_is(two_rooms: str, yaw: float) -> None:
    mask, depth, _ = panorama_of(world(two_rooms), (-1.2, 0, -1.2), yaw, "table")
    seen = steering.locate_in_view(mask, depth)
    assert np.degrees(seen.bearing) == pytest.approx((90 - np.degrees(yaw) + 180) % 360 - 180, abs=3)  # 1 m to the west
    assert 1.0 < seen.distance < 1.8
    assert seen.side == 0
    assert steering.locate_in_view(np.zeros_like(mask), depth) is None


@pytest.mark.parametrize("start", [(-1.0, 0, 1.2), (-0.6, 0, 1.0)])
def test_the_side_of_a_detour_is_where_more_is_seen(two_rooms: str, start: Any) -> None:
    place = world(two_rooms)
    mask, depth, thing = panorama_of(place, start, -np.pi / 2, "shelf")  # through the door, behind the wall beside it
    seen = steering.locate_in_view(mask, depth)
    assert seen.side != 0
    left, right = (visible_fraction(place, np.add(start, (0, 0, step)), thing) for step in (-0.15, 0.15))
    assert seen.side == (1 if left > right else -1)
    assert abs(left - right) > 0.05
    first = steering.rank_headings(seen, seen.bearing, 0)[0]
    assert (first - seen.bearing) * seen.side > 0


def test_clearance_is_the_way_to_the_walls(two_rooms: str) -> None:
    _, depth, _ = panorama_of(world(two_rooms), (-1.2, 0, -1.2), 0.0, "table")
    free = steering.measure_clearance(depth)
    assert free[0] == pytest.approx(0.8, abs=0.05)  # the wall in the north
    assert free[8] == pytest.approx(3.0, abs=0.1)  # the partition, beside the way to the wall in the south
    assert free[4] == pytest.approx(1.0, abs=0.1)  # the table in the west
    assert free[12] == pytest.approx(1.15, abs=0.1)  # the partition in the east


@given(st.floats(-4, 4), st.lists(st.floats(0, 5), min_size=16, max_size=16), st.integers(1, 6))
def test_plans_are_turns_and_then_steps_where_it_is_free(heading: float, free: list[float], horizon: int) -> None:
    plan = steering.plan_towards(heading, np.array(free), horizon).tolist()
    assert 1 <= len(plan) <= horizon
    turns = [action for action in plan if action != FORWARD]
    assert plan == turns + [FORWARD] * (len(plan) - len(turns))
    assert len(set(turns)) <= 1
    steps = len(plan) - len(turns)
    if steps:
        assert set(turns) <= {TURN_LEFT, TURN_RIGHT}
        direction = len(turns) * (1 if TURN_LEFT in turns else -1)
        assert 0.2 * steps <= free[direction % 16]


def test_a_plan_goes_round_what_is_in_the_way() -> None:
    free = np.full(16, 3.0)
    assert steering.plan_towards(np.pi / 4, free, 4).tolist() == [TURN_LEFT, TURN_LEFT, FORWARD, FORWARD]
    free[2] = 0.3
    assert steering.plan_towards(np.pi / 4, free, 4).tolist() == [TURN_LEFT, FORWARD, FORWARD, FORWARD]
    assert steering.plan_towards(np.pi / 4 * 3.5, np.where(np.isin(np.arange(16), [3, 9]), 3.0, 0.3), 8).tolist() == [
        *[TURN_RIGHT] * 7,
        FORWARD,
    ]  # nine turns left of it, and so two from the wanted seven
    assert steering.plan_towards(np.pi, np.zeros(16), 3).tolist().count(FORWARD) == 0
    assert (
        steering.plan_towards(0.0, np.full(16, np.inf), 4).tolist() == [FORWARD] * 4
    )  # nothing stands anywhere around


def test_what_is_large_or_hidden_is_passed_aside_and_what_is_small_is_neared() -> None:
    small = steering.TargetSighting(0.5, 3.0, np.radians(10), 0.0, 0.0)
    assert steering.rank_headings(small, 0.5, 0)[0] == 0.5
    assert steering.rank_headings(replace(small, size=np.radians(60)), 0.5, -1)[0] < 0.5
    assert steering.rank_headings(replace(small, hidden_left=0.8), 0.5, 1)[0] < 0.5
    assert steering.rank_headings(None, -1.0, 1)[0] == -1.0


# -- answers -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a network that has learnt nothing, but tells different looks apart."""
    from wiw.perception.recogniser import Recogniser
    from wiw.perception.recognition_network import Network

    torch.manual_seed(2)
    network = Network(len(CHOICES), 8)
    torch.nn.init.normal_(network.logits.weight)
    file = tmp_path_factory.mktemp("weights") / "weights.safetensors"
    Recogniser(network, CHOICES).save(file)
    return file


def policy(weights: Path, **options: Any) -> Any:
    from wiw.policies.recogniser.policy import Recognition

    return Recognition(weights, **options)


def answers(task: Any, agent: Any, live: int = 4, episodes: int = 1) -> list[list[float]]:
    sink = Sink()
    numbered = [(i, replace(task.episodes(1)[0], start_yaw=0.7 * i)) for i in range(episodes)]
    run_episodes(task, agent_for(task, agent), numbered, seed=0, live=live, sink=sink)
    assert [result.status for result in sink.results] == ["done"] * episodes
    return [
        [list(row.decision.answer.probabilities) for row in sink.decisions if row.episode == i] for i in range(episodes)
    ]


@pytest.mark.parametrize("model", [None, "warp"])
def test_answers_do_not_depend_on_what_else_is_live(two_rooms: str, tmp_path: Path, weights: Path, model: Any) -> None:
    task = AR(episode_file=a_file(tmp_path, two_rooms), decisions=3)
    agent = wiw.Agent(policy(weights), model)
    together, alone = answers(task, agent, 2, 2), answers(task, agent, 1, 2)
    assert together == alone
    assert together[0] != together[1]


def test_imagined_looks_change_the_answer_and_turned_real_ones_do_not(
    two_rooms: str, tmp_path: Path, weights: Path
) -> None:
    task = AR(episode_file=a_file(tmp_path, two_rooms), decisions=1)
    blind = answers(task, wiw.Agent(policy(weights)))
    imagined = answers(task, wiw.Agent(policy(weights), "warp"))
    assert np.abs(np.subtract(blind, imagined)).max() > 1e-3

    class Turner(type(policy(weights))):  # type: ignore[misc]
        def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
            return [[Proposal(np.array([TURN_LEFT, TURN_LEFT], np.int8))] for _ in situations]

    assert answers(task, wiw.Agent(Turner(weights), "warp")) == blind


def test_a_plan_that_loses_the_target_scores_less(two_rooms: str, tmp_path: Path, weights: Path) -> None:
    from wiw.policies.base import Situation

    task = AR(episode_file=a_file(tmp_path, two_rooms))
    env = task.environment(depth=True)
    observation = env.begin(task.episode(0))
    answerer = policy(weights)
    situation = Situation(observation, env.goal, Key(0, 0), answerer.begin(env.goal, Key(0, 0)))
    answerer.observe([situation])
    gone = replace(observation, target=replace(observation.target, mask=np.zeros_like(observation.target.mask)))
    plans = [Proposal(np.array([FORWARD], np.int8))]
    futures = [Rollout(observation.panorama[None], np.zeros(1, bool), "panorama")]
    (kept,), (lost,) = (
        answerer.score([replace(situation, observation=seen)], [plans], [futures])[0] for seen in (observation, gone)
    )
    sure = answerer.recogniser([situation.memory.looks[0][1]], CHOICES).max()
    assert lost == pytest.approx(sure - answerer.lost)
    assert kept > lost


def test_turns_and_the_order_of_steering_cost_a_plan(two_rooms: str, tmp_path: Path, weights: Path) -> None:
    from wiw.policies.base import Situation

    task = AR(episode_file=a_file(tmp_path, two_rooms))
    env = task.environment(depth=True)
    observation = env.begin(task.episode(0))
    answerer = policy(weights, turning=0.05, trust=0.2)
    situation = Situation(observation, env.goal, Key(0, 0), answerer.begin(env.goal, Key(0, 0)))
    answerer.observe([situation])
    ways = [([FORWARD], 7.0), ([FORWARD], 5.0), ([TURN_LEFT, FORWARD], 5.0)]
    plans = [Proposal(np.array(way, np.int8), prior) for way, prior in ways]
    futures = [
        Rollout(np.repeat(observation.panorama[None], len(way), 0), np.ones(len(way), bool), "panorama")
        for way, _ in ways
    ]
    (scores,) = answerer.score([situation], [plans], [futures])
    assert scores[0] - scores[1] == pytest.approx(0.2)
    assert scores[1] - scores[2] == pytest.approx(0.05)


@pytest.mark.parametrize("options", [{"views": 0}, {"remember": 0}, {"views": -1}, {"remember": 1.5}])
def test_no_glimpses_are_not_all_glimpses(options: dict[str, int]) -> None:
    with pytest.raises(ArgumentError, match="expected remember and views of at least 1"):
        wiw.policy("recogniser", **options)


@pytest.mark.parametrize("options", [{"lost": "much"}, {"turning": float("nan")}, {"trust": float("inf")}])
def test_deductions_are_numbers(options: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError, match="expected numbers for lost, turning and trust"):
        wiw.policy("recogniser", **options)


def test_weights_are_named_or_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ArgumentError, match=r"expected weights pictures or extents, or a file .*, got 'extent'"):
        wiw.policy("recogniser", weights="extent")
    with pytest.raises(FileError, match=r"nowhere\.safetensors"):
        wiw.policy("recogniser", weights=tmp_path / "nowhere.safetensors")
    monkeypatch.setenv("HOME", str(SHIPPED["pictures"].parent))
    assert wiw.policy("recogniser", weights="~/pictures.safetensors").file == SHIPPED["pictures"]


@pytest.mark.parametrize("name", ["pictures", "extents"])
def test_weights_that_come_with_the_package_are_small_and_calibrated(name: str) -> None:
    from wiw.perception.recogniser import Recogniser
    from wiw.policies.recogniser.policy import SHIPPED

    recogniser = Recogniser.load(SHIPPED[name])
    assert recogniser.network.extents == (name == "extents")
    assert SHIPPED[name].stat().st_size < 2 * 2**20
    assert recogniser.card["accuracy"]["start + 3 real"] > recogniser.card["accuracy"]["start"] > 0.75
    assert recogniser.card["calibration_error"]["after"] < 0.05


@pytest.mark.nightly
def test_weights_that_come_with_the_package_know_things_of_unseen_homes() -> None:
    from wiw.perception.recogniser import Recogniser
    from wiw.policies.recogniser.policy import SHIPPED
    from wiw.training.glimpse_sets import START, GlimpseSetRules, collect_glimpse_sets

    recogniser = Recogniser.load(SHIPPED["pictures"])
    looks = collect_glimpse_sets(world("apartments:test/900"), 0, recogniser.categories, GlimpseSetRules(places=6))
    first = [looks.glimpses[np.array([row])] for row in np.flatnonzero(looks.kinds == START)]
    right = recogniser(first).argmax(axis=1) == looks.labels
    assert len(right) >= 20
    assert right.mean() > 0.6


def test_weights_that_measure_extents_know_things_of_a_house_by_other_hands(data_dir: Path) -> None:
    from wiw.perception.recogniser import Recogniser
    from wiw.policies.recogniser.policy import SHIPPED
    from wiw.training.glimpse_sets import START, GlimpseSetRules, collect_glimpse_sets

    recogniser = Recogniser.load(SHIPPED["extents"])
    house = world(str(data_dir / "small_house" / "worlds" / "small_house.world"))
    looks = collect_glimpse_sets(house, 0, recogniser.categories, GlimpseSetRules(places=24, neighbours=0, reshape=1))
    first = [looks.glimpses[np.array([row])] for row in np.flatnonzero(looks.kinds == START)]
    right = recogniser(first).argmax(axis=1) == looks.labels
    assert len(right) >= 100
    assert right.mean() >= 0.3


def test_front_views_are_looked_at_too(two_rooms: str, tmp_path: Path, weights: Path) -> None:
    from wiw.perception.tracking import Track

    task = AR(episode_file=a_file(tmp_path, two_rooms, yaw=np.pi / 2))
    observation = task.environment(depth=True).begin(task.episode(0))
    frames = observation.front[None]
    mask = wiw.panorama.to_perspective(observation.target.mask.astype(np.uint8), 90.0, (480, 480), 0.0, 0.0, "nearest")
    track = Track(mask[None] > 0, (observation.target.front_box,))
    look = policy(weights)._extract_glimpses(Rollout(frames, np.zeros(1, bool), "front"), track)
    from wiw.perception.glimpses import extract_glimpses

    real, _ = extract_glimpses(observation.panorama[None], observation.target.mask[None], np.zeros(1, bool))
    np.testing.assert_allclose(look.scalars, real.scalars, atol=0.02)
    inside = look.images[0, 0].max(axis=-1) > 0  # nothing is known of what lies beyond the front view
    assert 0.3 < inside.mean() < 1
    assert np.abs(look.images[0, 0].astype(int) - real.images[0, 0])[inside].mean() < 6


@pytest.mark.parametrize("model", [None, "copy"])
def test_a_policy_that_only_proposes_is_revised_by_it(
    two_rooms: str, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, model: Any
) -> None:
    from wiw.policies.recogniser.policy import SHIPPED, Recognition

    monkeypatch.setitem(SHIPPED, "pictures", weights)
    task = AR(episode_file=a_file(tmp_path, two_rooms), decisions=2)
    agent = wiw.Agent("heuristic", model)
    assert isinstance(agent_for(task, agent).reviser, Recognition)
    assert len(answers(task, agent)[0]) == 2
    assert not isinstance(agent_for(task, wiw.Agent("heuristic", "copy", "matcher")).reviser, Recognition)
    assert not isinstance(agent_for(task, wiw.Agent("matcher", model)).reviser, Recognition)


def test_it_is_told_by_its_weights(weights: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.safetensors"
    from wiw.perception.recogniser import Recogniser
    from wiw.perception.recognition_network import Network

    Recogniser(Network(4, 8), CHOICES).save(other)
    assert policy(weights).describe() == policy(weights).describe() != policy(other).describe()
