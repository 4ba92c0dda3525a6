# SPDX-License-Identifier: Apache-2.0
"""Votes for the category of voxels, against a dictionary of them."""

from __future__ import annotations

from collections import defaultdict
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from wiw.mapping.fragments import pack_voxels
from wiw.mapping.label_votes import MOST_DEPTH, STRIDE, LabelVotes
from wiw.mapping.object_map import ObjectMap
from wiw.mapping.views import Views, place_cameras, unproject

NAMES = ("", "wall", "chair", "cup")
SIZE = (24, 32)


def make_views(depth: float | NDArray[np.float32], odometry: tuple[float, float, float] = (0, 0, 0)) -> Views:
    pose = np.array(odometry, float)
    filled = np.broadcast_to(np.float32(depth), (4, *SIZE)).copy()
    return Views(np.zeros((4, *SIZE, 3), np.uint8), filled, place_cameras(pose), pose)


def make_labels(category: NDArray[np.uint8], confidence: NDArray[np.float32] | float = 1.0) -> Any:
    return SimpleNamespace(
        category=category,
        confidence=np.broadcast_to(np.float32(confidence), category.shape).copy(),
        state=np.zeros_like(category),
    )


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), looks=st.integers(1, 3))
def test_votes_are_those_of_a_dictionary(seed: int, looks: int) -> None:
    rng = np.random.default_rng(seed)
    votes, expected = LabelVotes(), defaultdict[tuple[int, int], float](float)
    for _ in range(looks):
        views = make_views(rng.choice([0, 0.7, 2.0, 7.0], (4, *SIZE)).astype(np.float32), (*rng.normal(size=2), 0.3))
        labels = make_labels(
            rng.integers(0, len(NAMES), (4, *SIZE)).astype(np.uint8), rng.random((4, *SIZE)).astype(np.float32)
        )
        votes.add(views, labels)
        for view, row, column in np.ndindex(views.depth.shape):
            on_grid = row % STRIDE == STRIDE // 2 and column % STRIDE == STRIDE // 2
            if on_grid and 0 < views.depth[view, row, column] <= MOST_DEPTH:
                point = unproject(views, *(np.array([i]) for i in (view, row, column)))
                pair = int(pack_voxels(point)[0]), int(labels.category[view, row, column])
                expected[pair] += float(labels.confidence[view, row, column])
    voxels = np.unique([voxel for voxel, _ in expected])
    asked = np.sort(rng.choice(voxels, rng.integers(1, 40)))
    asked = np.unique(np.append(asked, [0, voxels[-1] + 5]))  # and voxels of which there is no view
    found = votes.count(asked, len(NAMES))
    for kind in range(len(NAMES)):
        assert found[kind] == pytest.approx(sum(expected[voxel, kind] for voxel in asked.tolist()))
        own = np.array([expected[voxel, kind] for voxel in asked.tolist()])
        total = np.array([sum(expected[voxel, each] for each in range(len(NAMES))) for voxel in asked.tolist()])
        shares = np.divide(own, total, out=np.ones_like(total), where=total > 0)
        assert votes.measure_shares(asked, kind) == pytest.approx(shares)


def test_a_thing_that_other_looks_see_a_wall_in_loses_support() -> None:
    seen, wall = np.full((4, *SIZE), 1, np.uint8), np.full((4, *SIZE), 1, np.uint8)
    seen[0, 8:16, 8:20] = NAMES.index("chair")
    objects = ObjectMap(NAMES)
    objects.add(make_views(2.0), make_labels(seen))
    (chair,) = objects.find("chair")
    assert objects.measure_support(chair) > 0.8
    for look in range(1, 12):
        objects.add(make_views(2.0), make_labels(wall))
        (chair,) = objects.find("chair")
        assert objects.measure_support(chair) == pytest.approx(1 / (1 + look), abs=0.05)


def test_voxels_that_most_looks_see_a_wall_in_are_no_part_of_a_thing() -> None:
    once, often = np.full((4, *SIZE), 1, np.uint8), np.full((4, *SIZE), 1, np.uint8)
    once[0, 8:16, 4:28] = NAMES.index("chair")
    often[0, 8:16, 4:16] = NAMES.index("chair")
    objects = ObjectMap(NAMES)
    for labels in (once, often, often, often):
        objects.add(make_views(0.3), make_labels(labels))
    (chair,) = objects.find("chair")
    kept = objects.find_supported(chair, 0.35)
    assert set(kept) < set(chair.voxels)
    assert len(kept) == pytest.approx(len(chair.voxels) / 2, rel=0.15)
    assert np.array_equal(objects.find_supported(chair, 0.0), chair.voxels)
