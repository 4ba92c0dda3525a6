# SPDX-License-Identifier: Apache-2.0
"""OpenEQA's published files: counts, poses and lengths as published, and every kind of damage a typed error."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.datasets import episodes
from wiw.datasets.questions import Question, openeqa
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError

ITEM: dict[str, Any] = {
    "question": "What is above the table?",
    "answer": "A painting",
    "category": "object recognition",
    "question_id": "a1",
    "episode_history": "hm3d-v0/000-hm3d-two_rooms",
}


@pytest.fixture
def published(data_dir: Path) -> Path:
    folder = data_dir / "openeqa"
    if not folder.is_dir():
        pytest.skip(f"no published questions: {folder} is missing")
    return folder


def write(path: Path, *items: Any) -> Path:
    path.write_text(json.dumps(list(items)))
    return path


def question_of(episode: Any) -> Question:
    return Question.from_info(episode.info["question"])


def test_the_list_of_184_is_read_as_published(published: Path) -> None:
    episodes = openeqa.load(published / "open-eqa-184.json")
    lengths = [episode.geodesic for episode in episodes]
    questions = [question_of(episode) for episode in episodes]
    assert len(episodes) == 184
    assert len({episode.episode_id for episode in episodes}) == 184
    assert len(set(lengths)) == 57
    assert np.mean(lengths) == pytest.approx(12.637, abs=5e-4)
    assert len({episode.scene for episode in episodes}) == 57
    assert len({question.category for question in questions}) == 7
    extra = [question.category for question in questions if question.extra_answers]
    assert extra == ["object localization"] * 35
    assert all(math.isnan(value) for episode in episodes for value in episode.start_position)


def test_the_lengths_are_those_of_the_published_file(published: Path) -> None:
    lengths = json.loads((published / "gt_path_length.json").read_text())
    assert len(lengths) == 557
    assert len(set(lengths.values())) == 63
    assert (round(min(lengths.values()), 3), round(max(lengths.values()), 3)) == (5.011, 28.331)


def test_the_list_of_41_has_poses_about_the_vertical(published: Path) -> None:
    path = published / "open-eqa-41-3dmem.json"
    episodes = openeqa.load(path)
    assert len(episodes) == 41
    for episode, item in zip(episodes, json.loads(path.read_text()), strict=True):
        w, x, y, z = item["rotation"]
        assert x == z == 0
        assert (math.cos(episode.start_yaw / 2), math.sin(episode.start_yaw / 2)) == pytest.approx((w, y), abs=1e-5)
        assert list(episode.start_position) == item["position"]
    shared = {each.episode_id for each in episodes} & {
        each.episode_id for each in openeqa.load(published / "open-eqa-184.json")
    }
    assert len(shared) == 16


def test_a_question_of_the_list_runs_in_a_scene_of_its_name(two_rooms: str, tmp_path: Path) -> None:
    folder = tmp_path / "00007-two_rooms"
    folder.mkdir()
    for file in Path(two_rooms).parent.glob("two_rooms.*"):
        shutil.copy(file, folder)
    path = write(tmp_path / "list.json", ITEM, {**ITEM, "question_id": "a2", "episode_history": "00007-two_rooms"})
    (tmp_path / "gt_path_length.json").write_text(json.dumps({"a1": 6.5}))
    episodes = openeqa.load(path, tmp_path)
    assert [episode.scene for episode in episodes] == [str(folder / "two_rooms.obj")] * 2
    assert episodes[0].geodesic == 6.5
    assert math.isnan(episodes[1].geodesic)
    place = world(episodes[0].scene, "cpu")
    starts = [openeqa.locate_start(place, episode).start_position for episode in episodes]
    assert place.navmesh.is_navigable(np.array(starts)).all()
    assert starts[0] != starts[1]
    assert starts == [openeqa.locate_start(place, episode).start_position for episode in episodes]


def test_a_start_of_the_list_is_checked_against_the_mesh(two_rooms: str, tmp_path: Path) -> None:
    poses = [{"position": [x, 0.0, 0.0], "rotation": [1.0, 0.0, 0.0, 0.0]} for x in (-2.0, 40.0)]
    path = write(tmp_path / "list.json", {**ITEM, **poses[0]}, {**ITEM, **poses[1], "question_id": "a2"})
    good, bad = openeqa.load(path)
    place = world(two_rooms, "cpu")
    assert openeqa.locate_start(place, good).start_position == pytest.approx((-2, 0, 0), abs=0.2)
    with pytest.raises(FileError, match=r"episode a2: start_position \(40.0, 0.0, 0.0\) is not on the navigation mesh"):
        openeqa.locate_start(place, bad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"answer": "  "}, "item 1: answer: expected words"),
        ({"answer": None}, "item 1: answer: expected text"),
        ({"question": ""}, "item 1: question: expected words"),
        ({"category": "colours"}, "item 1: category: expected one of"),
        ({"question_id": "a1"}, "item 1: question_id 'a1' is also that of item 0"),
        ({"question_id": ""}, "item 1: question_id: expected words"),
        ({"episode_history": 3}, "item 1: episode_history: expected text"),
        ({"extra_answers": "on the sofa"}, "item 1: extra_answers: expected a list"),
        ({"extra_answers": ["on the sofa", ""]}, "item 1: extra_answers: expected words"),
        ({"position": [0, 1]}, "item 1: start: expected both"),
        ({"position": [0, 1], "rotation": [1, 0, 0, 0]}, r"item 1: position must be \[x, y, z\]"),
        (
            {"position": [0, 1, 2], "rotation": [0, 0, 0, 0]},
            "item 1: rotation: expected a unit quaternion in order wxyz",
        ),
        ({"position": [0, 1, 2], "rotation": [0, 1, 0, 0]}, "item 1: rotation: .*not about the vertical"),
        ({"position": [10**400, 1, 2], "rotation": [1, 0, 0, 0]}, "item 1: position: expected a finite number"),
        ({"position": [0, 1, 2], "rotation": [10**400, 0, 0, 0]}, "item 1: .*too large"),
    ],
)
def test_a_damaged_item_is_a_typed_error_naming_file_index_and_field(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = write(tmp_path / "list.json", ITEM, {**ITEM, "question_id": "a2", **change})
    with pytest.raises(FileError, match=message) as error:
        openeqa.load(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("missing", ["question", "answer", "category", "question_id", "episode_history"])
def test_a_missing_field_is_a_typed_error(tmp_path: Path, missing: str) -> None:
    path = write(tmp_path / "list.json", {name: value for name, value in ITEM.items() if name != missing})
    with pytest.raises(FileError, match=f"list.json: item 0: lacks {missing}"):
        openeqa.load(path)


@pytest.mark.parametrize("body", ["{}", "[]", "[3]", '"x"', "[", '[{"answer": NaN}]'])
def test_a_file_of_another_kind_is_a_typed_error(tmp_path: Path, body: str) -> None:
    path = tmp_path / "list.json"
    path.write_text(body)
    with pytest.raises(FileError, match=r"list\.json"):
        openeqa.load(path)


def test_a_number_that_is_none_is_a_typed_error(tmp_path: Path) -> None:
    path = tmp_path / "list.json"
    pose = '"position": [0.0, NaN, 1.0], "rotation": [1, 0, 0, 0]'
    path.write_text(f"[{json.dumps(ITEM)[:-1]}, {pose}}}]")
    with pytest.raises(FileError, match=r"list\.json"):
        openeqa.load(path)


def test_episodes_without_a_start_are_not_saved(tmp_path: Path) -> None:
    found = openeqa.load(write(tmp_path / "list.json", ITEM))
    with pytest.raises(ArgumentError, match=r"mine\.json: expected episodes with starts"):
        episodes.save(tmp_path / "mine.json", found, "aeqa")
    assert not (tmp_path / "mine.json").exists()


def test_an_unknown_scene_is_a_typed_error(tmp_path: Path) -> None:
    path = write(tmp_path / "list.json", ITEM)
    with pytest.raises(FileError, match=r"item 0: episode_history '000-hm3d-two_rooms': .* has no scene two_rooms"):
        openeqa.load(path, tmp_path)


@pytest.mark.parametrize(
    "body", ["[]", '{"a1": "far"}', '{"a1": 0}', '{"a1": -3.5}', '{"a1": null}', f'{{"a1": 1{"0" * 400}}}']
)
def test_damaged_lengths_are_a_typed_error(tmp_path: Path, body: str) -> None:
    path = write(tmp_path / "list.json", ITEM)
    (tmp_path / "gt_path_length.json").write_text(body)
    with pytest.raises(FileError, match=r"gt_path_length\.json"):
        openeqa.load(path)
    (tmp_path / "other.json").write_text('{"a1": 2}')
    assert openeqa.load(path, path_lengths=tmp_path / "other.json")[0].geodesic == 2
