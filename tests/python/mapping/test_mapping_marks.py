# SPDX-License-Identifier: Apache-2.0
"""Landmarks within sight, and their numbers in the pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from mapping_tours import Tour, mapped, walk
from numpy.typing import NDArray

from wiw.mapping.landmarks import OPENING_IDS, VISITED, Landmark, LandmarkFinder, draw_opening, find_place_behind
from wiw.mapping.marks import LabelBox, draw_marks, place_labels
from wiw.mapping.object_map import ObjectMap
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.openings import Opening
from wiw.mapping.views import unproject

SHAPE = (120, 160)
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)  # shrinking takes minutes here


def rectangle(left: int, top: int, width: int, height: int) -> NDArray[np.bool_]:
    mask = np.zeros(SHAPE, bool)
    mask[top : top + height, left : left + width] = True
    return mask


def landmark(number: int, masks: dict[int, NDArray[np.bool_]]) -> Landmark:
    return Landmark(number, f"thing {number}", np.zeros(3), masks, 3.0)


def overlaps(one: LabelBox, other: LabelBox) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


shapes = st.tuples(st.integers(0, 150), st.integers(0, 110), st.integers(1, 160), st.integers(1, 120))


@settings(max_examples=60, deadline=None, phases=PHASES)
@given(st.lists(shapes, min_size=1, max_size=15), st.integers(0, 14))
def test_numbers_never_overlap_and_lie_in_the_picture(places: list[tuple[int, int, int, int]], asked: int) -> None:
    masks = {number: rectangle(*place) for number, place in enumerate(places, start=1)}
    boxes = place_labels(masks, [asked])
    for box in boxes.values():
        assert 0 <= box[0] < box[2] <= SHAPE[1] and 0 <= box[1] < box[3] <= SHAPE[0]
    ordered = list(boxes.values())
    assert not any(overlaps(a, b) for i, a in enumerate(ordered) for b in ordered[i + 1 :])
    assert len(boxes) == len(masks)  # there is room for fifteen


@settings(max_examples=60, deadline=None, phases=PHASES)
@given(st.lists(shapes, min_size=1, max_size=12), st.tuples(st.integers(0, 120), st.integers(0, 80)))
def test_no_number_hides_what_is_asked_about(places: list[tuple[int, int, int, int]], corner: tuple[int, int]) -> None:
    masks = {number: rectangle(*place) for number, place in enumerate(places, start=1)}
    masks[99] = rectangle(*corner, 40, 40)
    for number, (left, top, right, bottom) in place_labels(masks, [99]).items():
        covered = int(masks[99][top:bottom, left:right].sum())
        assert covered == 0 or (number == 99 and covered <= 0.2 * 1600)


def test_a_number_stands_in_the_middle_of_a_large_thing_and_beside_a_small_one() -> None:
    boxes = place_labels({1: rectangle(10, 10, 60, 40), 2: rectangle(120, 60, 8, 8)})
    assert abs((boxes[1][0] + boxes[1][2]) / 2 - 40) < 22 and abs((boxes[1][1] + boxes[1][3]) / 2 - 30) <= 3
    left, top, right, bottom = boxes[2]
    assert not rectangle(120, 60, 8, 8)[top:bottom, left:right].any() and abs(left - 124) < 40


def test_a_picture_with_no_room_leaves_numbers_out() -> None:
    masks = {number: np.ones((18, 24), bool) for number in range(1, 9)}
    assert 1 <= len(place_labels(masks)) < 8
    assert place_labels({1: np.zeros((18, 24), bool)}) == {}
    assert place_labels({1: np.ones((4, 4), bool)}) == {}


def test_a_landmark_has_one_number_in_all_views() -> None:
    marks = [
        landmark(7, {0: rectangle(10, 10, 50, 50)}),
        landmark(9, {0: rectangle(90, 60, 60, 50), 2: rectangle(0, 0, 30, 30)}),
    ]
    images = np.full((4, *SHAPE, 3), 127, np.uint8)
    marked = draw_marks(images, marks, asked=[9])
    assert marked.names == {0: {1: "thing 7", 2: "thing 9"}, 1: {}, 2: {2: "thing 9"}, 3: {}}
    assert {number: mark.id for number, mark in marked.landmarks.items()} == {1: 7, 2: 9}
    assert (images == 127).all()
    for view, boxes in marked.boxes.items():
        changed = (marked.images[view] != 127).any(axis=2)
        assert changed.any() == bool(boxes)
        for left, top, right, bottom in boxes.values():
            assert changed[top:bottom, left:right].mean() > 0.9
    edge = marked.images[0][10, 10:60]
    assert (edge != 127).any(axis=1).all()  # the outline


# -- landmarks ---------------------------------------------------------------------------------------------------------


def test_landmarks_are_within_sight_and_where_their_pixels_are() -> None:
    tour = walk()
    objects, grid, finder = ObjectMap(tour.categories), OccupancyGrid(), LandmarkFinder()
    count = 0
    for index, observation in enumerate(tour.observations[:6]):
        views, ids = tour.cut(index)
        owners = objects.add(views, tour.label(ids))
        grid.add(observation["depth"], observation["odometry"])
        for mark in finder.find(views, owners, objects, grid.openings):
            assert mark.masks[mark.view].sum() == max(mask.sum() for mask in mark.masks.values())
            if mark.id > OPENING_IDS:
                continue
            rows, columns = np.nonzero(mark.masks[mark.view])
            points = unproject(views, np.full(len(rows), mark.view), rows, columns)
            assert np.linalg.norm(np.median(points, axis=0) - objects[mark.id].center) < 1.5
            assert mark.category == objects[mark.id].category
            count += 1
    assert count > 20


def test_what_was_visited_is_no_landmark_any_more_but_doors_are() -> None:
    tour = Tour("apartments:val/3", 12)
    objects, grid, finder = ObjectMap(tour.categories), OccupancyGrid(), LandmarkFinder()
    close: set[int] = set()
    doors = 0
    for index, observation in enumerate(tour.observations):
        views, ids = tour.cut(index)
        owners = objects.add(views, tour.label(ids))
        grid.add(observation["depth"], observation["odometry"])
        marks = finder.find(views, owners, objects, grid.openings)
        for mark in marks:
            if mark.category in ("door", "passage", "opening"):
                doors += mark.distance < VISITED
            else:
                assert mark.distance > VISITED and mark.id not in close
        close |= {
            thing.id
            for thing in objects.objects
            if (owners == thing.id).sum() > 2000
            and thing.category not in ("door", "passage")
            and np.linalg.norm(thing.points[:, :2] - observation["odometry"][:2], axis=1).min() <= VISITED
        }
    assert len(close) > 5 and doors > 0


@pytest.mark.parametrize("index", [2, 9, 17])
def test_the_pixels_of_an_opening_show_what_is_behind_it(index: int) -> None:
    known = mapped()
    views, _ = known.tour.cut(index)
    for opening in known.grid.openings:
        for view in range(4):
            rows, columns = np.nonzero(draw_opening(views, view, opening))
            rows, columns = rows[views.depth[view, rows, columns] > 0], columns[views.depth[view, rows, columns] > 0]
            if len(rows) < 300:
                continue
            points = unproject(views, np.full(len(rows), view), rows, columns)
            behind = np.linalg.norm(points - [*views.odometry[:2], 1.0], axis=1)
            nearest = np.linalg.norm(opening.edges - views.odometry[:2], axis=1).min()
            assert (behind > nearest - 0.6).mean() > 0.95


def test_a_way_to_an_opening_leads_through_it() -> None:
    opening = Opening(1, np.array([[2.0, -0.5], [2.0, 0.5]]))
    for pose, behind in (
        ((0.0, 0.3, 0.0), 2.6),
        ((4.0, -1.0, 3.0), 1.4),
        ((1.95, 0.0, 0.0), 2.6),
        ((2.0, 0, 3.1), 1.4),
    ):
        np.testing.assert_allclose(find_place_behind(opening, np.array(pose)), [behind, 0.0], atol=1e-9)


def test_landmarks_say_where_a_way_to_them_leads() -> None:
    known = mapped()
    views, ids = known.tour.cut(2)
    objects = ObjectMap(known.tour.categories)
    owners = objects.add(views, known.tour.label(ids))
    marks = LandmarkFinder().find(views, owners, objects, known.grid.openings)
    kinds = {mark.id > OPENING_IDS for mark in marks}
    assert kinds == {True, False}
    for mark in marks:
        if mark.id > OPENING_IDS:
            assert np.linalg.norm(mark.destination - mark.position[:2]) == pytest.approx(0.6) and mark.radius == 0.25
        else:
            np.testing.assert_array_equal(mark.destination, objects[mark.id].center[:2])
            assert 0.8 < mark.radius == 0.8 + objects[mark.id].extent[:2].min() / 2
