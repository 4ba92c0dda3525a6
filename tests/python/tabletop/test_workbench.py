# SPDX-License-Identifier: Apache-2.0
"""The arm at its table: moves, grasps, mechanisms, forks, and pictures that show the same."""

from __future__ import annotations

import re
from textwrap import dedent

import numpy as np
import pytest
from egl import needs_egl
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from wiw import physics
from wiw.action import PoseGrid
from wiw.errors import ArgumentError
from wiw.physics import Articulation, Box, Capsule, ConvexHull, Cylinder, Sphere, place
from wiw.tabletop.shapes import build_mesh, merge_meshes, paint_mesh
from wiw.tabletop.workbench import CAMERAS, TABLE, Thing, Workbench

DOWN = (np.pi, 0.0, 0.0)
BUTTON = """<robot name="button">
  <link name="base"><visual><geometry><cylinder radius="0.045" length="0.016"/></geometry></visual>
    <collision><geometry><cylinder radius="0.045" length="0.016"/></geometry></collision></link>
  <link name="plate"><inertial><mass value="0.05"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><cylinder radius="0.032" length="0.02"/></geometry></visual>
    <collision><geometry><cylinder radius="0.032" length="0.02"/></geometry></collision></link>
  <joint name="press" type="prismatic"><parent link="base"/><child link="plate"/><origin xyz="0 0 0.02"/>
    <axis xyz="0 0 1"/><limit lower="-0.016" upper="0" effort="5" velocity="1"/></joint></robot>"""


def cube(name: str, colour=(0.8, 0.1, 0.1)) -> Thing:
    return Thing(name, ((Box([0.045] * 3), np.eye(4)),), colour, mass=0.08)


def on_table(x: float, y: float, height: float = 0.045):
    return place(x, y, TABLE + height / 2)


@pytest.fixture
def bench() -> Workbench:
    return Workbench([(cube("red"), on_table(0.1, -0.15)), (cube("green", (0.1, 0.6, 0.2)), on_table(0.2, 0.15))])


def at(x: float, y: float, height: float, gripper: float = 1.0):
    return [x, y, TABLE + height, *DOWN, gripper]


@settings(max_examples=25)
@given(
    st.floats(0.0, 0.3), st.floats(-0.25, 0.25), st.floats(0.15, 0.4), st.floats(-0.4, 0.4), st.sampled_from([0.0, 1.0])
)
def test_it_goes_where_it_is_told(x: float, y: float, height: float, yaw: float, gripper: float) -> None:
    bench = Workbench([])
    wanted = np.array([x, y, TABLE + height, np.pi, 0, yaw, gripper])
    move = bench.move_to(wanted)
    assert move.reason == "free" and move.free == 1
    came = bench.pose
    assert np.linalg.norm(came[:3] - wanted[:3]) < 0.003 and abs(came[6] - gripper) < 0.02
    turned = Rotation.from_euler("xyz", came[3:6]).inv() * Rotation.from_euler("xyz", wanted[3:6])
    assert np.degrees(turned.magnitude()) < 0.6


def test_it_takes_a_cube_and_puts_it_on_another(bench: Workbench) -> None:
    for pose in (at(0.1, -0.15, 0.15), at(0.1, -0.15, 0.02), at(0.1, -0.15, 0.02, 0), at(0.1, -0.15, 0.2, 0)):
        assert bench.move_to(pose).reason == "free"
    assert bench.held_object == "red" and bench.get_pose("red")[2, 3] > TABLE + 0.15
    for pose in (at(0.2, 0.15, 0.2, 0), at(0.2, 0.15, 0.067, 0), at(0.2, 0.15, 0.067), at(0.2, 0.15, 0.2)):
        assert bench.move_to(pose).reason == "free"
    bench.settle()
    red, green = bench.get_pose("red")[:3, 3], bench.get_pose("green")[:3, 3]
    assert bench.held_object is None and np.abs(red - green - (0, 0, 0.045)).max() < 0.006


def test_a_spring_goes_down_under_the_hand_and_comes_back() -> None:
    button = Thing("button", mechanism=Articulation.from_text(BUTTON))
    bench = Workbench([(button, place(0.2, 0.1, TABLE + 0.008))])
    bench.set_spring("button", 4.0)
    bench.settle()
    assert abs(bench.get_joint_positions("button")[0]) < 1e-3
    bench.move_to(at(0.2, 0.1, 0.12, 0))
    bench.move_to(at(0.2, 0.1, 0.028, 0))
    assert bench.get_joint_positions("button")[0] < -0.003
    bench.move_to(at(0.2, 0.1, 0.12, 0))
    bench.settle()
    assert abs(bench.get_joint_positions("button")[0]) < 1e-3


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        ([2.0, 0, 1.0, *DOWN, 1], {"out of reach", "not converged", "joint limits"}),
        (at(0.15, 0.0, -0.1), {"collision"}),
    ],
)
def test_a_way_that_is_not_free_ends_early_and_can_be_left(bench: Workbench, pose, why) -> None:
    move = bench.move_to(pose)
    assert move.reason in why and move.free < 1
    assert bench.pose[2] > TABLE - 0.002
    assert bench.move_to(at(0.15, 0.0, 0.3)).reason == "free"


@pytest.mark.parametrize("pose", [[np.nan] * 7, [0.2, 0, 1, *DOWN, 1.2], [0.2, 0, 1, *DOWN], [0.2, 0, 1, *DOWN, -0.1]])
def test_what_is_no_pose_moves_nothing(bench: Workbench, pose) -> None:
    before = bench.pose
    with pytest.raises(ArgumentError, match="gripper from 0 to 1"):
        bench.move_to(pose)
    np.testing.assert_array_equal(bench.pose, before)


@pytest.mark.parametrize(("seed", "count"), [(5, 10), (7, 4), (15, 2), (33, 3)])
def test_limits_that_joints_push_against_can_be_left(seed: int, count: int) -> None:
    """Poses of someone who knows nothing of the arm; on their way the solver oversteps a limit by some millionths."""
    grid, random, bench = PoseGrid(), np.random.default_rng(seed), Workbench([])
    for _ in range(count):
        numbers = random.random(7) * [100, 100, 100, 120, 120, 120, 2]
        bench.move_to(grid.decode(numbers.astype(int)))
    assert np.isfinite(bench.pose).all()


def test_a_fork_goes_on_as_the_original_does_and_leaves_it_alone(bench: Workbench) -> None:
    bench.move_to(at(0.1, -0.15, 0.15))
    fork = bench.fork()
    plan = [at(0.1, -0.15, 0.02), at(0.1, -0.15, 0.02, 0), at(0.25, 0.0, 0.25, 0)]
    foreseen = fork.render_fronts_after(plan, (120, 120))
    assert bench.held_object is None and fork.held_object == "red"
    truth = [bench.move_to(pose) and bench.render_view("front", (120, 120))["color"] for pose in plan]
    np.testing.assert_array_equal(foreseen, np.stack(truth))
    np.testing.assert_array_equal(bench.pose, fork.pose)
    np.testing.assert_array_equal(bench.get_pose("red"), fork.get_pose("red"))


def test_a_film_shows_every_step_of_the_way_it_goes(bench: Workbench) -> None:
    bench.move_to(at(0.1, -0.15, 0.1))
    before, other = bench.pose, bench.fork()
    move, film = bench.film(at(0.1, -0.15, 0.02, 0))
    assert move == other.move_to(at(0.1, -0.15, 0.02, 0))
    np.testing.assert_array_equal(bench.pose, other.pose)
    np.testing.assert_array_equal(film[0].pose, before)
    np.testing.assert_array_equal(film[-1].pose, bench.pose)
    seconds = np.array([moment.seconds for moment in film])
    np.testing.assert_allclose(np.diff(seconds), 1 / 240)
    assert film[-1].seconds == bench.seconds and bench.held_object == "red"
    heights = [film[i].pose[2] for i in range(0, len(film), 20)]
    assert len(heights) > 5 and heights == sorted(heights, reverse=True)
    with pytest.raises(ArgumentError, match="finite pose"):
        bench.film([np.nan] * 7)
    bench.settle(1)
    assert bench.film(at(0.1, -0.15, 0.1, 0))[1][0].seconds == pytest.approx(seconds[-1] + 1 / 240)


def test_pictures_show_things_where_they_are(bench: Workbench) -> None:
    for camera in CAMERAS:
        assert bench.render_view(camera, (60, 80))["color"].shape == (60, 80, 3)
    before = bench.render_view("front", (240, 240), ("color", "depth", "instance"))
    red = (before["color"].astype(int) @ [1, -1, -1]) > 60
    assert 20 < red.sum() < 400 and len(np.unique(before["instance"][red])) == 1
    eye = np.array(CAMERAS["front"].eye)
    seen = np.linalg.norm(bench.get_pose("red")[:3, 3] - eye)
    assert abs(np.median(before["depth"][red]) / seen - 1) < 0.1
    for pose in (at(0.1, -0.15, 0.15), at(0.1, -0.15, 0.02), at(0.1, -0.15, 0.02, 0), at(0.1, 0.2, 0.3, 0)):
        bench.move_to(pose)
    after = bench.render_view("front", (240, 240))["color"]
    moved = (after.astype(int) @ [1, -1, -1]) > 60
    assert np.argwhere(moved)[:, 1].mean() > np.argwhere(red)[:, 1].mean() + 20
    with pytest.raises(ArgumentError, match="left_shoulder"):
        bench.render_view("behind")


def test_a_picture_without_the_arm_shows_what_is_behind_it(bench: Workbench) -> None:
    bench.move_to(at(0.1, -0.15, 0.15))
    color, bare = (bench.render_view("front", (240, 240), arm=arm)["color"] for arm in (True, False))
    white = (bare.min(axis=-1) > 190) & (color.min(axis=-1) > 190)
    assert (np.abs(color.astype(int) - bare).max(axis=-1) > 8).mean() > 0.03 and white.mean() < 0.005
    np.testing.assert_array_equal(bench.render_view("front", (240, 240))["color"], color)


@needs_egl
@pytest.mark.gpu
@pytest.mark.parametrize("arm", [True, False])
def test_shadows_are_as_fine_on_the_gpu(arm: bool) -> None:
    benches = [Workbench([(cube("red"), on_table(0.1, -0.15))], backend) for backend in ("cpu", "gpu")]
    rays, raster = (bench.render_view("front", (240, 240), arm=arm)["color"].astype(int) for bench in benches)
    assert np.abs(rays - raster).mean() < 0.08 and (np.abs(rays - raster).max(axis=-1) > 15).sum() < 40


def test_names_are_told_apart() -> None:
    with pytest.raises(ArgumentError, match="a name for each thing"):
        Workbench([(cube("one"), on_table(0.1, 0)), (cube("one"), on_table(0.2, 0))])


# -- meshes ------------------------------------------------------------------------------------------------------------

SHAPES = {
    "box": (Box([0.2, 0.3, 0.4]), 0.024),
    "ball": (Sphere(0.2), 4 / 3 * np.pi * 0.008),
    "cylinder": (Cylinder(0.1, 0.5), np.pi * 0.01 * 0.5),
    "capsule": (Capsule(0.1, 0.5), np.pi * 0.01 * 0.5 + 4 / 3 * np.pi * 0.001),
    "hull": (ConvexHull(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])), 1 / 6),
}


@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_meshes_enclose_the_volume_of_their_shape(name: str, rounded: bool) -> None:
    shape, volume = SHAPES[name]
    mesh = build_mesh(shape, rounded)
    corners = mesh["positions"].astype(float)[mesh["triangles"]]
    enclosed = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert enclosed == pytest.approx(volume, rel=0.02)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = mesh["normals"][mesh["triangles"]].mean(axis=1)
    assert ((flat * normals).sum(-1) >= -1e-9).all()
    np.testing.assert_allclose(np.linalg.norm(mesh["normals"], axis=1), 1, atol=1e-5)


def test_broken_edges_keep_measures_and_are_smooth() -> None:
    for shape in (Box([0.2, 0.3, 0.4]), Cylinder(0.1, 0.4)):
        sharp, smooth = build_mesh(shape), build_mesh(shape, rounded=True)
        np.testing.assert_allclose(np.ptp(smooth["positions"], axis=0), np.ptp(sharp["positions"], axis=0), atol=1e-6)
        slanted = (np.abs(smooth["normals"]) > 0.1).sum(axis=1) > 1
        assert slanted.any()
        corners = smooth["positions"][slanted] + 0.02 * smooth["normals"][slanted]
        assert (np.abs(corners).max(axis=1) > 0.1).all()  # edges look outwards


def test_paint_stays_on_its_part() -> None:
    red, blue = paint_mesh(build_mesh(Box([1, 1, 1])), (1, 0, 0)), paint_mesh(build_mesh(Sphere(1)), (0, 0, 1, 0.5))
    both = merge_meshes([(red, np.eye(4)), (blue, place(z=3))])
    assert (both["colors"][:24] == (255, 0, 0, 255)).all() and (both["colors"][24:] == (0, 0, 255, 255)).all()
    assert both["colors"].dtype == np.uint8 and len(both["colors"]) == len(both["positions"])


def test_parts_make_one_mesh_and_other_things_none() -> None:
    both = merge_meshes(
        [(build_mesh(Box([1, 1, 1])), place(z=2)), (build_mesh(Box([1, 1, 1])), place(x=3, rpy=(0, 0, 0.3)))]
    )
    assert len(both["positions"]) == 48 and both["triangles"].max() == 47
    assert both["positions"][:24, 2].min() == pytest.approx(1.5)
    with pytest.raises(ArgumentError, match=r"a shape of wiw\.physics"):
        build_mesh("ball")


@pytest.mark.parametrize("size", [(480, 480), (240, 320)])
def test_cameras_tell_where_points_are_in_their_pictures(size: tuple[int, int]) -> None:
    spots = np.array([[0.0, -0.2, TABLE + 0.02], [0.3, 0.25, TABLE + 0.02], [0.1, 0.1, 1.1]])
    ball = ((Sphere(0.02), np.eye(4)),)
    bench = Workbench([(Thing(f"ball {i}", ball), place(*spot)) for i, spot in enumerate(spots)])
    ids = bench.render_view("front", size, ("instance",))["instance"]
    for at in CAMERAS["front"].project_points(spots, size):
        column, row = np.floor(at).astype(int)
        rows, columns = np.nonzero(ids == ids[row, column])
        assert len(rows) < 400, "no ball is there"
        np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], at, atol=0.7)


def test_ids_in_pictures_have_names(bench: Workbench) -> None:
    ids = bench.render_view("front", (60, 60), ("instance",))["instance"]
    seen = {bench.instance_names[number - 1] for number in np.unique(ids)}
    assert {"table", "arm", "red", "green"} <= seen <= {"table", "floor", "wall", "arm", "red", "green"}


def test_the_wrist_camera_goes_with_the_arm(bench: Workbench) -> None:
    before, fixed = bench.get_camera_pose("wrist"), bench.get_camera_pose("front")
    here = bench.pose
    bench.move_to(np.add(here, [0.05, 0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(
        bench.get_camera_pose("wrist")[:3, 3] - before[:3, 3], bench.pose[:3] - here[:3], atol=1e-3
    )
    np.testing.assert_array_equal(bench.get_camera_pose("front"), fixed)
    assert bench.joints.shape == (9,) and (np.abs(bench.joints[:7]) < 4).all()


def test_the_example_of_the_physics_grasps_its_cube() -> None:
    example = dedent(re.search(r"( {4}world = World.*?\n)\n?$", physics.__doc__, re.DOTALL)[1])
    names = dict(vars(physics))
    exec(example.replace("Gripper(world).close()", "held = Gripper(world).close()"), names)
    assert names["held"] == names["cube"]
