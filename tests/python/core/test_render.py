# SPDX-License-Identifier: Apache-2.0
"""The ray caster through Python: shapes, given buffers, errors, threads, and an independent ray caster as oracle."""

import hashlib
import os
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from locations import PYTHON_TESTS

from wiw.errors import ArgumentError
from wiw.render import Renderer
from wiw.scenes import Scene


def boxes(seed, count=12):
    """A closed room of 6 x 3 x 5 m with boxes in it: positions [V, 3], triangles [T, 3] of each, room first."""
    rng = np.random.default_rng(seed)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)
    extents = [(np.array([-3, 0, -2.5]), np.array([6, 3, 5]))]
    extents += [(rng.uniform([-2.8, 0, -2.3], [2, 2, 1.5]), rng.uniform(0.1, 0.9, 3)) for _ in range(count)]
    return [((low + size * corners).astype(np.float32), triangles) for low, size in extents]


def make_scene(seed=3):
    rng = np.random.default_rng(seed)
    texture = rng.integers(0, 256, (32, 32, 4), np.uint8)
    meshes = [
        {"positions": p, "triangles": t, "uv": p[:, :2] * 0.7, "material": i % 2}
        for i, (p, t) in enumerate(boxes(seed))
    ]
    materials = [{"name": "noise", "texture": 0}, {"name": "paint", "base_color": [0.2, 0.6, 0.4, 1]}]
    return Scene.from_arrays(meshes, textures=[texture], materials=materials)


def look(position, yaw=0.0, pitch=0.0):
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ [[1, 0, 0], [0, cp, -sp], [0, sp, cp]]
    pose[:3, 3] = position
    return pose


POSES = np.stack([look([0, 1.5, 0], 0.3), look([1, 0.4, 1.2], 2.2, 0.4), look([-2, 2.5, -1], -2, -0.6)])


@pytest.fixture(scope="module")
def renderer():
    return Renderer(make_scene(), "cpu")


def world_rays(pose, size, hfov_deg=None):
    """Directions [H, W, 3], scaled so that depth times direction reaches the surface."""
    height, width = size
    y, x = np.mgrid[:height, :width] + 0.5
    if hfov_deg is None:
        longitude, latitude = (x / width - 0.5) * 2 * np.pi, (0.5 - y / height) * np.pi
        rays = [np.sin(longitude) * np.cos(latitude), np.sin(latitude), -np.cos(longitude) * np.cos(latitude)]
    else:
        focal = width / 2 / np.tan(np.radians(hfov_deg) / 2)
        rays = [(x - width / 2) / focal, -(y - height / 2) / focal, -np.ones_like(x)]
    return np.stack(rays, -1) @ pose[:3, :3].T


@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def nearest_hits(meshes, origin, rays, margin=1e-6):
    """Moeller-Trumbore against every triangle: depth [N], mesh number from 1 [N], gap to the second surface [N].

    `margin` widens triangles (narrows them below zero), in barycentric coordinates.
    """
    depth, mesh, second = np.full(len(rays), np.inf), np.zeros(len(rays), int), np.full(len(rays), np.inf)
    for number, (positions, triangles) in enumerate(meshes, 1):
        for a, b, c in positions[triangles].astype(float):
            p = np.cross(rays, c - a)
            determinant = p @ (b - a)
            inverse = np.where(np.abs(determinant) > 1e-9, 1 / determinant, np.nan)  # NaN: along the plane, no hit
            u = (p @ (origin - a)) * inverse
            q = np.cross(origin - a, b - a)
            v = (rays @ q) * inverse
            t = ((c - a) @ q) * inverse
            t = np.where((u >= -margin) & (v >= -margin) & (u + v <= 1 + margin) & (t > 0.01), t, np.inf)
            nearer = t < depth
            other = np.where(nearer, depth, t)
            same_face = np.abs(other - np.minimum(t, depth)) < 1e-6  # the other half of a quad, along its diagonal
            second = np.minimum(second, np.where(same_face & (mesh == number), np.inf, other))
            depth, mesh = np.where(nearer, t, depth), np.where(nearer, number, mesh)
    return depth, mesh, second - depth


@example(seed=0, position=(0.0, 1.0, 0.0), yaw=0.0, pitch=7e-20, hfov_deg=None)  # ray components below 1e-19
@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 1000),
    st.tuples(st.floats(-2.9, 2.9), st.floats(0.1, 2.9), st.floats(-2.4, 2.4)),
    st.floats(-4, 4),
    st.floats(-1.4, 1.4),
    st.sampled_from([None, 30.0, 90.0, 140.0]),
)
def test_depth_and_ids_are_those_of_a_slow_ray_caster(seed, position, yaw, pitch, hfov_deg):
    meshes = boxes(seed)
    scene = Scene.from_arrays([{"positions": p, "triangles": t} for p, t in meshes])
    pose, size = look(position, yaw, pitch), (13, 22)
    renderer = Renderer(scene, "cpu")
    picture = renderer.panorama(pose, size) if hfov_deg is None else renderer.perspective(pose, size, hfov_deg)
    rays = world_rays(pose, size, hfov_deg).reshape(-1, 3)
    depth, mesh, gap = nearest_hits(meshes, pose[:3, 3], rays)
    sure = (gap > 1e-3) & (nearest_hits(meshes, pose[:3, 3], rays, -1e-5)[0] == depth)  # away from edges, too
    assert sure.mean() > 0.7
    assert np.abs(picture["depth"].ravel() - depth)[sure].max() < 1e-4
    assert (picture["instance"].ravel() == mesh)[sure].all()


def test_trimesh_casts_the_same_rays(renderer):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    meshes = boxes(3)
    offsets = np.cumsum([0] + [len(p) for p, _ in meshes])
    whole = trimesh.Trimesh(
        np.concatenate([p for p, _ in meshes]),
        np.concatenate([t + o for (_, t), o in zip(meshes, offsets[:-1], strict=True)]),
        process=False,
    )
    for hfov_deg in (None, 75.0):
        size = (60, 90)
        picture = renderer.panorama(POSES, size) if hfov_deg is None else renderer.perspective(POSES, size, hfov_deg)
        for i, pose in enumerate(POSES):
            rays = world_rays(pose, size, hfov_deg).reshape(-1, 3)
            points, number, face = whole.ray.intersects_location(np.tile(pose[:3, 3], (len(rays), 1)), rays, False)
            along = np.linalg.norm(points - pose[:3, 3], axis=1) / np.linalg.norm(rays[number], axis=1)
            close = np.abs(picture["depth"][i].ravel()[number] - along) < 1e-4
            same = picture["instance"][i].ravel()[number] == face // 12 + 1
            assert close.mean() > 0.998 and same.mean() > 0.998


def test_shapes_and_dtypes(renderer):
    picture = renderer.perspective(POSES, (20, 30), 70)
    assert list(picture) == ["color", "depth", "instance"]
    assert picture["color"].shape == (3, 20, 30, 3) and picture["color"].dtype == np.uint8
    assert picture["depth"].shape == (3, 20, 30) and picture["depth"].dtype == np.float32
    assert picture["instance"].shape == (3, 20, 30) and picture["instance"].dtype == np.uint32
    assert renderer.panorama(POSES[0])["color"].shape == (1, 576, 1024, 3)
    assert list(renderer.panorama(POSES, (8, 16), outputs=("depth",))) == ["depth"]
    assert renderer.perspective(POSES[:0], (4, 4), 90)["depth"].shape == (0, 4, 4)
    assert "Embree" in renderer.description


def test_writes_into_given_buffers(renderer):
    pool = np.full((5, 20, 30), -1, np.float32)
    picture = renderer.perspective(POSES, (20, 30), 70, outputs=("depth", "instance"), out={"depth": pool[1:4]})
    assert np.shares_memory(picture["depth"], pool)
    assert (pool[[0, 4]] == -1).all() and (pool[1:4] > 0).all()
    assert np.array_equal(pool[1:4], renderer.perspective(POSES, (20, 30), 70)["depth"])


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ({"depth": np.zeros((3, 20, 31), np.float32)}, "got \\[3, 20, 31\\]"),
        ({"depth": np.zeros((3, 20, 30))}, "float32"),
        ({"depth": np.zeros((3, 20, 60), np.float32)[:, :, ::2]}, "contiguous"),
        ({"depth": "no array"}, "str"),
        ({"normals": np.zeros((3, 20, 30), np.float32)}, "normals"),
    ],
)
def test_buffers_that_do_not_fit_are_refused(renderer, out, message):
    with pytest.raises(ArgumentError, match=message):
        renderer.perspective(POSES, (20, 30), 70, outputs=("depth",), out=out)


def test_read_only_buffers_are_refused(renderer):
    depth = np.zeros((3, 20, 30), np.float32)
    depth.flags.writeable = False
    with pytest.raises(ArgumentError, match="writeable"):
        renderer.perspective(POSES, (20, 30), 70, outputs=("depth",), out={"depth": depth})


def test_bad_arguments_are_refused(renderer):
    with pytest.raises(ArgumentError, match="rigid"):
        renderer.perspective(np.zeros((4, 4)), (20, 30), 70)
    with pytest.raises(ArgumentError, match="1e9 m"):
        renderer.panorama(np.block([[np.eye(3), np.full((3, 1), 1e20)], [np.zeros((1, 3)), 1]]), (20, 30))
    with pytest.raises(ArgumentError, match=r"\[B, 4, 4\]"):
        renderer.perspective(np.zeros((2, 3, 4)), (20, 30), 70)
    with pytest.raises(ArgumentError, match="180"):
        renderer.perspective(POSES, (20, 30), 180)
    with pytest.raises(ArgumentError, match="size"):
        renderer.panorama(POSES, (0, 30))
    with pytest.raises(ArgumentError, match="normals"):
        renderer.panorama(POSES, (20, 30), outputs=("normals",))
    with pytest.raises(ArgumentError, match="unsigned"):
        renderer.set_poses([-1], np.eye(4)[None])
    with pytest.raises(ArgumentError, match="does not exist"):
        renderer.set_poses([99], np.eye(4)[None])
    with pytest.raises(ArgumentError, match="backend"):
        Renderer(make_scene(), "vulkan")  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="samples"):
        Renderer(make_scene(), "cpu", samples=2)


def test_moved_instances_are_where_they_were_put():
    renderer = Renderer(make_scene(), "cpu")
    before = renderer.perspective(POSES, (60, 80), 90)
    away = np.eye(4)
    away[:3, 3] = 100
    hidden = list(range(2, 14))
    renderer.set_poses(hidden, np.tile(away, (12, 1, 1)))
    empty = renderer.perspective(POSES, (60, 80), 90)
    assert set(np.unique(empty["instance"])) == {1}
    renderer.set_poses(hidden, np.tile(np.eye(4), (12, 1, 1)))
    back = renderer.perspective(POSES, (60, 80), 90)
    assert all(np.array_equal(before[name], back[name]) for name in before)


def digest(threads):
    code = """
    import hashlib, sys, test_render as t
    picture = t.Renderer(t.make_scene(), "cpu", samples=4).panorama(t.POSES, (70, 131))
    print(hashlib.sha256(b"".join(picture[name].tobytes() for name in picture)).hexdigest())
    """
    paths = os.pathsep.join([str(PYTHON_TESTS), *filter(None, sys.path)])
    result = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "PYTHONPATH": paths, "WIW_NUM_THREADS": str(threads)},
        capture_output=True,
        text=True,
        check=True,
    )
    return result.stdout.strip()


def test_any_number_of_threads_gives_the_same_bytes():
    assert digest(1) == digest(2) == digest(5)


def test_one_renderer_serves_several_python_threads(renderer):
    wanted = hashlib.sha256(renderer.panorama(POSES, (50, 90))["color"].tobytes()).digest()
    seen = []

    def work():
        for _ in range(5):
            seen.append(hashlib.sha256(renderer.panorama(POSES, (50, 90))["color"].tobytes()).digest())

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [wanted] * 20
