# SPDX-License-Identifier: Apache-2.0
"""What kinds of manipulation task know for a policy: reading, other targets, going on, and how being done looks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from wiw.errors import ArgumentError
from wiw.physics import place
from wiw.tabletop.base import PALETTE, is_holding
from wiw.tabletop.link_meshes import build_link_meshes
from wiw.tabletop.table import Table
from wiw.tabletop.tasks import TABLETOP_TASKS, find_task
from wiw.tabletop.workbench import TABLE, Workbench
from wiw.types import ArmObservation


def observe(bench: Workbench, objects) -> ArmObservation:
    return ArmObservation(bench.render_view()["color"], bench.pose, None, bench.get_poses(objects))


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_instructions_are_read_as_they_are_meant(name: str) -> None:
    kind = TABLETOP_TASKS[name]
    for variation in range(kind.variations):
        setup = kind.create_setup(variation, variation)
        assert find_task(setup.instruction) is kind
        assert kind.parse_target(setup.instruction) == setup.target
        others = kind.list_alternatives(setup.objects, setup.target)
        assert others and setup.target not in others
        for other in others:
            assert kind.parse_target(kind.phrase_instruction(other, variation)) == other


@pytest.mark.parametrize(
    ("text", "said"),
    [("bring me the tea", "about one of button, block, ring, cup"), ("put the ring into the blue cup", "about one of")],
)
def test_instructions_about_nothing_here_are_refused(text: str, said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        find_task(text)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("push_buttons", "push the button", "1 to 3 colours"),
        ("push_buttons", "push the red button, then the red one", "1 to 3 colours"),
        ("stack_cups", "stack the red cup on the blue cup", "names one colour"),
        ("slide_block", "slide the block", "names one colour"),
    ],
)
def test_unreadable_targets_are_refused(name: str, text: str, said: str) -> None:
    with pytest.raises(ArgumentError, match=said):
        TABLETOP_TASKS[name].parse_target(text)


@pytest.mark.parametrize("name", TABLETOP_TASKS)
def test_being_done_is_seen_also_blurred_and_small(name: str) -> None:
    """Every end that is right looks more like it than every end that is not."""
    kind = TABLETOP_TASKS[name]
    right, wrong = [], []
    setup = kind.create_setup(40, 41)
    for target in (setup.target, kind.list_alternatives(setup.objects, setup.target)[0]):
        bench = setup.build_workbench()
        places = bench.get_poses(setup.objects)
        for pose in kind.plan_expert(places, target):
            bench.move_to(pose)
        assert kind.is_success(bench, setup) is (target == setup.target)
        front = bench.render_view()["color"]
        small = cv2.GaussianBlur(cv2.resize(front, (240, 240), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
        scores = [kind.estimate_completion(view, places, setup.target) for view in (front, small)]
        assert all(0 <= score <= 1 for score in scores)
        (right if target == setup.target else wrong).extend(scores)
    assert min(right) > max(wrong) + 0.2 and min(right) > 0.5


@pytest.mark.parametrize("name, cut", [("push_buttons", 5), ("insert_peg", 3), ("stack_cups", 5), ("stack_cups", 9)])
def test_experts_go_on_from_where_things_stand(name: str, cut: int) -> None:
    kind = TABLETOP_TASKS[name]
    setup = kind.create_setup(40, 41)
    bench = setup.build_workbench()
    whole = kind.plan_expert(bench.get_poses(setup.objects), setup.target)
    for pose in whole[:cut]:
        bench.move_to(pose)
    assert not kind.is_success(bench, setup)
    now = observe(bench, setup.objects)
    rest = kind.plan_expert(now.places, kind.find_remaining_target(now, setup.target), now.pose)
    assert len(rest) <= len(whole) - cut + 1
    for pose in rest:
        bench.move_to(pose)
    assert kind.is_success(bench, setup)


def test_what_is_left_of_a_row_of_buttons_shows() -> None:
    kind = TABLETOP_TASKS["push_buttons"]
    setup = kind.create_setup(40, 41)
    assert len(setup.target) == 3
    bench = setup.build_workbench()
    first, *rest = setup.target
    assert kind.find_remaining_target(observe(bench, setup.objects), setup.target) == setup.target
    for pose in kind.plan_expert(bench.get_poses(setup.objects), (first,)):
        bench.move_to(pose)
    now = observe(bench, setup.objects)
    assert kind.find_remaining_target(now, setup.target) == tuple(rest)
    assert kind.find_remaining_target(now, (first,)) is None
    assert kind.find_remaining_target(now, (rest[0], first)) is None


def test_tables_of_buttons_share_what_they_are_made_of() -> None:
    kind = TABLETOP_TASKS["push_buttons"]
    mechanisms = {thing.mechanism for seed in range(40) for thing, _ in kind.create_setup(seed, seed).things}
    assert len(mechanisms) <= len(PALETTE)
    assert build_link_meshes.cache_info().maxsize is not None


def test_what_is_held_is_told_by_the_fingers() -> None:
    ring = np.eye(4)
    hand = np.array([0.0, 0.035, 0.0, np.pi, 0, 0, 0.17])
    assert is_holding(hand, ring)
    assert not is_holding(None, ring)
    for index, value in ((6, 0.0), (6, 1.0), (1, 0.085), (2, 0.1)):
        elsewhere = hand.copy()
        elsewhere[index] = value
        assert not is_holding(elsewhere, ring)


def test_cups_that_are_stacked_are_left() -> None:
    kind = TABLETOP_TASKS["stack_cups"]
    setup = kind.create_setup(40, 41)
    places = dict(zip(setup.objects, [place(0.1, 0.1, TABLE + 0.025 * level) for level in range(3)], strict=True))
    plan = kind.plan_expert(places, setup.target)
    assert plan.shape == (1, 7) and plan[0, 2] > TABLE + 0.15 and plan[0, 6] == 1


@pytest.mark.parametrize("name", sorted(TABLETOP_TASKS))
def test_the_order_of_objects_says_nothing_of_what_is_asked(name: str) -> None:
    task = TABLETOP_TASKS[name]
    for seed in range(3):
        objects = Table(task, task.create_setup(seed, seed)).objects
        assert list(objects) == sorted(objects) and len(objects) > 1
