# SPDX-License-Identifier: Apache-2.0
"""The OpenGL back end through Python: agreement with the ray caster, and every way a machine can lack a GPU."""

import os
import subprocess
import sys
import textwrap
import threading

import numpy as np
import pytest
from egl import needs_egl, usable_devices

from wiw import _core, scenes
from wiw.render import Renderer

pytestmark = pytest.mark.gpu


def quad(corner, across, along):
    corner, across, along = (np.asarray(v, np.float32) for v in (corner, across, along))
    positions = np.stack([corner, corner + across, corner + across + along, corner + along])
    uv = np.float32([[0, 0], [3, 0], [3, 3], [0, 3]])
    return {"positions": positions, "triangles": np.uint32([[0, 1, 2], [0, 2, 3]]), "uv": uv, "material": 0}


@pytest.fixture(scope="module")
def room():
    y, x = np.mgrid[0:64, 0:64] / 64 * 2 * np.pi
    texture = np.stack([130 + 90 * np.sin(x), 120 + 80 * np.cos(2 * y), 110 + 70 * np.sin(x + y)], axis=2)
    texture = np.dstack([texture, np.full((64, 64), 255)]).astype(np.uint8)
    meshes = [
        quad([-3, 0, 3], [6, 0, 0], [0, 0, -6]),
        quad([-3, 0, -3], [6, 0, 0], [0, 2.5, 0]),
        quad([3, 0, -3], [0, 0, 6], [0, 2.5, 0]),
        quad([-0.5, 0.5, -1.5], [1, 0.2, 0], [0, 1, 0.3]),
    ]
    return _core.scene.Scene.from_arrays(meshes, textures=[texture], materials=[{"name": "blobs", "texture": 0}])


def poses(count=4, height=1.2, spread=1.0, seed=0):
    generator = np.random.default_rng(seed)
    out = np.tile(np.eye(4), (count, 1, 1))
    for pose in out:
        yaw = generator.uniform(0, 2 * np.pi)
        cos, sin = np.cos(yaw), np.sin(yaw)
        pose[:3, :3] = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
        pose[:3, 3] = [generator.uniform(-spread, spread), height, generator.uniform(-spread, spread)]
    return out


def silhouettes(instance, depth):
    edge = np.zeros(instance.shape, bool)
    across = (instance[..., 1:] != instance[..., :-1]) | (np.abs(np.diff(depth, axis=-1)) > 0.1)
    along = (instance[..., 1:, :] != instance[..., :-1, :]) | (np.abs(np.diff(depth, axis=-2)) > 0.1)
    edge[..., 1:] |= across
    edge[..., :-1] |= across
    edge[..., 1:, :] |= along
    edge[..., :-1, :] |= along
    return edge


def assert_agree(cpu, gpu, ids, color):
    assert np.mean(cpu["instance"] != gpu["instance"]) < ids
    away = ~silhouettes(cpu["instance"], cpu["depth"])
    assert np.mean((np.abs(cpu["depth"] - gpu["depth"]) > 0.01) & away) < 0.001
    assert np.mean(np.abs(cpu["color"].astype(int) - gpu["color"])) < color


def run_python(code, **environment):
    """Output of a fresh interpreter, whose last line it is asked to print."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout.strip()


ONE_TRIANGLE = """
import numpy as np
from wiw import _core
from wiw.errors import BackendError
from wiw.render import Renderer
scene = _core.scene.Scene.from_arrays(
    [{"positions": np.float32([[-1, 0, -2], [1, 0, -2], [0, 1, -2]]), "triangles": np.uint32([[0, 1, 2]])}])
"""


@needs_egl
def test_devices_say_what_they_are():
    for device in usable_devices():
        assert device["vendor"]
        assert device["renderer"]
        assert int(device["version"].split(".")[0]) >= 3
        assert device["software"] or "llvmpipe" not in device["renderer"]


@needs_egl
def test_agrees_with_the_ray_caster(room):
    cpu, gpu = Renderer(room, "cpu"), Renderer(room, "gpu")
    assert gpu.description.startswith("gpu (")
    views = poses()
    assert_agree(cpu.perspective(views, (160, 200), 80), gpu.perspective(views, (160, 200), 80), 0.001, 0.5)
    assert_agree(cpu.panorama(views, (144, 256)), gpu.panorama(views, (144, 256)), 0.005, 2.0)


@needs_egl
def test_agrees_on_a_real_house(data_dir):
    house = scenes.load(data_dir / "small_house" / "worlds" / "small_house.world")
    cpu, gpu = Renderer(house, "cpu"), Renderer(house, "gpu")
    views = poses(count=3, spread=4.0, seed=1)
    assert_agree(cpu.perspective(views, (240, 240), 90), gpu.perspective(views, (240, 240), 90), 0.001, 0.5)
    assert_agree(cpu.panorama(views, (576, 1024)), gpu.panorama(views, (576, 1024)), 0.005, 1.0)


@needs_egl
def test_a_panorama_shows_what_a_view_along_the_same_rays_shows(room):
    gpu = Renderer(room, "gpu")
    pose = poses(count=1)
    panorama = gpu.panorama(pose, (360, 720))
    view = gpu.perspective(pose, (201, 201), 60)
    focal = 201 / (2 * np.tan(np.radians(30)))
    v, u = np.mgrid[0:201, 0:201] - 100.0
    ray = np.stack([u / focal, -v / focal, -np.ones_like(u)], axis=-1)
    length = np.linalg.norm(ray, axis=-1)
    longitude = np.arctan2(ray[..., 0], -ray[..., 2])
    latitude = np.arcsin(ray[..., 1] / length)
    column = np.floor((longitude / (2 * np.pi) + 0.5) * 720).astype(int)
    row = np.floor((0.5 - latitude / np.pi) * 360).astype(int)
    ids = panorama["instance"][0][row, column]
    assert np.mean(ids != view["instance"][0]) < 0.02  # half a pixel of the panorama around outlines
    away = (ids == view["instance"][0]) & (ids != 0)
    distance = view["depth"][0] * length
    ratio = panorama["depth"][0][row, column][away] / distance[away]
    assert np.median(np.abs(ratio - 1)) < 0.005
    assert np.percentile(np.abs(ratio - 1), 99) < 0.05


@needs_egl
def test_writes_into_given_arrays_and_only_the_asked_outputs(room):
    gpu = Renderer(room, "gpu")
    views = poses()
    whole = gpu.perspective(views, (64, 80), 90)
    depth = np.full((4, 64, 80), -1, np.float32)
    only = gpu.perspective(views, (64, 80), 90, outputs=("depth",), out={"depth": depth})
    assert only["depth"] is depth
    assert set(only) == {"depth"}
    np.testing.assert_array_equal(depth, whole["depth"])


@needs_egl
def test_moved_instances_follow(room):
    gpu, cpu = Renderer(room, "gpu"), Renderer(room, "cpu")
    moved = np.eye(4)
    moved[:3, 3] = [0.3, 0.4, -0.5]
    views = poses()
    before = gpu.perspective(views, (96, 96), 90)
    for renderer in (gpu, cpu):
        renderer.set_poses([4], moved[None])
    after = gpu.perspective(views, (96, 96), 90)
    assert np.any(before["instance"] != after["instance"])
    assert_agree(cpu.perspective(views, (96, 96), 90), after, 0.001, 0.5)


@needs_egl
def test_works_from_any_thread(room):
    views = poses()
    expected = Renderer(room, "gpu").perspective(views, (64, 64), 90)
    pictures = {}

    def work(index):
        pictures[index] = Renderer(room, "gpu").perspective(views, (64, 64), 90)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for picture in pictures.values():
        for name, values in picture.items():
            np.testing.assert_array_equal(values, expected[name])


def test_without_egl_everything_else_works():
    code = (
        ONE_TRIANGLE
        + """
assert Renderer(scene).description.startswith("cpu")
for use in (lambda: Renderer(scene, "gpu"), _core.render.egl_devices):
    try:
        use()
    except BackendError as error:
        assert "libegl1" in str(error) and "libNoSuchEGL.so" in str(error), error
    else:
        raise AssertionError("expected BackendError")
print("fine")
"""
    )
    assert run_python(code, WIW_EGL_LIBRARY="libNoSuchEGL.so") == "fine"


@needs_egl
def test_an_unknown_device_is_named():
    code = ONE_TRIANGLE + 'try:\n    Renderer(scene, "gpu")\nexcept BackendError as error:\n    print(error)'
    message = run_python(code, WIW_EGL_DEVICE="99")
    assert "WIW_EGL_DEVICE=99" in message
    assert "wiw doctor" in message


@needs_egl
@pytest.mark.parametrize("device", [str(device["index"]) for device in usable_devices()])
def test_every_device_can_be_chosen(device):
    code = ONE_TRIANGLE + 'print(Renderer(scene, "gpu").perspective(np.eye(4), (9, 9), 90)["instance"].max())'
    assert run_python(code, WIW_EGL_DEVICE=device) == "1"


@needs_egl
def test_a_fork_is_refused_with_the_remedy():
    code = (
        ONE_TRIANGLE
        + """
import os
gpu = Renderer(scene, "gpu")
pid = os.fork()
if pid == 0:
    try:
        gpu.perspective(np.eye(4), (9, 9), 90)
    except BackendError as error:
        os._exit(0 if "spawn" in str(error) else 1)
    os._exit(2)
print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
"""
    )
    assert run_python(code) == "0"


def test_auto_takes_the_ray_caster_unless_there_is_hardware():
    hardware = any(not device["software"] for device in usable_devices())
    description = run_python(ONE_TRIANGLE + "print(Renderer(scene).description)", WIW_EGL_DEVICE="")
    assert description.startswith("gpu" if hardware else "cpu")
