# SPDX-License-Identifier: Apache-2.0
"""Navigation meshes against brute force, geometry known by heart, and themselves."""

import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import nav_twins as twins
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw.errors import ArgumentError, FileError, NavigationError
from wiw.nav import Ground, NavMesh, NavMeshSettings, select_waypoints
from wiw.scenes import Scene

pillars = st.tuples(st.floats(0, 7), st.floats(0, 5), st.floats(0.2, 3), st.floats(0.2, 3), st.floats(0, math.pi / 2))


def room(shapes, width=7.0, depth=5.0):
    parts = [twins.floor(0, 0, width, depth)] + [twins.pillar(*shape) for shape in shapes]
    return NavMesh.from_triangles(*twins.join(parts))


def outline_of(mesh, island=0):
    segments, owner = mesh.outline()
    return segments[owner == island][:, :, [0, 2]]


@pytest.fixture(scope="module")
def obstacle_course():
    return room([(2, 1.5, 0.6, 2.5, 0.3), (4.5, 3.5, 1.5, 0.5, 1.0), (5.5, 1.2, 1, 1, 0.8), (3.2, 4, 0.4, 1.6, 0)])


@pytest.fixture(scope="module")
def two_rooms():
    return NavMesh.from_triangles(*twins.join([twins.floor(0, 0, 10, 4), *twins.wall_boxes([(4, -1, 5, 5)])]))


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.lists(pillars, max_size=5), st.integers(0, 2**32))
def test_exact_distances_equal_brute_force(shapes, seed):
    mesh = room(shapes)
    points = mesh.sample(15, seed)
    fast = mesh.distance_matrix(points)
    np.testing.assert_allclose(fast, twins.brute_force_distances(points[:, [0, 2]], outline_of(mesh)), atol=1e-4)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.lists(pillars, max_size=7), st.integers(0, 2**32))
def test_exact_distances_are_a_metric_and_never_longer_than_detour(shapes, seed):
    mesh = room(shapes)
    points = mesh.sample(40, seed)
    exact = mesh.distance_matrix(points)
    assert (exact == exact.T).all() and (np.diag(exact) == 0).all() and np.isfinite(exact).all()
    through = (exact[:, :, None] + exact[None]).min(axis=1)
    assert (exact <= through + 1e-6).all()
    for i in range(0, 40, 2):
        detour = twins.horizontal_length(mesh.shortest_path(points[i], points[i + 1], metric="detour"))
        assert exact[i, i + 1] <= detour + 1e-5


def test_single_queries_paths_and_fields_agree_with_the_matrix(obstacle_course):
    points = obstacle_course.sample(60, 3)
    matrix = obstacle_course.distance_matrix(points)
    np.testing.assert_allclose(obstacle_course.geodesic_distance(points[0], points), matrix[0], atol=1e-9)
    np.testing.assert_allclose(obstacle_course.distances_from(points[0])(points), matrix[0], atol=1e-9)
    np.testing.assert_allclose(obstacle_course.distances_from(points[:3])(points), matrix[:3].min(0), atol=1e-9)
    walls = outline_of(obstacle_course).astype(float)
    for i in range(1, 60):
        path, length = obstacle_course.shortest_path(points[0], points[i], return_length=True)
        assert abs(length - matrix[0, i]) < 1e-9
        assert abs(twins.horizontal_length(path) - length) < 1e-4
        plan = path[:, [0, 2]].astype(float)
        assert all(twins.sees(a, b, walls) for a, b in itertools.pairwise(plan))


def test_ways_to_points_on_walls_and_corners_are_found(obstacle_course):
    segments, owner = obstacle_course.outline()
    ends = segments[owner == 0].reshape(-1, 3)[::2]
    middles = segments[owner == 0].mean(1)
    points = np.concatenate([ends, middles])[:30]
    fast = obstacle_course.distance_matrix(points)
    np.testing.assert_allclose(
        fast, twins.brute_force_distances(points[:, [0, 2]], outline_of(obstacle_course)), atol=1e-4
    )


def test_the_way_around_a_wall_by_hand():
    mesh = NavMesh.from_triangles(*twins.join([twins.floor(0, 0, 8, 8), *twins.wall_boxes([(3, -1, 5, 4)])]))
    # The wall grows by the agent's radius, rounded to cells; a string over its end is the upper hull of its corners.
    corners = np.unique(outline_of(mesh).reshape(-1, 2), axis=0).astype(float)
    end_of_wall = corners[(np.abs(corners[:, 0] - 4) < 1.3) & (corners[:, 1] > 3.5) & (corners[:, 1] < 4.5)]
    hull = []
    for corner in [np.array([1.0, 1.0]), *end_of_wall[np.argsort(end_of_wall[:, 0])], np.array([7.0, 1.0])]:
        while len(hull) > 1 and twins.cross(hull[-1] - hull[-2], corner - hull[-2]) >= 0:
            hull.pop()
        hull.append(corner)
    by_hand = np.linalg.norm(np.diff(hull, axis=0), axis=1).sum()
    assert len(hull) > 3
    assert mesh.geodesic_distance([1, 0.2, 1], [7, 0.2, 1]) == pytest.approx(by_hand, abs=1e-4)


def test_long_ways_have_no_limit():
    lanes, length = 60, 8.0
    gaps = [1 if k % 2 == 0 else -1 for k in range(lanes - 1)]
    walls = [(0.6 + k, gap, 0.8 + k, length + gap) for k, gap in enumerate(gaps)]
    mesh = NavMesh.from_triangles(*twins.join([twins.floor(0, 0, lanes, length), *twins.wall_boxes(walls)]))
    assert mesh.islands[0].polygons > 256
    start, end = mesh.snap([0.3, 0, 0.4]), mesh.snap([lanes - 0.5, 0, 0.4])
    assert mesh.geodesic_distance(start, end, metric="detour") == math.inf
    assert mesh.geodesic_distance(start, end, metric="detour", return_reason=True)[1].startswith("search limit")
    exact = mesh.geodesic_distance(start, end)
    uncapped = twins.horizontal_length(mesh.shortest_path(start, end, metric="detour-uncapped"))
    assert 300 < exact <= uncapped < 1.01 * exact


def test_unreachable_says_why(two_rooms):
    left, right, away = [1, 0.2, 2], [9, 0.2, 2], [60, 0, 0]
    distances, reasons = two_rooms.geodesic_distance(left, [left, right, away], return_reason=True)
    assert distances.tolist() == [0, math.inf, math.inf]
    assert reasons == ["", "other island", "end off mesh"]
    assert two_rooms.geodesic_distance(away, left, return_reason=True)[1] == "start off mesh"
    with pytest.raises(NavigationError, match="other island"):
        two_rooms.shortest_path(left, right)
    assert two_rooms.distances_from(left)([right, away], return_reason=True)[1] == ["other island", "start off mesh"]
    with pytest.raises(NavigationError, match="goal 1 is off the mesh"):
        two_rooms.distances_from([left, away])
    matrix = two_rooms.distance_matrix([left, away, right, left])
    assert np.isinf(matrix[1]).all() and np.isinf(matrix[:, 1]).all()
    assert matrix[0, 3] == 0 and math.isinf(matrix[0, 2])


def test_floors_above_each_other_are_distinct():
    """A ramp turns back above the lower floor: places with one plan position are a long way apart."""
    ramp = twins.quad([[2, 0, 4.2], [2, 0, 6], [10, 3, 6], [10, 3, 4.2]])
    parts = [twins.floor(0, 0, 10, 4), twins.floor(0, 3.9, 2.05, 6), ramp]
    parts += [twins.floor(9.95, 0, 12, 6, 3.0), twins.floor(4, 0, 10, 4, 3.0)]
    mesh = NavMesh.from_triangles(*twins.join(parts))
    low, high = mesh.snap([6, 0.2, 2]), mesh.snap([6, 3.2, 2])
    assert mesh.island_of(low) == mesh.island_of(high)
    length = mesh.geodesic_distance(low, high)
    path = mesh.shortest_path(low, high)
    # Around the ramp's foot at (2, 4) and its head at (10, 4.2), each kept at the agent's distance.
    by_hand = math.hypot(4, 2) + 8 + math.hypot(4, 2)
    assert by_hand < length < by_hand + 1.2
    assert twins.horizontal_length(path) == pytest.approx(length, abs=1e-4)
    climbed = mesh.surface_length(path)
    assert length + 0.3 < climbed < length + 1.5  # 3 m up on 8 m cost hypot(8, 3) - 8 = 0.54 m; voxel steps add some
    assert length <= twins.horizontal_length(mesh.shortest_path(low, high, metric="detour")) + 1e-5


@pytest.mark.parametrize("version", [1, 2])
def test_files_keep_the_mesh(tmp_path, obstacle_course, version):
    obstacle_course.save(tmp_path / "a.navmesh", version=version)
    loaded = NavMesh.load(tmp_path / "a.navmesh")
    points = obstacle_course.sample(30, 0)
    assert (loaded.sample(30, 0) == points).all()
    assert (loaded.distance_matrix(points) == obstacle_course.distance_matrix(points)).all()
    loaded.save(tmp_path / "b.navmesh", version=version)
    assert (tmp_path / "a.navmesh").read_bytes() == (tmp_path / "b.navmesh").read_bytes()
    if version == 2:
        assert loaded.settings == obstacle_course.settings


def test_files_have_habitats_layout(tmp_path, obstacle_course):
    obstacle_course.save(tmp_path / "a.navmesh")
    data = (tmp_path / "a.navmesh").read_bytes()
    magic, version, tiles = np.frombuffer(data, np.int32, 3)
    assert (data[:4], version, tiles) == (b"TESM", 2, 1) and magic == 0x4D534554
    numbers = np.frombuffer(data, np.float32, 13, offset=40)
    np.testing.assert_allclose(numbers, [0.05, 0.2, 1.5, 0.1, 0.2, 45, 20, 20, 12, 1.3, 6, 6, 1], rtol=1e-6)
    assert list(data[92:96]) == [1, 1, 1, 0]
    assert np.frombuffer(data, np.int32, 1, offset=100)[0] == len(data) - 104
    assert data[104:108] == b"VAND"


def test_damaged_files_are_refused_by_name(tmp_path, obstacle_course):
    obstacle_course.save(tmp_path / "good.navmesh")
    good = (tmp_path / "good.navmesh").read_bytes()
    bad = tmp_path / "bad.navmesh"
    cases = {
        b"": "ends inside the header",
        b"glTF" + good[4:]: "TESM",
        good[:4] + b"\x07\0\0\0" + good[8:]: "version 1 or 2, got 7",
        good[:8] + b"\x02\0\0\0" + good[12:]: "expected 1 tile",
        good[:90]: "ends inside the settings",
        good[:-1]: "ends inside the tile",
        good + b"\0": "1 bytes follow",
        good[:104] + b"\0" + good[105:]: "DNAV",
        good[:40] + np.float32(np.nan).tobytes() + good[44:]: "cell_size",
        good[:200] + np.float32(9e-41).tobytes() + good[204:]: "header holds a damaged number",  # of the grid
    }
    for data, cause in cases.items():
        bad.write_bytes(data)
        with pytest.raises(FileError, match=cause) as error:
            NavMesh.load(bad)
        assert "bad.navmesh" in str(error.value)
    with pytest.raises(FileError, match="cannot be opened"):
        NavMesh.load(tmp_path / "missing.navmesh")


def test_samples_are_uniform_over_the_largest_island(two_rooms):
    points = two_rooms.sample(4000, 1)
    low, high = two_rooms.islands[0].bounds
    assert two_rooms.is_navigable(points).all() and (two_rooms.island_of(points) == 0).all()
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 2], bins=4, range=[(low[0], high[0]), (low[2], high[2])])
    assert ((counts - 250) ** 2 / 250).sum() < 37.7  # chi-square, 15 degrees of freedom, p = 0.001
    everywhere = two_rooms.sample(4000, 1, island=None)
    share = (two_rooms.island_of(everywhere) == 0).mean()
    assert share == pytest.approx(two_rooms.islands[0].area / two_rooms.area, abs=0.03)
    assert (two_rooms.sample(9, 5) == two_rooms.sample(9, 5)).all()


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.lists(pillars, max_size=5), st.integers(0, 2**32), st.booleans())
def test_steps_stay_on_the_mesh_and_pass_no_wall(shapes, seed, sliding):
    mesh = room(shapes)
    start = mesh.sample(50, seed)
    wish = start + np.random.default_rng(seed).normal(size=start.shape).astype(np.float32) * [0.6, 0, 0.6]
    end = mesh.try_step(start, wish, sliding=sliding)
    assert mesh.is_navigable(end).all()
    assert (mesh.island_of(end) == mesh.island_of(start)).all()
    walked = np.linalg.norm((end - start)[:, [0, 2]], axis=1)
    asked = np.linalg.norm((wish - start)[:, [0, 2]], axis=1)
    if sliding:  # the end is the reachable point nearest to the wish: never further from it than the start was
        left = np.linalg.norm((end - wish)[:, [0, 2]], axis=1)
        assert (left <= asked + 1e-3).all()
        return
    assert (walked <= asked + 1e-3).all()
    walls = outline_of(mesh).astype(float)
    elsewhere = mesh.island_of(wish) != mesh.island_of(start)  # e.g. on top of a pillar
    assert (walked[elsewhere] == 0).all()
    ways = zip(start[:, [0, 2]], end[:, [0, 2]], wish[:, [0, 2]].astype(float), elsewhere, strict=True)
    for a, b, w, refused in ways:
        if not refused and twins.distance_to_walls(a, walls) > 5e-3:
            assert np.linalg.norm(b - a) == pytest.approx(walked_before_wall(a.astype(float), w, walls), abs=2e-3)


def walked_before_wall(start, end, walls):
    way, side = end - start, walls[:, 1] - walls[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = twins.cross(walls[:, 0] - start, side) / twins.cross(way, side)
        s = twins.cross(walls[:, 0] - start, way) / twins.cross(way, side)
    hits = t[(s >= 0) & (s <= 1) & (t > 0)]
    return min(1.0, hits.min(initial=1.0)) * np.linalg.norm(way)


def test_waypoints_equal_their_definition(obstacle_course):
    distances = obstacle_course.distance_matrix(obstacle_course.sample(200, 2))
    score = distances.max(1) + 1.7 * distances.sum(1) / 199
    chosen = []
    for i in np.argsort(-score, kind="stable"):
        if all(distances[i, j] >= 1.5 for j in chosen):
            chosen.append(i)
    index, scores = select_waypoints(distances, spacing=1.5)
    assert index.tolist() == chosen and len(chosen) > 3
    np.testing.assert_allclose(scores, score[chosen])
    points = obstacle_course.select_waypoints(0, spacing=1.5)
    between = obstacle_course.distance_matrix(points)
    assert between[~np.eye(len(points), dtype=bool)].min() >= 1.5
    with pytest.raises(ArgumentError, match="finite"):
        select_waypoints(np.full((2, 2), math.inf))


def test_queries_from_many_threads_agree(obstacle_course):
    points = obstacle_course.sample(60, 0)
    matrix = obstacle_course.distance_matrix(points)
    detour = obstacle_course.geodesic_distance(points[0], points, metric="detour")

    def ask(i):
        return (
            obstacle_course.geodesic_distance(points[i], points),
            obstacle_course.geodesic_distance(points[0], points, metric="detour"),
            obstacle_course.try_step(points, points[::-1]),
        )

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(ask, range(60)))
    np.testing.assert_allclose([a for a, _, _ in answers], matrix, atol=1e-9)
    assert all((d == detour).all() for _, d, _ in answers)
    assert all((s == answers[0][2]).all() for _, _, s in answers)


def test_shapes_and_arguments(two_rooms):
    one = [1, 0.2, 2]
    assert two_rooms.snap(one).shape == (3,) and two_rooms.snap([one]).shape == (1, 3)
    assert two_rooms.is_navigable(one) is True and isinstance(two_rooms.geodesic_distance(one, one), float)
    assert two_rooms.geodesic_distance([one], one).shape == (1,)
    assert np.isnan(two_rooms.snap([60, 0, 0])).all()
    nothing = np.zeros((0, 3))
    assert two_rooms.snap(nothing).shape == (0, 3) and two_rooms.distance_matrix(nothing).shape == (0, 0)
    triangles, island = two_rooms.triangles()
    sides = triangles[:, 1:] - triangles[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    assert areas.sum() == pytest.approx(two_rooms.area, rel=1e-5)
    assert areas[island == 0].sum() == pytest.approx(two_rooms.islands[0].area, rel=1e-5)
    for call in (
        lambda: two_rooms.sample(1, 0, island=two_rooms.island_of([60, 0, 0])),
        lambda: two_rooms.sample(1, 0, island=len(two_rooms.islands)),
        lambda: two_rooms.surface_length([one, [math.nan] * 3]),
        lambda: two_rooms.select_waypoints(0, density=math.nan, min_samples=10),
        lambda: select_waypoints(np.ones((2, 2)), mean_weight=math.nan),
        lambda: two_rooms.snap([[1, 2]]),
        lambda: two_rooms.geodesic_distance([one] * 2, [one] * 3),
        lambda: two_rooms.geodesic_distance(one, one, metric="euclid"),
        lambda: NavMeshSettings(cell_sise=1),
        lambda: NavMeshSettings(cell_size=-1),
        lambda: NavMesh.from_triangles([[0, 0, 0]], [[0, 0, 1]]),
        lambda: two_rooms.save("/tmp/never.navmesh", version=3),
    ):
        with pytest.raises(ArgumentError):
            call()
    with pytest.raises(TypeError):
        two_rooms.sample(1, 0, island="all")
    found = {two_rooms.island_of(point) for point in two_rooms.sample(400, 0, island=None)}
    assert found == set(range(len(two_rooms.islands)))


def test_the_ground_leaves_points_off_the_mesh_as_they_are(two_rooms):
    vertices, faces = twins.floor(0, 0, 10, 4)
    scene = Scene.from_arrays([{"positions": np.asarray(vertices, np.float32), "triangles": np.asarray(faces)}])
    points = np.array([[1, 0.2, 1], [60, 0.2, 1]], np.float32)
    placed = Ground(scene).put_down(two_rooms.snap(points))
    assert np.isnan(placed[1]).all() and placed[0, 1] == 0


@pytest.mark.parametrize("name", ["nav_test", "dungeon", "small_house"])
def test_real_places(data_dir, name):
    if name == "small_house":
        from wiw import scenes

        mesh = NavMesh.build(scenes.load(data_dir / "small_house" / "worlds" / "small_house.world"))
        assert mesh.islands[0].area == pytest.approx(136, abs=3)
    else:
        mesh = NavMesh.from_triangles(*twins.read_obj(data_dir / "nav" / f"{name}.obj"))
    points = mesh.sample(400, 0)
    exact = mesh.distance_matrix(points)
    assert np.isfinite(exact).all() and (exact == exact.T).all()
    for k in range(0, 400, 8):
        assert (exact <= exact[:, [k]] + exact[[k]] + 1e-6).all()
    pairs = np.random.default_rng(0).integers(0, 400, (600, 2))
    detour = [twins.horizontal_length(mesh.shortest_path(points[a], points[b], metric="detour")) for a, b in pairs]
    excess = np.array(detour) - exact[pairs[:, 0], pairs[:, 1]]
    assert excess.min() > -1e-4
    assert (excess > 0.01).mean() > 0.03  # Detour's own weakness; if it vanished, the two would be one algorithm
