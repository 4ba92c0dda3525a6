# SPDX-License-Identifier: Apache-2.0
"""The four views, and the map of objects, against the simulator."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mapping_tours import Tour, add_all, mapped, walk
from numpy.typing import NDArray

from wiw.errors import ArgumentError
from wiw.mapping.fragments import VOXEL, cut_depth_steps, find_packable, pack_voxels, split_voxels, unpack_voxels
from wiw.mapping.object_map import ObjectMap
from wiw.mapping.views import (
    HFOV_DEG,
    SIZE,
    VIEW_NAMES,
    VIEW_YAWS_DEG,
    Views,
    cut_labels,
    cut_views,
    place_cameras,
    project,
    unproject,
)

NAMES = ("", "wall", "chair", "cup", "vase", "table")


def labels_of(category: NDArray[np.uint8], confidence: float = 1.0, state: int = 0) -> Any:
    return SimpleNamespace(
        category=category,
        confidence=np.full(category.shape, confidence, np.float32),
        state=np.full(category.shape, state, np.uint8),
    )


def blank_views(odometry: tuple[float, float, float] = (0, 0, 0), away: float = 4.0) -> Views:
    """Nothing but walls `away` metres from each camera."""
    pose = np.array(odometry, float)
    depth = np.full((4, *SIZE), away, np.float32)
    return Views(np.zeros((4, *SIZE, 3), np.uint8), depth, place_cameras(pose), pose)


def add_square(
    views: Views, category: NDArray[np.uint8], kind: int, middle: tuple[float, float, float], half: float
) -> None:
    """Draw a square that faces the cameras, at a place of the start's frame, into each view that shows it."""
    pixels, depth = project(views, np.array([middle]))
    for view in range(4):
        away = depth[view, 0]
        if away <= 0.1:
            continue
        (x, y), reach = pixels[view, 0], half * views.focal / away
        rows = slice(max(0, round(y - reach)), max(0, round(y + reach)))
        columns = slice(max(0, round(x - reach)), max(0, round(x + reach)))
        category[view, rows, columns] = kind
        views.depth[view, rows, columns] = away


# -- views -------------------------------------------------------------------------------------------------------------


def test_views_are_what_a_camera_there_would_draw() -> None:
    tour = walk()
    observation = tour.observations[4]
    tour.observe(tour.to_world(observation["odometry"][:2]), tour.yaw + observation["odometry"][2])
    poses = []
    for yaw in np.radians(VIEW_YAWS_DEG):
        turn = np.eye(4)
        turn[0, 0] = turn[2, 2] = np.cos(yaw)
        turn[0, 2], turn[2, 0] = np.sin(yaw), -np.sin(yaw)
        poses.append(np.asarray(tour.core.T_world_camera) @ turn)
    drawn = tour.world.renderer.perspective(np.stack(poses), SIZE, HFOV_DEG)
    views, ids = tour.cut(4)
    assert (drawn["instance"] == ids).mean() > 0.97
    assert np.median(np.abs(drawn["depth"] - views.depth) / np.maximum(drawn["depth"], 0.1)) < 0.004
    assert np.abs(drawn["color"].astype(int) - views.images).mean() < 4
    for view, pose in enumerate(poses):
        np.testing.assert_allclose(tour.to_start(pose[:3, 3]), views.T_start_camera[view, :3, 3], atol=1e-6)
        np.testing.assert_allclose(tour.axes() @ pose[:3, :3], views.T_start_camera[view, :3, :3], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "place"), [("front", (3, 0)), ("left", (0, 3)), ("right", (0, -3)), ("back", (-3, 0))]
)
def test_each_view_looks_where_its_name_says(name: str, place: tuple[float, float]) -> None:
    pixels, depth = project(blank_views(), np.array([[*place, 1.0], [*place, 1.5]]))
    view = VIEW_NAMES.index(name)
    np.testing.assert_allclose(pixels[view, 0], [SIZE[1] / 2, SIZE[0] / 2], atol=1e-6)
    assert depth[view, 0] == pytest.approx(3.0) and pixels[view, 1, 1] < SIZE[0] / 2  # higher is further up
    panorama = np.zeros((64, 128, 3), np.uint8)
    column = round(64 - np.degrees(np.arctan2(place[1], place[0])) / 360 * 128) % 128
    panorama[30:34, [column - 1, column]] = 255
    views = cut_views(panorama, np.ones((64, 128), np.float32), np.zeros(3))
    assert views.images[:, SIZE[0] // 2, SIZE[1] // 2, 0].argmax() == view


def test_points_come_back_to_their_pixels() -> None:
    views, _ = walk().cut(7)
    random = np.random.default_rng(0)
    view, rows, columns = (random.integers(0, most, 500) for most in (4, *SIZE))
    hit = views.depth[view, rows, columns] > 0
    view, rows, columns = view[hit], rows[hit], columns[hit]
    pixels, depth = project(views, unproject(views, view, rows, columns))
    index = np.arange(len(view))
    np.testing.assert_allclose(depth[view, index], views.depth[view, rows, columns], rtol=1e-5)
    np.testing.assert_allclose(pixels[view, index], np.stack([columns, rows], 1) + 0.5, atol=1e-4)


def test_neighbouring_views_overlap_across_the_seam_too() -> None:
    ids = cut_labels(np.tile(np.arange(1024, dtype=np.uint32), (576, 1)))
    front, left, right, back = (set(view.ravel().tolist()) for view in ids)
    assert front & left and front & right and left & back and right & back
    assert len(front | left | right | back) > 1010


def test_wrong_arrays_are_refused() -> None:
    depth, odometry = np.ones((64, 128), np.float32), np.zeros(3)
    with pytest.raises(ArgumentError, match="panorama of"):
        cut_views(np.zeros((64, 64, 3), np.uint8), depth, odometry)
    with pytest.raises(ArgumentError, match="odometry"):
        cut_views(np.zeros((64, 128, 3), np.uint8), depth, np.array([0, 0, np.nan]))
    with pytest.raises(ArgumentError, match=r"depth float32 \[H, W\]"):
        cut_views(np.zeros((64, 128, 3), np.uint8), depth[None], odometry)


# -- fragments ---------------------------------------------------------------------------------------------------------


def test_voxels_are_packed_without_loss() -> None:
    points = np.random.default_rng(1).uniform(-30, 30, (1000, 3))
    middles = unpack_voxels(pack_voxels(points))
    assert np.abs(middles - points).max() <= VOXEL / 2 + 1e-9


def test_a_step_of_depth_is_cut_and_a_slope_is_not() -> None:
    category = np.ones((1, 40, 60), np.uint8)
    step = np.full(category.shape, 2.0, np.float32)
    step[:, :, 30:] = 2.6
    cut = cut_depth_steps(category, step)
    assert cut[:, :, 30].all() and cut.sum() == 40  # the farther pixel of each row
    slope = (1.0 / np.linspace(1.0, 0.2, 60, dtype=np.float32))[None, None].repeat(40, 1)  # a plane, seen obliquely
    assert not cut_depth_steps(category, slope).any()


@pytest.mark.parametrize("away", [1700.0, 4e6, np.inf, np.nan])
def test_what_is_too_far_for_a_voxel_is_in_no_fragment(away: float) -> None:
    """Keys would wrap there, and the thing would stand somewhere near the start."""
    objects, views = ObjectMap(NAMES), blank_views()
    category = np.ones((4, *SIZE), np.uint8)
    add_square(views, category, 2, (2.0, 0.0, 1.0), 0.25)
    category[3, 20:60, 20:60], views.depth[3, 20:60, 20:60] = 3, away
    with np.errstate(all="raise"):
        owners = objects.add(views, labels_of(category))
    assert [thing.category for thing in objects.objects] == ["chair"] and not owners[3, 20:60, 20:60].any()
    assert not find_packable(views)[3, 20:60, 20:60].any() and find_packable(views)[:3].all()


def test_pixels_within_half_a_kilometre_have_voxels() -> None:
    views = blank_views(away=500.0)
    everywhere = np.nonzero(find_packable(views))
    assert len(everywhere[0]) == views.depth.size
    points = unproject(views, *everywhere)
    assert np.abs(unpack_voxels(pack_voxels(points)) - points).max() <= VOXEL / 2 + 1e-6


# -- the map -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", ["apartments:val/3", "apartments:val/1"])
def test_what_was_shown_is_found_once_where_it_is(scene: str) -> None:
    known = mapped(scene)
    shown = known.shown()
    found = {thing.id: known.matches(thing) for thing in shown}
    assert np.mean([bool(found[thing.id]) for thing in shown]) >= 0.93
    assert np.mean([max(0, len(each) - 1) for each in found.values()]) <= 0.06
    errors = [
        min(np.linalg.norm(each.center - thing.center) for each in found[thing.id])
        for thing in shown
        if found[thing.id]
    ]
    assert np.median(errors) < 0.05 and np.quantile(errors, 0.9) < 0.3


def test_an_instance_that_two_views_share_has_one_object() -> None:
    known = mapped()
    shared = same = 0
    for index, owners in enumerate(known.owners):
        _, ids = known.tour.cut(index)
        shown = [set(np.unique(view).tolist()) for view in ids]
        for one, other in ((0, 1), (0, 2), (1, 3), (2, 3)):
            for number in shown[one] & shown[other]:
                sides = [Counter(owners[view][ids[view] == number].tolist()) for view in (one, other)]
                best = [side.most_common(1)[0] for side in sides]
                if min(count for _, count in best) >= 200 and best[0][0] and best[1][0]:
                    shared += 1
                    same += best[0][0] == best[1][0]
    assert shared > 60 and same / shared > 0.94


@pytest.mark.parametrize("bearing", [0.0, 45.0, 90.0, 135.0, 180.0, -135.0, -52.0])
def test_a_thing_is_one_object_wherever_the_agent_heads(bearing: float) -> None:
    """At 45 degrees two views show it; at 180 the panorama's seam goes through it."""
    objects = ObjectMap(NAMES)
    angle = np.radians(bearing)
    views = blank_views()
    category = np.ones((4, *SIZE), np.uint8)
    place = (2 * np.cos(angle), 2 * np.sin(angle), 1.0)
    add_square(views, category, 2, place, 0.25)
    owners = objects.add(views, labels_of(category))
    (chair,) = objects.objects
    assert chair.category == "chair" and set(np.unique(owners).tolist()) == {0, chair.id}
    np.testing.assert_allclose(chair.center, place, atol=0.25)


def test_states_and_colours_are_voted_for_by_size_and_confidence() -> None:
    objects = ObjectMap(NAMES)
    for half, state, confidence in ((0.1, 1, 0.9), (0.1, 1, 0.9), (0.4, 2, 0.9), (0.4, 1, 0.31)):
        views, category = blank_views(), np.zeros((4, *SIZE), np.uint8)
        add_square(views, category, 2, (2.0, 0.0, 1.0), half)
        shade = "red" if half > 0.2 else "blue"
        objects.add(views, labels_of(category, confidence, state), lambda pixels, _, shade=shade: (shade, 0.8))
    (chair,) = objects.objects
    assert (chair.state, chair.color, chair.decisions) == ("off", "red", 4)
    assert (chair.first, chair.last) == (0, 3) and 0.5 < chair.color_share < 1 and 0.5 < chair.state_share < 1
    assert chair.confidence == pytest.approx(0.9) and chair.size > 0.02


def test_what_is_unsure_or_background_is_not_mapped() -> None:
    objects = ObjectMap(NAMES)
    views, category = blank_views(), np.ones((4, *SIZE), np.uint8)
    add_square(views, category, 2, (2.0, 0.0, 1.0), 0.3)
    assert not objects.add(views, labels_of(category, 0.2)).any() and not objects.objects


def test_parts_that_turn_out_to_be_one_keep_the_lower_id() -> None:
    objects = ObjectMap(NAMES)
    for places in ([(2.0, 0.5, 1.0)], [(2.0, -0.5, 1.0)], [(2.0, 0.3, 1.0), (2.0, -0.3, 1.0), (2.0, 0.0, 1.0)]):
        views, category = blank_views(), np.zeros((4, *SIZE), np.uint8)
        for place in places:
            add_square(views, category, 5, place, 0.3)
        owners = objects.add(views, labels_of(category))
    (table,) = objects.objects
    assert table.id == 1 and set(np.unique(owners).tolist()) == {0, 1} and objects.count("Table") == 1
    assert table.extent[1] == pytest.approx(1.6, abs=0.2)


def test_a_cup_beside_a_vase_stays_a_cup_and_a_cup_called_a_vase_does_not_become_two() -> None:
    objects = ObjectMap(NAMES)
    views, category = blank_views(), np.zeros((4, *SIZE), np.uint8)
    add_square(views, category, 4, (2.0, 0.2, 1.0), 0.12)
    add_square(views, category, 3, (2.0, -0.02, 1.0), 0.06)
    objects.add(views, labels_of(category))
    assert [thing.category for thing in objects.objects] == ["vase", "cup"]
    category[category == 3] = 4
    objects.add(views, labels_of(category, 0.5))
    assert sorted(thing.category for thing in objects.objects if thing.size > 0)[0] == "cup"
    assert objects.count("cup") == 1


@pytest.mark.parametrize(("category", "count"), [("chair", 1), ("picture", 2)])
def test_pictures_on_both_sides_of_a_wall_are_two(category: str, count: int) -> None:
    objects = ObjectMap(("", "wall", category))
    for away in (3.0, 3.13):
        views = blank_views()
        kinds = np.ones(views.depth.shape, np.uint8)
        add_square(views, kinds, 2, (away, 0.0, 1.5), 0.35)
        objects.add(views, labels_of(kinds))
    assert len(objects.objects) == count


def test_the_map_is_a_function_of_its_inputs() -> None:
    tour = Tour("apartments:val/3", 4)
    one, other = add_all(tour), add_all(tour)
    assert [thing.id for thing in one.objects.objects] == [thing.id for thing in other.objects.objects]
    for first, second in zip(one.objects.objects, other.objects.objects, strict=True):
        np.testing.assert_array_equal(first.voxels, second.voxels)
        np.testing.assert_array_equal(first.category_votes, second.category_votes)
    np.testing.assert_array_equal(one.owners, other.owners)


def test_wrong_labels_are_refused() -> None:
    views = blank_views()
    with pytest.raises(ArgumentError, match="expected category, confidence and state"):
        ObjectMap(NAMES).add(views, labels_of(np.zeros((4, 3, 3), np.uint8)))
    with pytest.raises(ArgumentError, match="categories below 6, got 9"):
        ObjectMap(NAMES).add(views, labels_of(np.full((4, *SIZE), 9, np.uint8)))
    with pytest.raises(ArgumentError, match="states below 5, got 5"):
        ObjectMap(NAMES).add(views, labels_of(np.zeros((4, *SIZE), np.uint8), state=5))
    with pytest.raises(ArgumentError, match="'' first"):
        ObjectMap(("chair", "table"))


# -- rooms -----------------------------------------------------------------------------------------------------------


def test_rooms_of_things_are_those_of_the_table() -> None:
    known = mapped()
    pairs = [(thing, known.matches(thing)[0]) for thing in known.shown(400) if len(known.matches(thing)) == 1]
    pairs = [
        (thing, found) for thing, found in pairs if thing.room and thing.category not in ("door", "passage", "window")
    ]
    rooms = [(thing.room, known.grid.find_room(found.points)) for thing, found in pairs]
    agree = [
        (own == another != 0) == (true == other)
        for i, (true, own) in enumerate(rooms)
        for other, another in rooms[i + 1 :]
    ]
    assert len(agree) > 500 and np.mean(agree) > 0.95


# -- taking apart ------------------------------------------------------------------------------------------------------


def fill(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    axes = [np.arange(a + 0.025, b, 0.05) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_what_stands_apart_on_the_floor_or_above_is_taken_apart() -> None:
    seat = [fill((x, 0, 0.4), (x + 0.4, 0.4, 0.5)) for x in (0.0, 0.45)]
    backs = [fill((x, 0, 0.5), (x + 0.2, 0.1, 0.95)) for x in (0.0, 0.65)]
    apart = split_voxels(np.unique(pack_voxels(np.concatenate([seat[0], seat[1] + [0.3, 0, 0]]))))
    assert sorted(map(len, apart)) == [len(part) for part in seat]
    by_backs = split_voxels(np.unique(pack_voxels(np.concatenate([*seat, *backs]))))
    assert len(by_backs) == 2 and sum(map(len, by_backs)) == len(np.concatenate([*seat, *backs]))
    scrap = seat[0][:3] + np.array([0.6, 0, 0])
    one = np.unique(pack_voxels(np.concatenate([seat[0], backs[0], scrap])))
    assert len(split_voxels(one)) == 1


def test_small_things_side_by_side_are_several_where_gaps_are_not_bridged() -> None:
    cup = np.argwhere(np.ones((2, 2, 2))) * VOXEL
    two = np.unique(pack_voxels(np.concatenate([cup, cup + np.array([3 * VOXEL, 0, 0])]) + VOXEL / 2))
    assert len(split_voxels(two)) == 1  # as the sparse voxels of a thing seen from afar
    found = split_voxels(two, bridged=False)
    assert [len(part) for part in found] == [8, 8] and set(np.concatenate(found)) == set(two)
