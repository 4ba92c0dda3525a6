# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wiw.datasets import episodes as files
from wiw.datasets.habitat import heading_of, yaw_of
from wiw.errors import FileError
from wiw.tasks.imagenav import ImageNav
from wiw.types import Episode

finite = st.floats(-1e3, 1e3)
points = st.tuples(finite, finite, finite)


@given(
    st.lists(
        st.builds(
            Episode,
            st.text(max_size=8),
            st.text(max_size=20),
            points,
            finite,
            points,
            finite,
            finite,
            st.dictionaries(st.text(max_size=5), st.integers()),
        ),
        max_size=4,
    )
)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]) -> None:
    path = tmp_path_factory.mktemp("episodes") / "e.json"
    files.save(path, episodes, "imagenav", seed=1)
    assert files.load(path) == episodes


@given(st.floats(-np.pi + 1e-6, np.pi - 1e-6))
def test_yaw_in_both_quaternion_orders(yaw: float) -> None:
    x, y, z, w = 0.0, np.sin(yaw / 2), 0.0, np.cos(yaw / 2)
    assert yaw_of([x, y, z, w], "xyzw", "t") == pytest.approx(yaw, abs=1e-9)
    assert yaw_of([w, x, y, z], "wxyz", "t") == pytest.approx(yaw, abs=1e-9)


def test_the_wrong_quaternion_order_is_noticed() -> None:
    with pytest.raises(FileError, match="order"):
        yaw_of([0.9238795, 0.0, 0.3826834, 0.0], "xyzw", "t")


def habitat_file(path: Path, scene: str) -> Path:
    episode = {
        "episode_id": "7",
        "scene_id": scene,
        "start_position": [-2.0, 0.05, 0.5],
        "start_rotation": [0, 0.0, 0, 1.0],
        "info": {"geodesic_distance": 5.5},
        "goals": [{"position": [3.0, 0.05, 1.0], "radius": None}],
    }
    path.write_bytes(gzip.compress(json.dumps({"episodes": [episode]}).encode()))
    return path


def test_habitat_episodes_run(two_rooms: str, tmp_path: Path) -> None:
    path = habitat_file(tmp_path / "val.json.gz", "data/scene_datasets/" + Path(two_rooms).name)
    task = ImageNav(episode_file=path, scene_folder=Path(two_rooms).parent)
    episode = task.episodes(1)[0]
    assert episode.scene == two_rooms and episode.geodesic == 5.5 and episode.goal_yaw == heading_of("7")
    env = task.environment()
    env.begin(episode)
    assert env.goal.image.std() > 1 and env.result()["shortest"] > 5


def test_world_in_world_episodes_are_read(tmp_path: Path) -> None:
    item = {
        "datum_id": 1,
        "episode_id": 3,
        "scene_relpath": "a/b.glb",
        "goal_image_relpath": "i.png",
        "start_position": [0, 0, 0],
        "start_rotation": [1, 0, 0, 0],
        "goal_position": [1, 0, 1],
        "goal_rotation": [0.0, 0, 1.0, 0],
        "goal_radius": 0.5,
    }
    path = tmp_path / "e.json"
    path.write_text(json.dumps({"version": 1, "data": [item]}))
    episode = files.load(path, "/scenes")[0]
    assert episode.scene == "/scenes/a/b.glb" and abs(episode.goal_yaw) == pytest.approx(np.pi)
    assert np.isnan(episode.geodesic)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b'{"format": "wiw-episodes", "version": 99}',
        b'{"format": "wiw-episodes", "version": 1, "episodes": [{"episode_id": "1"}]}',
        b'{"episodes": [{"start_rotation": [0, 0, 0, 1]}]}',
    ],
)
def test_damaged_files_are_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.json"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"broken\.json"):
        files.load(path)
    with pytest.raises(FileError, match="nowhere"):
        files.load(tmp_path / "nowhere.json")
