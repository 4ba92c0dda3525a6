# SPDX-License-Identifier: Apache-2.0
"""Active Recognition episodes: measured visibility, what is generated, and what is read."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wiw.cli import main
from wiw.datasets import ar, visibility
from wiw.datasets import episodes as episode_file
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.render import Renderer
from wiw.scenes import Scene
from wiw.tasks.ar import AR
from wiw.types import Episode

RULES = ar.EpisodeRules(hidden=0.75, gain=1.2, small=0.6, tiny=1.0, survey=150)
"""Two bare rooms have little that hides anything."""
CHOICES = ("chest", "picture", "shelf", "table")


def only(scene: Any, instance: int) -> Scene:
    """A scene that holds one instance alone."""
    vertices, triangles, names = scene.world_triangles()
    return Scene.from_arrays([{"positions": vertices, "triangles": triangles[names == instance]}])


def test_alone_is_what_a_scene_of_that_instance_alone_shows(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    points = place.ground.put_down(place.navmesh.sample(6, 3)).astype(float)
    before = visibility.measure_sizes(place, points)
    for instance in (7, 8, 10):
        bare = Renderer(only(place.scene, instance), "cpu")
        poses = [visibility.camera_pose(point, 0.0) for point in points]
        ids = bare.panorama(np.stack(poses), visibility.SIZE, outputs=("instance",))["instance"]
        sine = np.sin(np.linspace(np.pi / 2, -np.pi / 2, visibility.SIZE[0] + 1))
        expected = ((ids > 0).sum(axis=2) * -np.diff(sine)).sum(axis=1) * 2 * np.pi / visibility.SIZE[1]
        np.testing.assert_allclose(
            visibility.measure_unoccluded_sizes(place, points, instance), expected, rtol=0.02, atol=2e-4
        )
        assert (before[:, instance] <= expected * 1.02 + 2e-4).all()
    np.testing.assert_array_equal(visibility.measure_sizes(place, points), before)  # all is back in its place
    np.testing.assert_allclose(before.sum(axis=1), 4 * np.pi)


def test_measuring_visibility_leaves_pictures_as_they_were() -> None:
    place = world("apartments:val/0", "cpu")
    points = place.ground.put_down(place.navmesh.sample(25, 5)).astype(float)
    poses = np.stack([visibility.camera_pose(points[k], np.pi / 8 * k) for k in (6, 18)])
    before = place.renderer.perspective(poses, (480, 480), 90.0)
    for instance in range(1, len(place.scene.instances) + 1):
        visibility.visible_fraction(place, points[0], instance)
    after = place.renderer.perspective(poses, (480, 480), 90.0)
    for output, pixels in before.items():
        np.testing.assert_array_equal(after[output], pixels, output)


def test_a_share_is_none_behind_a_wall_and_all_in_plain_sight(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    table = next(int(thing["id"]) for thing in place.scene.instances if thing["name"] == "table")
    assert visibility.visible_fraction(place, np.array([2.0, 0, -1.0]), table) == 0
    assert visibility.visible_fraction(place, np.array([-1.0, 0, -1.0]), table) == pytest.approx(1)


def test_episodes_are_hard_at_the_start_and_can_be_mended(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    made = ar.generate(place, 4, 1, CHOICES, RULES)
    assert made == ar.generate(place, 4, 1, CHOICES, RULES)
    assert [episode.episode_id for episode in made] == ["0000", "0001", "0002", "0003"]
    for episode in made:
        info, start = episode.info, np.asarray(episode.start_position)
        thing = place.scene.instances[info["target"] - 1]
        assert thing["category"] == info["category"]
        np.testing.assert_allclose(episode.goal_position, np.asarray(thing["bounds"]).mean(axis=0), atol=1e-5)
        share = visibility.visible_fraction(place, start, info["target"])
        assert share == pytest.approx(info["visible"], abs=1e-3)
        assert info["difficulty"] == (share < 0.4) + (share < 0.2)
        best = np.asarray(info["best_position"])
        now, then = visibility.measure_sizes(place, np.stack([start, best]))[:, info["target"]]
        assert now >= RULES.seen
        assert then >= max(RULES.large, RULES.gain * now)
        assert share <= RULES.hidden or now <= RULES.small * then
        assert visibility.visible_fraction(place, best, info["target"]) >= RULES.clear - 1e-3
        assert info["best_primitives"] <= RULES.budget


def test_no_two_episodes_show_a_target_from_one_place(two_rooms: str) -> None:
    made = ar.generate(
        world(two_rooms, "cpu"), 8, 1, ("table", "shelf"), ar.EpisodeRules(1, hidden=1, gain=1, survey=30)
    )
    assert len({(episode.info["target"], episode.start_position) for episode in made}) == 8
    assert max(Counter(episode.info["category"] for episode in made).values()) == 4


def test_default_episodes_stay_as_they_were() -> None:
    made = ar.generate(world("apartments:val/0", "cpu"), 2, 0)
    found = [(e.info["category"], e.info["visible"], e.info["best_primitives"]) for e in made]
    assert found == [("toilet", pytest.approx(0.117, abs=2e-3), 8), ("chair", pytest.approx(0.344, abs=2e-3), 6)]
    assert set(made[0].info) == {
        *("target", "category", "difficulty", "visible", "best_position", "best_primitives", "best_visible")
    }


def test_hard_first_looks_take_turns_and_are_what_they_say() -> None:
    place, rules = world("apartments:val/0", "cpu"), ar.EpisodeRules(first_look="balanced", survey=120, places=15)
    made = ar.generate(place, 3, 0, rules=rules)
    assert [episode.info["first_look"] for episode in made] == ["hidden", "small", "averted"]
    for episode in made:
        start, best = np.asarray(episode.start_position), np.asarray(episode.info["best_position"])
        target = episode.info["target"]
        now, then = visibility.measure_sizes(place, np.stack([start, best]))[:, target]
        share = visibility.visible_fraction(place, start, target)
        if episode.info["first_look"] == "hidden":
            assert share <= rules.hidden and then >= rules.gain * now
        else:
            assert share > rules.hidden
        if episode.info["first_look"] == "small":
            assert now <= rules.tiny and now <= rules.small * then
        if episode.info["first_look"] == "averted":
            ahead = np.asarray(place.scene.instances[target - 1]["T_world_instance"])[[0, 2], 2]
            bearings = [np.subtract(spot, episode.goal_position)[[0, 2]] for spot in (start, best)]
            angles = [np.degrees(np.arccos(way @ ahead / np.linalg.norm(way))) for way in bearings]
            assert (
                angles[0] >= rules.averted and angles[1] <= rules.facing and np.linalg.norm(bearings[0]) <= rules.nearby
            )
            assert angles == pytest.approx(
                [episode.info["view_angle_deg"], episode.info["best_view_angle_deg"]], abs=0.1
            )


def test_furniture_faces_where_one_can_stand(two_rooms: str) -> None:
    place = world("apartments:val/0", "cpu")
    behind = ahead = 0
    for thing in place.scene.instances:
        front = ar.find_front(place, thing)
        if thing["category"] not in ("sofa", "bookshelf", "dresser", "wardrobe", "bathtub", "toilet", "sink"):
            continue
        low, high = np.asarray(thing["bounds"], float)
        reach = np.abs(front) @ (high - low) / 2 + 0.2
        spots = (low + high) / 2 * [1, 0, 1] + reach * np.stack([front, -front])
        free = place.navmesh.is_navigable(place.ground.put_down(spots).astype(float))
        ahead, behind = ahead + int(free[0]), behind + int(free[1])
    assert ahead >= 3 and not behind
    lamp = next(thing for thing in place.scene.instances if thing["category"] == "floor lamp")
    assert ar.find_front(place, lamp) is None, "it looks alike from all sides"
    bare = world(two_rooms, "cpu")
    assert all(ar.find_front(bare, thing) is None for thing in bare.scene.instances), "nobody knows their fronts"


def test_the_preset_asks_for_them() -> None:
    task = AR(preset="foresight")
    assert (task.decisions, task.rules.candidates, task.rules.horizon) == (1, 3, 8)
    asked = {"first_look": "balanced", "hidden": 0.3, "tiny": 0.006, "small": 0.4, "averted": 90.0, "facing": 60.0}
    assert task.generator == ar.EpisodeRules(**asked)
    assert AR(preset="foresight", hidden=0.2).generator == ar.EpisodeRules(**{**asked, "hidden": 0.2})
    assert task.describe()["generator"] == asked and "generator" not in AR().describe()
    assert AR().generator == ar.EpisodeRules()


def test_the_command_writes_the_episodes_of_a_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["episodes", "ar", "--scenes", "apartments:val:1", "--episodes", "1", "--out", str(tmp_path / "a.json")]
    assert main([*command, "--preset", "forsight"]) == 2
    assert "no preset 'forsight'" in capsys.readouterr().err
    assert main([*command, "--preset", "foresight"]) == 0
    assert ar.load(tmp_path / "a.json")[0][0].info["first_look"] in ar.FIRST_LOOKS


def test_the_best_view_is_as_many_primitives_away_as_it_says(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    start, yaw = np.array([-2.0, 0.0, 0.5]), 0.4
    ends, primitives = ar._reachable(place, start, yaw, 6)
    turns = np.arange(-7, 9) * np.pi / 8
    for end, spent in zip(ends[1:], primitives[1:], strict=True):
        way = (end - start)[[0, 2]]
        heading = np.arctan2(-way[0], -way[1])
        off = np.abs((heading - yaw - turns + np.pi) % (2 * np.pi) - np.pi)
        assert off.min() < 1e-3
        assert spent == round(abs(turns[off.argmin()]) / (np.pi / 8)) + round(float(np.hypot(*way)) / 0.2)
        assert spent <= 6
    assert len(ends) > 12


def test_categories_take_turns(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    before = ["chest", "chest", "picture", "picture", "shelf"]
    first = ar.generate(place, 1, 1, CHOICES, RULES, before=before)
    assert first[0].info["category"] == "table"
    things = Counter(episode.info["category"] for episode in ar.generate(place, 4, 2, CHOICES, RULES))
    assert max(things.values()) - min(things[name] for name in things) <= 1


def test_too_few_are_said_to_be(two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match="only 0 of 1"):
        ar.generate(world(two_rooms, "cpu"), 1, 1, CHOICES, ar.EpisodeRules(gain=1e6, survey=40, attempts=1))


def a_file(path: Path, scene: str, **info: Any) -> Path:
    episode = Episode("0", scene, (0, 0, 0), 0, (1, 0, 0), 0, 1, {"target": 8, "category": "table", **info})
    episode_file.save(path, [episode], "ar", categories=list(CHOICES))
    return path


@pytest.mark.parametrize(
    ("info", "message"),
    [
        ({"target": None}, r"episode 0: info\.target: expected the id of an instance .* got None"),
        ({"target": 0}, r"info\.target"),
        ({"category": ""}, r"episode 0: info\.category: expected the target's category, got ''"),
        ({"category": "sofa"}, r"episode 0: info\.category 'sofa' is not among the categories chest, .*categories=\["),
    ],
)
def test_bad_fields_are_named(tmp_path: Path, two_rooms: str, info: dict[str, Any], message: str) -> None:
    with pytest.raises(FileError, match=message) as error:
        AR(episode_file=a_file(tmp_path / "bad.json", two_rooms, **info))
    assert "bad.json" in str(error.value)


def test_a_scene_that_is_not_there_is_named(tmp_path: Path) -> None:
    task = AR(episode_file=a_file(tmp_path / "ar.json", "/nowhere/house.glb"))
    with pytest.raises(FileError, match=r"ar\.json: episode 0: scene: /nowhere/house\.glb: no such file"):
        task.require(task.episodes(1))


def test_a_target_that_the_scene_has_not_is_named(tmp_path: Path, two_rooms: str) -> None:
    task = AR(episode_file=a_file(tmp_path / "ar.json", two_rooms, target=99))
    with pytest.raises(ArgumentError, match=r"target 99 is not an instance of .*which has 1 to 11"):
        task.environment().begin(task.episode(0))


def test_a_file_brings_its_choices_unless_they_are_given(tmp_path: Path, two_rooms: str) -> None:
    path = a_file(tmp_path / "ar.json", two_rooms)
    assert AR(episode_file=path).choices == CHOICES
    assert AR(episode_file=path, categories=["door", "table"]).choices == ("door", "table")
    body = json.loads(path.read_text())
    for named, message in (([1], "categories: expected a list of names"), ("table", "categories")):
        path.write_text(json.dumps({**body, "categories": named}))
        with pytest.raises(FileError, match=message):
            AR(episode_file=path)


def test_the_published_files_schema_is_read(tmp_path: Path, two_rooms: str) -> None:
    item = {
        "scene_id": f"/home/authors/data/{Path(two_rooms).parent.name}/{Path(two_rooms).name}",
        "episode_id": 12,
        "start_position": [-1.2, 0.0, -1.2],
        "start_rotation": [np.cos(0.2), 0.0, np.sin(0.2), 0.0],
        "target_id": 8,
        "target_categrory": "table",
        "difficulty": 2,
    }
    path = tmp_path / "episodes_AR.json.gz"
    path.write_bytes(gzip.compress(json.dumps({"episodes": [item]}).encode()))
    (read,) = episode_file.load(path, Path(two_rooms).parents[1])
    episode_file.save(tmp_path / "own.json", [read], "ar")
    assert repr(episode_file.load(tmp_path / "own.json")) == repr([read]) and np.isnan(read.goal_position).all()
    task = AR(episode_file=path, scene_folder=Path(two_rooms).parents[1])
    episode = task.episode(0)
    assert AR(episode_file=tmp_path / "own.json").episode(0).goal_position == episode.goal_position
    assert (episode.episode_id, episode.scene, episode.start_yaw) == ("12", two_rooms, pytest.approx(0.4))
    assert episode.info == {"source": "world-in-world", "target": 8, "category": "table", "difficulty": 2}
    centre = np.asarray(world(two_rooms).scene.instances[7]["bounds"]).mean(axis=0)
    np.testing.assert_allclose(episode.goal_position, centre, atol=1e-5)
    assert task.choices == ar.PUBLISHED_CATEGORIES and len(task.choices) == 27, "all, whatever the file's targets are"
    assert task.environment().begin(episode).target.mask.any()
    for wrong in (8.5, -1, "8"):
        path.write_bytes(gzip.compress(json.dumps({"episodes": [{**item, "target_id": wrong}]}).encode()))
        with pytest.raises(FileError, match=r"episode 0: .*target_id: expected "):
            AR(episode_file=path)
    del item["target_categrory"]
    path.write_bytes(gzip.compress(json.dumps({"episodes": [item]}).encode()))
    with pytest.raises(FileError, match=r"episodes_AR\.json\.gz: episode 0: .*target_categrory"):
        AR(episode_file=path)
