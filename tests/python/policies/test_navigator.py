# SPDX-License-Identifier: Apache-2.0
"""The navigator: ways over an unfinished map, the belief of where the goal is, and the policy with a tiny network."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.errors import ArgumentError, WeightsError
from wiw.mapping.occupancy import OccupancyGrid
from wiw.policies.base import Situation
from wiw.runs.recipes import AgentRecipe
from wiw.types import Goal, Key, Observation, Rollout

torch = pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.policies.navigator.bands import get_goal_mask, project_goal  # noqa: E402
from wiw.policies.navigator.belief import (  # noqa: E402
    VISITED,
    Evidence,
    Weights,
    compute_belief,
    find_peaks,
    rate_bearings,
    share_weights,
)
from wiw.policies.navigator.candidates import (  # noqa: E402
    choose_apart,
    crop_floor,
    list_candidates,
    make_candidate,
    measure_arrivals,
)
from wiw.policies.navigator.network import CENTRES, Network, to_input  # noqa: E402
from wiw.policies.navigator.policy import Memory, Navigator  # noqa: E402
from wiw.policies.navigator.way_cells import WayCells  # noqa: E402
from wiw.policies.navigator.ways import UNKNOWN_COST, WayMap  # noqa: E402
from wiw.policies.navigator.weights import load, save  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_torch_thread")

CARD = {"shares": [1 / 9] * 9, "similarity": [[3.5 - 0.25 * k, 0.4] for k in range(9)]}
KEY = Key(0, 0)
EVEN = np.full(32, 1 / 32)
NEUTRAL = np.zeros(9)
CELLS = WayCells()
"""Within 9 m of the start."""


def tiny_network(seed: int = 0) -> Network:
    torch.manual_seed(seed)
    return Network(width=8, heads=2).eval()


def tiny_policy(**options: Any) -> Navigator:
    return Navigator.from_network(tiny_network(), CARD, **options)


def known_floor(*blocks: tuple[float, float, float, float], side: float = 4.0) -> OccupancyGrid:
    """A map of known floor from -side to side, with walls (x0, x1, y0, y1) in metres."""
    cells = round(2 * side / 0.1)
    grid = OccupancyGrid(
        origin=(-cells // 2, -cells // 2),
        free=np.ones((cells, cells), bool),
        occupied=np.zeros((cells, cells), bool),
        walls=np.zeros((cells, cells), bool),
    )
    for x0, x1, y0, y1 in blocks:
        rows, columns = (slice(round((a + side) / 0.1), round((b + side) / 0.1)) for a, b in ((x0, x1), (y0, y1)))
        grid.occupied[rows, columns], grid.free[rows, columns] = True, False
    return grid


WALL = (0.8, 1.0, -2.0, 4.0)
"""A wall across x = 0.9, which is open to the right, at y below -2."""


# -- the network -------------------------------------------------------------------------------------------------------


def test_a_turned_panorama_turns_bearings_and_changes_no_distance() -> None:
    network, rng = tiny_network(), np.random.default_rng(0)
    bands = torch.from_numpy(rng.integers(0, 256, (2, 32, 128, 3), np.uint8))
    goal = to_input(torch.from_numpy(rng.integers(0, 256, (1, 32, 32, 3), np.uint8)), torch.from_numpy(get_goal_mask()))
    with torch.inference_mode():
        here, turned = (network(to_input(views), goal) for views in (bands, bands.roll(12, 2)))
        assert here.bearings.shape == (2, 32) and here.distances.shape == (2, len(CENTRES))
        torch.testing.assert_close(turned.bearings, here.bearings.roll(3, 1))
        torch.testing.assert_close(turned.distances, here.distances)
        torch.testing.assert_close(turned.visible, here.visible)
        assert (here.bearings[0] - here.bearings[1]).abs().max() > 1e-3


def test_places_and_goals_are_compared_each_with_each() -> None:
    network, rng = tiny_network(), np.random.default_rng(1)
    places = to_input(torch.from_numpy(rng.integers(0, 256, (2, 32, 128, 3), np.uint8)))
    goals = to_input(torch.from_numpy(rng.integers(0, 256, (3, 32, 32, 3), np.uint8)))
    with torch.inference_mode():
        found = network(places, goals).distances.reshape(2, 3, -1)
        torch.testing.assert_close(found[1, 2], network(places[1:], goals[2:]).distances[0])


def test_a_goal_is_shown_as_its_view_shows_it() -> None:
    image = np.full((480, 480, 3), 200, np.uint8)
    band, mask = project_goal(image), get_goal_mask()
    assert (band[mask] == 200).all() and (band[~mask] == 0).all()
    assert mask[:, 16].all() and not mask[0, 0]


def test_weights_are_saved_with_what_they_are_built_of(tmp_path: Path) -> None:
    network = tiny_network()
    save(tmp_path / "weights.safetensors", network, CARD)
    again, card = load(tmp_path / "weights.safetensors")
    assert (again.width, again.heads, card) == (8, 2, CARD)
    assert Navigator(tmp_path / "weights.safetensors").describe()["weights"] != ""
    with pytest.raises(WeightsError, match="wiw train navigator"):
        Navigator(tmp_path / "none.safetensors")


def test_weights_of_an_infinite_width_are_refused(tmp_path: Path) -> None:
    network = tiny_network()
    network.width = np.inf
    save(tmp_path / "weights.safetensors", network, CARD)
    with pytest.raises(WeightsError, match="expected complete weights of navigator: cannot convert float infinity"):
        load(tmp_path / "weights.safetensors")


# -- ways --------------------------------------------------------------------------------------------------------------


def test_ways_lead_round_walls_and_begin_where_the_wall_ends() -> None:
    way_map = WayMap(known_floor(WALL), CELLS)
    ways = way_map.measure_ways(np.array([[0.0, 0.0], [0.0, -3.0]]))
    (behind,) = CELLS.find(np.array([[2.0, 0.1]]))
    assert ways.metres[0, behind] == pytest.approx(2 * np.hypot(0.9, 2.2) + 1.1, abs=0.7)
    assert -1.9 < ways.azimuths[0, behind] < -0.8  # to the right, where the wall ends
    assert abs(ways.azimuths[1, behind]) < 0.9
    cells = way_map.trace(ways, 0, behind)
    assert CELLS.centres[cells][:, 1].min() < -1.9
    assert np.allclose(CELLS.centres[cells[-1]], CELLS.centres[behind])


def test_unknown_floor_is_farther_and_what_is_occupied_is_none() -> None:
    grid = known_floor(side=1.0)
    ways = WayMap(grid, CELLS).measure_ways(np.zeros((1, 2)))
    near, far = (ways.metres[0, CELLS.find(np.array([[x, 0.1]]))[0]] for x in (0.7, 2.7))
    assert near == pytest.approx(0.7, abs=0.25)
    assert far == pytest.approx(1 + 1.7 * UNKNOWN_COST, abs=0.35)
    blocked = WayMap(known_floor((0.6, 1.0, -1.0, 1.0), side=1.0), CELLS)
    assert not (blocked.open | blocked.unknown).ravel()[CELLS.find(np.array([[0.8, 0.1]]))].any()


def test_the_map_grows_on_the_sides_where_places_lie_beyond_9_m() -> None:
    inside = np.array([[-9.0, 8.99], [8.99, -9.0], [0.0, 0.0]])
    assert WayCells.around(inside) == CELLS and CELLS.shape == (90, 90) and CELLS.contain(inside)
    assert CELLS.centres[0].tolist() == pytest.approx([-8.9, -8.9])
    assert CELLS.find(inside).tolist() == [89, 89 * 90, 45 * 90 + 45]
    far = np.array([[0.0, 0.0], [9.1, -17.5]])
    assert not CELLS.contain(far)
    wide = WayCells.around(far)
    assert (wide.low, wide.high) == ((-45, -125), (85, 45)) and wide.contain(far)
    np.testing.assert_allclose(wide.centres[wide.find(far)], far, atol=0.1001)
    assert np.abs(wide.centres[wide.find_near(far[1], 0.5)] - far[1]).max() < 0.5


def test_a_larger_map_changes_nothing_in_a_closed_room() -> None:
    walls = ((-4.0, 4.0, 3.6, 4.0), (-4.0, 4.0, -4.0, -3.6), (3.6, 4.0, -4.0, 4.0), (-4.0, -3.6, -4.0, 4.0))
    grid, places = known_floor(*walls, (0.8, 1.0, -2.0, 3.6)), np.array([[0.0, 0.0], [0.0, -3.0]])
    wide = WayCells.around(np.array([[-20.0, 3.0], [2.0, 11.0]]))
    small, large = (WayMap(grid, cells).measure_ways(places) for cells in (CELLS, wide))
    inner = np.flatnonzero(np.isfinite(small.metres[0]))
    outer = wide.find(CELLS.centres[inner])
    assert len(inner) > 1000 and np.isfinite(large.metres[0]).sum() == len(inner)
    np.testing.assert_array_equal(large.metres[:, outer], small.metres[:, inner])
    np.testing.assert_array_equal(large.azimuths[:, outer], small.azimuths[:, inner])


# -- the belief --------------------------------------------------------------------------------------------------------

PLAIN = Weights(bearing=1.0, closeness=1.0, doubt=0.1, overlap=0.5)


def looking(x: float, y: float, towards: float, sharpness: float = 4.0) -> Evidence:
    """Evidence of a place whose panorama faces along y and that expects the goal at an azimuth."""
    front = np.pi / 2
    azimuths = front + np.pi - (np.arange(32) + 0.5) * 2 * np.pi / 32
    weights = np.exp(sharpness * np.cos(azimuths - towards))
    return Evidence(np.array([x, y, front]), weights / weights.sum(), NEUTRAL)


def believe(grid: OccupancyGrid, *evidence: Evidence, trail: Any = ((0.0, 0.0),)) -> NDArray[np.float64]:
    way_map = WayMap(grid, CELLS)
    ways = way_map.measure_ways(np.array([own.pose[:2] for own in evidence]))
    return compute_belief(way_map, evidence, ways, np.array(trail, float), np.array(CENTRES), PLAIN)


def test_bearings_of_two_places_cross_where_the_goal_is() -> None:
    goal = np.array([2.0, 1.5])
    places = ((0.0, 0.0), (2.0, -1.5), (-1.0, 2.0))
    evidence = [looking(*place, towards=float(np.arctan2(*(goal - place)[::-1])), sharpness=8.0) for place in places]
    belief = believe(known_floor(), *evidence)
    assert belief.sum() == pytest.approx(1) and np.linalg.norm(CELLS.centres[belief.argmax()] - goal) < 0.7
    assert belief[CELLS.find(np.array([[-2.0, -2.0]]))[0]] < 0.01 * belief.max()


def test_the_bearing_is_that_of_the_way_and_not_of_the_straight_line() -> None:
    """To the right the wall ends; so a place before it that says "right" speaks of what is behind the wall, too."""
    belief = believe(known_floor(WALL), looking(0.0, 0.0, towards=-1.4))
    behind, beside = CELLS.find(np.array([[2.1, 0.1], [0.1, 2.1]]))
    assert belief[behind] > 5 * belief[beside]


def test_near_places_draw_the_belief_and_visited_ones_repel_it() -> None:
    close = Evidence(np.zeros(3), EVEN, np.array([2.0, 2, 2, 0, 0, 0, 0, 0, 0]))
    belief = believe(known_floor(), close)
    away = np.linalg.norm(CELLS.centres, axis=1)
    assert (belief[away < VISITED] == 0).all()
    assert VISITED < away[belief.argmax()] < 1.6


def test_places_close_together_share_their_weight() -> None:
    shares = share_weights(np.array([[0.0, 0.0], [0.0, 0.0], [5.0, 0.0]]), 0.5)
    np.testing.assert_allclose(shares, [0.5, 0.5, 1.0])
    here = looking(0.0, 0.0, towards=0.3)
    ahead, behind = rate_bearings(here, np.array([0.3, 0.3 + np.pi]), 0.1)
    assert ahead > 1 and behind < -1


def test_peaks_are_apart() -> None:
    worth = np.zeros(len(CELLS.centres))
    first, beside, second = CELLS.find(np.array([[0.1, 0.1], [0.5, 0.1], [2.1, 0.1]]))
    worth[[first, beside, second]] = 3.0, 2.0, 1.0
    assert find_peaks(CELLS, worth, 5) == [first, second]


# -- candidates --------------------------------------------------------------------------------------------------------


def test_plans_go_round_corners_and_fill_the_horizon() -> None:
    grid = known_floor(WALL)
    way_map = WayMap(grid, CELLS)
    ways = way_map.measure_ways(np.zeros((1, 2)))
    target = int(CELLS.find(np.array([[2.1, 0.1]]))[0])
    plans = list_candidates(grid, way_map, ways, np.zeros(3), [target], 45)
    assert len({plan.actions.tobytes() for plan in plans}) == len(plans) > 8
    route = plans[0]
    assert np.linalg.norm(route.poses[-1, :2] - [2.1, 0.1]) < 0.5  # round the end of the wall
    assert route.poses[:, 1].min() < -1.9
    short = list_candidates(grid, way_map, ways, np.zeros(3), [target], 5)
    assert {len(plan.actions) for plan in short} == {5}


@pytest.mark.parametrize("horizon", [1, 3])
def test_routes_stay_on_the_cropped_floor(horizon: int) -> None:
    """The map of the search ends near the agent; a wall there must not lead it over the edge."""
    grid = known_floor((0.3, 0.5, -3.0, 3.0), (-3.0, 0.4, 0.4, 0.6))
    way_map, far = WayMap(grid, CELLS), CELLS.find(np.array([[3.9, 3.9], [-3.9, -3.9], [2.1, 0.1]]))
    ways = way_map.measure_ways(np.zeros((1, 2)))
    plans = list_candidates(grid, way_map, ways, np.array([0.0, 0.0, 0.3]), [int(cell) for cell in far], horizon)
    assert {len(plan.actions) for plan in plans} == {horizon}
    floor = crop_floor(grid, np.zeros(3), 0.5)
    assert floor.occupied[:3].all() and floor.occupied[:, -3:].all() and floor.free[8, 8]


def test_targets_to_which_no_way_leads_are_left_out() -> None:
    grid = known_floor((1.0, 1.2, -10, 10), side=10)  # a wall from edge to edge
    way_map = WayMap(grid, CELLS)
    ways = way_map.measure_ways(np.zeros((1, 2)))
    here, beyond = (int(cell) for cell in CELLS.find(np.array([[0.1, 2.1], [2.1, 0.1]])))
    assert np.isinf(ways.metres[0, beyond])
    both = list_candidates(grid, way_map, ways, np.zeros(3), [beyond, here], 8)
    (nowhere, *_), (route, *_) = list_candidates(grid, way_map, ways, np.zeros(3), [beyond], 8), both
    assert route.poses[-1, 1] > 0.5 and len(nowhere.actions) > 0


def test_where_no_way_leads_anywhere_the_agent_looks_around() -> None:
    grid = known_floor((-4, 4, -4, -0.15), (-4, 4, 0.15, 4), (-4, -0.15, -4, 4), (0.15, 4, -4, 4))
    way_map = WayMap(grid, CELLS)
    here = int(CELLS.find(np.zeros((1, 2)))[0])
    (plan,) = list_candidates(grid, way_map, way_map.measure_ways(np.zeros((1, 2))), np.zeros(3), [here], 5)
    assert plan.actions.tolist() == [TURN_LEFT] * 4


def test_arrivals_count_turns_and_what_is_passed_on_the_way() -> None:
    plan = make_candidate(np.zeros(3), np.array([FORWARD] * 6, np.int8))
    ways = WayMap(known_floor(), CELLS).measure_ways(plan.poses[-1:, :2])
    found = measure_arrivals(plan, ways, 0)
    passed, ahead, back = CELLS.find(np.array([[0.7, 0.1], [3.1, 0.1], [-1.9, 0.1]]))
    assert found[passed] == 2  # after 0.4 m it is 0.3 m away
    assert found[ahead] == pytest.approx(6 + (1.9 - 0.45) / 0.2, abs=1.5)
    assert found[back] == pytest.approx(6 + 8 + (3.1 - 0.45) / 0.2, abs=2)


def test_chosen_plans_end_apart_and_those_that_only_turn_come_last() -> None:
    plans = [
        make_candidate(np.zeros(3), np.array(actions, np.int8))
        for actions in ([1, 1, 1], [1, 1], [2, 2, 2], [2, 2, 2, 2, 1, 1, 1])
    ]
    assert choose_apart(plans, np.array([4.0, 3.0, 2.0, 1.0]), 2, 0.5) == [0, 3]
    assert choose_apart(plans, np.array([4.0, 3.0, 2.0, 1.0]), 4, 0.5) == [0, 3, 2, 1]
    assert choose_apart(plans, np.array([1.0, 1.0, 5.0, 1.0]), 1, 0.5) == [2]


# -- the policy --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def situate(two_rooms: str) -> Callable[..., Situation]:
    """Make the first situation of an episode, for a policy."""
    env: Any = wiw.make("ImageNav-v0", scenes=two_rooms, backend="cpu").unwrapped

    def make(policy: Navigator, episode: int = 0, key: Key = KEY) -> Situation:
        found, _ = env.reset(options={"episode": episode})
        names = ("panorama", "front", "odometry", "depth")
        goal = env.goal
        return Situation(Observation(*(found[name] for name in names)), goal, key, policy.begin(goal, key))

    return make


def noise(seed: int, frames: int) -> NDArray[np.uint8]:
    coarse = np.random.default_rng(seed).integers(0, 256, (frames, 8, 16, 3), np.uint8)
    return coarse.repeat(8, axis=1).repeat(8, axis=2)


def imagine(plans: Any, seed: int, view: str = "panorama") -> list[Rollout]:
    made = []
    for number, plan in enumerate(plans):
        moved = np.cumsum(plan.actions == FORWARD) > 0
        made.append(Rollout(noise(seed + number, len(plan.actions)), ~moved, view))
    return made


def test_a_decision_depends_neither_on_the_batch_nor_on_the_key(situate: Any) -> None:
    policy = tiny_policy()

    def decide(*asked: tuple[int, Key]) -> list[Any]:
        situations = [situate(policy, episode, key) for episode, key in asked]
        policy.observe(situations)
        plans = policy.propose(situations, 3, 6)
        scores = policy.score(situations, plans, [imagine(own, 7) for own in plans])
        return [(*(p.actions.tolist() for p in own), *given) for own, given in zip(plans, scores, strict=True)]

    together = decide((0, Key(0, 0)), (1, Key(0, 1)))
    assert together == [*decide((0, Key(5, 9, 4))), *decide((1, Key(2, 3)))]
    assert len(together[0]) == 6 and together[0] != together[1]


def test_imagined_places_change_the_worth_of_plans_and_are_remembered(situate: Any) -> None:
    policy = tiny_policy()
    situation = situate(policy)
    policy.observe([situation])
    plans = policy.propose([situation], 3, 8)
    assert [len(plans[0]), len(situation.memory.real), situation.memory.imagined] == [3, 1, []]
    ends = [make_candidate(np.zeros(3), plan.actions).poses[-1, :2] for plan in plans[0]]
    assert np.linalg.norm(ends[0] - ends[1]) >= 0.5
    (scores,) = policy.score([situation], plans, [imagine(plans[0], 3)])
    assert not np.allclose(scores, [plan.prior for plan in plans[0]])
    remembered = situation.memory.imagined
    assert len(remembered) >= 1 and {own.trust for own in remembered} == {policy.options.trust}
    places = np.array([own.pose[:2] for own in [*situation.memory.real, *remembered]])
    gaps = np.linalg.norm(places[:, None] - places, axis=2) + 9 * np.eye(len(places))
    assert gaps.min() > policy.options.spacing
    at_end = replace(situation.observation, odometry=remembered[0].pose)
    policy.observe([replace(situation, observation=at_end, executed=tuple(plans[0][0].actions))])
    assert len(situation.memory.imagined) < len(remembered) + 1 and len(situation.memory.real) == 2
    assert all(np.linalg.norm((own.pose - at_end.odometry)[:2]) > 0.4 for own in situation.memory.imagined)


def test_rotation_alone_imagines_nothing(situate: Any) -> None:
    policy = tiny_policy()
    situation = situate(policy)
    policy.observe([situation])
    (plans,) = policy.propose([situation], 3, 8)
    still = [Rollout(noise(1, len(plan.actions)), np.ones(len(plan.actions), bool), "panorama") for plan in plans]
    (scores,) = policy.score([situation], [plans], [still])
    np.testing.assert_allclose(scores, [plan.prior for plan in plans])


def test_front_views_of_perspective_models_count(situate: Any) -> None:
    policy = tiny_policy()
    situation = situate(policy)
    policy.observe([situation])
    (plans,) = policy.propose([situation], 3, 8)
    front = [replace(own, frames=own.frames[:, :, 32:96], view="front") for own in imagine(plans, 4)]
    policy.score([situation], [plans], [front])
    assert len(situation.memory.imagined) > 0


def test_extending_changes_nothing_that_is_known_of_the_real_episode(situate: Any) -> None:
    policy = tiny_policy()
    situation = situate(policy)
    policy.observe([situation])
    policy.propose([situation], 3, 6)
    before = deepcopy(situation.memory)
    there = Observation(np.zeros((576, 1024, 3), np.uint8), situation.observation.front, np.array([0.6, 0.0, 0.4]))
    (plans,) = policy.extend([replace(situation, observation=there)], 3, 6)
    memory: Memory = situation.memory
    assert len(plans) == 3
    np.testing.assert_array_equal(memory.target, before.target)
    assert (len(memory.real), len(memory.imagined)) == (len(before.real), len(before.imagined))
    np.testing.assert_array_equal(memory.grid.free, before.grid.free)


def test_the_agent_keeps_to_its_target_until_another_is_much_better() -> None:
    policy = tiny_policy(loyalty=0.5)
    memory = Memory(None, None)  # type: ignore[arg-type]
    worth = np.zeros(len(CELLS.centres))
    first, second = CELLS.find(np.array([[2.1, 0.1], [-2.1, 0.1]]))
    for value, expected in ((0.9, first), (1.9, first), (2.1, second), (1.9, second), (0.4, first)):
        worth[[first, second]] = 1.0, value
        assert policy._choose_target(memory, CELLS, worth) == expected


@pytest.mark.parametrize("start", [8.7, 12.0])
def test_the_agent_goes_on_beyond_9_m_from_the_start(start: float) -> None:
    """All that it has seen says: straight ahead, 2 to 3 m from here."""
    policy, pose = tiny_policy(), np.array([start, 0.0, 0.0])
    ahead = Evidence(
        pose, np.where(np.abs(np.arange(32) - 15.5) < 2, 0.25, 0.0), np.array([-2.0, -2, 0, 2, 2, 0, -2, -2, -2])
    )
    memory = Memory(None, None, known_floor(side=16.0), [ahead])  # type: ignore[arg-type]
    observation = Observation(np.zeros((576, 1024, 3), np.uint8), np.zeros((480, 480, 3), np.uint8), pose)
    situation = Situation(observation, Goal("imagenav"), KEY, memory)
    (plans,) = policy.propose([situation], 3, 12)
    assert memory.target is not None and np.linalg.norm(memory.target - [start + CENTRES[3], 0.0]) < 0.5
    end = make_candidate(pose, plans[0].actions).poses[-1]
    assert end[0] > start + 1.0 and abs(end[1]) < 0.5


def test_what_the_policy_needs_is_asked_for_in_words(situate: Any) -> None:
    policy = tiny_policy()
    situation = situate(policy)
    blind = replace(situation, observation=replace(situation.observation, depth=None))
    with pytest.raises(ArgumentError, match="navigator builds its map from depth, but the observation has none"):
        policy.observe([blind])
    with pytest.raises(ArgumentError, match="expected a goal image, got none in task ar"):
        policy.begin(Goal("ar", choices=("chair",)), Key(0, 0))
    with pytest.raises(ArgumentError, match="unknown option 'depth'"):
        tiny_policy(depth=3)
    with pytest.raises(ArgumentError, match="doubt: expected a number, got 'much'"):
        tiny_policy(doubt="much")
    for out_of_range, message in (
        ({"patience": 0}, "expected patience above 0, got 0"),
        ({"patience": float("nan")}, "expected patience above 0, got nan"),
        ({"trust": float("inf")}, "expected trust of 0 or more, got inf"),
        ({"spacing": -1}, "expected spacing of 0 or more, got -1"),
        ({"targets": 0}, "targets must be positive, got 0"),
        ({"doubt": 1}, "expected doubt below 1"),
        ({"commitment": 2}, "commitment of at most 1, got .* and 2"),
    ):
        with pytest.raises(ArgumentError, match=rf"policy navigator: .*{message}"):
            tiny_policy(**out_of_range)


@pytest.mark.nightly
def test_runs_of_one_and_of_two_workers_are_equal(tmp_path: Path) -> None:
    save(tmp_path / "weights.safetensors", tiny_network(), CARD)
    options = {"navigator": {"weights": str(tmp_path / "weights.safetensors")}}
    agent = AgentRecipe("navigator", "warp", policy_options=options, depth=2, candidates=2, horizon=4)
    one, two = (
        wiw.evaluate("imagenav", agent, 2, scenes="apartments:val:2", workers=n, progress=False, out=tmp_path / str(n))
        for n in (1, 2)
    )
    assert [episode["metrics"] for episode in one.episodes] == [episode["metrics"] for episode in two.episodes]
