# SPDX-License-Identifier: Apache-2.0
"""Faces of the panorama room: shapes, conventions, and agreement with NumPy and py360convert."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wiw import panorama
from wiw.errors import ArgumentError

SIZE = (72, 128)


def noise(shape, seed=0, dtype=np.uint8):
    return np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)


def smooth(size):
    """Colour as a smooth function of direction."""
    d = panorama.directions(size).astype(np.float64)
    channels = [127 + 90 * d[..., 0] * d[..., 2], 127 + 90 * d[..., 1] * d[..., 0], 127 - 90 * d[..., 2]]
    return np.stack(channels, -1).astype(np.float32)


def test_directions_follow_the_convention():
    d = panorama.directions((4, 8))
    assert d.shape == (4, 8, 3)
    assert d.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(d, axis=-1), 1, atol=1e-6)
    assert np.all(d[0, :, 1] > 0)  # the first row looks up
    assert np.all(d[:, 4:, 0] > 0)  # the right half looks right
    assert np.all(d[:, 2:6, 2] < 0)  # the middle looks to the front
    np.testing.assert_allclose(d[1], d[2] * [1, -1, 1], atol=1e-6)


@pytest.mark.parametrize("shape", [SIZE, (*SIZE, 1), (*SIZE, 3), (2, *SIZE, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_shapes_and_types_are_kept(shape, dtype):
    pano = noise(shape, dtype=dtype)
    lead, tail = (shape[:1] if len(shape) == 4 else ()), (shape[-1:] if len(shape) > 2 else ())
    view = panorama.to_perspective(pano, 90, (10, 12))
    assert view.shape == (*lead, 10, 12, *tail)
    assert view.dtype == dtype
    assert panorama.to_perspective(pano, 90, (10, 12), yaw_deg=[0, 90]).shape == (*lead, 2, 10, 12, *tail)
    assert panorama.rotate(pano, 33).shape == shape
    assert panorama.resize(pano, (10, 20)).shape == (*lead, 10, 20, *tail)
    faces = panorama.to_cubemap(pano, 16)
    assert faces.shape == (*lead, 6, 16, 16, *tail)
    assert panorama.from_cubemap(faces, SIZE).shape == shape


def test_yaw_is_positive_to_the_left_and_pitch_upwards():
    pano = panorama.directions((180, 360))
    middle = (slice(5, 6), slice(5, 6))
    for yaw, expected in [(0, (0, 0, -1)), (90, (-1, 0, 0)), (-90, (1, 0, 0)), (180, (0, 0, 1))]:
        view = panorama.to_perspective(pano, 60, (11, 11), yaw_deg=yaw)
        np.testing.assert_allclose(view[middle][0, 0], expected, atol=1e-3)
    up = panorama.to_perspective(pano, 60, (11, 11), pitch_deg=30)
    np.testing.assert_allclose(up[middle][0, 0], (0, 0.5, -np.sqrt(0.75)), atol=1e-3)


def test_a_turned_panorama_shows_the_turned_view():
    pano = noise((*SIZE, 3))
    assert np.array_equal(panorama.rotate(pano, 22.5), np.roll(pano, SIZE[1] // 16, axis=1))
    for yaw in (22.5, -45.0, 180.0):
        straight = panorama.to_perspective(panorama.rotate(pano, yaw), 80, (20, 30))
        assert np.array_equal(straight, panorama.to_perspective(pano, 80, (20, 30), yaw_deg=yaw))


@settings(max_examples=40, deadline=None)
@given(
    yaw=st.floats(-720, 720),
    pitch=st.floats(-90, 90),
    hfov=st.floats(2, 170),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
)
def test_any_view_of_a_smooth_panorama_is_the_smooth_function(yaw, pitch, hfov, height, width):
    size = (180, 360)
    view = panorama.to_perspective(smooth(size), hfov, (height, width), yaw_deg=yaw, pitch_deg=pitch)
    focal = width / (2 * np.tan(np.radians(hfov) / 2))
    u, v = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    ray = np.stack([u, -v, -np.ones_like(u)], -1)
    p, y = np.radians(pitch), np.radians(yaw)
    tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    turn = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    d = ray @ (turn @ tilt).T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    expected = np.stack([127 + 90 * d[..., 0] * d[..., 2], 127 + 90 * d[..., 1] * d[..., 0], 127 - 90 * d[..., 2]], -1)
    # Linear interpolation over one-degree texels errs by at most 90 * 2 * (0.0175 ** 2) / 8 per axis.
    np.testing.assert_allclose(view, expected, atol=0.05)


def test_cube_and_back_is_nearly_the_identity():
    pano = smooth((90, 180))
    back = panorama.from_cubemap(panorama.to_cubemap(pano, 64), (90, 180))
    np.testing.assert_allclose(back, pano, atol=0.3)  # worst at the corners, where three texels meet


def test_resize_is_the_area_mean():
    pano = noise((576, 1024, 3))
    blocks = pano.reshape(144, 4, 256, 4, 3).mean((1, 3))
    assert np.abs(panorama.resize(pano, (144, 256)) - blocks).max() <= 0.5 + 1e-4
    assert np.array_equal(panorama.resize(pano, (576, 1024)), pano)


def test_depth_conversions_are_inverse_and_fit_a_wall():
    size, hfov = (30, 40), 100.0
    planar = np.full((2, *size), 2.5, np.float32)
    distance = panorama.planar_to_distance(planar, hfov)
    np.testing.assert_allclose(panorama.distance_to_planar(distance, hfov), planar, rtol=1e-6)
    # A wall 2.5 m ahead, seen in a panorama's depth and cut out of it.
    d = panorama.directions((576, 1024))
    pano = np.where(d[..., 2] < -0.05, 2.5 / np.maximum(-d[..., 2], 0.05), 0).astype(np.float32)
    view = panorama.to_perspective(pano, hfov, size)
    np.testing.assert_allclose(panorama.distance_to_planar(view, hfov), planar[0], rtol=1e-3)


def test_out_is_filled_and_checked():
    pano = noise((*SIZE, 3))
    plan = panorama.PerspectivePlan(SIZE, (8, 9), 70)
    out = np.empty((2, 8, 9, 3), np.uint8)
    views = plan(pano, [0, 90], out=out)
    assert np.shares_memory(views, out)
    assert np.array_equal(out[1], plan(pano, 90))
    with pytest.raises(ArgumentError, match="out"):
        plan(pano, 0, out=np.empty((8, 9, 3), np.float32))
    with pytest.raises(ArgumentError, match="out"):
        plan(pano, 0, out=np.empty((9, 9, 3), np.uint8))


def test_errors_say_what_was_expected():
    pano = noise((*SIZE, 3))
    with pytest.raises(ArgumentError, match="bilinear"):
        panorama.to_perspective(pano, 90, (4, 4), interpolation="cubic")
    with pytest.raises(ArgumentError, match="nearest"):
        panorama.to_perspective(pano.astype(np.uint32), 90, (4, 4))
    with pytest.raises(ArgumentError, match="uint8, float32 or uint32"):
        panorama.to_perspective(pano.astype(np.float64), 90, (4, 4))
    with pytest.raises(ArgumentError, match="hfov_deg"):
        panorama.to_perspective(pano, 180, (4, 4))
    with pytest.raises(ArgumentError, match="even number of columns"):
        panorama.rotate(pano[:, :-1], 10)
    with pytest.raises(ArgumentError, match="the size the plan was made for"):
        panorama.PerspectivePlan((10, 20), (4, 4), 90)(pano, 0)
    with pytest.raises(ArgumentError, match="finite"):
        panorama.rotate(pano, float("nan"))
    for size in ((0, 4), (SIZE[0] + 1, 4), (2**31 - 1, 2**31 - 1)):
        with pytest.raises(ArgumentError, match="resize"):
            panorama.resize(pano, size)
    with pytest.raises(ArgumentError, match="faces"):
        panorama.from_cubemap(noise((5, 8, 8)), SIZE)


@pytest.mark.parametrize("yaw", [0, 40, -135, 180])
@pytest.mark.parametrize("pitch", [0, 25, -90])
def test_py360convert_mode_agrees_with_py360convert(yaw, pitch):
    py360convert = pytest.importorskip("py360convert")
    pano = smooth((180, 360))
    for size in [(40, 40), (30, 50)]:
        ours = panorama.to_perspective(pano, 80, size, yaw_deg=yaw, pitch_deg=pitch, convention="py360convert")
        theirs = py360convert.e2p(pano, 80, yaw, pitch, size)
        # It rounds coordinates to 1/32 pixel: 1.6 a degree and pixel makes 0.05.
        np.testing.assert_allclose(ours, theirs, atol=0.1)
    native = panorama.to_perspective(pano, 80, (40, 40), yaw_deg=-yaw, pitch_deg=pitch)
    reference = py360convert.e2p(pano, 80, yaw, pitch, (40, 40))
    assert np.abs(native - reference).max() > 0.3  # the two conventions do differ
