# SPDX-License-Identifier: Apache-2.0
"""Traversals: Algorithm 1 against a slow twin, and the agent's path against the environment's own rules."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import nav_twins as twins
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw._core import env as core_env
from wiw.action import FORWARD, NULL, TURN_LEFT, TURN_RIGHT
from wiw.datasets.cameras import camera_pose
from wiw.errors import ArgumentError
from wiw.nav import Ground, NavMesh
from wiw.render import Renderer
from wiw.scenes import Scene
from wiw.training.navigation_rules import PRESETS, NavigationRules, make_rules
from wiw.training.traversal import (
    HEADINGS,
    TURN_RAD,
    Follower,
    Traversal,
    TraversalSegment,
    choose_islands,
    find_point_ahead,
    measure_coverage,
    plan_scene,
    plan_traversal,
)
from wiw.training.waypoints import Waypoints, find_connected

SMALL = NavigationRules(min_samples=80, density=2, spacing=1.5, leaf_ratio=0.5)
pillars = st.tuples(st.floats(0.5, 6), st.floats(0.5, 4), st.floats(0.2, 2), st.floats(0.2, 2), st.floats(0, 1.5))
shapes = st.lists(pillars, max_size=4)
rules = st.builds(
    NavigationRules,
    min_samples=st.just(80),
    density=st.just(2.0),
    spacing=st.floats(1, 3),
    leaf_ratio=st.sampled_from([0.05, 0.5]),
    visited_radius=st.floats(0.3, 3),
    next_waypoint=st.sampled_from(["nearest", "2m"]),
    max_segment_frames=st.sampled_from([5, 750]),
)


def room(pieces: Any, width: float = 7.0, depth: float = 5.0) -> Scene:
    parts = [twins.floor(0, 0, width, depth)] + [twins.pillar(*piece) for piece in pieces]
    return scene_of(parts)


def scene_of(parts: Any) -> Scene:
    vertices, faces = twins.join(parts)
    return Scene.from_arrays([{"positions": vertices.astype(np.float32), "triangles": faces}])


def two_rooms() -> Scene:
    """Floors of 28 and 20 m2 with nothing in between, and one of 4 m2."""
    return scene_of([twins.floor(0, 0, 7, 4), twins.floor(9, 0, 14, 4), twins.floor(16, 0, 18, 2)])


def compare(left: Traversal, right: Traversal) -> None:
    for one, other in zip(left.segments, right.segments, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name))
    assert (left.dropped, left.coverage, left.north) == (right.dropped, right.coverage, right.north)


# -- what every traversal keeps to -------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(shapes, st.integers(0, 2**32), rules)
def test_actions_lead_an_environment_through_the_recorded_poses(pieces: Any, seed: int, rules: NavigationRules) -> None:
    scene = room(pieces)
    navmesh, ground = NavMesh.build(scene), Ground(scene)
    env = core_env.NavigationEnv(Renderer(scene, "cpu").core, navmesh, ground)
    for traversal in plan_scene(navmesh, "room", seed, 0, rules):
        for segment in traversal.segments:
            yaws = traversal.north + segment.headings * TURN_RAD
            env.reset(segment.positions[0].astype(np.float64), float(yaws[0]))
            for frame, action in enumerate(segment.actions):
                assert action == NULL if frame == 0 else env.step(int(action)), "a recorded action changes the pose"
                stored = camera_pose(ground.put_down(segment.positions[frame]).astype(np.float64), float(yaws[frame]))
                np.testing.assert_allclose(stored, env.T_world_camera, atol=2e-5)


@settings(max_examples=25, deadline=None)
@given(shapes, st.integers(0, 2**32), rules)
def test_a_traversal_is_one_walk_on_one_island(pieces: Any, seed: int, rules: NavigationRules) -> None:
    navmesh = NavMesh.build(room(pieces))
    for traversal in plan_scene(navmesh, "room", seed, 0, rules):
        assert traversal.frames <= rules.max_scene_frames
        before: TraversalSegment | None = None
        for segment in traversal.segments:
            assert navmesh.is_navigable(segment.positions).all()
            assert (navmesh.island_of(segment.positions) == traversal.island).all()
            assert 2 <= len(segment) <= rules.max_segment_frames
            check_motion(segment)
            metres = navmesh.geodesic_distance(segment.positions[-1], segment.waypoint)
            assert (metres <= rules.goal_radius) == (segment.ending == "reached")
            if before is not None:
                np.testing.assert_array_equal(before.positions[-1], segment.positions[0])
                assert before.headings[-1] == segment.headings[0]
            before = segment


def check_motion(segment: TraversalSegment) -> None:
    """Turns turn on the spot by one heading; steps keep the heading and go at most 0.2 m and a cell's rounding."""
    moved = np.linalg.norm(np.diff(segment.positions[:, [0, 2]], axis=0), axis=1)
    turned = (np.diff(segment.headings) + HEADINGS // 2) % HEADINGS - HEADINGS // 2
    actions = segment.actions[1:]
    np.testing.assert_array_equal(turned, (actions == TURN_LEFT).astype(int) - (actions == TURN_RIGHT))
    np.testing.assert_array_equal(moved[actions != FORWARD], 0)
    np.testing.assert_allclose(moved[actions == FORWARD], 0.2, atol=0.011)


@settings(max_examples=20, deadline=None)
@given(shapes, st.integers(0, 2**32), rules)
def test_no_waypoint_within_the_visited_radius_is_gone_to(pieces: Any, seed: int, rules: NavigationRules) -> None:
    navmesh = NavMesh.build(room(pieces))
    (traversal, *_) = plan_scene(navmesh, "room", seed, 0, replace(rules, max_segment_frames=750))
    visited = np.zeros((0, 3), np.float32)
    for segment in traversal.segments:
        if len(visited):
            nearest = navmesh.geodesic_distance(visited, segment.waypoint).min()
            assert nearest >= rules.visited_radius - 1e-3
        visited = np.concatenate([visited, segment.positions])
    if traversal.segments and not any(segment.ending == "cap" for segment in traversal.segments):
        left = [each for each in traversal.waypoints if not is_visited(navmesh, visited, each, rules)]
        assert len(left) <= traversal.dropped, "a traversal ends when all waypoints are visited or dropped"


def is_visited(navmesh: NavMesh, positions: Any, waypoint: Any, rules: NavigationRules) -> bool:
    return bool(navmesh.geodesic_distance(positions, waypoint).min() < rules.visited_radius + 1e-3)


@settings(max_examples=10, deadline=None)
@given(shapes, st.integers(0, 2**32))
def test_the_same_seed_gives_the_same_traversal(pieces: Any, seed: int) -> None:
    navmesh = NavMesh.build(room(pieces))
    first, again = (plan_scene(navmesh, "room", seed, 0, SMALL) for _ in range(2))
    for left, right in zip(first, again, strict=True):
        compare(left, right)
    others = plan_scene(navmesh, "room", seed, 1, SMALL), plan_scene(navmesh, "other", seed, 0, SMALL)
    assert all(other[0].north != first[0].north for other in others)


# -- the algorithm -----------------------------------------------------------------------------------------------------


def test_waypoints_are_those_of_the_paper() -> None:
    """Samples, scores, order, pruning, removal and ranking anew, in plain loops."""
    navmesh = NavMesh.build(room([(3, 2.5, 2, 1, 0.4)]))
    waypoints = Waypoints(navmesh, 0, 5, SMALL)
    area = navmesh.islands[0].area
    count = max(80, math.floor(2 * area))
    np.testing.assert_array_equal(waypoints.samples, navmesh.sample(count, 5, 0))
    distances = navmesh.distance_matrix(waypoints.samples)
    chosen: list[int] = []
    for index in sorted(range(count), key=lambda i: -leaf_score(distances, i, range(count))):
        if all(distances[index, other] >= SMALL.spacing for other in chosen):
            chosen.append(index)
    assert waypoints.candidates.tolist() == chosen[: math.ceil(0.5 * count)]
    here = waypoints.samples[chosen[2]]
    others = [index for index in chosen if index != chosen[2]]
    assert waypoints.find_next(here, chosen[2]) == min(others, key=lambda i: distances[chosen[2], i])
    waypoints.mark_visited(np.stack([here, waypoints.samples[chosen[0]]]))
    left = [index for index in chosen if min(distances[index, chosen[2]], distances[index, chosen[0]]) >= 0.5]
    assert waypoints.candidates.tolist() == sorted(left, key=lambda i: -leaf_score(distances, i, left))
    waypoints.drop(left[0])
    assert left[0] not in waypoints.candidates and len(waypoints.candidates) == len(left) - 1


def leaf_score(distances: Any, index: int, among: Any) -> float:
    metres = [distances[index, other] for other in among]
    return max(metres) + 1.7 * sum(metres) / (len(metres) - 1)


class OneAlone:
    """A navigation mesh on which no path leads to the third of any points."""

    def __init__(self, navmesh: NavMesh) -> None:
        self._navmesh = navmesh

    def __getattr__(self, name: str) -> Any:
        return getattr(self._navmesh, name)

    def distance_matrix(self, points: Any) -> Any:
        distances = self._navmesh.distance_matrix(points)
        distances[2] = distances[:, 2] = np.inf
        distances[2, 2] = 0
        return distances


def test_a_sample_that_no_path_leads_to_is_left_out() -> None:
    """Now and then one lies on the edge of a wall without thickness."""
    navmesh = NavMesh.build(room([]))
    waypoints = Waypoints(OneAlone(navmesh), 0, 1, SMALL)  # type: ignore[arg-type]
    np.testing.assert_array_equal(waypoints.samples, np.delete(navmesh.sample(80, 1, 0), 2, axis=0))
    assert find_connected(np.array([[0, np.inf, 1], [np.inf, 0, np.inf], [1, np.inf, 0]])).tolist() == [0, 2]


def test_candidates_are_the_most_peripheral_waypoints() -> None:
    navmesh = NavMesh.build(room([]))
    few = Waypoints(navmesh, 0, 5, replace(SMALL, leaf_ratio=0.02))
    assert len(few.candidates) == 2 < len(few.points)
    np.testing.assert_array_equal(few.samples[few.candidates], few.points[:2])


def test_two_metres_are_preferred_where_asked() -> None:
    navmesh = NavMesh.build(room([]))
    waypoints = Waypoints(navmesh, 0, 5, replace(SMALL, next_waypoint="2m"))
    here = waypoints.samples[waypoints.candidates[0]]
    others = waypoints.candidates[1:]
    metres = navmesh.geodesic_distance(waypoints.samples[others], here)
    expected = others[np.argmin(np.abs(metres - 2))]
    assert waypoints.find_next(here, int(waypoints.candidates[0])) == expected


def test_each_large_island_is_traversed_and_small_ones_are_not() -> None:
    navmesh = NavMesh.build(two_rooms())
    assert choose_islands(navmesh, SMALL) == [0, 1]
    assert choose_islands(navmesh, replace(SMALL, min_island_area=40)) == [0]
    traversals = plan_scene(navmesh, "rooms", 0, 0, SMALL)
    assert [each.island for each in traversals] == [0, 1] and all(each.segments for each in traversals)
    assert traversals[0].segments[-1].positions[-1, 0] < 8 < traversals[1].segments[0].positions[0, 0]


def test_frames_are_capped() -> None:
    navmesh = NavMesh.build(two_rooms())
    capped = plan_scene(navmesh, "rooms", 0, 0, replace(SMALL, max_scene_frames=40))
    assert sum(each.frames for each in capped) <= 40
    assert capped[-1].segments[-1].ending == "cap"
    short = plan_traversal(navmesh, 0, 1, replace(SMALL, max_segment_frames=6))
    assert max(map(len, short.segments)) == 6 and short.dropped == 0


def test_a_way_is_searched_for_where_no_heading_near_the_path_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    """The agent finds every waypoint by searching alone, and comes closer each time."""
    navmesh = NavMesh.build(room([(3, 2.5, 2, 1, 0.4)]))
    monkeypatch.setattr(Follower, "_find_step", lambda self, waypoint: None)
    traversal = plan_traversal(navmesh, 0, 1, SMALL)
    assert traversal.dropped == 0 and len(traversal.segments) > 3
    for segment in traversal.segments:
        check_motion(segment)
        assert segment.ending == "reached"
        path = navmesh.geodesic_distance(segment.positions[0], segment.waypoint)
        assert 0.2 * (segment.actions == FORWARD).sum() < 2 * path + 0.4, "turns cost, too"


def test_a_search_that_finds_nothing_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The way back is free, but after so many steps the waypoint is dropped; what was recorded is kept."""
    navmesh = NavMesh.build(room([]))
    monkeypatch.setattr("wiw.training.traversal.SEARCH_STEPS", 30)
    monkeypatch.setattr("wiw.training.traversal.SEARCH_GAIN", 2.0)
    find = Follower._find_step
    monkeypatch.setattr(Follower, "_find_step", lambda self, at: find(self, at) if at[0] < 3 else None)
    traversal = plan_traversal(navmesh, 0, 1, SMALL)
    assert traversal.dropped > 0 and traversal.frames > 20
    assert all(segment.waypoint[0] < 3 for segment in traversal.segments)


def test_a_start_that_no_step_leads_out_of_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first two starts are nooks: the third is taken, and the two are counted."""
    navmesh = NavMesh.build(room([]))
    tried: list[Any] = []
    can_step = Follower.can_step

    def refuse_twice(self: Follower) -> bool:
        tried.append(self.position)
        return len(tried) > 2 and can_step(self)

    monkeypatch.setattr(Follower, "can_step", refuse_twice)
    traversal = plan_traversal(navmesh, 0, 1, SMALL)
    assert traversal.dropped == 2 and traversal.frames > 50
    np.testing.assert_array_equal(traversal.segments[0].positions[0], tried[2])
    for start in tried[:2]:
        assert not any((segment.waypoint == start).all() for segment in traversal.segments)


def test_a_waypoint_that_cannot_be_reached_is_dropped_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """No step is free: nothing is recorded, nothing moves, and every waypoint is counted."""
    navmesh = NavMesh.build(room([]))
    monkeypatch.setattr("wiw.training.traversal.Follower._step_end", lambda self, heading: None)
    traversal = plan_traversal(navmesh, 0, 1, SMALL)
    assert traversal.segments == () and traversal.dropped == len(traversal.waypoints) > 3
    assert traversal.coverage == 0


def test_coverage_is_the_share_of_the_floor_near_the_path() -> None:
    navmesh = NavMesh.build(room([]))
    samples = navmesh.sample(4000, 0, 0)
    at = navmesh.snap(np.array([[3.5, 0, 2.5]], np.float32))
    segment = TraversalSegment(at, np.zeros(1, np.int64), np.zeros(1, np.int8), at[0], "reached")
    disc = np.pi / navmesh.islands[0].area
    assert measure_coverage(navmesh, samples, [segment]) == pytest.approx(disc, rel=0.15)
    assert measure_coverage(navmesh, samples, []) == 0


def test_a_radius_of_three_metres_covers_less_in_fewer_frames() -> None:
    """Six rooms along a corridor: rooms whose waypoint is near the corridor's are never entered."""
    fronts = [(x + 1, 3, x + 3.2, 3.2) for x in (0, 3, 6, 9, 12, 15)]
    between = [(x, 3, x + 0.2, 7) for x in (3, 6, 9, 12, 15)]
    walls = twins.wall_boxes([*fronts, *between])
    navmesh = NavMesh.build(scene_of([twins.floor(0, 1.5, 18, 7), *walls]))
    means = {}
    for name in PRESETS:
        traversals = [plan_scene(navmesh, "rooms", seed, 0, PRESETS[name])[0] for seed in range(10)]
        means[name] = np.mean([[each.coverage, each.frames] for each in traversals], axis=0)
    assert (means["paper"] < means["default"]).all() and means["default"][0] > 0.75, means


@pytest.mark.parametrize(("distance", "expected"), [(0, [0, 0, 0]), (1.5, [1, 0, 0.5]), (9, [1, 1, 2])])
def test_the_point_ahead_is_measured_along_the_path(distance: float, expected: list[float]) -> None:
    path = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [1, 1, 2]], np.float32)
    np.testing.assert_allclose(find_point_ahead(path, distance), expected)


# -- rules -------------------------------------------------------------------------------------------------------------


def test_presets_differ_in_the_visited_radius_alone() -> None:
    default, paper = asdict(make_rules("default")), asdict(make_rules("paper"))
    assert {name for name in default if default[name] != paper[name]} == {"visited_radius"}
    assert (default["visited_radius"], paper["visited_radius"], paper["spacing"]) == (0.5, 3.0, 3.0)
    assert make_rules("paper", {"spacing": 2.0}) == NavigationRules(spacing=2.0, visited_radius=3.0)
    assert make_rules("default", {"spacing": "2e1"}) == NavigationRules(spacing=20.0), "text, to YAML"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spacing": 0.0}, "spacing above 0"),
        ({"density": math.nan}, "density above 0"),
        ({"mean_weight": -1.0}, "mean_weight"),
        ({"visited_radius": 0.2}, "visited_radius above goal_radius"),
        ({"max_segment_frames": 1}, "2 or more"),
        ({"mean_weight": math.nan}, "finite mean_weight"),
        ({"min_island_area": math.inf}, "finite min_island_area"),
        ({"visited_radius": math.nan}, "finite visited_radius"),
        ({"turn_threshold_deg": math.nan}, "turn_threshold_deg from 11.25"),
        ({"spacing": "1e999"}, "spacing above 0"),
        ({"next_waypoint": "far"}, "next_waypoint: expected one of nearest, 2m, got 'far'"),
        ({"spacin": 1.0}, "unknown rule 'spacin'.*Did you mean spacing"),
        ({"spacing": "2m"}, "collect: spacing: expected a number, got '2m'"),
        ({"density": "abc"}, "density: expected a number"),
        ({"density": None}, "density: expected a number, got None"),
        ({"spacing": True}, "spacing: expected a number, got True"),
        ({"min_samples": 1.5}, "min_samples: expected a whole number"),
        ({"max_scene_frames": 30.5}, "max_scene_frames: expected a whole number"),
    ],
)
def test_rules_that_cannot_be_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        make_rules("default", options)
    with pytest.raises(ArgumentError, match="default, paper, got large"):
        make_rules("large")
