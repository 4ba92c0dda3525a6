# SPDX-License-Identifier: Apache-2.0
"""What physics owes an arm at its table: the same bits anywhere, nothing passing through anything, no energy from
nowhere, and a state that stays good whatever is asked for.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from locations import PYTHON_TESTS

from wiw.errors import ArgumentError, FileError
from wiw.physics import Box, Sphere, World, place
from wiw.tabletop.robot import load_robot
from wiw.tabletop.tasks import TABLETOP_TASKS
from wiw.tabletop.workbench import TABLE, Film, Thing, Workbench

DOWN = (np.pi, 0.0, 0.0)
WALL = 0.004
"""Metres of a cup's wall, the thinnest thing that is moved at the tables."""


def states(film: Film) -> list[Workbench]:
    return [film[i] for i in range(0, len(film), 4)]


def deepest(bench: Workbench) -> float:
    return max((-contact.distance for contact in bench._world.contacts()), default=0.0)


# -- the same bits everywhere ------------------------------------------------------------------------------------------


def digest() -> str:
    """Of two tables' whole states after their experts' first poses."""
    found = hashlib.sha256()
    for kind in (TABLETOP_TASKS["push_buttons"], TABLETOP_TASKS["stack_cups"]):
        setup = kind.create_setup(11, 3)
        bench = setup.build_workbench()
        for pose in kind.plan_expert(bench.get_poses(setup.objects), setup.target)[:3]:
            bench.move_to(pose)
        found.update(bench._world.snapshot().numbers.tobytes())
    return found.hexdigest()


def test_tables_repeat_to_the_bit_also_in_another_process() -> None:
    path = os.pathsep.join([str(PYTHON_TESTS), *filter(None, sys.path)])
    code = "import test_table_physics as t; print(t.digest())"
    environment = {**os.environ, "PYTHONPATH": path, "WIW_NUM_THREADS": "3"}
    there = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert digest() == digest() == there.stdout.strip()


# -- nothing passes through anything -----------------------------------------------------------------------------------


def test_a_block_is_not_pressed_through_the_table() -> None:
    """Motors that want 2 cm more than there is squeeze so light a thing some millimetres in; it comes out again."""
    block = Thing("block", ((Box([0.045] * 3), np.eye(4)),), mass=0.08)
    bench = Workbench([(block, place(0.2, 0.0, TABLE + 0.0225))])
    bench.move_to([0.2, 0, TABLE + 0.1, *DOWN, 0])
    _, film = bench.film([0.2, 0, TABLE + 0.025, *DOWN, 0])
    heights = [state.get_pose("block")[2, 3] - TABLE for state in states(film)]
    assert min(heights) > 0.0225 - 0.008 and max(map(deepest, states(film))) < 0.012
    bench.move_to([0.2, 0, TABLE + 0.2, *DOWN, 0])
    bench.settle()
    assert bench.get_pose("block")[2, 3] - TABLE == pytest.approx(0.0225, abs=1e-3)


def test_a_hand_that_swings_through_a_cup_takes_it_along() -> None:
    setup = TABLETOP_TASKS["stack_cups"].create_setup(5, 0)
    cup, _ = setup.things[0]
    bench = Workbench([(cup, place(0.2, 0.0, TABLE))])
    bench.move_to([0.2, -0.3, TABLE + 0.05, *DOWN, 0])
    move, film = bench.film([0.2, 0.3, TABLE + 0.05, *DOWN, 0])
    assert move.reason == "free" and max(map(deepest, states(film))) < WALL / 2
    for state in states(film):
        hand, there = state.pose[:3], state.get_pose(cup.name)[:3, 3]
        assert there[1] > hand[1] - 0.01 or abs(there[0] - hand[0]) > 0.03  # before the fingers, or aside


def test_beads_stay_in_a_cup_at_the_speed_of_a_hand() -> None:
    cup, _ = TABLETOP_TASKS["stack_cups"].create_setup(5, 0).things[0]
    world = World()
    world.add_body(Box([1, 1, 0.1]), T_world_body=place(z=-0.05))
    world.add_body(list(cup.parts))
    for angle in np.linspace(0, 2 * np.pi, 9)[:-1]:
        bead = world.add_body(Sphere(0.004), mass=0.005, T_world_body=place(z=0.03))
        world.set_body_velocity(bead, [np.cos(angle), np.sin(angle), 0, 0, 0, 0])
        for _ in range(60):
            world.step()
            x, y, z = world.body_poses()[bead][:3, 3]
            assert np.hypot(x, y) < 0.045 and z > 0.004
        world.set_body_pose(bead, place(1 + bead, 0, 1))  # out of the others' way


# -- energy ------------------------------------------------------------------------------------------------------------


def test_things_that_fall_on_each_other_only_lose_energy() -> None:
    setup, world = TABLETOP_TASKS["stack_cups"].create_setup(5, 0), World()
    world.add_body(Box([1, 1, 0.1]), T_world_body=place(z=-0.05))
    for level, (cup, _) in enumerate(setup.things):
        at = place(0.01 * level, 0.004 * level, 0.05 + 0.12 * level, rpy=(0.2 * level, 0.1, 0.3))
        world.add_body(list(cup.parts), mass=cup.mass, T_world_body=at, friction=cup.friction)
    mass = setup.things[0][0].mass

    def energy() -> float:
        """Of moving and of height; that of turning is left out, so this may rise by it at most."""
        velocities, heights = world.body_velocities()[1:, :3], world.body_poses()[1:, 2, 3]
        return float(mass * (0.5 * (velocities**2).sum() + 9.81 * heights.sum()))

    before = energy()
    least = before
    for _ in range(48):
        world.step(10)
        assert energy() < least + 0.02 * before
        least = min(least, energy())
    assert np.abs(world.body_velocities()[1:]).max() < 0.02 and energy() < 0.5 * before


# -- whatever is asked for ---------------------------------------------------------------------------------------------


def test_a_task_is_done_after_every_kind_of_bad_input(tmp_path: Path) -> None:
    kind = TABLETOP_TASKS["slide_block"]
    setup = kind.create_setup(21, 1)
    bench = setup.build_workbench()
    before = bench._world.snapshot().numbers
    here = [0.2, 0.0, TABLE + 0.3, *DOWN]
    for bad in ([np.nan] * 7, [*here, 1.01], [*here, -0.5], here, [*here[:6], np.inf], [[*here, 1.0]]):
        with pytest.raises(ArgumentError):
            bench.move_to(bad)
    mesh = '<geometry><mesh filename="gone.stl"/></geometry>'
    (tmp_path / "arm.urdf").write_text(f'<robot name="a"><link name="b"><collision>{mesh}</collision></link></robot>')
    with pytest.raises(FileError, match="gone"):
        bench = Workbench(setup.things, robot=load_robot(tmp_path / "arm.urdf"))
    np.testing.assert_array_equal(bench._world.snapshot().numbers, before)
    for refused in ([3, 0, 1, *DOWN, 1], [0.2, 0.45, TABLE - 0.2, *DOWN, 1], [-0.35, 0, TABLE + 0.1, *DOWN, 0]):
        move = bench.move_to(refused)
        assert move.reason != "free" and move.free < 1
        assert np.isfinite(bench._world.snapshot().numbers).all() and bench.pose[2] > TABLE - 0.002
    bench.move_to([0.0, 0.0, TABLE + 0.4, *DOWN, 1])
    for pose in kind.plan_expert(bench.get_poses(setup.objects), setup.target):
        bench.move_to(pose)
    assert kind.is_success(bench, setup)
