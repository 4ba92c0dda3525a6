# SPDX-License-Identifier: Apache-2.0
"""Views and observations the planner makes, against NumPy in double precision and OpenCV."""

import cv2
import numpy as np
import pytest

from wiw._core import planner
from wiw.errors import ArgumentError

RNG = np.random.default_rng(11)
NOISE = RNG.integers(0, 256, (72, 128, 3)).astype(np.uint8)
PANORAMA = cv2.GaussianBlur(NOISE, (0, 0), 1.5, borderType=cv2.BORDER_WRAP)
LEFT = np.pi / 8


def front(panorama, size, hfov_deg, yaw):
    """A perspective view by rays, bilinear in double precision (views that avoid the poles)."""
    height, width = size
    focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    azimuth = np.arctan2(x, 1) - yaw
    elevation = np.arctan2(-y, np.hypot(x, 1))
    u = (azimuth / (2 * np.pi) + 0.5) * panorama.shape[1] - 0.5
    v = (0.5 - elevation / np.pi) * panorama.shape[0] - 0.5
    u0, v0 = np.floor(u).astype(int), np.floor(v).astype(int)
    fu, fv = (u - u0)[..., None], (v - v0)[..., None]

    def pixel(row, column):
        return panorama[row, column % panorama.shape[1]].astype(float)

    top = (1 - fu) * pixel(v0, u0) + fu * pixel(v0, u0 + 1)
    bottom = (1 - fu) * pixel(v0 + 1, u0) + fu * pixel(v0 + 1, u0 + 1)
    return (1 - fv) * top + fv * bottom


def one_row(plan, maker, imagined, **options):
    batch = planner.Batch.build([[plan]])
    return batch.views(PANORAMA[None], [np.stack(imagined)[None]] if imagined else [], maker, **options)[0]


def close(got, wanted, levels=1.0):
    return np.abs(got.astype(float) - wanted).max() <= levels


def test_front_views_of_the_rolled_reality_and_of_imagined_panoramas():
    imagined = PANORAMA[:, ::-1].copy()
    views = one_row([2, 2, 1], planner.ViewMaker("front", (48, 64), 80), [PANORAMA, imagined])
    assert close(views[0], front(PANORAMA, (48, 64), 80, LEFT))
    assert close(views[1], front(PANORAMA, (48, 64), 80, 2 * LEFT))
    assert close(views[2], front(imagined, (48, 64), 80, 0))
    assert not close(views[0], views[1], 8)


def test_turns_that_are_no_whole_columns():
    space = planner.ModelSpec().space.__class__(turn_deg=10)
    batch = planner.Batch.build([[[3, 3]]], planner.ModelSpec(space=space))
    views = batch.views(PANORAMA[None], [], planner.ViewMaker("front", (48, 48)))
    assert close(views[0, 1], front(PANORAMA, (48, 48), 90, np.radians(-20)), 1.5)
    small = batch.views(PANORAMA[None], [], planner.ViewMaker("panorama", (36, 64)))[0, 1]
    columns = 20 / 360 * 128
    whole, part = int(columns), columns - int(columns)
    rolled = (1 - part) * np.roll(PANORAMA, -whole, 1).astype(float) + part * np.roll(PANORAMA, -whole - 1, 1)
    assert close(small, cv2.resize(rolled, (64, 36), interpolation=cv2.INTER_AREA), 1.5)


def test_surround_views():
    views = one_row([2], planner.ViewMaker("surround", (40, 40)), [])
    assert views.shape == (1, 4, 40, 40, 3)
    for view, yaw in zip(views[0], (0, np.pi / 2, -np.pi / 2, np.pi), strict=True):
        assert close(view, front(PANORAMA, (40, 40), 90, LEFT + yaw))


@pytest.mark.parametrize("size", [(18, 32), (64, 100), (72, 128), (9, 48)])
def test_small_panoramas_are_area_averages(size):
    views = one_row([3, 1], planner.ViewMaker("panorama", size), [PANORAMA, PANORAMA])
    for view, image in zip(views, (np.roll(PANORAMA, -8, 1), PANORAMA), strict=True):
        assert close(view, cv2.resize(image.astype(float), size[::-1], interpolation=cv2.INTER_AREA), 0.51)


@pytest.mark.parametrize(
    ("size", "how"), [((48, 48), cv2.INTER_AREA), ((72, 128), None), ((100, 150), cv2.INTER_LINEAR)]
)
def test_perspective_frames_are_resized(size, how):
    view = one_row([1], planner.ViewMaker("front", size), [PANORAMA, PANORAMA], frames="perspective")[0]
    wanted = PANORAMA if how is None else cv2.resize(PANORAMA.astype(float), size[::-1], interpolation=how)
    assert close(view, wanted, 0.51)


def test_perspective_frames_hold_nothing_but_the_front():
    for maker in (planner.ViewMaker("surround", (48, 48)), planner.ViewMaker("front", (48, 48), 105)):
        with pytest.raises(ArgumentError, match="perspective model"):
            one_row([1], maker, [PANORAMA, PANORAMA], frames="perspective")


def test_observations_and_depth_of_rows():
    plans = [[[2, 1], [3, 3, 1]], [[1, 2]]]
    batch = planner.Batch.build(plans)
    panoramas = np.stack([PANORAMA, PANORAMA[::-1]])
    np.testing.assert_array_equal(batch.row_turns, [1, -2, 0])
    whole = batch.observations(panoramas, planner.ViewMaker("panorama", (72, 128)))
    for row, (episode, columns) in zip(whole, ((0, 8), (0, -16), (1, 0)), strict=True):
        np.testing.assert_array_equal(row, np.roll(panoramas[episode], columns, 1))
    maker = planner.ViewMaker("front", (48, 48))
    assert close(batch.observations(panoramas, maker)[1], front(PANORAMA, (48, 48), 90, -2 * LEFT))

    distances = RNG.uniform(1, 9, (2, 72, 128)).astype(np.float32)
    spheres = batch.depths(distances, planner.ViewMaker("panorama", (36, 64)))
    np.testing.assert_array_equal(spheres[0], np.roll(distances[0], 8, 1)[1::2, 1::2])
    planar = batch.depths(np.full((2, 72, 128), 3, np.float32), maker)
    ray = (np.arange(48) + 0.5 - 24) / 24
    length = np.sqrt(1 + ray[None] ** 2 + ray[:, None] ** 2)
    np.testing.assert_allclose(planar, np.broadcast_to(3 / length, planar.shape), rtol=1e-6)


def test_impossible_views_are_refused():
    with pytest.raises(ArgumentError, match="'front', 'panorama', 'surround'"):
        planner.ViewMaker("back")
    for arguments in (("front", (0, 5)), ("front", (5, 5), 180), ("panorama", (8, 15))):
        with pytest.raises(ArgumentError):
            planner.ViewMaker(*arguments)


@pytest.mark.parametrize("empty", [(64, 0), (0, 128)])
def test_images_without_a_pixel_are_refused(empty):
    batch = planner.Batch.build([[[1]]])
    for maker in (planner.ViewMaker("panorama", (64, 128)), planner.ViewMaker("front", (48, 48))):
        with pytest.raises(ArgumentError, match="panorama size"):
            batch.observations(np.zeros((1, *empty, 3), np.uint8), maker)
        with pytest.raises(ArgumentError, match="panorama size"):
            batch.views(PANORAMA[None], [np.zeros((1, 2, *empty, 3), np.uint8)], maker)
