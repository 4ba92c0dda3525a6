# SPDX-License-Identifier: Apache-2.0
"""The sun's light and shadows on both back ends, against a slow ray caster of the documented formula."""

import numpy as np
import pytest
from egl import needs_egl
from test_render import look, world_rays

from wiw.errors import ArgumentError
from wiw.render import Renderer
from wiw.scenes import Scene

SIZE, HFOV = (90, 120), 70.0
POSE = look([0.1, 1.0, 1.6], 0.05, -0.55)
COLORS = ((0.9, 0.9, 0.9), (0.8, 0.3, 0.2), (0.3, 0.5, 0.9))
SUNS = {"high": (-0.5, 0.8, 0.33), "behind": (0.3, 0.5, -0.8), "grazing": (0.9, 0.05, 0.2)}
BACKENDS = ["cpu", pytest.param("gpu", marks=[needs_egl, pytest.mark.gpu])]


def quad(corner, across, along):
    corner, across, along = (np.asarray(v, np.float32) for v in (corner, across, along))
    return np.stack([corner, corner + across, corner + across + along, corner + along])


def table(shift=(0, 0, 0)):
    """Vertices [V, 3] of a table top, a box on it, and a tilted plane over it; every four make a quad."""
    x, y, z = 0.3 * np.eye(3)
    low = np.array([-0.4, 0, -0.2]) + shift
    box = [(low, x, y), (low + z, x, y), (low, z, y), (low + x, z, y), (low, x, z), (low + y, x, z)]
    return [
        quad([-1, 0, 1], [2, 0, 0], [0, 0, -2]),
        np.concatenate([quad(*side) for side in box]),
        quad([0.1, 0.45, -0.3], [0.5, 0.1, 0], [0, -0.15, 0.45]),
    ]


def quads_to_triangles(positions):
    return (np.arange(0, len(positions), 4)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)


def make_scene(sun, shift=(0, 0, 0)):
    meshes = [{"positions": p, "triangles": quads_to_triangles(p), "material": i} for i, p in enumerate(table(shift))]
    return Scene.from_arrays(meshes, materials=[{"base_color": [*color, 1]} for color in COLORS], sun=sun)


@np.errstate(divide="ignore", invalid="ignore")
def distances(triangles, origins, rays, margin):
    """Moeller-Trumbore, every ray [N] against every triangle [T]: distances [N, T] in rays' lengths, inf for a miss.

    `margin` widens triangles (narrows them below zero), in barycentric coordinates.
    """
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(rays[:, None], e2)
    inverse = 1 / np.einsum("ntk,tk->nt", p, e1)
    s = origins[:, None] - a
    u = np.einsum("ntk,ntk->nt", p, s) * inverse
    q = np.cross(s, e1)
    v = np.einsum("ntk,nk->nt", q, rays) * inverse
    t = np.einsum("ntk,tk->nt", q, e2) * inverse
    return np.where((u >= -margin) & (v >= -margin) & (u + v <= 1 + margin) & (t > 1e-6), t, np.inf)


def expected(sun, shift=(0, 0, 0), margin=0.0):
    """What the formula gives, one pixel at a time: colour [N, 3], visibility [N], nearest triangle [N]."""
    positions = table(shift)
    triangles = np.concatenate([p[quads_to_triangles(p)] for p in positions]).astype(float)
    owner = np.repeat(range(3), [len(p) // 2 for p in positions])
    rays = world_rays(POSE, SIZE, HFOV).reshape(-1, 3)
    depth = distances(triangles, np.tile(POSE[:3, 3], (len(rays), 1)), rays, margin)
    nearest, t = depth.argmin(1), depth.min(1)
    hit = np.isfinite(t)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[nearest]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= -np.sign(np.sum(normal * rays, 1, keepdims=True))
    towards = np.asarray(sun["direction"], float) / np.linalg.norm(sun["direction"])
    points = np.where(hit[:, None], POSE[:3, 3] + t[:, None] * rays, 0)
    sunward = normal * np.where(normal @ towards < 0, -1, 1)[:, None]
    start = points + 2.1e-4 * sunward
    visible = ~np.isfinite(distances(triangles, start, np.tile(towards, (len(rays), 1)), margin)).any(1)
    nx, ny, nz = normal.T
    ambient = 0.80 + 0.12 * ny + 0.05 * (nx**2 - nz**2) + 0.02 * nx
    light = sun["ambient"] * ambient + sun["strength"] * np.maximum(0, normal @ towards) * visible
    color = 255 * np.array(COLORS)[owner[nearest]] * np.minimum(1, light)[:, None]
    return color, visible & hit, np.where(hit, nearest, -1)


def near_edges(picture, reach):
    """Pixels within `reach` of a change, [H, W]."""
    edge = np.zeros(picture.shape, bool)
    edge[:, 1:] |= picture[:, 1:] != picture[:, :-1]
    edge[1:] |= picture[1:] != picture[:-1]
    grown = edge.copy()
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            grown |= np.roll(edge, (dy, dx), (0, 1))
    return grown


def assert_formula(picture, sun, shift=(0, 0, 0), reach=0, tolerance=0.75):
    color, visible, nearest = expected(sun, shift)
    (_, wide_visible, wide), (_, narrow_visible, narrow) = (expected(sun, shift, m) for m in (1e-3, -1e-3))
    # The diagonal of a quad moves with the margin but changes no light.
    sure = (wide_visible == narrow_visible) & (nearest >= 0) & (wide // 2 == narrow // 2)
    if reach:
        sure &= ~near_edges((2 * (nearest // 2) + visible).reshape(SIZE), reach).ravel()
    assert sure.mean() > 0.3
    assert visible[sure].any() and not visible[sure].all()
    assert np.abs(picture["color"].reshape(-1, 3) - color)[sure].max() <= tolerance


@pytest.mark.parametrize("direction", SUNS.values(), ids=SUNS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_light_and_shadows_are_those_of_the_formula(backend, direction):
    sun = {"direction": direction, "strength": 0.65, "ambient": 0.5}
    picture = Renderer(make_scene(sun), backend).perspective(POSE, SIZE, HFOV)
    if backend == "cpu":
        assert_formula(picture, sun)
    else:  # edges are blurred by three texels of the map
        assert_formula(picture, sun, reach=1, tolerance=1.5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_moved_box_takes_its_shadow_along(backend):
    sun = {"direction": SUNS["high"], "strength": 0.65, "ambient": 0.5}
    renderer = Renderer(make_scene(sun), backend)
    before = renderer.perspective(POSE, SIZE, HFOV)
    for shift in ([0.3, 0.2, 0.25], [-0.2, 0.0, 0.1]):
        moved = np.eye(4)
        moved[:3, 3] = shift
        renderer.set_poses([2], moved[None])
        after = renderer.perspective(POSE, SIZE, HFOV)
        assert_formula(after, sun, shift, *((0, 0.75) if backend == "cpu" else (1, 1.5)))
        table_in_both = (before["instance"] == 1) & (after["instance"] == 1)
        assert np.any((before["color"] != after["color"])[table_in_both])


@pytest.mark.parametrize("backend", BACKENDS)
def test_light_falls_through_the_holes_of_a_cutout(backend):
    """A sheet whose left half is a hole, level over the floor under a sun at the zenith."""
    texture = np.full((64, 64, 4), 255, np.uint8)
    texture[:, :32, 3] = 0
    sheet, floor = quad([-1, 1, 1], [2, 0, 0], [0, 0, -2]), quad([-2, 0, 2], [4, 0, 0], [0, 0, -4])
    uv = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
    scene = Scene.from_arrays(
        [
            {"positions": floor, "triangles": quads_to_triangles(floor)},
            {"positions": sheet, "triangles": quads_to_triangles(sheet), "uv": uv, "material": 0},
        ],
        textures=[texture],
        materials=[{"texture": 0, "alpha_cutoff": 0.5}],
        sun={"direction": [0, 1, 0], "strength": 0.4, "ambient": 0.5},
    )
    renderer = Renderer(scene, backend)
    view = look([0, 0.5, 1.5], 0.0, -0.3)  # under the sheet
    for _ in range(2):
        picture = renderer.perspective(view, (90, 120), 80)
        rays = world_rays(view, (90, 120), 80)
        x, _, z = np.moveaxis(view[:3, 3] + picture["depth"][0][..., None] * rays, -1, 0)
        on_floor = (picture["instance"][0] == 1) & (np.abs(z) < 0.95)
        bright, dark = np.round(255 * (0.5 * 0.92 + 0.4)), np.round(255 * 0.5 * 0.92)
        red = picture["color"][0][..., 0].astype(int)
        assert np.abs(red - bright)[on_floor & (x > -0.9) & (x < -0.05)].max() <= 1
        assert np.abs(red - dark)[on_floor & (x > 0.05) & (x < 0.9)].max() <= 1
        renderer.set_poses([2], np.eye(4)[None])  # the moved part has holes as well


@needs_egl
@pytest.mark.gpu
def test_back_ends_agree_in_panoramas_away_from_edges():
    scene = make_scene({"direction": SUNS["high"]})
    cpu, gpu = (Renderer(scene, backend).panorama(POSE, (180, 360)) for backend in ("cpu", "gpu"))
    edges = near_edges(cpu["instance"][0], 2) | near_edges(cpu["color"][0].astype(int) @ [65536, 256, 1], 2)
    sky = cpu["instance"][0] == 0
    difference = np.abs(cpu["color"][0].astype(int) - gpu["color"][0]).max(-1)
    assert difference[~edges & ~sky].max() <= 2
    assert (~edges & ~sky).sum() > 0.5 * (~sky).sum()


def test_a_sun_comes_back_as_it_was_given():
    sun = make_scene({"direction": [0, 3, 4], "strength": 0.25, "ambient": 0.75}).sun
    assert sun["direction"] == pytest.approx((0, 0.6, 0.8))
    assert (sun["strength"], sun["ambient"]) == (0.25, 0.75)
    assert make_scene(None).sun is None
    default = make_scene({}).sun
    assert np.linalg.norm(default["direction"]) == pytest.approx(1)
    assert default["direction"][1] > 0


@pytest.mark.parametrize(
    ("sun", "message"),
    [
        ({"direction": [0, 0, 0]}, "not zero"),
        ({"direction": [0, np.nan, 1]}, "finite"),
        ({"direction": [0, 1]}, r"direction \[3\]"),
        ({"strength": -0.1}, r"strength must be in \[0, 1\], got -0.1"),
        ({"strength": 1.5}, "strength"),
        ({"ambient": float("nan")}, "ambient"),
        ({"color": [1, 1, 1]}, "'color' is no key of a sun"),
    ],
)
def test_suns_out_of_range_are_refused(sun, message):
    with pytest.raises(ArgumentError, match=message):
        make_scene(sun)


def test_pictures_do_not_remember_earlier_moves():
    angles = np.linspace(0, 2 * np.pi, 25)[:-1]
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tube = np.concatenate([np.insert(0.2 * ring, 1, height, axis=1) for height in (0.0, 0.5)]).astype(np.float32)
    sides = [[i, j, i + 24] for i, j in zip(range(24), (*range(1, 24), 0), strict=True)]
    sides += [[j, j + 24, i + 24] for i, j, _ in sides]
    normals = np.insert(np.concatenate([ring, ring]), 1, 0.0, axis=1).astype(np.float32)
    floor = quad([-1, 0, 1], [2, 0, 0], [0, 0, -2])
    meshes = [
        {"positions": floor, "triangles": quads_to_triangles(floor)},
        {"positions": tube, "triangles": np.array(sides), "normals": normals},
    ]
    scene = Scene.from_arrays(meshes, sun={"direction": SUNS["high"]})
    turned, wide = np.eye(4), np.diag([2.0, 1, 1, 1])
    turned[:3, :3] = [[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]
    travelled, fresh = Renderer(scene, "cpu"), Renderer(scene, "cpu")
    for pose in (turned, wide, turned):
        travelled.set_poses([2], pose[None])
    fresh.set_poses([2], turned[None])
    one, other = (renderer.perspective(POSE, SIZE, HFOV) for renderer in (travelled, fresh))
    assert (one["instance"] == 2).sum() > 300
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
