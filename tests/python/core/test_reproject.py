# SPDX-License-Identifier: Apache-2.0
"""Reprojection against analytic rooms and a slow twin."""

import numpy as np
import pytest

from wiw import panorama, reproject
from wiw.errors import ArgumentError

SIZE = (144, 256)
LOW, HIGH = np.array([-3.0, -1.0, -4.0]), np.array([2.5, 1.6, 3.0])


def psnr(a, b):
    return 10 * np.log10(255.0**2 / np.mean((a.astype(np.float64) - b) ** 2))


def paint(point):
    """Smooth colour of a point in space."""
    wave = [127 + 60 * np.sin(4 * point[..., 0] + k) + 60 * np.sin(5 * point[..., 1] + 2 * k) for k in range(3)]
    wave[0] = wave[0] * (0.75 + 0.25 * np.cos(5 * point[..., 2]))
    return np.clip(np.stack(wave, -1), 0, 255)


def room(directions, centre, pillar=None):
    """Distance to the walls of a box room, and to a vertical pillar (x, z, radius) if there is one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(directions > 0, (HIGH - centre) / directions, (LOW - centre) / directions).min(-1)
        if pillar is not None:
            x, z, radius = centre[0] - pillar[0], centre[2] - pillar[1], pillar[2]
            a = directions[..., 0] ** 2 + directions[..., 2] ** 2
            b = x * directions[..., 0] + z * directions[..., 2]
            root = b * b - a * (x * x + z * z - radius**2)
            hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
            distance = np.where((hit > 0) & (hit < distance), hit, distance)
    return distance


def view_rays(size, hfov_deg):
    height, width = size
    focal = width / (2 * np.tan(np.radians(hfov_deg) / 2))
    u, v = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    return np.stack([u, -v, -np.ones_like(u)], -1)


def picture(rays, pose=None, pillar=None):
    """Colour and depth (in multiples of the given rays) of the room from a pose."""
    pose = np.eye(4) if pose is None else pose
    turned = rays @ pose[:3, :3].T
    depth = room(turned, pose[:3, 3], pillar)
    return np.rint(paint(pose[:3, 3] + turned * depth[..., None])).astype(np.uint8), depth.astype(np.float32)


def sphere(size=SIZE):
    return panorama.directions(size).astype(np.float64)


POSES = {
    "forward": reproject.pose(forward=1.0),
    "aside and turned": reproject.pose(forward=0.3, left=1.1, yaw_deg=70),
    "up": reproject.pose(up=0.5, yaw_deg=-10),
}


def test_no_motion_changes_nothing():
    color = np.random.default_rng(0).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    _, depth = picture(sphere())
    out = reproject.warp(color[None], depth[None], np.eye(4)[None, None], outputs=("color", "depth", "hole"))
    assert np.abs(out["color"][0, 0].astype(int) - color).max() <= 1
    np.testing.assert_allclose(out["depth"][0, 0], depth, rtol=1e-5)
    assert not out["hole"].any()


def test_no_motion_changes_nothing_in_a_perspective_view():
    color, depth = picture(view_rays((60, 80), 100))
    out = reproject.warp(
        color[None], depth[None], np.eye(4)[None, None], hfov_deg=100, outputs=("color", "depth", "hole")
    )
    assert np.abs(out["color"][0, 0].astype(int) - color).max() <= 1
    np.testing.assert_allclose(out["depth"][0, 0], depth, rtol=1e-5)
    assert not out["hole"].any()


@pytest.mark.parametrize("turns", [1, -3, 8])
def test_a_turn_on_the_spot_is_a_roll(turns):
    color, depth = picture(sphere())
    turned = reproject.warp(color[None], depth[None], reproject.pose(yaw_deg=22.5 * turns)[None, None])[0, 0]
    assert np.abs(turned.astype(int) - panorama.rotate(color, 22.5 * turns)).max() <= 1


@pytest.mark.parametrize("name", POSES)
def test_a_convex_room_is_seen_as_it_is(name):
    color, depth = picture(sphere())
    true_color, true_depth = picture(sphere(), POSES[name])
    out = reproject.warp(color[None], depth[None], POSES[name][None, None], outputs=("color", "depth", "hole"))
    # The source has no texel at its very poles.
    assert out["hole"].mean() < (0.01 if name == "up" else 5e-4)
    error = np.abs(out["depth"][0, 0] - true_depth) / true_depth
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.999) < 0.03  # triangles cut the room's edges
    assert psnr(out["color"][0, 0], true_color) > 38


@pytest.mark.parametrize("name", POSES)
def test_perspective_views_of_a_panorama_come_straight_from_its_mesh(name):
    color, depth = picture(sphere((288, 512)))
    true_color, true_depth = picture(view_rays((90, 120), 80), POSES[name])
    out = reproject.warp(
        color[None],
        depth[None],
        POSES[name][None, None],
        size=(90, 120),
        target_hfov_deg=80,
        outputs=("color", "depth"),
    )
    assert psnr(out["color"][0, 0], true_color) > 38
    assert np.median(np.abs(out["depth"][0, 0] - true_depth) / true_depth) < 1e-3


def test_perspective_views_move_too():
    pose = reproject.pose(forward=0.5, left=0.1)
    color, depth = picture(view_rays((120, 160), 90))
    true_color, true_depth = picture(view_rays((120, 160), 90), pose)
    out = reproject.warp(color[None], depth[None], pose[None, None], hfov_deg=90, outputs=("color", "depth", "hole"))
    seen = ~out["hole"][0, 0]
    assert seen.mean() > 0.9  # the view's left edge was not in the source
    assert psnr(out["color"][0, 0][seen], true_color[seen]) > 38
    np.testing.assert_allclose(out["depth"][0, 0][seen], true_depth[seen], rtol=0.03)


def test_what_a_pillar_hid_is_filled_from_behind_it():
    pillar = (0.0, -2.0, 0.25)
    pose = reproject.pose(forward=0.4, left=0.8)
    color, depth = picture(sphere(), pillar=pillar)
    true_color, true_depth = picture(sphere(), pose, pillar)
    out = reproject.warp(color[None], depth[None], pose[None, None], outputs=("color", "depth", "hole"))
    hole = out["hole"][0, 0]
    assert 0.002 < hole.mean() < 0.1
    uncovered = hole & (true_depth > 2.5)
    assert uncovered.sum() > 0.6 * hole.sum()
    assert np.median(out["depth"][0, 0][uncovered] / true_depth[uncovered]) == pytest.approx(1, abs=0.15)
    # The pillar itself keeps its size: no rubber sheet to the wall behind.
    near, true_near = (out["depth"][0, 0] < 2.2).sum(), (true_depth < 2.2).sum()
    copied = reproject.warp(color[None], depth[None], np.eye(4)[None, None])[0, 0]
    assert near == pytest.approx(true_near, rel=0.15)
    assert psnr(out["color"][0, 0], true_color) > psnr(copied, true_color) + 12


@pytest.mark.parametrize("nothing", [0.0, -1.0, np.nan, np.inf, 2e4])
def test_sky_stays_where_it_is_and_keeps_depth_zero(nothing):
    color, depth = picture(sphere())
    sky = sphere()[..., 1] > 0.5
    depth[sky] = nothing
    color[sky] = (10, 200, 30)
    out = reproject.warp(color[None], depth[None], POSES["forward"][None, None], outputs=("color", "depth"))
    high = sphere()[..., 1] > 0.9
    assert np.all(out["depth"][0, 0][high] == 0)
    assert np.all(out["color"][0, 0][high] == (10, 200, 30))


def test_batches_give_what_single_calls_give():
    rooms = [picture(sphere(), reproject.pose(left=0.3 * k)) for k in range(3)]
    color, depth = (np.stack(x) for x in zip(*rooms, strict=True))
    poses = np.stack([[reproject.pose(forward=0.2 * t, yaw_deg=5 * b) for t in range(4)] for b in range(3)])
    whole = reproject.warp(color, depth, poses, outputs=("color", "depth", "hole"))
    assert whole["color"].shape == (3, 4, *SIZE, 3)
    assert whole["hole"].dtype == bool
    for b in range(3):
        for t in range(4):
            one = reproject.warp(
                color[b : b + 1], depth[b : b + 1], poses[b : b + 1, t : t + 1], outputs=("color", "depth")
            )
            assert np.array_equal(one["color"][0, 0], whole["color"][b, t])
            assert np.array_equal(one["depth"][0, 0], whole["depth"][b, t])


def test_a_camera_behind_everything_sees_black():
    color, depth = picture(view_rays((20, 30), 60))
    out = reproject.warp(
        color[None],
        depth[None],
        reproject.pose(forward=50)[None, None],
        hfov_deg=60,
        outputs=("color", "depth", "hole"),
    )
    assert out["hole"].all()
    assert not out["color"].any()
    assert not out["depth"].any()


def test_errors_say_what_was_expected():
    color, depth = picture(sphere((20, 40)))
    with pytest.raises(ArgumentError, match=r"depth \[B = 1, 20, 40\]"):
        reproject.warp(color[None], depth[None, :, :-1], np.eye(4)[None, None])
    with pytest.raises(ArgumentError, match="color: expected uint8"):
        reproject.warp(color[None] / 255, depth[None], np.eye(4)[None, None])
    with pytest.raises(ArgumentError, match="color: expected uint8"):
        reproject.warp(color, depth, np.eye(4)[None, None])
    for integers in (np.uint16, np.int64):  # millimetres, as cameras write them, are no metres
        with pytest.raises(ArgumentError, match=r"depth: expected metres in a floating type, got u?int.* / 1000"):
            reproject.warp(color[None], (1000 * depth[None]).astype(integers), np.eye(4)[None, None])
    with pytest.raises(ArgumentError, match="outputs"):
        reproject.warp(color[None], depth[None], np.eye(4)[None, None], outputs=("holes",))
    with pytest.raises(ArgumentError, match="T_source_target"):
        reproject.warp(color[None], depth[None], np.eye(4)[None])
    with pytest.raises(ArgumentError, match="rigid"):
        reproject.warp(color[None], depth[None], 2 * np.eye(4)[None, None])
    with pytest.raises(ArgumentError, match="field of view"):
        reproject.warp(color[None], depth[None], np.eye(4)[None, None], hfov_deg=200)
    with pytest.raises(ArgumentError, match="cut"):
        reproject.warp(color[None], depth[None], np.eye(4)[None, None], cut=0)
