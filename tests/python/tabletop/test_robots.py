# SPDX-License-Identifier: Apache-2.0
"""Arms from URDF files at the table: what is found in them, what they look like and do, and what is refused."""

from __future__ import annotations

import re
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import wiw
from wiw.errors import ArgumentError, FileError
from wiw.physics import PANDA_READY, Articulation, Box, World, place, read_surface
from wiw.runs.recipes import AgentRecipe
from wiw.tabletop.robot import load_panda, load_robot
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import TABLE, Thing, Workbench
from wiw.tasks.manipulation import Manipulation

OWN = (Path(wiw.__file__).parent / "configs/robots/panda.urdf").read_text()
CUBE = """solid cube
{}
endsolid cube
"""
FACET = "facet normal 0 0 0 outer loop vertex {} {} {} vertex {} {} {} vertex {} {} {} endloop endfacet"


def cube_stl(file: Path, size: float) -> None:
    """An STL whose facets have no normals."""
    corners = [(x, y, z) for x in (0, size) for y in (0, size) for z in (0, size)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
    facets = [FACET.format(*(number for corner in each for number in corners[corner])) for each in triangles]
    file.write_text(CUBE.format("\n".join(facets)))


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """A robot of other names than the Panda's, with a mesh for a hand and a finger that mimics the other."""
    folder = tmp_path / "acme_description"
    (folder / "meshes").mkdir(parents=True)
    (folder / "urdf").mkdir()
    cube_stl(folder / "meshes/hand.stl", 100.0)
    mesh = '<mesh filename="package://acme_description/meshes/hand.stl" scale="0.0006 0.002 0.0006"/>'
    text = OWN.replace('<box size="0.056 0.204 0.05"/>', mesh).replace('"0.95 0.95 0.95 1"', '"0 0.6 0.6 1"')
    text = text.replace("panda_finger_joint", "jaw").replace("panda_", "acme_").replace("hand_tcp", "tool_center")
    end = "</joint>\n</robot>"
    assert text.strip().endswith(end)
    text = text.replace(end, '<mimic joint="jaw1"/>' + end)
    (folder / "urdf/acme.urdf").write_text(text)
    return folder / "urdf/acme.urdf"


def test_another_robot_is_found_its_way_about(other: Path) -> None:
    robot = load_robot(other)
    assert (robot.tcp, robot.hand) == ("acme_tool_center", "acme_hand")
    assert robot.fingers == ("acme_leftfinger", "acme_rightfinger") and robot.finger_joints == ("jaw1", "jaw2")
    tip = robot.description.forward_kinematics(robot.ready_joints)[robot.tool_index]
    usual = load_panda().description.forward_kinematics(PANDA_READY)[load_panda().tool_index]
    np.testing.assert_allclose(tip, usual, atol=2e-3)
    assert robot.ready_joints[-2:] == pytest.approx(0.04)


def test_another_robot_takes_a_cube_and_is_seen(other: Path) -> None:
    cube = Thing("cube", ((Box([0.045] * 3), np.eye(4)),), (0.8, 0.1, 0.1), mass=0.08)
    bench = Workbench([(cube, place(0.15, 0.1, TABLE + 0.0225))], robot=load_robot(other))
    seen = bench.render_view("front", (120, 120))["color"].astype(int)
    teal = (seen[..., 1] > seen[..., 0] + 60) & (np.abs(seen[..., 1] - seen[..., 2]) < 10)
    assert 100 < teal.sum() < 3000
    for height, gripper in ((0.15, 1), (0.02, 1), (0.02, 0), (0.2, 0)):
        assert bench.move_to([0.15, 0.1, TABLE + height, np.pi, 0, 0, gripper]).reason == "free"
    assert bench.held_object == "cube" and bench.get_pose("cube")[2, 3] > TABLE + 0.15


def test_equal_descriptions_are_equal_robots(other: Path, tmp_path: Path) -> None:
    equal, fatter = (shutil.copytree(other.parents[1], tmp_path / name / "acme_description") for name in "ab")
    cube_stl(fatter / "meshes/hand.stl", 101.0)
    assert load_robot(equal / "urdf/acme.urdf").identity == load_robot(other).identity != load_panda().identity
    assert load_robot(fatter / "urdf/acme.urdf").identity != load_robot(other).identity


def test_a_task_names_its_robot(other: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = Manipulation("slide_block", robot=other)
    assert task.describe()["robot"] == load_robot(other).identity
    assert Manipulation("slide_block").describe()["robot"] == {"name": "panda"}
    assert task.set_table(task.episode(0)).bench.robot is task.robot
    monkeypatch.chdir(other.parent)
    assert Manipulation.make_portable({"robot": "acme.urdf"})["robot"] == str(other)
    assert Manipulation.make_portable({"robot": None})["robot"] is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("prismatic", "revolute", r"two fingers slide.*acme_joint1"),
        ("tool_center", "point", r"tcp, grasptarget.*robot_tcp=LINK.*acme_point"),
        ('<axis xyz="0 1 0"/>', '<axis xyz="1 0 0"/>', "the fingers moving along y"),
        ('xyz="0 0 0.1034"', 'xyz="0 0 -0.1034"', "z out of the hand"),
        ('xyz="0 0 0.333"', 'xyz="0 0 3.33"', "where work begins"),
        ('mimic joint="jaw1"', 'mimic joint="jaw2"', "mimics 'jaw2'.*mimics none"),
    ],
)
def test_what_cannot_work_at_the_table_is_refused(other: Path, old: str, new: str, words: str) -> None:
    other.write_text(other.read_text().replace(old, new))
    with pytest.raises(ArgumentError, match=f"(?s){words}"):
        load_robot(other)


def test_a_link_may_be_named_as_the_tool(other: Path) -> None:
    other.write_text(other.read_text().replace("tool_center", "point"))
    robot = load_robot(other, "acme_point")
    assert robot.tcp == "acme_point" and robot.identity["tcp"] == "acme_point"
    with pytest.raises(ArgumentError, match="acme_elbow"):
        load_robot(other, "acme_elbow")
    with pytest.raises(ArgumentError, match="moving along y"):
        load_robot(other, "acme_link8")  # turned by 45 degrees from the hand
    with pytest.raises(ArgumentError, match="'acme_leftfinger' to be fixed to the hand, 'acme_hand', but it moves"):
        load_robot(other, "acme_leftfinger")


@pytest.mark.parametrize("damage", [lambda file: file.unlink(), lambda file: file.write_bytes(b"\0" * 200)])
def test_a_missing_or_damaged_mesh_is_named_with_its_link(other: Path, damage) -> None:
    damage(other.parents[1] / "meshes/hand.stl")
    with pytest.raises(FileError, match=r"hand\.stl.*acme_hand"):
        load_robot(other)


def test_surfaces_of_files_keep_axes_scale_and_colours(tmp_path: Path) -> None:
    cube_stl(tmp_path / "cube.STL", 2.0)
    mesh = read_surface(tmp_path / "cube.STL", scale=(1, 2, -3))
    assert np.ptp(mesh["positions"], axis=0).tolist() == [2, 4, 6] and mesh["positions"][:, 2].max() == 0
    assert len(mesh["triangles"]) == 12 and (mesh["colors"][:, 3] == 0).all()
    np.testing.assert_allclose(np.abs(mesh["normals"]).max(axis=1), 1, atol=1e-6)  # edges of a cube stay edges
    (tmp_path / "a.mtl").write_text("newmtl leaf\nKd 0.1 0.5 0.2\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl leaf\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    leaf = read_surface(tmp_path / "a.obj")
    np.testing.assert_allclose(leaf["colors"], [[0.1, 0.5, 0.2, 1]] * 3, atol=1e-6)
    np.testing.assert_allclose(leaf["normals"], [[0, 0, 1]] * 3, atol=1e-6)


def test_a_joint_that_mimics_goes_where_the_other_is_told_to_go(other: Path) -> None:
    world = World(gravity=(0, 0, 0))
    description = Articulation(other)
    world.add_articulation(description)
    target = world.joint_positions()
    one, two = description.joint_index("jaw1"), description.joint_index("jaw2")
    target[one], target[two] = 0.03, 0.0
    world.set_joint_targets(target)
    assert world.joint_targets()[two] == 0.03
    world.step(240)
    assert world.joint_positions()[[one, two]] == pytest.approx([0.03, 0.03], abs=1e-4)
    target[one] = 0.01
    world.set_joint_positions(target)
    assert world.joint_positions()[two] == 0.01


def test_the_real_description_does_the_work(franka_urdf: Path) -> None:
    robot, kind = load_robot(franka_urdf), TABLETOP_TASKS["insert_peg"]
    setup = kind.create_setup(3, 4)
    bench = setup.build_workbench(robot=robot)
    for pose in kind.plan_expert(bench.get_poses(setup.objects), setup.target):
        bench.move_to(pose)
    assert kind.is_success(bench, setup)
    assert sum(len(mesh["triangles"]) for _, mesh in robot.link_meshes) > 50_000


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 {}
"""
DAE = """<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset/>
<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="a" count="9">0 0 0 1 0 0 0 1 0</float_array>
<technique_common><accessor source="#a" count="{count}" stride="{stride}"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices><triangles count="1">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/>{more}</node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
DEEP = 3000


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("far.ply", PLY.format(99999999), "surface"),
        ("before.ply", PLY.format(-7), "surface"),
        ("stride.dae", DAE.format(count=3, stride=100000, more=""), "damaged"),
        ("count.dae", DAE.format(count=4000000, stride=3, more=""), "damaged"),
        ("itself.dae", DAE.format(count=3, stride=3, more='<instance_node url="#n"/>'), "shows itself"),
        ("deep.dae", DAE.format(count=3, stride=3, more="<node>" * DEEP + "</node>" * DEEP), "too deep"),
        ("normal.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn nan nan nan\nf 1//1 2//1 3//1\n", "normal is not finite"),
    ],
)
def test_a_damaged_mesh_is_named_with_its_link(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(FileError, match=rf"{name}: .*mesh of link 'hand'") as refused:
        read_surface(tmp_path / name, link="hand")
    assert words in str(refused.value) or words == "surface"


@pytest.mark.parametrize("scale", [[1, 0, 1], [1, np.nan, 1]])
def test_a_mesh_keeps_its_extent(tmp_path: Path, scale: list[float]) -> None:
    (tmp_path / "whole.ply").write_text(PLY.format(2))
    assert len(read_surface(tmp_path / "whole.ply")["triangles"]) == 1
    assert len(read_surface(write(tmp_path / "whole.dae", DAE.format(count=3, stride=3, more="")))["triangles"]) == 1
    with pytest.raises(FileError, match="factors of scale"):
        read_surface(tmp_path / "whole.ply", scale=scale)


def write(file: Path, text: str) -> Path:
    """The file, with this in it."""
    file.write_text(text)
    return file


def test_an_arm_that_is_not_seen_leaves_the_things_where_they_are(tmp_path: Path) -> None:
    bare = re.sub(r"<visual>.*?</visual>", "", OWN, flags=re.S)
    setup = TABLETOP_TASKS["push_buttons"].create_setup(3, 0)
    seen, with_own = (
        setup.build_workbench(robot=robot).render_view("front", (120, 120), ("instance",), arm=False)["instance"]
        for robot in (load_robot(write(tmp_path / "bare.urdf", bare)), None)
    )
    np.testing.assert_array_equal(seen, with_own)


def test_a_panda_of_narrower_fingers_works(tmp_path: Path) -> None:
    narrow = write(tmp_path / "narrow.urdf", OWN.replace('upper="0.04"', 'upper="0.035"'))
    assert load_robot(narrow).ready_joints[-2:] == pytest.approx(0.035)
    Manipulation("slide_block", robot=narrow).environment().reset(seed=0)


def test_a_description_that_has_changed_is_another_robot(other: Path) -> None:
    first = load_robot(other)
    assert load_robot(other) is first
    other.write_text(other.read_text().replace("0 0.6 0.6 1", "0.6 0 0 1"))
    assert load_robot(other).identity != first.identity


def test_a_model_that_draws_one_arm_is_refused_with_another(other: Path, tmp_path: Path) -> None:
    task = Manipulation("slide_block", robot=other)
    with pytest.raises(ArgumentError, match="armnet: expected the built-in arm"):
        wiw.evaluate(task, AgentRecipe("scripted", "armnet"), episodes=1, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_bench_and_its_fork_are_drawn_by_two_threads(tmp_path: Path) -> None:
    setup = TABLETOP_TASKS["slide_block"].create_setup(3, 0)
    bench = setup.build_workbench()
    fork = bench.fork()
    fork.move_to([0.15, 0.1, TABLE + 0.1, np.pi, 0, 0, 1])
    alone = [each.render_view("front", (48, 48))["color"] for each in (bench, fork)]
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(2) as pool:
            taken = list(pool.map(lambda k: (bench, fork)[k % 2].render_view("front", (48, 48))["color"], range(120)))
    finally:
        sys.setswitchinterval(usual)
    assert all(np.array_equal(picture, alone[k % 2]) for k, picture in enumerate(taken))
