# SPDX-License-Identifier: Apache-2.0
"""Frames in the size of a small network: where their depth is taken, and how they are written."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from wiw.datasets.cameras import camera_pose
from wiw.datasets.worlds import world
from wiw.errors import FileError
from wiw.training.collect_navigation import collect_navigation

pytest.importorskip("pyarrow", reason="needs wiw[export]")
pytest.importorskip("torch", reason="needs wiw[torch]")

from wiw.training import reduced_frames
from wiw.training.reduced_frames import ReducedFrames, compute_log_distances, reduce_depth, reduce_frames

RULES = {"min_samples": 60, "spacing": 1.5, "leaf_ratio": 0.5, "max_scene_frames": 40}
SIZE = (16, 32)


# -- depth -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(64, 128), (72, 144), (50, 100)])
def test_depth_is_that_in_the_middle_of_a_pixel(size: tuple[int, int]) -> None:
    rows, columns = np.indices((576, 1024)) + 0.5
    for places, axis in ((rows, 0), (columns, 1)):
        shown = np.exp(reduce_depth((1 + places / 100).astype(np.float32), size).astype(np.float64)).mean(axis=1 - axis)
        step = places.shape[axis] / size[axis]
        middles = (np.arange(size[axis]) + 0.5) * step
        off = 100 * (shown - 1) - middles  # in pixels of the large one: up to half a pixel, and float16
        assert abs(off.mean()) < 0.6 and np.abs(off).max() < 1.8


def test_a_mirrored_depth_is_reduced_to_the_mirrored_one() -> None:
    depth = np.random.default_rng(0).uniform(0.5, 9, (45, 99)).astype(np.float32)
    np.testing.assert_array_equal(reduce_depth(depth[:, ::-1], (9, 11))[:, ::-1], reduce_depth(depth, (9, 11)))
    np.testing.assert_array_equal(reduce_depth(depth[::-1], (9, 11))[::-1], reduce_depth(depth, (9, 11)))


def test_reduced_depth_is_what_is_rendered_in_that_size(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    points = place.ground.put_down(place.navmesh.sample(3, 1, place.floor)).astype(float)
    poses = np.stack([camera_pose(point, 0.3 * number) for number, point in enumerate(points)])
    large, small = (
        place.renderer.panorama(poses, size, outputs=("depth",))["depth"] for size in ((9 * SIZE[0], 9 * SIZE[1]), SIZE)
    )
    reduced = np.stack([reduce_depth(depth, SIZE) for depth in large]).astype(np.float32)
    error = np.abs(reduced - compute_log_distances(small))
    assert (error < 2e-3).mean() > 0.99, "rays through the middle of a pixel are the same in both"


# -- arrays ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [True, False])
def test_arrays_are_the_segments_one_after_another(depth: bool, two_rooms: str, tmp_path: Path) -> None:
    made: dict[str, Any] = {"rules": RULES, "size": (32, 64), "backend": "cpu", "lossless": True, "depth": depth}
    data = collect_navigation(tmp_path / "data", two_rooms, **made)
    frames, places = reduce_frames(data, (32, 64), tmp_path / "cache"), 0
    assert len(data) > 1 and frames.starts.tolist() == np.cumsum([0, *map(len, data)])[:-1].tolist()
    for index, segment in enumerate(data):
        shown = frames.find_places(index, 0, len(segment))
        assert shown.tolist() == list(range(places, places + len(shown)))
        sources = np.unique(segment.sources)
        np.testing.assert_array_equal(frames.images[shown], segment.images[sources])
        if segment.depths is not None:
            exact = reduced_frames.compute_log_distances(segment.depths[sources])
            np.testing.assert_allclose(frames.log_distances[shown], exact, atol=2e-3)
        places += len(shown)
    assert len(frames.images) == len(frames.poses) == places
    assert frames.log_distances.shape == ((places, 32, 64) if depth else (places, 0, 0))


class _Data:
    """As many segments as wanted, of 2 pictures each."""

    folder, meta = Path("data"), {"files": {}}

    def __init__(self, segments: int, pictures: int = 2) -> None:
        row = {"scene": "home", "segment": 0, "file": "data/a.parquet", "row_group": 0, "pictures": pictures}
        self.segments = [row] * segments

    def __len__(self) -> int:
        return len(self.segments)

    def __iter__(self) -> Any:
        return (SimpleNamespace() for _ in self.segments)


def reduce_made_up(data: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> ReducedFrames:
    def make(*_: Any) -> dict[str, Any]:
        large = np.zeros((2, 512, 1024, 3), np.uint8), np.zeros((2, 512, 1024), np.float16)
        return {"images": large[0], "log_distances": large[1], "poses": np.zeros((2, 3)), "pictures": np.arange(2)}

    monkeypatch.setattr(reduced_frames, "_reduce_segment", make)
    return reduce_frames(data, (512, 1024), folder)


def test_pictures_of_one_segment_at_a_time_are_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tracemalloc.start()
    try:
        frames = reduce_made_up(_Data(12), tmp_path, monkeypatch)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    one = (frames.images.nbytes + frames.log_distances.nbytes) / 12
    assert len(frames.images) == 24 and peak < 4 * one


def test_pictures_that_are_not_listed_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileError, match=r"home, segment 0: expected 3 pictures as in segments\.parquet, got 2"):
        reduce_made_up(_Data(2, pictures=3), tmp_path, monkeypatch)
    assert not list(tmp_path.iterdir())
