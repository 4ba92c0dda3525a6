# SPDX-License-Identifier: Apache-2.0
"""The memory of points behind PathDreamer and SE3DS: a readable twin, properties, and what a simulator sees."""

from __future__ import annotations

import ast
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import wiw
from wiw.action import FORWARD
from wiw.tasks.imagenav import ImageNav
from wiw.world_models.panoramic.server import memory
from wiw.world_models.panoramic.server.memory import Memory, Sight

SCALE = 10.0
SIZE = (16, 32)
FOLDER = Path(memory.__file__).parent
SEEDS = st.integers(0, 2**32 - 1)
STEPS = st.tuples(*[st.floats(-1.5, 1.5)] * 3)


def panorama(seed: int, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Colours without black, and depth of which a part is nothing or beyond the scale."""
    random = np.random.default_rng(seed)
    depth = random.uniform(-0.1, 1.2, size).clip(0, 1).astype(np.float32)
    return random.integers(1, 256, (*size, 3)).astype(np.uint8), depth


def twin(views: list[tuple], position: tuple[float, float, float], size: tuple[int, int]) -> Sight:
    """Pixel by pixel, from the words of the module."""
    height, width = size
    picture, depth = np.zeros((*size, 3), np.uint8), np.ones(size, np.float64)
    seen = np.zeros(size, bool)
    for colours, shares, stood in views:
        rows, columns = shares.shape
        for row in range(rows):
            for column in range(columns):
                if not 0 < shares[row, column] < 1:
                    continue
                down = math.pi * (row + 0.5) / rows
                right = 2 * math.pi * ((column + 0.5) / columns - 0.5)
                ray = (math.sin(down) * math.sin(right), math.sin(down) * math.cos(right), math.cos(down))
                x, y, z = (
                    s + SCALE * shares[row, column] * r - p for s, r, p in zip(stood, ray, position, strict=True)
                )
                far = math.sqrt(x * x + y * y + z * z)
                v = min(height - 1, int(math.acos(max(-1, min(1, z / far))) / math.pi * height))
                u = int((math.atan2(x, y) / (2 * math.pi) + 0.5) * width) % width
                if not seen[v, u] or far / SCALE < depth[v, u]:
                    picture[v, u], depth[v, u], seen[v, u] = colours[row, column], far / SCALE, True
    return Sight(picture, depth.clip(0, 1).astype(np.float32), seen)


@settings(max_examples=25)
@given(SEEDS, STEPS, STEPS)
def test_the_splat_is_its_twin(seed: int, stood: tuple, position: tuple) -> None:
    views = [(*panorama(seed), (0.0, 0.0, 0.0)), (*panorama(seed + 1), stood)]
    remembered = Memory(SCALE)
    for colours, depth, place in views:
        remembered.add(colours, depth, place)
    found, expected = remembered.view_from(position, SIZE), twin(views, position, SIZE)
    off = (found.features != expected.features).any(-1) | (found.seen != expected.seen)
    assert off.mean() <= 0.02  # points on the border of two pixels
    np.testing.assert_allclose(found.depth[~off], expected.depth[~off], atol=1e-5)


@given(SEEDS, STEPS)
def test_from_its_own_place_a_panorama_is_as_it_was(seed: int, place: tuple) -> None:
    colours, depth = panorama(seed)
    remembered = Memory(SCALE)
    remembered.add(colours, depth, place)
    found = remembered.view_from(place, SIZE)
    known = (depth > 0) & (depth < 1)
    np.testing.assert_array_equal(found.seen, known)
    np.testing.assert_array_equal(found.features, np.where(known[..., None], colours, 0))
    np.testing.assert_allclose(found.depth, np.where(known, depth, 1), atol=1e-6)
    assert len(remembered) == known.sum()


@given(st.floats(0.05, 0.4), st.floats(0.45, 0.95), st.booleans())
def test_the_nearer_of_two_is_seen(near: float, far: float, near_first: bool) -> None:
    remembered = Memory(SCALE)
    both = [(np.full(SIZE, 7, np.uint8), near), (np.full(SIZE, 9, np.uint8), far)]
    for labels, share in both if near_first else both[::-1]:
        remembered.add(labels, np.full(SIZE, share, np.float32), (0, 0, 0))
    found = remembered.view_from((0, 0, 0), SIZE)
    assert (found.features == 7).all() and found.seen.all()
    np.testing.assert_allclose(found.depth, near, atol=1e-6)


@given(st.floats(0.5, 4), st.floats(-0.4, 0.4))
def test_what_lies_ahead_comes_nearer_by_the_step(distance: float, step: float) -> None:
    colours, depth = np.zeros((15, 31), np.uint8), np.zeros((15, 31), np.float32)
    colours[7, 15], depth[7, 15] = 200, distance / SCALE
    remembered = Memory(SCALE)
    remembered.add(colours, depth, (0, 0, 0))
    found = remembered.view_from((0, step, 0), (15, 31))
    assert found.features[7, 15] == 200 and found.seen.sum() == 1
    assert found.depth[7, 15] * SCALE == pytest.approx(distance - step, abs=1e-5)


def test_axes_are_right_ahead_and_up() -> None:
    for position, side in (((1, 0, 0), (8, 24)), ((0, 1, 0), (8, 16)), ((-1, 0, 0), (8, 8)), ((0, 0, 1), (0, 0))):
        v, u = side
        ray = memory.directions((16, 32))[v, u]
        assert np.dot(ray, position) > 0.9


def test_only_what_is_to_be_kept_is_remembered() -> None:
    colours, _ = panorama(0)
    keep = np.zeros(SIZE, bool)
    keep[memory.sharp_rows(SIZE[0])] = True
    remembered = Memory(SCALE)
    remembered.add(colours, np.full(SIZE, 0.5, np.float32), (0, 0, 0), keep)
    seen = remembered.view_from((0, 0, 0), SIZE).seen
    assert not seen[:2].any() and not seen[15:].any() and seen[2:15].all()
    assert memory.sharp_rows(512) == slice(64, 449)


@given(SEEDS)
def test_resizing_keeps_what_is_constant_and_labels_stay_labels(seed: int) -> None:
    colours, depth = panorama(seed, (18, 32))
    flat = np.full((18, 32, 3), 77, np.uint8)
    np.testing.assert_array_equal(memory.resize_smooth(flat, (16, 24)), 77)
    assert set(np.unique(memory.resize_nearest(depth, (16, 24)))) <= set(np.unique(depth))
    np.testing.assert_array_equal(memory.resize_nearest(colours, (18, 32)), colours)
    np.testing.assert_array_equal(memory.resize_smooth(colours, (18, 32)), colours)


def test_viewpoints_of_plans_are_places_and_turns() -> None:
    for yaw in np.radians([0, 22.5, -90, 180]):
        cos, sin = np.cos(yaw), np.sin(yaw)
        pose = np.array([[cos, 0, sin, 0.3], [0, 1, 0, 0.1], [-sin, 0, cos, -2], [0, 0, 0, 1]])
        position, found = memory.locate_camera(pose)
        assert position == (0.3, 2, 0.1) and math.isclose(math.cos(found - yaw), 1)
    image = np.random.default_rng(0).integers(0, 256, (4, 32, 3), np.uint8)
    np.testing.assert_array_equal(memory.turn_panorama(image, np.radians(22.5)), wiw.panorama.rotate(image, 22.5))
    with pytest.raises(ValueError, match="upright"):
        memory.locate_camera(np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]]))


def test_a_step_in_a_room_shows_what_the_simulator_does(two_rooms: str) -> None:
    """Where the nearest point lies on what is truly seen there, its colour is right; others are holes or leaks."""
    task = ImageNav(scenes=two_rooms)
    env = task.environment(depth=True)
    observation = env.begin(task.episode(0))
    ahead = env.fork()
    before = ahead.camera_poses_after(np.array([FORWARD], np.int8))  # the same place if the way is blocked
    ahead.step(int(FORWARD))
    truth = ahead.observe(["panorama", "depth"])
    pose = np.linalg.inv(_pose(env.fork())) @ before[0]
    remembered = Memory(SCALE)
    remembered.add(observation.panorama, (observation.depth / SCALE).clip(0, 1), (0, 0, 0))
    found = remembered.view_from(memory.locate_camera(pose)[0], (576, 1024))
    close = found.seen & (np.abs(found.depth * SCALE - truth["depth"]) < 0.02 * truth["depth"])
    error = np.abs(found.features.astype(float) - truth["panorama"])[close]
    assert close.mean() > 0.5 and np.linalg.norm(pose[:3, 3]) > 0.1
    assert 10 * np.log10(255**2 / (error**2).mean()) > 30


def _pose(simulator: object) -> np.ndarray:
    return simulator.camera_poses_after(np.array([4], np.int8))[0]  # type: ignore[attr-defined]


@pytest.mark.parametrize("file", ["memory.py", "messages.py", "networks.py", "shim.py"])
def test_it_runs_where_the_official_code_does(file: str) -> None:
    """Python 3.8, and nothing of wiw."""
    tree = ast.parse((FOLDER / file).read_text(), feature_version=(3, 8))
    names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    assert not any(name.split(".")[0] == "wiw" for name in names if name)
