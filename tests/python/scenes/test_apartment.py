# SPDX-License-Identifier: Apache-2.0
"""The apartment generator as users meet it; cpp/tests/apartment tests its geometry and light."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
from locations import ROOT

import wiw.scenes
from wiw import _core
from wiw.errors import ArgumentError
from wiw.nav import NavMesh
from wiw.render import Renderer

PYTHON = ROOT / "python"


@pytest.fixture(scope="module")
def scene() -> wiw.scenes.Scene:
    return wiw.scenes.apartment(3, "val")


def test_it_tells_what_is_where(scene: wiw.scenes.Scene) -> None:
    rooms = {room["name"] for room in scene.rooms}
    assert 5 <= len(rooms) <= 9
    assert scene.attributes["split"] == "val"
    assert [instance["id"] for instance in scene.instances] == list(range(1, len(scene.instances) + 1))
    for instance in scene.instances:
        assert instance["attributes"]["room"] in rooms
        assert instance["attributes"]["color"]
        assert instance["category"] in scene.categories
    assert len(set(scene.categories)) == len(scene.categories) >= 25
    assert {"wall", "floor", "ceiling", "door", "window", "bed", "sofa", "toilet"} <= set(scene.categories)


def test_the_defaults_of_the_agent_reach_every_room(scene: wiw.scenes.Scene) -> None:
    mesh = NavMesh.build(scene)
    places = mesh.sample(600, seed=0)
    ground = places[places[:, 1] < 0.3]
    assert len(ground) > 400
    distances = mesh.distance_matrix(ground)
    reached = ground[np.isfinite(distances[0])]
    for room in scene.rooms:
        low, high = room["bounds"]
        inside = np.all((reached[:, [0, 2]] > low[[0, 2]]) & (reached[:, [0, 2]] < high[[0, 2]]), axis=1)
        assert inside.any(), room["name"]


def test_rooms_are_bright_but_not_blown_out_and_look_different(scene: wiw.scenes.Scene) -> None:
    poses = np.tile(np.eye(4), (len(scene.rooms), 1, 1))
    for pose, room in zip(poses, scene.rooms, strict=True):
        pose[:3, 3] = room["bounds"].mean(axis=0)
    pictures = Renderer(scene, backend="cpu").panorama(poses, (144, 256), outputs=("color",))["color"]
    brightness = pictures.mean(axis=(1, 2, 3))
    assert np.all(brightness > 70), brightness
    assert np.all(brightness < 225), brightness
    assert (pictures.min(axis=-1) >= 254).mean() < 0.06
    mean_color = pictures.mean(axis=(1, 2))
    apart = np.linalg.norm(mean_color[:, None] - mean_color[None], axis=-1)
    assert np.median(apart[~np.eye(len(apart), dtype=bool)]) > 10


def test_splits_share_neither_layouts_nor_colors() -> None:
    layouts, colors = [], []
    for split in ("train", "val", "test"):
        identities = [_core.scene.apartment_identity(seed, split) for seed in range(50)]
        layouts.append({layout for layout, _ in identities})
        colors.append({color for _, palette in identities for color in palette})
    for sets in (layouts, colors):
        assert all(a.isdisjoint(b) for a, b in itertools.combinations(sets, 2))


def test_an_unknown_split_is_refused() -> None:
    with pytest.raises(ArgumentError, match="'train', 'val' or 'test'"):
        wiw.scenes.apartment(0, "dev")


_DIGEST = """
import hashlib, numpy, wiw.scenes, wiw.render
scene = wiw.scenes.apartment(2, "train", cache=False)
pose = numpy.eye(4)
pose[:3, 3] = scene.rooms[0]["bounds"].mean(axis=0)
color = wiw.render.Renderer(scene, backend="cpu").panorama(pose[None], (288, 512), outputs=("color",))["color"]
data = b"".join(array.tobytes() for array in scene.world_triangles()) + color.tobytes()
print(hashlib.sha256(data).hexdigest(), wiw._core.core.num_threads())
"""


@pytest.mark.nightly
def test_bytes_are_the_same_in_another_process_with_another_number_of_threads() -> None:
    def digest(threads: int) -> list[str]:
        environment = {**os.environ, "WIW_NUM_THREADS": str(threads), "PYTHONPATH": str(PYTHON)}
        done = subprocess.run(
            [sys.executable, "-c", _DIGEST], env=environment, capture_output=True, text=True, check=True
        )
        return done.stdout.split()

    (first, one), (second, two) = digest(1), digest(2)
    assert (one, two) == ("1", "2")
    assert first == second
