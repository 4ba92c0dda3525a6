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


def weights(count, source, scale):
    """[count, source]: what pixels of a view show of those of a frame, `scale` of which they are wide; middles meet."""
    hit = (np.arange(count) + 0.5 - count / 2)[:, None] * scale + source / 2  # by the rays of the view's pixels
    left = np.arange(source)
    if scale >= 1:
        overlap = np.minimum(hit + scale / 2, left + 1) - np.maximum(hit - scale / 2, left)
        return np.clip(overlap, 0, None) / scale
    near = 1 - np.abs(np.clip(hit, 0.5, source - 0.5) - (left + 0.5))
    return np.clip(near, 0, None) * ((hit >= 0) & (hit < source))


def looked_up(frame, size):
    """The frame in another size by rays, both 90 degrees wide: black where they pass it, means over pixels' areas."""
    scale = frame.shape[1] / size[1]
    rows, columns = (weights(side, source, scale) for side, source in zip(size, frame.shape, strict=False))
    return np.einsum("yv,vuc,xu->yxc", rows, frame.astype(float), columns)


@pytest.mark.parametrize(
    ("frame", "size"),
    [
        ((48, 48), (32, 32)),
        ((44, 80), (32, 32)),
        ((80, 44), (32, 32)),
        ((36, 64), (96, 96)),
        ((45, 64), (64, 64)),
        ((72, 128), (72, 128)),
        ((40, 40), (18, 32)),
        ((40, 40), (30, 20)),
    ],
)
def test_perspective_frames_are_shown_in_their_own_directions(frame, size):
    whole = PANORAMA if frame[0] <= frame[1] else PANORAMA.transpose(1, 0, 2)
    pixels = np.ascontiguousarray(whole[: frame[0], : frame[1]])
    view = one_row([1], planner.ViewMaker("front", size), [pixels, pixels], frames="perspective")[0]
    assert close(view, looked_up(pixels, size), 0.51)


@pytest.mark.parametrize("frame", [(176, 320), (320, 176), (200, 200)])
def test_what_a_perspective_model_is_shown_and_gives_back_is_the_front_view(frame):
    """Conditioning and way back have the same rays: a model that repeats what it is shown is a window on reality."""
    smooth = cv2.resize(cv2.GaussianBlur(NOISE, (0, 0), 3), (1024, 576))
    batch = planner.Batch.build([[[1]]])
    shown = batch.observations(smooth[None], planner.ViewMaker("front", frame))
    assert shown.shape == (1, *frame, 3)
    front = planner.ViewMaker("front", (96, 96))
    back = batch.views(smooth[None], [np.stack([shown, shown], 1)], front, frames="perspective")[0, 0]
    real = batch.views(smooth[None], [np.stack([smooth, smooth])[None]], front)[0, 0]
    tangent = np.abs(np.arange(96) + 0.5 - 48) / 48  # of a row's elevation
    seen, half_seen = tangent + 1 / 96 <= frame[0] / frame[1], tangent - 1 / 96 < frame[0] / frame[1]
    assert close(back[seen], real[seen].astype(float), 3)
    assert (back[~half_seen] == 0).all()
    assert seen.all() if frame[0] >= frame[1] else seen.sum() == 52


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
    wide = batch.depths(np.full((2, 72, 128), 3, np.float32), planner.ViewMaker("front", (24, 48)))
    np.testing.assert_allclose(wide, planar[:, 12:36], rtol=1e-6)


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


def test_arrays_of_another_dtype_are_named_by_dtype_and_shape():
    batch, maker = planner.Batch.build([[[1]]]), planner.ViewMaker("front", (8, 8))
    with pytest.raises(ArgumentError, match=r"panoramas uint8 .*, got an episode's \[72, 128, 3\] float32"):
        batch.views(PANORAMA[None].astype(np.float32), [], maker)
    with pytest.raises(ArgumentError, match=r"rollouts uint8 .*, got \[1, 2, 72, 128, 3\] float64"):
        batch.views(PANORAMA[None], [np.zeros((1, 2, 72, 128, 3))], maker)
    with pytest.raises(ArgumentError, match=r"rollouts uint8 .*, got <class 'list'>"):
        batch.views(PANORAMA[None], [[1]], maker)
