# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wiw.datasets import episodes as files
from wiw.datasets.cameras import camera_pose
from wiw.datasets.decisions import Decisions, load_decisions, read_scenes, save_decisions
from wiw.datasets.habitat import heading_of, yaw_of
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.evaluate import evaluate, resume_run
from wiw.tasks.imagenav import ImageNav
from wiw.types import Episode

finite = st.floats(-1e3, 1e3)
points = st.tuples(finite, finite, finite)


@given(
    st.lists(
        st.builds(
            Episode,
            st.text(max_size=8),
            st.sampled_from(["apartments:val/3", "/scenes/a.glb", "/a b/\u00e9.world"]),
            points,
            finite,
            points,
            finite,
            st.floats(0, 1e3),
            st.dictionaries(st.text(max_size=5), st.integers()),
        ),
        max_size=4,
    )
)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, episodes: list[Episode]) -> None:
    path = tmp_path_factory.mktemp("episodes") / "e.json"
    files.save(path, episodes, "imagenav", seed=1)
    assert files.load(path) == episodes


def test_scenes_are_found_from_the_file_or_from_the_folder_given(tmp_path: Path, two_rooms: str) -> None:
    near, far = tmp_path / "scans" / "a.glb", "/elsewhere/b.glb"
    episodes = [
        Episode(str(i), str(scene), (0, 0, 0), 0, (1, 0, 0), 0, 1)
        for i, scene in enumerate((near, far, "apartments:val/3"))
    ]
    path = tmp_path / "e.json"
    files.save(path, episodes, "imagenav")
    (tmp_path / "moved").mkdir()
    moved = path.rename(tmp_path / "moved" / "e.json")
    assert [e.scene for e in files.load(moved)] == [str(tmp_path / "moved/scans/a.glb"), far, "apartments:val/3"]
    assert [e.scene for e in files.load(moved, "/s")] == ["/s/scans/a.glb", far, "apartments:val/3"]


@given(st.floats(-np.pi + 1e-6, np.pi - 1e-6))
def test_yaw_in_both_quaternion_orders(yaw: float) -> None:
    x, y, z, w = 0.0, np.sin(yaw / 2), 0.0, np.cos(yaw / 2)
    assert yaw_of([x, y, z, w], "xyzw", "t") == pytest.approx(yaw, abs=1e-9)
    assert yaw_of([w, x, y, z], "wxyz", "t") == pytest.approx(yaw, abs=1e-9)


def test_the_wrong_quaternion_order_is_noticed() -> None:
    with pytest.raises(FileError, match="order"):
        yaw_of([0.9238795, 0.0, 0.3826834, 0.0], "xyzw", "t")


def habitat_file(path: Path, scene: str, **more: Any) -> Path:
    episode = {
        "episode_id": "7",
        "scene_id": scene,
        "start_position": [-2.0, 0.05, 0.5],
        "start_rotation": [0, 0.0, 0, 1.0],
        "info": {"geodesic_distance": 5.5},
        "goals": [{"position": [3.0, 0.05, 1.0], "radius": None}],
        **more,
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


@pytest.mark.parametrize("info", [None, {}, {"geodesic_distance": None}])
def test_habitat_may_leave_the_length_out(tmp_path: Path, info: Any) -> None:
    path = habitat_file(tmp_path / "val.json.gz", "a.glb", info=info)
    assert np.isnan(files.load(path, "/s")[0].geodesic)


@pytest.mark.parametrize("metres", [-1.0, "far", True])
def test_a_length_is_a_number_of_at_least_0(tmp_path: Path, metres: Any) -> None:
    path = habitat_file(tmp_path / "val.json.gz", "a.glb", info={"geodesic_distance": metres})
    with pytest.raises(FileError, match=r"episode 0.*info\.geodesic_distance: expected a"):
        files.load(path, "/s")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"goal_position": None}, "goal_position: expected a point, as info has no target and no question"),
        ({"goal_position": [0, 0]}, r"goal_position must be \[x, y, z\]"),
        ({"geodesic": -5.0}, "geodesic: expected a number of at least 0, got -5.0"),
        ({"info": {"radius": -1}}, r"info\.radius: expected a number above 0, got -1"),
        ({"info": {"radius": 0}}, r"info\.radius: expected a number above 0, got 0"),
        ({"info": {"goal_image": 5}}, r"info\.goal_image: expected text, got 5"),
    ],
)
def test_numbers_that_no_episode_can_have_are_named(tmp_path: Path, change: Any, message: str) -> None:
    path = tmp_path / "e.json"
    place = (0.0, 0.0, 0.0)
    files.save(path, [Episode("0", "apartments:val/0", place, 0.0, place, 0.0, 1.0)], "imagenav")
    body = json.loads(path.read_text())
    body["episodes"][0] |= change
    path.write_text(json.dumps(body))
    with pytest.raises(FileError, match=f"episode 0: {message}"):
        files.load(path)


@pytest.mark.parametrize("info", [{"target": 3, "category": "bed"}, {"question": {"text": "What is this?"}}])
def test_episodes_of_another_task_are_no_image_goals(tmp_path: Path, info: Any) -> None:
    path = tmp_path / "e.json"
    place = (0.0, 0.0, 0.0)
    files.save(path, [Episode("0", "apartments:val/0", place, 0.0, place, 0.0, 1.0, info)], "ar")
    with pytest.raises(FileError, match=f"e.json: episode 0 has a {next(iter(info))}, so it is one of another task"):
        ImageNav(episode_file=path).episodes(1)


def object_goal_file(path: Path, scene: str) -> Path:
    """An ObjectNav file: two chests, of which the second has the nearer view points."""

    def chest(name: str, *views: tuple[float, float]) -> dict:
        states = [{"position": [x, 0.05, 1.0], "rotation": [0, 0.7071068, 0, 0.7071068]} for x, _ in views]
        views_of = [{"agent_state": state, "iou": iou} for state, (_, iou) in zip(states, views, strict=True)]
        return {"object_id": name, "object_category": "chest", "position": [0, 0, 0], "view_points": views_of}

    episode = {
        "episode_id": "0",
        "scene_id": scene,
        "start_position": [-2.0, 0.05, 0.5],
        "start_rotation": [0, 0.0, 0, 1.0],
        "info": {"geodesic_distance": 1.0, "closest_goal_object_id": 4},
        "goals": [],
        "object_category": "chest",
        "shortest_paths": None,
    }
    goals = {f"{scene}_chest": [chest("3"), chest("4", (3.5, 0.9)), chest("5", (2.0, 0.2), (3.0, 0.4))]}
    path.write_text(json.dumps({"episodes": [episode], "goals_by_category": goals}))
    return path


def test_an_object_goal_becomes_the_view_that_shows_most_of_the_nearest_object(tmp_path: Path) -> None:
    (episode,) = files.load(object_goal_file(tmp_path / "e.json", "a.glb"), "/scenes")
    assert episode.scene == "/scenes/a.glb" and np.isnan(episode.geodesic)
    assert episode.goal_position == (3.0, 0.05, 1.0) and episode.goal_yaw == pytest.approx(np.pi / 2)
    assert (episode.info["category"], episode.info["object"]) == ("chest", "5")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda body: body.pop("goals_by_category"), "not a navigation episode"),
        (lambda body: body["goals_by_category"].update({"a.glb_chest": []}), "not a navigation episode"),
        (lambda body: body["episodes"][0].pop("object_category"), "not a navigation episode"),
    ],
)
def test_object_goals_that_are_not_there_are_refused(tmp_path: Path, change: Any, message: str) -> None:
    path = object_goal_file(tmp_path / "e.json", "a.glb")
    body = json.loads(path.read_text())
    change(body)
    path.write_text(json.dumps(body))
    with pytest.raises(FileError, match=f"episode 0: {message}"):
        files.load(path, "/scenes")


def world_in_world_file(path: Path, scene: str = "a/b.glb", **more: Any) -> Path:
    item = {
        "datum_id": 1,
        "episode_id": 3,
        "scene_relpath": scene,
        "goal_image_relpath": "i.png",
        "start_position": [-2.0, 0, 0.5],
        "start_rotation": [1, 0, 0, 0],
        "goal_position": [3.0, 0, 1.0],
        "goal_rotation": [0.0, 0, 1.0, 0],
        "goal_radius": 0.5,
        "goal_rot_diff": 0.0,
        **more,
    }
    path.write_text(json.dumps({"version": 1, "num_items": 1, "meta": {}, "data": [item]}))
    return path


def test_world_in_world_episodes_are_read(tmp_path: Path) -> None:
    episode = files.load(world_in_world_file(tmp_path / "e.json", step_to_goal=33), "/scenes")[0]
    assert episode.scene == "/scenes/a/b.glb" and abs(episode.goal_yaw) == pytest.approx(np.pi)
    assert np.isnan(episode.geodesic)
    assert episode.info["ideal_primitives"] == 33 and episode.info["radius"] == 0.5
    files.save(tmp_path / "own.json.gz", [episode], "imagenav")
    again = files.load(tmp_path / "own.json.gz")[0]
    assert np.isnan(again.geodesic) and again.info == episode.info


def test_the_picture_of_a_published_goal_is_its_front_view(tmp_path: Path, two_rooms: str) -> None:
    file = world_in_world_file(tmp_path / "e.json", two_rooms)
    drawn = ImageNav(episode_file=file)
    assert "goal_image" not in drawn.episode(0).info
    place = drawn.environment()
    place.begin(drawn.episode(0))
    episode = drawn.episode(0)
    here = world(two_rooms)
    pose = camera_pose(here.ground.put_down(episode.goal_position).astype(float), episode.goal_yaw)
    image = here.renderer.panorama(pose[None], outputs=("color",))["color"][0]
    cv2.imwrite(str(tmp_path / "i.png"), image[..., ::-1])
    told = ImageNav(episode_file=file)
    env = told.environment()
    env.begin(told.episode(0))
    assert told.episode(0).info["goal_image"] == str(tmp_path / "i.png")
    assert np.abs(env.goal.image.astype(float) - place.goal.image).mean() < 3  # but for sharpness
    (tmp_path / "i.png").write_bytes(b"no picture")
    with pytest.raises(FileError, match="expected a goal image"):
        told.environment().begin(told.episode(0))
    cv2.imwrite(str(tmp_path / "i.png"), image[:, :100])
    with pytest.raises(FileError, match="about twice as wide as high, got 576x100"):
        told.environment().begin(told.episode(0))
    cv2.imwrite(str(tmp_path / "i.png"), cv2.resize(image, (1025, 513)))
    with pytest.raises(FileError, match=r"i\.png: expected a panorama: .*even"):
        told.environment().begin(told.episode(0))


def test_a_picture_outside_the_files_folder_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(b"")
    (tmp_path / "own").mkdir()
    file = world_in_world_file(tmp_path / "own/e.json", goal_image_relpath="../secret.png")
    assert "goal_image" not in files.load(file, "/scenes")[0].info


FORMATS = {
    "habitat": lambda path, scene: habitat_file(path.with_suffix(".json.gz"), scene),
    "objects of habitat": object_goal_file,
    "world-in-world": world_in_world_file,
    "world-in-world with steps": lambda path, scene: world_in_world_file(path, scene, step_to_goal=33, goal_radius=9),
}


@pytest.mark.parametrize(
    ("form", "preset", "shortest", "ideal"),
    [
        ("habitat", "paper", 5.5, None),
        ("habitat", "official", 5.5, None),
        ("objects of habitat", "official", 5.1, None),
        ("world-in-world", "official", 5.1, None),
        ("world-in-world with steps", "official", 5.1, 33),
    ],
)
def test_episodes_of_other_systems_are_evaluated(
    tmp_path: Path, two_rooms: str, form: str, preset: str, shortest: float, ideal: int | None
) -> None:
    path = FORMATS[form](tmp_path / "e.json", Path(two_rooms).name)
    recipe = TaskRecipe(
        "imagenav",
        {"episode_file": str(path), "scene_folder": str(Path(two_rooms).parent), "preset": preset, "decisions": 2},
    )
    log = evaluate(recipe, AgentRecipe("heuristic"), 1, out=tmp_path / "run", progress=False)
    (row,) = log.episodes
    assert row["status"] == "done", row["error"]
    assert row["geodesic"] == row["metrics"]["shortest"] == pytest.approx(shortest, abs=0.1)
    assert row["metrics"]["success"] == (form == "world-in-world with steps")  # 9 m around the goal are both rooms
    if ideal is not None:
        assert row["metrics"]["spl"] == pytest.approx(min(1.0, ideal / max(ideal, row["metrics"]["actions"])))
    assert log.report().read_text().count("m to the goal") == 1
    assert resume_run(tmp_path / "run", progress=False).complete


def test_the_files_radius_holds_unless_one_is_given(tmp_path: Path, two_rooms: str) -> None:
    path = world_in_world_file(tmp_path / "e.json", Path(two_rooms).name, step_to_goal=33, goal_radius=9)
    options = {"episode_file": path, "scene_folder": Path(two_rooms).parent}
    for more, reached in (({}, True), ({"radius": 0.5}, False)):
        env = ImageNav(**options, **more).environment()
        env.begin(env.task.episode(0))
        assert env.run([1]).terminated == reached


def test_ideal_steps_of_the_file_are_what_spl_is_measured_against(tmp_path: Path, two_rooms: str) -> None:
    found = []
    for steps in (1, 2, 4):
        path = world_in_world_file(tmp_path / "e.json", Path(two_rooms).name, step_to_goal=steps, goal_radius=9)
        task = ImageNav(episode_file=path, scene_folder=Path(two_rooms).parent, preset="official")
        env = task.environment()
        env.begin(task.episode(0))
        env.run([1, 2, 1, 2])
        found.append(env.result()["spl"])
    assert found == [0.25, 0.5, 1.0]


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


@pytest.mark.parametrize("option", [{"scenes": "apartments:val"}, {"per_scene": 3}, {"tier": "far"}])
def test_a_file_of_episodes_leaves_no_option_unused(option) -> None:
    with pytest.raises(ArgumentError, match=f"{next(iter(option))}: only for generated episodes"):
        ImageNav(episode_file="episodes.json", **option)
    assert ImageNav(**option).episode_file is None


def test_a_folder_of_scenes_without_a_file_of_episodes_is_refused() -> None:
    with pytest.raises(ArgumentError, match="scene_folder is where the scenes of an episode file are"):
        ImageNav(scene_folder="scans")


def test_a_file_without_decisions_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    picture = np.zeros((0, 4, 8, 3), np.uint8)
    none = Decisions((), picture, picture, np.zeros((0, 2, 3), np.int8), picture[:, None], np.zeros((0, 2)))
    save_decisions(tmp_path / "none.parquet", none)
    assert read_scenes(tmp_path / "none.parquet") == []
    with pytest.raises(FileError, match=r"none\.parquet: expected stored decisions, got a file without any"):
        load_decisions(tmp_path / "none.parquet")
