# SPDX-License-Identifier: Apache-2.0
"""The map of floor space and the routes over it, against navigation mesh and simulator."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from mapping_tours import Mapped, Tour, add_all, mapped, walk
from numpy.typing import NDArray

from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT, to_trajectory
from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError
from wiw.mapping.alignment import find_wall_azimuth, turn_odometry
from wiw.mapping.occupancy import CELL, OccupancyGrid
from wiw.mapping.openings import name_openings
from wiw.mapping.routes import RADIUS, STEP, find_refused, follow_heading, measure_distances, route
from wiw.mapping.views import CAMERA_HEIGHT, cut_views, measure_camera_height, unproject

SCENES = ["apartments:val/3", "apartments:val/1"]


def make_grid(picture: str) -> OccupancyGrid:
    """A map of a drawing: "." free, "#" occupied, "?" unknown; the first row and column begin at the start."""
    rows = np.array([list(line.strip()) for line in picture.strip().splitlines()])
    return OccupancyGrid(origin=(0, 0), free=rows == ".", occupied=rows == "#", walls=np.zeros(rows.shape, bool))


def navigable(known: Mapped) -> NDArray[np.bool_]:
    """Which cells' middles are on the largest island of the navigation mesh."""
    mesh, shape = known.tour.world.navmesh, known.grid.free.shape
    points = known.tour.to_world(known.grid.to_points(np.argwhere(np.ones(shape, bool)))).astype(np.float32)
    return (np.asarray(mesh.is_navigable(points)) & (np.asarray(mesh.island_of(points)) == 0)).reshape(shape)


# -- the camera --------------------------------------------------------------------------------------------------------


def test_the_camera_of_an_agent_on_the_floor_is_where_its_legs_end() -> None:
    for scene in SCENES:
        for seen in mapped(scene).tour.observations:
            assert measure_camera_height(seen["depth"]) == CAMERA_HEIGHT


def test_an_agent_on_a_coffee_table_maps_the_home_where_it_is() -> None:
    """Navigation meshes lead over low furniture; odometry does not tell, but the floor shows it."""
    here = world("apartments:val/9", "cpu")
    points = here.ground.put_down(here.navmesh.sample(600, 0)).astype(float)
    raised = points[(points[:, 1] > 0.15) & (points[:, 1] < 0.6)]
    assert len(raised) > 2
    for place in raised[:4]:
        seen = here.renderer.panorama(camera_pose(place, 1.0)[None], outputs=("color", "depth"))
        depth, height = seen["depth"][0], CAMERA_HEIGHT + place[1]
        assert measure_camera_height(depth) == pytest.approx(height, abs=0.03)
        views = cut_views(seen["color"][0], depth, np.zeros(3))
        np.testing.assert_allclose(views.T_start_camera[:, 2, 3], height, atol=0.03)
        points = unproject(views, *np.nonzero(views.depth > 0))
        assert points[:, 2].min() > -0.1  # and not as far below the floor as the agent is above it
        grid = OccupancyGrid()
        grid.add(depth, np.zeros(3))
        assert grid.area > 4
        away = measure_distances(grid, np.zeros(3))
        goals = np.argwhere(np.isfinite(away) & (away > 1.2))
        assert len(goals) > 20  # it can step down
        found = route(grid, np.zeros(3), grid.to_points(goals[len(goals) // 2]), 0.2)
        assert found.reached and len(found.actions)


def test_the_agents_own_floor_is_the_level_that_most_area_lies_at() -> None:
    """Even if its level lies between two steps of the histogram, and less of a lower floor is all in one."""
    rows, columns = np.meshgrid(np.arange(288), np.arange(576), indexing="ij")
    pitch, azimuth = np.pi * ((rows + 0.5) / 288 - 0.5), 2 * np.pi * (columns + 0.5) / 576
    noise = np.random.default_rng(0).normal(1, 0.002, rows.shape)
    for edge, lower, expected in ((0.4, 0.32, CAMERA_HEIGHT), (-0.4, 0.32, 1.32), (0.4, 0.0, CAMERA_HEIGHT)):
        near = CAMERA_HEIGHT / np.maximum(np.sin(pitch), 1e-3)
        far = (CAMERA_HEIGHT + lower) / np.maximum(np.sin(pitch), 1e-3)
        ahead = near * np.cos(pitch) * np.cos(azimuth)
        depth = np.where(ahead < edge, near, far)
        depth[depth * np.cos(pitch) > 4] = 0  # the floor ends there
        assert measure_camera_height((depth * noise).astype(np.float32)) == pytest.approx(expected, abs=0.02)


def test_nothing_seen_below_says_nothing_about_the_camera() -> None:
    assert measure_camera_height(np.zeros((64, 128), np.float32)) == CAMERA_HEIGHT
    assert measure_camera_height(np.full((64, 128), np.nan, np.float32)) == CAMERA_HEIGHT
    for height in (1, 2, 15, 63):
        assert measure_camera_height(np.full((height, 2 * height), 3.0, np.float32)) == CAMERA_HEIGHT


# -- the grid ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", SCENES)
def test_where_the_agent_fits_is_where_the_mesh_says(scene: str) -> None:
    known = mapped(scene)
    truth, fits = navigable(known), known.grid.standable
    assert (truth & fits).sum() / fits.sum() > 0.985
    assert (truth & fits).sum() / truth.sum() > 0.75


@pytest.mark.parametrize("scene", SCENES)
def test_each_room_is_one(scene: str) -> None:
    known = mapped(scene)
    rooms = {}
    for room in known.tour.world.scene.rooms:
        low, high = np.asarray(room["bounds"], float)
        cells = np.argwhere(known.grid.known)
        places = known.tour.to_world(known.grid.to_points(cells))
        inside = ((places > low + 0.2) & (places < high - 0.2))[:, [0, 2]].all(axis=1)
        numbers = known.grid.rooms[tuple(cells[inside].T)]
        most = np.bincount(numbers).argmax()
        assert most > 0 and (numbers == most).mean() > 0.85
        rooms[room["name"]] = int(most)
    assert len(set(rooms.values())) == len(rooms)


@pytest.mark.parametrize("scene", SCENES)
def test_openings_are_the_doorways(scene: str) -> None:
    known = mapped(scene)
    doors = [thing for thing in known.tour.things() if thing.category in ("door frame", "passage")]
    entrance = next(thing for thing in known.tour.things() if thing.name == "entrance door")
    inner = [door for door in doors if np.linalg.norm((door.center - entrance.center)[:2]) > 0.5]
    away = np.array([[np.linalg.norm(o.position - d.center[:2]) for o in known.grid.openings] for d in inner])
    assert (away.min(axis=1) < 0.5).mean() >= 0.85
    assert (away.min(axis=0) < 0.5).mean() >= 0.85
    assert all(0.35 <= opening.width <= 3.0 for opening in known.grid.openings)


def test_openings_keep_their_ids() -> None:
    tour, ids = mapped(SCENES[0]).tour, {}
    grid = OccupancyGrid()
    for observation in tour.observations:
        grid.add(observation["depth"], observation["odometry"])
        for opening in grid.openings:
            before = ids.setdefault(opening.id, opening.position)
            assert np.linalg.norm(before - opening.position) < 1.2
            ids[opening.id] = opening.position
    assert len(ids) <= 12


def test_naming_openings_takes_the_nearest() -> None:
    opening = mapped(SCENES[0]).grid.openings[0]
    names = {4: opening.position + np.array([0.1, 0]), 7: opening.position + np.array([0.5, 0])}
    (named,) = name_openings([opening], names)
    assert named.id == 4


def test_frontiers_are_there_at_first_and_shrink() -> None:
    tour = mapped(SCENES[0]).tour
    sizes = [sum(frontier.cells for frontier in add_all(tour, count).grid.frontiers) for count in (1, 30)]
    assert sizes[0] > 2 * sizes[1] and sizes[0] > 20


def test_frontiers_are_free_cells_beside_the_unknown() -> None:
    grid = make_grid("\n".join(["." * 12 + "?" * 12] * 12))
    (frontier,) = grid.frontiers
    assert frontier.cells == 12
    np.testing.assert_allclose(frontier.position, [0.55, 1.15], atol=0.06)
    speck = make_grid("\n".join(["......", "......", "..??..", "......", "......"]))
    assert speck.frontiers == ()


def test_a_look_into_the_unknown_adds_more_than_one_at_what_is_known() -> None:
    tour = mapped(SCENES[0]).tour
    early, late = add_all(tour, 1).grid, mapped(SCENES[0]).grid
    gains = [early.measure_gain(frontier.position) for frontier in early.frontiers]
    assert max(gains) > early.measure_gain(tour.observations[0]["odometry"][:2])
    assert late.measure_gain(tour.observations[0]["odometry"][:2]) < 1.0


def test_gain_counts_what_is_visible_only() -> None:
    grid = make_grid("\n".join(["?" * 40] * 19 + ["?" * 10 + "#" * 20 + "?" * 10] + ["." * 40] * 20))
    middle = np.array([2.5, 2.0])
    assert grid.measure_gain(middle, np.pi, 40.0, 2.0) == 0.0  # behind the wall
    assert grid.measure_gain(middle, 0.0, 90.0, 1.2) == 0.0  # known already
    wide = grid.measure_gain(middle, 0.0, 90.0, 3.0)
    assert 4.0 < wide < np.pi * 9 / 4


def test_the_map_grows_with_the_walk() -> None:
    grid, depth = OccupancyGrid(), np.zeros((64, 128), np.float32)
    depth[32:] = 1.0 / np.sin((np.arange(32) + 0.5) / 64 * np.pi)[:, None]  # an endless floor
    for x in (0.0, 30.0, -25.0):
        grid.add(depth, np.array([x, 0.0, 0.3]))
        assert grid.lookup(grid.free, np.array([[x, 0.0], [x + 1, 0.5]])).all()
    assert grid.lookup(grid.free, np.array([[0.0, 0.0], [12.0, 0.0]])).tolist() == [True, False]


def test_a_refused_step_is_remembered() -> None:
    grid = make_grid("\n".join(["." * 30] * 30))
    grid.mark_blocked(np.array([1.5, 1.5, 0.0]), STEP)
    assert grid.occupied[17, 15] and not grid.standable[16, 15]
    assert not grid.occupied[15, 15]


# -- routes ------------------------------------------------------------------------------------------------------------


def walk_to(tour: Tour, grid: OccupancyGrid, goal: NDArray[np.float64]) -> tuple[int, int]:
    """Walk as an agent does, which plans anew where a step is refused; return refused and all primitives."""
    refused = steps = 0
    while np.linalg.norm(tour.odometry()[:2] - goal) > RADIUS and refused < 9:
        found = route(grid, tour.odometry(), goal)
        for action, expected in zip(found.actions, found.poses[1:], strict=True):
            steps += 1
            if not tour.core.step(int(action)):
                grid.mark_blocked(tour.odometry(), STEP)
                refused += 1
                break
            np.testing.assert_allclose(tour.odometry()[:2], expected[:2], atol=1e-3)
    assert refused < 9
    return refused, steps


@pytest.mark.parametrize("scene", SCENES)
def test_routes_are_short_and_can_be_walked(scene: str) -> None:
    known = mapped(scene)
    tour, mesh = known.tour, known.tour.world.navmesh
    poses = [observation["odometry"] for observation in tour.observations]
    ratios, refused, steps = [], 0, 0
    for index, pose in enumerate(poses):
        goal = poses[(index * 7 + 11) % len(poses)][:2]
        found = route(known.grid, pose, goal)
        assert found.reached and np.linalg.norm(found.poses[-1, :2] - goal) <= RADIUS
        tour.core.reset(tour.to_world(pose[:2]), tour.yaw + pose[2])
        blocked, carried_out = walk_to(tour, copy.deepcopy(known.grid), goal)
        refused, steps = refused + blocked, steps + carried_out
        shortest = float(mesh.geodesic_distance(tour.to_world(pose[:2]), tour.to_world(goal)))
        if shortest > 1.5:
            ratios.append(found.length / shortest)
    assert refused / steps < 0.01
    assert np.mean(ratios) < 1.05 and np.max(ratios) < 1.2


def test_a_route_goes_round_what_is_in_the_way() -> None:
    grid = make_grid("\n".join(["." * 40] * 18 + ["." * 8 + "#" * 32] * 2 + ["." * 40] * 20))
    start, goal = np.array([1.0, 3.0, 0.0]), np.array([3.0, 3.0])
    found = route(grid, start, goal)
    assert found.reached and 4.5 < found.length < 6.0
    cells = grid.to_cells(found.poses)
    assert grid.standable[cells].all()
    np.testing.assert_allclose(found.poses[1:, :2], start[:2] + to_trajectory(found.actions)[:, :2], atol=1e-9)
    assert measure_distances(grid, start)[30, 30] == pytest.approx(found.length, abs=0.6)


def test_a_target_beyond_the_known_is_approached() -> None:
    grid = make_grid("\n".join(["." * 20 + "#" + "?" * 9] * 20))
    found = route(grid, np.array([1.0, 0.5, 0.0]), np.array([1.0, 2.8]))
    assert not found.reached and np.linalg.norm(found.poses[-1, :2] - [1.0, 1.85]) < 0.35


def test_a_route_ends_where_its_target_is_in_sight() -> None:
    """A wall hides the target from the side that is nearer."""
    rows = ["." * 40] * 15 + ["." * 30 + "#" * 1 + "." * 9] * 10 + ["." * 40] * 15
    grid = make_grid("\n".join(rows))
    found = route(grid, np.array([2.0, 2.0, 0.0]), np.array([2.0, 3.6]), radius=1.0)
    line = found.poses[-1, :2] + np.linspace(0, 1, 50)[:, None] * ([2.0, 3.6] - found.poses[-1, :2])
    assert found.reached and not grid.lookup(grid.occupied, line).any()


def test_first_and_radius() -> None:
    grid = make_grid("\n".join(["." * 40] * 40))
    whole = route(grid, np.array([1.0, 1.0, 0.0]), np.array([3.0, 1.0]))
    part = route(grid, np.array([1.0, 1.0, 0.0]), np.array([3.0, 1.0]), first=4)
    assert part.actions.tolist() == [FORWARD] * 4 and not part.reached and len(part.poses) == 5
    assert whole.reached and whole.actions.tolist() == [FORWARD] * 9
    assert len(route(grid, np.array([1.0, 1.0, 0.0]), np.array([3.0, 1.0]), radius=1.0).actions) == 6
    there = route(grid, np.array([1.0, 1.0, 0.0]), np.array([1.1, 1.0]))
    assert there.reached and len(there.actions) == 0


@pytest.mark.parametrize(
    ("azimuth", "expected"),
    [(0.0, []), (np.pi / 2, [TURN_LEFT] * 4), (-0.8, [TURN_RIGHT] * 2), (2 * np.pi + 0.1, []), (-3.3, [TURN_LEFT] * 8)],
)
def test_a_heading_is_turned_to(azimuth: float, expected: list[int]) -> None:
    found = route(make_grid("\n".join(["." * 9] * 9)), np.array([0.45, 0.45, 0.0]), azimuth)
    assert found.actions.tolist() == expected and found.reached


def test_following_a_heading_stops_before_a_wall() -> None:
    grid = make_grid("\n".join(["." * 40] * 20 + ["#" * 40] + ["." * 40] * 19))
    found = follow_heading(grid, np.array([1.0, 2.0, np.pi / 2]), 0.0, 3.0)
    assert found.actions.tolist() == [TURN_RIGHT] * 4 + [FORWARD] * 4 and not found.reached
    assert follow_heading(grid, np.array([1.0, 2.0, 0.0]), 0.0, 0.6).reached


@pytest.mark.parametrize("blocked", [None, 0, 2, 4])
def test_the_step_that_was_refused_is_found(blocked: int | None) -> None:
    actions = [int(a) for a in (FORWARD, FORWARD, FORWARD, TURN_LEFT, FORWARD, FORWARD, TURN_RIGHT)]
    x, y, azimuth = 1.0, -2.0, 0.3
    refused, expected = False, None
    for number, action in enumerate(actions):
        if action == int(FORWARD):
            if number == blocked:
                refused, expected = True, np.array([x, y, azimuth])
            if not refused:
                x, y = x + 0.2 * np.cos(azimuth), y + 0.2 * np.sin(azimuth)
        else:
            azimuth += np.radians(22.5) * (1 if action == int(TURN_LEFT) else -1)
            refused = False
    found = find_refused(np.array([1.0, -2.0, 0.3]), actions, np.array([x, y, azimuth]))
    assert (found is None) == (expected is None)
    assert expected is None or np.allclose(found, expected)


def test_where_all_steps_were_refused_the_first_is_found() -> None:
    actions = [int(a) for a in (TURN_LEFT, FORWARD, FORWARD, TURN_LEFT, FORWARD, TURN_RIGHT)]
    found = find_refused(np.array([1.0, -2.0, 0.3]), actions, np.array([1.0, -2.0, 0.3 + np.radians(22.5)]))
    assert found is not None and np.allclose(found, [1.0, -2.0, 0.3 + np.radians(22.5)])
    assert find_refused(np.zeros(3), [int(TURN_LEFT)] * 2, np.array([0.0, 0.0, np.radians(45)])) is None


@pytest.mark.parametrize("turn_deg", [-40.0, 0.0, 17.0, 44.0])
def test_the_walls_azimuth_is_found_whatever_the_heading(turn_deg: float) -> None:
    tour = walk("apartments:val/3", 4)
    turn = np.radians(turn_deg)
    for observation in tour.observations:
        odometry = observation["odometry"] + np.array([0.0, 0.0, turn])
        # The start's axes are turned from the world's, along which all walls stand, by the start's heading.
        expected = turn - tour.yaw
        found = find_wall_azimuth(observation["depth"], odometry)
        off = (found - expected + np.pi / 4) % (np.pi / 2) - np.pi / 4
        assert abs(np.degrees(off)) < 1.0 and abs(found) <= np.pi / 4
        along = turn_odometry(odometry, found)
        assert np.allclose(np.hypot(*along[:2]), np.hypot(*odometry[:2]))
        assert abs(find_wall_azimuth(observation["depth"], along)) < 1e-6


def test_a_target_of_another_kind_is_refused() -> None:
    with pytest.raises(ArgumentError, match="finite point"):
        route(OccupancyGrid(), np.zeros(3), np.zeros(4))
    with pytest.raises(ArgumentError, match="finite point"):
        route(OccupancyGrid(), np.zeros(3), np.array([np.nan, 0.0]))
    with pytest.raises(ArgumentError, match="or a heading, got nan"):
        route(OccupancyGrid(), np.zeros(3), float("nan"))


def test_cells_and_points_agree() -> None:
    grid = OccupancyGrid()
    points = np.random.default_rng(0).uniform(-5, 5, (100, 2))
    middles = grid.to_points(np.stack(grid.to_cells(points), axis=1))
    assert np.abs(middles - points).max() <= CELL / 2 + 1e-9


def test_a_tour_of_few_places_is_of_the_same_start() -> None:
    few = Tour(SCENES[0], 3)
    np.testing.assert_allclose(few.observations[0]["odometry"], 0.0, atol=1e-9)
