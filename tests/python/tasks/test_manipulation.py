# SPDX-License-Identifier: Apache-2.0
"""The four tasks at the table: their experts, their words, and episodes of them."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw.action import PoseGrid
from wiw.envs.manipulation import ManipulationEnv
from wiw.errors import ArgumentError
from wiw.tabletop.base import PALETTE, REACH, make_action, scatter_places
from wiw.tabletop.workbench import LAMPS, TABLE
from wiw.tasks.imagenav import ImageNav
from wiw.tasks.manipulation import TABLETOP_TASKS, Manipulation

GRID = PoseGrid()


def solve_episode(env: ManipulationEnv, discrete: bool = False) -> dict[str, float]:
    """The result of an episode that its expert plays, asked anew where a plan was not enough."""
    kind, setup = env.table.kind, env.table.setup
    while True:
        plan = kind.plan_expert(env.observation.places, setup.target)
        segment = env.run(GRID.decode(GRID.encode(plan)) if discrete else plan)
        if segment.terminated or segment.truncated:
            return env.result()


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_experts_do_what_they_are_told(name: str, discrete: bool) -> None:
    """These few succeed; `docs/results.md` has 200 tables of each."""
    env = Manipulation(name, seed=7).environment()
    results = []
    for index in range(2):
        env.reset(options={"episode": index})
        assert not env.table.is_success()
        results.append(solve_episode(env, discrete))
    assert all(result["success"] for result in results)
    assert all(result["poses"] <= 15 for result in results)


def test_a_block_that_is_carried_over_its_square_is_not_slid() -> None:
    setup = TABLETOP_TASKS["slide_block"].create_setup(0, 0)
    bench = setup.build_workbench("cpu")
    pose, square = bench.get_pose("block"), bench.get_pose(setup.target)[:2, 3]
    yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
    above, at = pose[:2, 3], ((0.15, 1), (0.03, 0), (0.25, 0))
    for x, y, height, free in (*((*above, *own) for own in at), (*square, 0.25, 0)):
        bench.move_to(make_action(x, y, height, free, yaw))
    assert bench.held_object == "block" and np.abs(bench.get_pose("block")[:2, 3] - square).max() < 0.02
    assert not TABLETOP_TASKS["slide_block"].is_success(bench, setup)
    bench.move_to(make_action(*square, 0.03, 0, yaw))
    assert TABLETOP_TASKS["slide_block"].is_success(bench, setup)


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_another_target_than_the_one_that_is_told_is_no_success(name: str) -> None:
    env = Manipulation(name, seed=3).environment()
    env.reset(options={"episode": 0})
    kind, setup = env.table.kind, env.table.setup
    others = [
        name for name in setup.objects if name not in ("ring", "block") and name not in np.atleast_1d(setup.target)
    ]
    wrong = (others[0],) if isinstance(setup.target, tuple) else others[0]
    for pose in kind.plan_expert(env.observation.places, wrong):
        _, _, done, over, _ = env.step(pose)
        assert not done
        if over:
            break


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_instructions_name_the_target_and_tables_are_functions_of_their_seed(name: str) -> None:
    kind = TABLETOP_TASKS[name]
    for seed, variation in ((0, 0), (1, 1), (2, 7), (3, 19)):
        setup, again = kind.create_setup(seed, variation), kind.create_setup(seed, variation)
        for colour in np.atleast_1d(setup.target):
            assert colour in setup.instruction and colour in setup.objects
        assert setup.instruction == again.instruction and setup.target == again.target
        for (one, here), (other, there) in zip(setup.things, again.things, strict=True):
            assert one.name == other.name
            np.testing.assert_array_equal(here, there)
        moved = [pose for _, pose in kind.create_setup(seed + 100, variation).things]
        assert any(not np.allclose(pose, other) for pose, (_, other) in zip(moved, setup.things, strict=True))


def test_buttons_count_in_their_order() -> None:
    kind = TABLETOP_TASKS["push_buttons"]
    setup = kind.create_setup(5, 2)
    assert len(setup.target) == 3
    for order, right in ((setup.target, True), (setup.target[::-1], False), ((*setup.target, setup.target[0]), False)):
        bench = setup.build_workbench()
        for pose in kind.plan_expert(bench.get_poses(setup.objects), order):
            bench.move_to(pose)
        assert bench.pressed_buttons == order
        assert kind.is_success(bench, setup) is right


def test_rings_light_up_by_the_order_of_pushes_whatever_is_asked() -> None:
    kind = TABLETOP_TASKS["push_buttons"]
    setup = kind.create_setup(5, 2)
    bench = setup.build_workbench()
    dark, before = bench.render_view()["color"].astype(int), bench.fork()
    one, other, third = setup.objects
    order = (third, one, other, third)
    for pose in kind.plan_expert(bench.get_poses(setup.objects), order):
        bench.move_to(pose)
    assert bench.pressed_buttons == order and before.pressed_buttons == ()
    bench.move_to(make_action(0.0, 0.35, 0.35, 0.0))
    lit = bench.render_view()["color"].astype(int)
    changed = np.abs(lit - dark).sum(-1) > 60
    pixels = {}
    for lamp, colour in LAMPS.items():
        alike = lit @ colour / np.linalg.norm(lit, axis=-1) / np.linalg.norm(colour)
        pixels[lamp] = int((changed & (alike > 0.98)).sum())
    assert pixels["lime"] < 20 and pixels["amber"] > 60 and pixels["red"] > 120, pixels


def test_the_environment_is_gymnasiums() -> None:
    env = Manipulation("slide_block").environment(depth=True)
    check_env(env, skip_render_check=True)
    observation, info = env.reset(options={"episode": 2})
    assert observation["front"].shape == (480, 480, 3) and observation["depth"].shape == (480, 480)
    assert info["instruction"] == env.goal.text
    again, _ = env.reset(options={"episode": 2})
    np.testing.assert_array_equal(observation["front"], again["front"])


def test_episodes_end_with_their_actions_and_record_what_was_refused() -> None:
    env = Manipulation("push_buttons", actions=3).environment()
    env.reset(options={"episode": 0})
    far, into = [3.0, 0, 1, np.pi, 0, 0, 1], [0.35, 0.25, TABLE - 0.2, np.pi, 0, 0, 1]
    segment = env.run([far, into, [0.2, 0, 1.1, np.pi, 0, 0, 1], far])
    assert len(segment.executed) == 3 and segment.truncated and not segment.terminated
    assert len(segment.refused) == 2 and segment.path.shape == (4, 3)
    assert env.result() == {"success": 0.0, "actions": 1.0, "poses": 3.0, "refused": 2.0}
    with pytest.raises(ArgumentError, match="finite pose"):
        env.table.bench.move_to([np.nan] * 7)


def test_what_is_no_task_is_named() -> None:
    with pytest.raises(ArgumentError, match="push_buttons, slide_block, insert_peg, stack_cups, got juggle"):
        Manipulation("juggle")
    with pytest.raises(ArgumentError, match="manipulation: actions must be positive, got 0"):
        Manipulation(actions=0)
    with pytest.raises(ArgumentError, match=r"reset\(\) first"):
        Manipulation().environment().step(np.zeros(7))
    names = [episode.info["task"] for episode in Manipulation("slide_block,insert_peg").episodes(4)]
    assert names == ["slide_block", "insert_peg"] * 2


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.integers(1, 4))
def test_things_are_scattered_apart_and_in_reach(key: int, count: int) -> None:
    places = scatter_places(key, count, 0.13)
    assert (places >= REACH[0]).all() and (places <= REACH[1]).all()
    gaps = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(count)
    assert gaps.min() >= 0.13
    with pytest.raises(ArgumentError, match="room"):
        scatter_places(key, 3, 2.0)


def test_the_palette_is_told_apart() -> None:
    colours = np.array(list(PALETTE.values()))
    gaps = np.abs(colours[:, None] - colours).max(-1) + np.eye(len(colours))
    assert gaps.min() >= 0.1 and len(PALETTE) == 19


@pytest.mark.parametrize("seed", [-1, 2**64, 0.5])
def test_a_seed_is_a_whole_number(seed: float) -> None:
    with pytest.raises(ArgumentError, match=r"seed: expected a whole number from 0 to 2\*\*64 - 1"):
        Manipulation(seed=seed)
    with pytest.raises(ArgumentError, match="seed: expected"):
        ImageNav(seed=seed)


def test_an_episode_has_a_number() -> None:
    with pytest.raises(ArgumentError, match="episode: expected a number of 0 or more"):
        Manipulation().episode(-1)
    for number in (-1, 0.5, "1", True, [1]):
        with pytest.raises(ArgumentError, match="reset: expected an episode number, a whole number of at least 0"):
            Manipulation().environment().reset(options={"episode": number})
    with pytest.raises(ArgumentError, match="robot_tcp"):
        Manipulation(robot_tcp="tip")
