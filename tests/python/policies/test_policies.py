# SPDX-License-Identifier: Apache-2.0
"""The policies by themselves: rules, memories and scores, against slow twins and made-up places."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import wiw
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError
from wiw.policies.base import Situation
from wiw.policies.heuristic import INVERSE
from wiw.policies.matcher.exploration import CELL, FAR_DISTANCE, ExplorationMap
from wiw.policies.matcher.policy import (
    HEADINGS,
    STEP,
    Matcher,
    Memory,
    appearance,
    choose_diverse,
    measure_imagined_gain,
    plan_straight_run,
    predict_positions,
    recall_gains,
)
from wiw.types import Goal, Key, Observation, Proposal, Rollout

BLANK = Observation(np.zeros((576, 1024, 3), np.uint8), np.zeros((480, 480, 3), np.uint8), np.zeros(3))


def noise(*shape: int, seed: int = 0) -> NDArray[np.uint8]:
    """Coarse coloured noise, so that it survives blurring and resizing."""
    small = np.random.default_rng(seed).integers(0, 256, (*shape[:-3], shape[-3] // 8, shape[-2] // 8, 3), np.uint8)
    return small.repeat(8, axis=-3).repeat(8, axis=-2)


@given(history=st.lists(st.sampled_from([FORWARD, TURN_LEFT, TURN_RIGHT]), max_size=6), decision=st.integers(0, 50))
def test_the_heuristics_rules_hold_across_decisions(history: list[int], decision: int) -> None:
    policy = wiw.policy("heuristic")
    situation = Situation(BLANK, Goal("imagenav"), Key(0, 1, decision), None, tuple(history))
    (plans,) = policy.propose([situation], 3, 8)
    for plan in plans:
        whole = [*history, *plan.actions.tolist()]
        for i in range(max(len(history), 1), len(whole)):
            assert whole[i] != INVERSE.get(whole[i - 1])
            assert whole[i] == FORWARD or i < 4 or len(set(whole[i - 4 : i + 1])) > 1


def test_the_heuristics_longest_turn_is_an_option_that_runs_record() -> None:
    for odd in (0, "3", True, 2.0):
        with pytest.raises(ArgumentError, match="expected a whole max_turns of at least 1"):
            wiw.policy("heuristic", max_turns=odd)
    assert wiw.policy("heuristic", max_turns=2).describe() == {"policy": "Heuristic", "max_turns": 2}
    assert wiw.policy("heuristic").describe() == {"policy": "Heuristic"}
    allowed = wiw.policy("heuristic", max_turns=1).list_allowed
    assert allowed([FORWARD]) == [FORWARD, TURN_LEFT, TURN_RIGHT] and allowed([TURN_LEFT]) == [FORWARD]


def test_the_heuristic_draws_anew_for_each_decision_and_candidate() -> None:
    policy = wiw.policy("heuristic")
    plans = {
        tuple(plan.actions)
        for decision in range(4)
        for plan in policy.propose([Situation(BLANK, Goal("imagenav"), Key(0, 0, decision), None)], 3, 8)[0]
    }
    assert len(plans) > 8


def test_histogram_similarity_equals_its_slow_twin() -> None:
    panoramas, image = noise(2, 64, 128, 3), noise(64, 64, 3, seed=1)
    panoramas[0, 20:44, 40:90] = noise(24, 50 + 6, 3, seed=1)[:, :50]
    goal, places = appearance.build_goal_template(image), appearance.extract_features(panoramas)
    fast = appearance.histogram_similarity(places, goal)
    total = len(goal.bins)
    own = np.zeros(total)
    own[goal.bins < len(goal.shares)] = goal.shares
    for n, column in ((0, 64), (0, 3), (1, 127)):
        around = np.arange(column - appearance.WINDOW // 2, column + appearance.WINDOW // 2) % appearance.COLUMNS
        counts = np.bincount(places.bins[n][:, around].ravel(), minlength=total)
        slow = np.sqrt(counts / counts.sum() * own).sum()
        assert fast[n, column] == pytest.approx(slow, abs=1e-5)


def test_a_place_is_most_like_the_goal_that_was_seen_from_it() -> None:
    panorama = noise(576, 1024, 3)
    image = wiw.panorama.to_perspective(panorama, 90.0, (480, 480))
    goal = appearance.build_goal_template(image)
    here = appearance.similarity(appearance.extract_features(wiw.panorama.resize(panorama[None], (64, 128))), goal)[0]
    there = appearance.similarity(appearance.extract_features(noise(1, 64, 128, 3, seed=5)), goal)[0]
    assert here.argmax() in (63, 64, 65)
    assert 3.0 < here.max() <= 4.001
    assert there.max() < here.max() - 1


@given(
    odometry=st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1)),
    actions=st.lists(st.sampled_from([FORWARD, TURN_LEFT, TURN_RIGHT]), min_size=1, max_size=9),
)
def test_positions_after_a_plan_equal_step_by_step(odometry: tuple[float, float, float], actions: list[int]) -> None:
    x, y, azimuth = odometry
    slow = []
    for action in actions:
        azimuth += {TURN_LEFT: 1, TURN_RIGHT: -1}.get(action, 0) * np.pi / 8
        x, y = (x + 0.2 * np.cos(azimuth), y + 0.2 * np.sin(azimuth)) if action == FORWARD else (x, y)
        slow.append((x, y))
    np.testing.assert_allclose(predict_positions(np.array(odometry), np.array(actions, np.int8)), slow, atol=1e-9)


def test_imagined_places_are_remembered_and_recalled_from_the_next_place() -> None:
    goal = appearance.build_goal_template(noise(64, 64, 3))
    memory = Memory(goal)
    memory.profile[:] = 1.0
    plan = Proposal(plan_straight_run(2, 5, 3))  # two turns to the left, three steps
    frames = noise(5, 64, 128, 3, seed=3)
    real = np.array([True, True, False, False, False])
    gain = measure_imagined_gain(memory, np.zeros(3), plan, Rollout(frames, real, "panorama"))
    values = appearance.similarity(appearance.extract_features(frames[2:]), goal).max(1)
    assert gain == pytest.approx(values.max() - 1.0)
    assert [value for _, value in memory.imagined_places] == pytest.approx(values.tolist())
    runs = np.full(HEADINGS, 3 * STEP)
    known = recall_gains(memory, np.zeros(3), runs)
    assert known[2] == pytest.approx(gain)
    assert (known[6:] == 0).all()
    step = np.array([*(STEP * np.array([np.cos(np.pi / 4), np.sin(np.pi / 4)])), np.pi / 4])
    assert recall_gains(memory, step, runs - STEP)[0] == pytest.approx(values[1:].max() - 1.0)


def test_turning_on_the_spot_imagines_nothing() -> None:
    memory = Memory(appearance.build_goal_template(noise(64, 64, 3)))
    turning = Proposal(plan_straight_run(8, 5, 3))
    future = Rollout(noise(5, 64, 128, 3), np.ones(5, bool), "panorama")
    assert measure_imagined_gain(memory, np.zeros(3), turning, future) is None
    assert memory.imagined_places == []


def test_diverse_headings_keep_their_distance_and_no_plan_comes_twice() -> None:
    plans = {k: plan_straight_run(k, 5, 5) for k in range(HEADINGS)}
    assert choose_diverse([0, 1, 2, 3, 15], plans, 3, 3) == [0, 3, 1]
    chosen = choose_diverse([5, 6, 7, 8, 11], plans, 1, 3)  # five turns and more are cut to the same five left turns
    assert chosen == [5, 11]


def corridor() -> tuple[ExplorationMap, NDArray[np.float32]]:
    """A map seen from the middle of a corridor along x, walls at y = -1 and 1, closed behind at x = -2."""
    exploration = ExplorationMap()
    azimuth = np.pi - (np.arange(128) + 0.5) / 128 * 2 * np.pi
    latitude = np.pi / 2 - (np.arange(288) + 0.5) / 288 * np.pi
    with np.errstate(divide="ignore"):
        flat = np.minimum(1 / np.abs(np.sin(azimuth)), np.where(np.cos(azimuth) < 0, -2 / np.cos(azimuth), np.inf))
        down = np.where(latitude < 0, 1.0 / np.sin(-latitude), np.inf)
    depth = np.minimum(flat[None] / np.cos(latitude)[:, None], down[:, None])
    return exploration, depth.astype(np.float32)


def test_the_map_knows_walls_free_space_and_the_frontier() -> None:
    exploration, depth = corridor()
    exploration.update(depth, np.zeros(3), np.zeros(128, np.float32))
    free = exploration.find_free_cells()
    assert free[exploration.to_cells(np.array([-1.5, 0.0, 2.0]), np.zeros(3))].all()
    assert not free[exploration.to_cells(np.zeros(2), np.array([-1.0, 1.0]))].any()
    runs, ends = exploration.look_ahead(np.zeros(3), 4, 2.5)
    assert runs[0] == 2.5
    assert 0.5 < runs[1] < 1.0
    np.testing.assert_allclose(ends[0], [2.5, 0])
    distance = exploration.distance_to_target(4.0, 0.1)
    ahead = exploration.sample_grid(distance, np.array([[0.0, 0.0], [2.0, 0.0]]))
    assert ahead[0] > ahead[1] + 1.5  # the open end of the corridor
    assert exploration.sample_grid(distance, np.array([[0.0, 1.5]]))[0] == FAR_DISTANCE


def test_the_target_is_the_frontier_that_looks_like_the_goal() -> None:
    """The corridor open at both ends: likeness decides between two frontiers at equal distance."""
    exploration, depth = corridor()
    ahead = depth[:, 32:96]
    depth = np.concatenate([ahead[:, ::-1][:, 32:], ahead, ahead[:, ::-1][:, :32]], 1)
    forward = np.r_[np.zeros(32), np.ones(64), np.zeros(32)].astype(np.float32)  # the columns that look ahead
    for likeness, nearer in ((forward, 1.0), (1 - forward, -1.0)):
        exploration = ExplorationMap()
        exploration.update(depth, np.zeros(3), likeness)
        distance = exploration.distance_to_target(4.0, 0.1)
        there, away = exploration.sample_grid(distance, np.array([[nearer, 0.0], [-nearer, 0.0]]))
        assert there < away


def test_the_map_reaches_as_far_as_the_agent_gets() -> None:
    """Along an endless corridor, and across it: the open end ahead stays the nearest frontier."""
    _, depth = corridor()
    depth = np.concatenate([depth[:, 32:96], depth[:, 32:96]], 1)  # open behind, too
    depth = np.roll(depth, 32, 1)
    for along in (np.array([1.0, 0.0]), np.array([0.0, -1.0])):
        azimuth = np.arctan2(along[1], along[0])
        exploration, found = ExplorationMap(), []
        for metres in np.arange(0, 30.1, 0.6):
            exploration.update(depth, np.array([*(metres * along), azimuth]), np.zeros(128, np.float32))
            field = exploration.distance_to_target(4.0, 0.1)
            found.append(exploration.sample_grid(field, np.array([metres * along, (metres + 1) * along])))
        here, ahead = np.transpose(found[1:])  # at first both ends are equally near
        assert np.all(np.abs(here - ahead - 1) < 0.11) and np.ptp(here) < 0.3
        assert len(exploration.explored) == 2 * exploration.half == len(exploration.centres)


def test_a_map_that_need_not_grow_is_as_it_was() -> None:
    exploration, depth = corridor()
    exploration.update(depth, np.array([11.4, -11.4, 0.3]), np.zeros(128, np.float32))
    assert exploration.explored.shape == (320, 320)
    exploration.update(depth, np.array([11.6, 0.0, 0.3]), np.zeros(128, np.float32))
    assert exploration.explored.shape == (400, 400)


def test_a_refused_step_makes_what_is_ahead_solid() -> None:
    exploration, depth = corridor()
    exploration.update(depth, np.zeros(3), np.zeros(128, np.float32))
    exploration.mark_blocked(np.array([STEP, 0.0, 0.0]))
    assert exploration.look_ahead(np.zeros(3), 1, 1.0)[0][0] == 1.0
    exploration.mark_blocked(np.zeros(3))
    assert exploration.look_ahead(np.zeros(3), 1, 1.0)[0][0] < 3 * CELL


def test_a_plan_of_which_only_the_turn_was_carried_out_marks_nothing() -> None:
    """It has not tried to go where its second step would have led."""
    depth = corridor()[1].repeat(8, 1)[:576].repeat(2, 0)[:576]
    goal, free = Goal("imagenav", image=noise(480, 480, 3, seed=2)), []
    for executed in ((int(TURN_LEFT),), (int(TURN_LEFT), int(FORWARD))):
        policy = Matcher()
        memory = policy.begin(goal, Key(0, 0))
        for done, azimuth in (((), 0.0), (executed, np.pi / 8)):
            shown = Observation(noise(576, 1024, 3), BLANK.front, np.array([0.0, 0.0, azimuth]), depth)
            policy.observe([Situation(shown, goal, Key(0, 0), memory, done)])
        free.append(memory.map.look_ahead(np.array([0.0, 0.0, np.pi / 8]), 1, 1.0)[0][0])
    assert free[0] > free[1] and free[1] < 3 * CELL


@pytest.mark.parametrize("size", [(64, 128), (100, 200), (288, 512), (576, 1024)])
def test_the_matcher_reads_panoramas_of_other_sizes(size: tuple[int, int]) -> None:
    depth = np.full(size, 2.0, np.float32)
    goal = Goal("imagenav", image=noise(480, 480, 3, seed=2))
    policy = Matcher()
    shown = Observation(noise(*size, 3), BLANK.front, np.zeros(3), depth)
    situation = Situation(shown, goal, Key(0, 0), policy.begin(goal, Key(0, 0)))
    policy.observe([situation])
    assert len(policy.propose([situation], 3, 5)[0]) == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reach": 0}, "expected reach above 0, got 0"),
        ({"gate_width": 0.0}, "expected gate_width above 0, got 0"),
        ({"gate_width": float("nan")}, "expected gate_width above 0, got nan"),
        ({"travel": -0.1}, "expected travel of 0 or more, got -0.1"),
        ({"spread": 0}, "spread must be positive, got 0"),
        ({"calm": 1.5}, "expected calm of at most 1 .*, got 1.5"),
        ({"gate": float("inf")}, "a number for gate, got .* and inf"),
    ],
)
def test_options_of_the_matcher_that_make_no_sense_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ArgumentError, match=f"policy matcher: .*{message}"):
        Matcher(**options)
    assert Matcher(gate=-1.0, travel=0, calm=1).options.travel == 0


@pytest.mark.parametrize("name", ["matcher", "climber", "geometric"])
def test_a_goal_without_an_image_is_refused(name: str) -> None:
    with pytest.raises(ArgumentError, match=f"policy {name}: expected a goal image, got none in task ar"):
        wiw.policy(name).begin(Goal("ar", choices=("bed", "chair")), Key(0, 0))


def test_the_matcher_without_imagination_ignores_the_world_models_weight() -> None:
    depth = corridor()[1].repeat(8, 1)[:576].repeat(2, 0)[:576]
    observation = Observation(noise(576, 1024, 3), BLANK.front, np.zeros(3), depth)
    goal = Goal("imagenav", image=noise(480, 480, 3, seed=2))
    plans = []
    for imagined in (0.5, 5.0):
        policy = Matcher(imagined=imagined)
        situation = Situation(observation, goal, Key(0, 0), policy.begin(goal, Key(0, 0)))
        policy.observe([situation])
        plans.append([plan.actions.tolist() for plan in policy.propose([situation], 3, 5)[0]])
    assert plans[0] == plans[1]
    assert len(plans[0]) == 3


def test_the_matcher_extends_plans_without_changing_what_it_knows_of_the_real_episode() -> None:
    depth = corridor()[1].repeat(8, 1)[:576].repeat(2, 0)[:576]
    goal = Goal("imagenav", image=noise(480, 480, 3, seed=2))
    policy = Matcher()
    memory = policy.begin(goal, Key(0, 0))
    policy.observe(
        [Situation(Observation(noise(576, 1024, 3), BLANK.front, np.zeros(3), depth), goal, Key(0, 0), memory)]
    )
    before = deepcopy(memory)
    ahead = np.array([0.6, 0.0, 0.0])
    there = Situation(Observation(noise(576, 1024, 3, seed=7), BLANK.front, ahead), goal, Key(0, 0), memory)
    (plans,) = policy.extend([there], 3, 5)
    assert len(plans) == 3
    assert memory.similarity == before.similarity and memory.recalled_gains == before.recalled_gains
    np.testing.assert_array_equal(memory.histogram, before.histogram)
    np.testing.assert_array_equal(memory.map.explored, before.map.explored)
