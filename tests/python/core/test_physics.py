# SPDX-License-Identifier: Apache-2.0
"""wiw.physics: the Panda's kinematics against NumPy, solving, paths, grasping, forks, and refusals."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import wiw
from wiw.errors import ArgumentError, FileError
from wiw.physics import (
    PANDA_READY,
    PANDA_TCP,
    Articulation,
    Box,
    ConvexHull,
    Cylinder,
    Gripper,
    InverseKinematics,
    Sphere,
    World,
    panda,
    place,
)

URDF = Path(wiw.__file__).parent / "configs/robots/panda.urdf"
DOWN = (np.pi, 0, 0)
LIMITS = panda().limits
TCP = panda().link_index(PANDA_TCP)

shares = st.lists(st.floats(0, 1), min_size=9, max_size=9).map(np.array)


def within_limits(share: np.ndarray) -> np.ndarray:
    return LIMITS["lower"] + share * (LIMITS["upper"] - LIMITS["lower"])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    skew = (a[:3, :3].T @ b[:3, :3] - b[:3, :3].T @ a[:3, :3]) / 2
    return float(np.arctan2(np.linalg.norm(skew[[2, 0, 1], [1, 2, 0]]), (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2))


def forward_twin(q: np.ndarray) -> dict[str, np.ndarray]:
    """Every link's pose from the numbers in the URDF, by Rodrigues' formula."""
    root = ET.parse(URDF).getroot()
    index = {name: i for i, name in enumerate(panda().joints)}
    joints = {joint.find("child").get("link"): joint for joint in root.iter("joint")}

    def numbers(element: ET.Element | None, key: str) -> list[float]:
        text = "" if element is None else element.get(key, "")
        return [float(x) for x in text.split()] or [0.0] * 3

    def pose(link: str) -> np.ndarray:
        if link not in joints:
            return np.eye(4)
        joint = joints[link]
        origin = place(*numbers(joint.find("origin"), "xyz"), rpy=numbers(joint.find("origin"), "rpy"))
        moved = np.eye(4)
        if joint.get("type") != "fixed":
            axis, value = np.array(numbers(joint.find("axis"), "xyz")), q[index[joint.get("name")]]
            cross = np.cross(np.eye(3), axis)
            if joint.get("type") == "prismatic":
                moved[:3, 3] = value * axis
            else:
                moved[:3, :3] = np.eye(3) + np.sin(value) * cross + (1 - np.cos(value)) * cross @ cross
        return pose(joint.find("parent").get("link")) @ origin @ moved

    return {link.get("name"): pose(link.get("name")) for link in root.iter("link")}


def table_and_arm(cubes: int = 0) -> World:
    world = World()
    world.add_body(Box([1.5, 1.5, 0.1]), T_world_body=place(0.4, z=-0.05), name="table", friction=0.8)
    world.add_articulation(panda())
    world.set_joint_positions(PANDA_READY)
    for i in range(cubes):
        at = place(0.4 + 0.12 * (i % 2), 0.14 * (i // 2) - 0.14, 0.02, rpy=(0, 0, 0.2 * i))
        world.add_body(Box([0.04] * 3), mass=0.1, T_world_body=at, friction=0.8)
    return world


def go(world: World, target: np.ndarray, **options: object) -> None:
    path = world.plan_linear(target, PANDA_TCP, **options)
    assert path.reason == "free" and path.free == 1
    assert world.follow(path)


@given(share=shares)
@settings(max_examples=40, deadline=None)
def test_forward_kinematics_follows_the_description(share: np.ndarray) -> None:
    q = within_limits(share)
    expected = forward_twin(q)
    for link, pose in zip(panda().links, panda().forward_kinematics(q), strict=True):
        assert np.allclose(pose, expected[link], atol=1e-12)


def test_bullet_agrees_on_every_link() -> None:
    world, rng = World(), np.random.default_rng(0)
    world.add_articulation(panda(), place(0.3, -0.2, 0.1, rpy=(0.1, 0.2, 0.3)))
    for _ in range(30):
        world.set_joint_positions(within_limits(rng.random(9)))
        assert np.abs(world.link_poses() - world.simulated_link_poses()).max() < 1e-12


@given(share=shares)
@settings(max_examples=100, deadline=None)
def test_inverse_kinematics_reaches_whatever_can_be_reached(share: np.ndarray) -> None:
    target = panda().forward_kinematics(within_limits(share))[TCP]
    result = InverseKinematics(panda(), PANDA_TCP)(target, PANDA_READY, restarts=200)
    assert result.reached and result.reason == "reached"
    reached = panda().forward_kinematics(result.joints)[TCP]
    assert np.linalg.norm(reached[:3, 3] - target[:3, 3]) < 1e-4 and angle(reached, target) < 1e-3
    assert (result.joints >= LIMITS["lower"]).all() and (result.joints <= LIMITS["upper"]).all()
    assert np.array_equal(result.joints[7:], PANDA_READY[7:])


def test_the_default_restarts_reach_nearly_every_pose_and_repeat_themselves() -> None:
    rng, ik = np.random.default_rng(1), InverseKinematics(panda(), PANDA_TCP)
    targets = [panda().forward_kinematics(within_limits(rng.random(9)))[TCP] for _ in range(1000)]
    results = [ik(target, PANDA_READY) for target in targets]
    assert np.mean([result.reached for result in results]) > 0.995
    again = [ik(target, PANDA_READY) for target in targets]
    assert all(np.array_equal(a.joints, b.joints) for a, b in zip(results, again, strict=True))


def test_inverse_kinematics_says_why_not() -> None:
    ik = InverseKinematics(panda(), PANDA_TCP)
    assert ik(place(3, 0, 0), PANDA_READY).reason == "out of reach"
    inside = ik(place(0, 0, 0.05, rpy=DOWN), PANDA_READY)
    assert not inside.reached and inside.reason in {"joint limits", "not converged"} and inside.attempts == 31
    for bad in (np.full((4, 4), np.nan), np.eye(3), 2 * np.eye(4), np.diag([1, 1, -1, 1])):
        with pytest.raises(ArgumentError):
            ik(bad, PANDA_READY)
    with pytest.raises(ArgumentError, match="panda_hand_tcp"):
        InverseKinematics(panda(), "panda_toe")
    for odd in ({"position_tolerance": np.nan}, {"rotation_tolerance": 0}, {"iterations": 0}, {"restarts": -1}):
        with pytest.raises(ArgumentError, match="inverse kinematics: expected"):
            ik(place(0.5, 0, 0.3, rpy=DOWN), PANDA_READY, **odd)


def test_paths_of_impossible_numbers_are_refused() -> None:
    world, target = table_and_arm(), place(0.5, 0.25, 0.3, rpy=DOWN)
    for odd in ({"step": np.nan}, {"angle_step": 0}, {"tolerance": np.nan}, {"step": 1e-300}):
        with pytest.raises(ArgumentError, match="expected a p"):
            world.plan_linear(target, PANDA_TCP, **odd)
    path = world.plan_linear(target, PANDA_TCP)
    for odd in ({"speed": np.nan}, {"tolerance": np.nan}):
        with pytest.raises(ArgumentError, match="expected a "):
            world.follow(path, **odd)


def test_a_straight_path_is_straight() -> None:
    world = table_and_arm()
    start = world.link_poses()[TCP]
    target = place(0.5, 0.25, 0.3, rpy=(np.pi, 0.3, 1.0))
    path = world.plan_linear(target, PANDA_TCP)
    assert path.reason == "free" and len(path.joints) == path.waypoints
    poses = np.array([panda().forward_kinematics(q)[TCP] for q in path.joints])
    share = np.linspace(0, 1, path.waypoints)
    assert np.allclose(poses[:, :3, 3], start[:3, 3] + share[:, None] * (target - start)[:3, 3], atol=2e-4)
    turned = np.array([angle(start, pose) for pose in poses])
    assert np.allclose(turned, share * angle(start, target), atol=3e-3)
    before = world.snapshot().numbers
    assert world.follow(path) and not np.array_equal(world.snapshot().numbers, before)
    reached = world.link_poses()[TCP]
    assert np.linalg.norm(reached[:3, 3] - target[:3, 3]) < 2e-3 and angle(reached, target) < 5e-3


def test_a_path_ends_where_the_arm_would_touch_something() -> None:
    world = table_and_arm()
    wall = world.add_body(Box([0.02, 0.6, 0.6]), T_world_body=place(0.45, 0, 0.4), name="wall")
    before = world.snapshot().numbers
    path = world.plan_linear(place(0.6, 0, 0.45, rpy=DOWN), PANDA_TCP)
    assert path.reason == "collision" and 0 < path.free < 0.9
    assert wall in (path.contact.a.body, path.contact.b.body) and world.body_name(wall) == "wall"
    assert np.array_equal(world.snapshot().numbers, before)
    assert world.plan_linear(place(0.6, 0, 0.45, rpy=DOWN), PANDA_TCP, allowed=[wall]).reason == "free"
    under = table_and_arm().plan_linear(place(0.4, 0.1, -0.05, rpy=DOWN), PANDA_TCP)
    assert under.reason == "collision" and 0 in (under.contact.a.body, under.contact.b.body)
    assert table_and_arm().plan_linear(place(2, 0, 0.4, rpy=DOWN), PANDA_TCP).reason != "free"


def test_a_cube_is_grasped_carried_and_let_go() -> None:
    world = table_and_arm(cubes=4)
    world.step(24)
    gripper, cube = Gripper(world), 3
    at = world.body_poses()[cube]
    yaw = np.arctan2(at[1, 0], at[0, 0])
    go(world, place(*at[:3, 3] + [0, 0, 0.12], rpy=(np.pi, 0, yaw)))
    go(world, place(*at[:3, 3], rpy=(np.pi, 0, yaw)))
    assert gripper.opening > 0.99 and gripper.held is None
    assert gripper.close() == cube == gripper.held == gripper.find_body_between_fingers()
    assert gripper.opening == pytest.approx(0.5, abs=0.01)
    held = np.linalg.inv(world.link_poses()[TCP]) @ world.body_poses()[cube]
    go(world, place(0.5, 0.1, 0.35, rpy=(np.pi, 0.3, yaw + 0.5)))
    now = np.linalg.inv(world.link_poses()[TCP]) @ world.body_poses()[cube]
    assert np.linalg.norm(now[:3, 3] - held[:3, 3]) < 2e-3 and angle(now, held) < np.radians(2)
    assert gripper.find_body_between_fingers() == cube  # the fingers press on
    others = [i for i in range(1, 5) if i != cube]
    assert np.abs(world.body_velocities()[others]).max() < 0.02
    gripper.open()
    assert gripper.held is None and gripper.opening > 0.95
    world.step(240)
    assert world.body_poses()[cube][2, 3] < 0.1


def test_what_is_held_is_checked_against_the_world_too() -> None:
    world = table_and_arm()
    pole = world.add_body(Box([0.02, 0.02, 0.3]), mass=0.05, T_world_body=place(0.4, 0, 0.15), friction=0.8)
    go(world, place(0.4, 0, 0.28, rpy=DOWN))
    assert Gripper(world).close() == pole
    go(world, place(0.4, 0, 0.4, rpy=DOWN), allowed=[0])
    lower = world.plan_linear(place(0.4, 0, 0.15, rpy=DOWN), PANDA_TCP)
    assert lower.reason == "collision" and {lower.contact.a.body, lower.contact.b.body} == {0, pole}


def test_closing_on_nothing_holds_nothing() -> None:
    world = table_and_arm()
    gripper = Gripper(world)
    assert gripper.close() is None and gripper.opening < 0.02
    gripper.open(0.5)
    assert gripper.opening == pytest.approx(0.5, abs=0.01)
    for bad in (-0.1, 1.1, np.nan):
        with pytest.raises(ArgumentError, match="opening"):
            gripper.open(bad)


def episode(seed: int) -> np.ndarray:
    rng, world = np.random.default_rng(seed), table_and_arm(cubes=4)
    for _ in range(6):
        world.set_joint_targets(within_limits(rng.random(9)))
        world.step(80)
    return world.snapshot().numbers


def test_episodes_repeat_to_the_bit_over_runs_and_threads() -> None:
    first = [episode(seed) for seed in range(3)]
    assert not np.array_equal(first[0], first[1])
    with ThreadPoolExecutor(3) as pool:
        for again in ([episode(seed) for seed in range(3)], list(pool.map(episode, range(3)))):
            assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_a_fork_goes_on_as_the_original_grasping_included() -> None:
    world, rng = table_and_arm(cubes=4), np.random.default_rng(0)
    x, y, z = world.body_poses()[2][:3, 3]
    go(world, place(x, y, z + 0.1, rpy=(np.pi, 0, 0.2)))
    for height in (0.05, 0.0, 0.15):
        fork = world.fork()
        for each in (world, fork):
            each.follow(each.plan_linear(place(x, y, z + height, rpy=(np.pi, 0, 0.2)), PANDA_TCP))
            if height == 0:
                assert Gripper(each).close() == 2
        assert np.array_equal(world.snapshot().numbers, fork.snapshot().numbers)
    state = world.snapshot()
    target = within_limits(rng.random(9))
    ends = []
    for _ in range(2):
        world.restore(state)
        world.set_joint_targets(target)
        world.step(120)
        ends.append(world.snapshot().numbers)
    assert np.array_equal(*ends)


def test_thrown_at_random_targets_the_arm_stays_within_limits_and_out_of_the_table() -> None:
    world, rng = table_and_arm(cubes=4), np.random.default_rng(3)
    for _ in range(15):
        world.set_joint_targets(within_limits(rng.random(9)))
        for _ in range(8):
            world.step(10)
            q = world.joint_positions()
            assert (q > LIMITS["lower"] - 0.05).all() and (q < LIMITS["upper"] + 0.05).all()
            assert np.isfinite(world.snapshot().numbers).all()
            assert (world.link_poses()[: TCP + 1, 2, 3] > -0.06).all()


def test_bad_input_is_refused_and_changes_nothing() -> None:
    world = table_and_arm(cubes=1)
    before = world.snapshot().numbers
    nan = np.full(9, np.nan)
    calls = [
        lambda: world.set_joint_targets(nan),
        lambda: world.set_joint_targets(PANDA_READY[:7]),
        lambda: world.set_joint_targets(PANDA_READY + 5),
        lambda: world.set_joint_positions(nan),
        lambda: world.set_joint_forces(np.full(9, -1.0)),
        lambda: world.set_joint_targets(PANDA_READY, 3),
        lambda: world.plan_linear(place(np.nan), PANDA_TCP),
        lambda: world.plan_linear(place(0.5), "panda_toe"),
        lambda: world.plan_linear(place(0.5), PANDA_TCP, allowed=[99]),
        lambda: world.follow(world.plan_linear(place(0.4, 0, 0.4, rpy=DOWN), PANDA_TCP), speed=2),
        lambda: world.attach("panda_hand", 0),
        lambda: world.add_body(Sphere(-1)),
        lambda: world.add_body([]),
        lambda: world.add_body(Box([0.1, 0.1, 0.1]), mass=-1),
        lambda: world.add_body(ConvexHull(np.zeros((5, 3)))),
        lambda: world.add_body(Cylinder(0.1, 0.1), restitution=np.nan),
        lambda: world.restore(World().snapshot()),
        lambda: World(time_step=0),
        lambda: Gripper(world, hand="paw"),
    ]
    for number, call in enumerate(calls):
        with pytest.raises(ArgumentError):
            call()
            pytest.fail(f"call {number} was not refused")
    assert np.array_equal(world.snapshot().numbers, before)


def robot(link: str = "", joint: str = "") -> str:
    return f"""<robot name="r"><link name="a"/><link name="b">{link}</link>
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
      {joint or '<limit lower="-1" upper="1" velocity="1" effort="1"/>'}</joint></robot>"""


MASS = '<inertial><mass value="{}"/><inertia ixx="{}" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'


@pytest.mark.parametrize(
    ("urdf", "error", "words"),
    [
        ("", FileError, "URDF"),
        ("<robot", FileError, "URDF"),
        ("<robot name='x'><link name='a'/><link name='b'/></robot>", FileError, "URDF"),
        (robot(MASS.format(-1, 1)), ArgumentError, "mass"),
        (robot(MASS.format("nan", 1)), FileError, "mass"),
        (robot(MASS.format(1, -5)), ArgumentError, "negative principal moment"),
        (robot(joint='<limit lower="2" upper="1" velocity="1" effort="1"/>'), ArgumentError, "limits of joint 'j'"),
        (robot(joint='<limit lower="0" upper="1" velocity="0" effort="1"/>'), ArgumentError, "limits of joint 'j'"),
        (robot('<collision><geometry><mesh filename="gone.stl"/></geometry></collision>'), FileError, r"gone.stl.*'b'"),
        (robot('<collision><geometry><box size="1 0 1"/></geometry></collision>'), ArgumentError, "box size"),
        (robot().replace("revolute", "planar"), ArgumentError, "not supported"),
    ],
)
def test_descriptions_that_cannot_be_are_refused(urdf: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Articulation.from_text(urdf)


def test_a_missing_description_is_named() -> None:
    with pytest.raises(FileError, match=r"nowhere\.urdf"):
        Articulation("nowhere.urdf")


def test_meshes_are_read_as_their_hulls(tmp_path: Path) -> None:
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    faces = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(f"f {' '.join(map(str, f))}\n" for f in faces)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes/cube.obj").write_text(text)
    mesh = '<mesh filename="package://some_robot/meshes/cube.obj" scale="0.1 0.1 0.1"/>'
    urdf = robot(f"<collision><geometry>{mesh}</geometry></collision>")
    folder = tmp_path / "some_robot"
    (folder / "urdf").mkdir(parents=True)
    (tmp_path / "meshes").rename(folder / "meshes")
    (folder / "urdf/r.urdf").write_text(urdf)
    world = World()
    world.add_articulation(Articulation(folder / "urdf/r.urdf"))
    ball = world.add_body(Sphere(0.05), mass=0.1, T_world_body=place(0.05, 0.05, 0.149))
    contacts = world.contacts()
    assert contacts and contacts[0].distance == pytest.approx(-0.001, abs=2e-4)
    assert {contacts[0].a.body, contacts[0].b.body} == {ball, -1}
    (folder / "meshes/cube.obj").write_bytes(b"\0" * 64)
    with pytest.raises(FileError, match=r"cube.obj.*'b'"):
        Articulation(folder / "urdf/r.urdf")


def test_the_real_description_is_the_same_arm(franka_urdf: Path) -> None:
    real, rng = Articulation(franka_urdf), np.random.default_rng(0)
    assert real.joints == panda().joints
    for _ in range(20):
        q = within_limits(rng.random(9))
        ours = dict(zip(panda().links, panda().forward_kinematics(q), strict=True))
        for link, pose in zip(real.links, real.forward_kinematics(q), strict=True):
            assert np.allclose(pose, ours[link], atol=1e-9)
    for name, mass in zip(real.links, real.masses, strict=True):
        assert mass == pytest.approx(panda().masses[panda().link_index(name)])
    world = World()
    world.add_articulation(real)
    world.set_joint_positions(PANDA_READY)
    world.step(240)
    assert np.abs(world.joint_positions() - PANDA_READY).max() < 1e-3


def tree(*joints: tuple[str, str, str]) -> str:
    """URDF text of links and the joints (parent, child, type) between them."""
    links = dict.fromkeys(link for parent, child, _ in joints for link in (parent, child))
    limit = '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="10" velocity="1"/>'
    named = [
        f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{limit}</joint>'
        for i, (parent, child, kind) in enumerate(joints)
    ]
    return '<robot name="r">' + "".join(f'<link name="{link}"/>' for link in links) + "".join(named) + "</robot>"


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ([("R", "A", "fixed"), ("A", "B", "revolute"), ("B", "A", "revolute")], "above itself"),
        ([("R", "A", "fixed"), ("A", "A", "revolute")], "above itself"),
        ([("R", "A", "fixed"), ("R", "B", "fixed"), ("A", "C", "fixed"), ("B", "C", "fixed")], "two parents"),
        ([(f"l{i}", f"l{i + 1}", "fixed") for i in range(1200)], "at most 1000 links"),
    ],
)
def test_links_that_make_no_tree_are_refused(joints: list[tuple[str, str, str]], words: str) -> None:
    with pytest.raises(ArgumentError, match=words):
        Articulation.from_text(tree(*joints))


def test_nothing_in_the_place_of_an_arm_is_refused() -> None:
    with pytest.raises(TypeError):
        World().add_articulation(None)
    with pytest.raises(TypeError):
        InverseKinematics(None, "x")
    world = World()
    still = world.add_articulation(Articulation.from_text('<robot name="r"><link name="a"/></robot>'))
    world.set_joint_forces(np.zeros(0), still)


def test_a_path_of_another_arm_is_not_followed() -> None:
    world = World()
    world.add_articulation(panda())
    world.set_joint_positions(PANDA_READY)
    other = world.add_articulation(Articulation.from_text(tree(("R", "A", "revolute"))), place(x=3))
    path = world.plan_linear(place(0.5, 0, 0.3, DOWN), PANDA_TCP)
    with pytest.raises(ArgumentError, match="path: expected 1 number"):
        world.follow(path, other)


def test_a_path_that_would_take_for_ever_is_refused() -> None:
    text = tree(("R", "A", "prismatic"))
    for velocity in ("1e-12", "1e-320"):
        world = World(gravity=[0, 0, 0])
        world.add_articulation(Articulation.from_text(text.replace('velocity="1"', f'velocity="{velocity}"')))
        path = world.plan_linear(place(z=0.3), "A")
        with pytest.raises(ArgumentError, match=r"a million time steps .* joint 'j0' would take more"):
            world.follow(path)
        assert world.snapshot().steps == 0 and world.joint_positions() == 0


def test_a_joint_that_mimics_another_is_nothing_to_solve_for() -> None:
    joint = 'name="panda_joint6" type="revolute">'
    text = URDF.read_text()
    assert joint in text
    coupled = Articulation.from_text(text.replace(joint, joint + '<mimic joint="panda_joint4" multiplier="-0.5"/>'))
    with pytest.raises(ArgumentError, match="'panda_joint6' mimics another"):
        InverseKinematics(coupled, PANDA_TCP)


def test_a_snapshot_of_another_world_is_refused_and_changes_nothing() -> None:
    def two(held: bool) -> World:
        world = World(gravity=[0, 0, 0])
        world.add_articulation(Articulation.from_text(tree(("R", "A", "revolute"))))
        for x in (1, 2) if held else (5,):
            world.add_body(Box([0.1] * 3), mass=1, T_world_body=place(x=x))
        if held:
            world.attach("A", 1)
        return world

    ours, theirs = two(False), two(True).snapshot()
    with pytest.raises(ArgumentError, match=r"of another world: expected one of 1 bodies.*got one of 2 bodies"):
        ours.restore(theirs)
    assert ours.body_poses()[0][0, 3] == 5
    ours.fork().step(3)
    boxes = World()  # as many numbers as an arm of eleven joints
    for x in (1, 2):
        boxes.add_body(Box([0.1] * 3), mass=1, T_world_body=place(x=x))
    arm = World()
    arm.add_articulation(Articulation.from_text(tree(*[(f"l{i}", f"l{i + 1}", "revolute") for i in range(11)])))
    with pytest.raises(ArgumentError, match="of another world"):
        arm.restore(boxes.snapshot())


INDICES = [joint["index"] for joint in panda().to_parts()["joints"]]
FIRST, FIXED = INDICES.index(0), INDICES.index(-1)


@pytest.mark.parametrize(
    ("place_of_value", "value", "words"),
    [
        (("joints", FIXED, "mimic"), [0, 1, 0], "mimics joint 0 of 9; expected two movable joints"),
        (("joints", FIRST, "mimic"), [0, 1, 0], "mimics joint 0 of 9; expected two movable joints"),
        (("joints", FIRST, "mimic"), [9, 1, 0], "mimics joint 9 of 9"),
        (("joints", FIRST, "mimic"), [-1, 1, 0], "mimics joint -1 of 9"),
        (("joints", FIRST, "mimic"), [1, np.nan, 0], "a finite multiplier and offset"),
        (("joints", FIRST, "axis"), [0, 0, 0], "to have length 1, got 0"),
        (("joints", FIRST, "axis"), [np.nan, 0, 1], "to have length 1, got nan"),
        (("limits", 0, 0), np.nan, "the limits of joint 'panda_joint1' are impossible"),
        (("limits", 1, 0), -9.0, "the limits of joint 'panda_joint1' are impossible"),
        (("limits", 2, 0), 0.0, "the limits of joint 'panda_joint1' are impossible"),
        (("limits", 3, 0), np.nan, "the limits of joint 'panda_joint1' are impossible"),
        (("links", 1, "mass"), -1.0, "expected a mass of zero or more"),
        (("links", 1, "center"), [np.inf, 0, 0], "a finite centre"),
        (("links", 1, "inertia"), [np.nan] * 9, "finite inertia"),
        (("links", 1, "inertia"), [1, 0, 0, 1, 1, 0, 0, 0, 1], "symmetric inertia"),
        (("links", 1, "inertia"), [-1, 0, 0, 0, 1, 0, 0, 0, 1], "negative principal moment"),
    ],
)
def test_parts_of_impossible_numbers_are_refused(place_of_value: tuple, value: object, words: str) -> None:
    parts = panda().to_parts()
    Articulation.from_parts(parts)
    *outer, last = place_of_value
    inner = parts
    for key in outer:
        inner = inner[key]
    inner[last] = value
    with pytest.raises(ArgumentError, match=f"parts of an articulation: .*{words}"):
        Articulation.from_parts(parts)


def test_what_mimics_is_mimicked_by_none() -> None:
    parts = panda().to_parts()
    movable = [joint for joint in parts["joints"] if joint["index"] >= 0]
    movable[1]["mimic"] = [0, 1, 0]
    Articulation.from_parts(parts)
    movable[2]["mimic"] = [1, 1, 0]
    with pytest.raises(ArgumentError, match="'panda_joint3' mimics joint 1 of 9"):
        Articulation.from_parts(parts)


def test_descriptions_are_read_in_many_threads(tmp_path: Path) -> None:
    (tmp_path / "r.urdf").write_text('<robot name="r"><link name="a"/></robot>')
    code = """
import sys, threading
from wiw.physics import Articulation
sys.setswitchinterval(1e-6)
def read():
    for _ in range(30):
        kept = [Articulation("r.urdf") for _ in range(200)]
threads = [threading.Thread(target=read) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
