# SPDX-License-Identifier: Apache-2.0
"""Questions about a scene that tells only names: what rooms are found, what is asked, what a file may add."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import wiw
from wiw.cli import main
from wiw.datasets import episodes as episode_file
from wiw.datasets.questions import Question
from wiw.datasets.questions.answers import find_answer
from wiw.datasets.questions.facts import UNCLEAR, SceneTable, Thing
from wiw.datasets.questions.generate import EpisodeRules, find_questions, generate, look_around
from wiw.datasets.questions.mesh_table import Attributes, read_attributes
from wiw.datasets.questions.room_plan import CELL, Floor, list_rooms, plan_rooms
from wiw.datasets.questions.room_plan import _find_doorways as find_doorways
from wiw.datasets.worlds import world
from wiw.errors import ArgumentError, FileError
from wiw.studies.run_log import load_run
from wiw.tasks.aeqa import AEQA

COLORS = {
    "plaster": (0.75, 0.72, 0.62), "oak": (0.42, 0.26, 0.12), "crimson": (0.75, 0.04, 0.04), "navy": (0.05, 0.1, 0.6),
    "leaf": (0.1, 0.55, 0.1), "chalk": (0.95, 0.95, 0.95),
}  # fmt: skip
BOXES = {
    "floor": ("oak", (0, -0.1, 0), (12, 0, 6)),
    "wall_north": ("plaster", (0, 0, 0), (12, 2.5, 0.1)),
    "wall_south": ("plaster", (0, 0, 5.9), (12, 2.5, 6)),
    "wall_west": ("plaster", (0, 0, 0), (0.1, 2.5, 6)),
    "wall_east": ("plaster", (11.9, 0, 0), (12, 2.5, 6)),
    "wall_a": ("plaster", (4.4, 0, 0), (4.5, 2.5, 2.4)),
    "wall_b": ("plaster", (4.4, 0, 3.4), (4.5, 2.5, 6)),
    "bed": ("crimson", (0.2, 0, 0.2), (2.2, 0.5, 2.0)),
    "wardrobe": ("leaf", (0.2, 0, 4.8), (1.4, 2.0, 5.6)),
    "sofa": ("navy", (5.0, 0, 0.3), (6.8, 0.8, 1.1)),
    "coffee_table": ("oak", (5.4, 0, 1.8), (6.4, 0.4, 2.4)),
    "vase": ("crimson", (5.8, 0.4, 2.0), (6.0, 0.7, 2.2)),
    "stove": ("chalk", (11.2, 0, 0.3), (11.8, 0.9, 0.9)),
    "refrigerator": ("chalk", (11.2, 0, 1.2), (11.8, 1.8, 1.9)),
}
"""Two rooms, joined by a doorway; sofa and stove share the right one, with 4 m between them."""
RULES = EpisodeRules(shortest=2.0, places=160)


@pytest.fixture(scope="session")
def house(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("house")
    materials = "".join(f"newmtl {name}\nKd {r} {g} {b}\n" for name, (r, g, b) in COLORS.items())
    (folder / "house.mtl").write_text(materials)
    lines, base = ["mtllib house.mtl"], 1
    for name, (material, low, high) in BOXES.items():
        corners = [(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        lines += [f"o {name}", f"usemtl {material}", *(f"v {x} {y} {z}" for x, y, z in corners)]
        lines += ["f " + " ".join(str(base + i) for i in quad) for quad in quads]
        base += 8
    (folder / "house.obj").write_text("\n".join(lines))
    return str(folder / "house.obj")


def make_thing(number: int, category: str, x: float, z: float, size: float = 0.6, **more: Any) -> Thing:
    low, high = np.array([x, 0.0, z]), np.array([x + size, 1.0, z + size])
    values = {"color": "", "material": "", "state": "", "room": "", "front": np.zeros(3), **more}
    return Thing(id=number, name=f"{category} {number}", category=category, low=low, high=high, **values)


def make_floor(width: float, depth: float, *walls: tuple[float, float, float, float]) -> Floor:
    """Return a floor with walls (x0, z0, x1, z1) in it, and around it."""
    shape = round(depth / CELL), round(width / CELL)
    solid = np.zeros(shape, bool)
    solid[[0, -1]] = solid[:, [0, -1]] = True
    for x0, z0, x1, z1 in walls:
        solid[round(z0 / CELL) : round(z1 / CELL), round(x0 / CELL) : round(x1 / CELL)] = True
    return Floor(np.zeros(2), ~solid, find_doorways(solid))


def name_rooms(floor: Floor, things: list[Thing], *places: tuple[float, float]) -> list[str]:
    plan = plan_rooms(floor, things)
    numbers = plan.find(np.array([(x, 0.0, z) for x, z in places]))
    return [plan.kinds[number - 1] if number else "" for number in numbers.tolist()]


# -- rooms -------------------------------------------------------------------------------------------------------------


def test_walls_and_doorways_keep_rooms_apart():
    floor = make_floor(8, 4, (3.9, 0, 4.1, 1.5), (3.9, 2.5, 4.1, 4))
    signs = [make_thing(1, "bed", 1, 1), make_thing(2, "toilet", 7, 3)]
    assert name_rooms(floor, signs, (3.5, 2), (4.5, 2)) == ["bedroom", "bathroom"]
    assert floor.doorways[20, 40] and not floor.doorways[20, 30]


def test_a_room_without_a_sign_is_nobodys():
    floor = make_floor(8, 4, (3.9, 0, 4.1, 1.5), (3.9, 2.5, 4.1, 4))
    assert name_rooms(floor, [make_thing(1, "bed", 1, 1)], (1, 3), (6, 2)) == ["bedroom", ""]
    assert plan_rooms(floor, [make_thing(1, "vase", 1, 1)]).kinds == ()


def test_an_open_plan_is_divided_by_what_is_clearly_nearest():
    floor = make_floor(10, 4)
    things = [make_thing(1, "sofa", 0.5, 1.5), make_thing(2, "stove", 9.0, 1.5)]
    assert name_rooms(floor, things, (2, 2), (8, 2), (5, 2)) == ["living room", "kitchen", ""]
    plan = plan_rooms(floor, things)
    near, between = make_thing(3, "bin", 8.0, 0.5), make_thing(4, "bin", 4.7, 1.5)
    assert plan.kinds[plan.find_thing(near.low, near.high, floor.open) - 1] == "kitchen"
    assert plan.find_thing(between.low, between.high, floor.open) == 0


def test_a_walk_counts_and_not_the_distance_through_a_wall():
    wall = (4.9, 0, 5.1, 7.6)  # to the south wall is no doorway: the gap is in no line with another wall
    floor = make_floor(10, 12, wall)
    things = [make_thing(1, "sofa", 4.0, 0.5), make_thing(2, "stove", 9.0, 6.0)]
    assert name_rooms(floor, things, (5.5, 0.7)) == ["kitchen"]


def test_signs_of_one_kind_are_one_room_where_they_are_near_each_other():
    wall = (7.9, 0, 8.1, 4.5), (7.9, 5.5, 8.1, 6)
    floor = make_floor(14, 6, *wall)
    things = [make_thing(1, "bed", 1, 1), make_thing(2, "bed", 4, 1), make_thing(3, "bed", 10, 1)]
    assert sorted(room.name for room in list_rooms(plan_rooms(floor, things))) == ["bedroom 1", "bedroom 2"]


def test_a_dining_table_near_a_kitchen_is_of_the_kitchen():
    floor = make_floor(14, 4)
    stove = make_thing(1, "stove", 0.5, 1.5)
    assert name_rooms(floor, [stove, make_thing(2, "dining table", 4.0, 1.5)], (4.8, 2)) == ["kitchen"]
    assert name_rooms(floor, [stove, make_thing(2, "dining table", 12.0, 1.5)], (12.8, 1)) == ["dining room"]


def test_planned_rooms_contain_their_floor_and_not_their_box():
    floor = make_floor(8, 8, (0, 3.9, 4, 4.1), (3.9, 0, 4.1, 4.1))  # the lower left is cut off
    plan = plan_rooms(floor, [make_thing(1, "bed", 6, 6)])
    (room,) = list_rooms(plan)
    inside = room.contains(np.array([[6.0, 0, 2.0], [2.0, 0, 6.0], [2.0, 0, 2.0]]))
    assert inside.tolist() == [True, True, False] and (room.low < 1).all()


# -- what is asked -----------------------------------------------------------------------------------------------------


def test_nothing_is_asked_about_a_room_that_a_thing_may_be_in():
    floor = make_floor(10, 4)
    signs = [make_thing(1, "bed", 1, 1), make_thing(2, "wardrobe", 3, 3)]
    rooms = list_rooms(plan_rooms(floor, signs))
    things = [make_thing(1, "bed", 1, 1, room="bedroom 1"), make_thing(2, "wardrobe", 3, 3, room="bedroom 1")]
    slots = {"use": "use to store clothes", "room": "bedroom"}
    known = find_answer(SceneTable("", tuple(things), rooms), "use", slots)
    assert known is not None and known.answer == "wardrobe"
    doubtful = SceneTable("", (*things, make_thing(3, "dresser", 6, 1, room=UNCLEAR)), rooms)
    assert find_answer(doubtful, "use", slots) is None
    lone = make_thing(3, "dining table", 6, 1, room=UNCLEAR)
    chair = make_thing(4, "chair", 6.7, 1, room=UNCLEAR)
    around = SceneTable("", (*things, lone, chair), rooms)
    assert find_answer(around, "count_around", {"objects": "chair", "anchor": "dining table"}) is None
    assert find_answer(around, "where", {"object": "dining table"}) is None


def test_a_house_of_meshes_has_rooms_colors_and_questions(house):
    found = look_around(world(house, "cpu"), 0, RULES)
    table = found.table
    assert sorted(table.room_kinds) == ["bedroom", "kitchen", "living room"]
    rooms = {thing.category: table.kind_of(thing.room) for thing in table.things}
    assert (rooms["bed"], rooms["sofa"], rooms["vase"], rooms["refrigerator"], rooms["wall"]) == (
        "bedroom", "living room", "living room", "kitchen", "",
    )  # fmt: skip
    colors = {thing.category: thing.color for thing in table.things}
    assert (colors["bed"], colors["sofa"], colors["wardrobe"]) == ("red", "blue", "green")
    asked = {each.text: each.fact.answer for each in find_questions(found)}
    assert asked["What color is the bed?"] == "red" and asked["In which room is the sofa?"] == "living room"
    assert asked["Where is the vase?"] == "on the coffee table in the living room"
    assert not any("made of" in text or "open" in text or " left " in text for text in asked)


def test_nothing_is_asked_about_names_that_questions_cannot_speak_of(house):
    found = look_around(world(house, "cpu"), 0, RULES)
    names = {"wardrobe": "cabinet left", "coffee table": "table/unknown", "refrigerator": "fridge on wall"}
    things = tuple(replace(each, category=names.get(each.category, each.category)) for each in found.table.things)
    texts = [each.text for each in find_questions(replace(found, table=replace(found.table, things=things)))]
    assert "What color is the bed?" in texts
    assert not any(name in text for name in names.values() for text in texts)


def test_questions_do_not_depend_on_the_folder(house, tmp_path):
    for file in Path(house).parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    first, moved = (look_around(world(path, "cpu"), 0, RULES) for path in (house, str(tmp_path / "house.obj")))
    assert np.array_equal(first.survey.points, moved.survey.points)


def test_what_dim_light_makes_doubtful_has_no_color(house):
    """White in dim light is rendered as a grey that a little more light would make white."""
    colors = {thing.category: thing.color for thing in look_around(world(house, "cpu"), 0, RULES).table.things}
    assert colors["refrigerator"] == ""


def test_a_file_says_more(house, tmp_path):
    said = {"refrigerator": {"color": "white", "state": "closed", "material": "metal"}, "wardrobe": {"room": "kitchen"}}
    (tmp_path / "more.json").write_text(json.dumps(said))
    found = look_around(world(house, "cpu"), 0, RULES, attributes=read_attributes(tmp_path / "more.json"))
    things = {thing.category: thing for thing in found.table.things}
    fridge = things["refrigerator"]
    assert (fridge.color, fridge.state, fridge.material) == ("white", "closed", "metal")
    assert found.table.kind_of(things["wardrobe"].room) == "kitchen"
    asked = {each.text: each.fact.answer for each in find_questions(found)}
    assert asked["Is the refrigerator open or closed?"] == "closed"
    assert asked["What is the refrigerator made of?"] == "metal"
    assert "What color is the refrigerator?" not in asked  # for it is not rendered so


@pytest.mark.parametrize(
    ("body", "wrong"),
    [
        ([], "expected an object such as"),
        ({"bed": {"colour": "red"}}, "bed: expected an object with some of category, color"),
        ({"bed": {"color": "scarlet"}}, "bed: color: expected one of white, .*, got 'scarlet'"),
        ({"bed": {"state": "made"}}, "bed: state: expected one of on, off"),
        ({"bed": {"color": 3}}, "bed: color: expected text, got 3"),
    ],
)
def test_a_file_of_another_form_is_refused(tmp_path, body, wrong):
    (tmp_path / "more.json").write_text(json.dumps(body))
    with pytest.raises(FileError, match=wrong):
        read_attributes(tmp_path / "more.json")


@pytest.mark.parametrize(
    ("name", "fields", "wrong"),
    [
        ("bath", {"color": "red"}, "has no instance 'bath'; it has floor"),
        ("bed", {"room": "cellar"}, "bed: room: expected a kind .* of bedroom, kitchen, living room; got 'cellar'"),
    ],
)
def test_a_file_for_another_scene_is_refused(house, name, fields, wrong):
    more = Attributes(((name, tuple(fields.items())),))
    with pytest.raises(ArgumentError, match=wrong):
        look_around(world(house, "cpu"), 0, RULES, attributes=more)


def test_attributes_are_for_scenes_that_tell_little(tmp_path):
    (tmp_path / "more.json").write_text("{}")
    with pytest.raises(ArgumentError, match="apartments need none"):
        AEQA("apartments:val/3", attributes=tmp_path / "more.json")


# -- episodes ----------------------------------------------------------------------------------------------------------


def test_episodes_of_a_house_are_marked_as_unbalanced(house, tmp_path, capsys):
    out = tmp_path / "house.json"
    options = ["--task-option", "shortest=2", "--task-option", "places=160", "--backend", "cpu"]
    assert main(["episodes", "aeqa", "--scenes", house, "--episodes", "8", "--out", str(out), *options]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "8 episodes in 1 scene" in shown and "unbalanced: each question is asked in one scene only" in shown
    assert json.loads(out.read_text())["balanced"] is False
    episodes = episode_file.load(out)
    assert all(episode.info["unbalanced"] is True for episode in episodes)
    texts = [Question.from_info(episode.info["question"]).text for episode in episodes]
    assert len(set(texts)) == 8
    task = AEQA(house, backend="cpu", shortest=2, places=160)
    assert [Question.from_info(each.info["question"]).text for each in task.episodes(3)] == texts[:3]
    run = ["run", "aeqa", "--episode-file", str(out), "--policy", "explorer-oracle", "--episodes", "1"]
    options = ["--backend", "cpu", "--task-option", "actions=15", "--out", str(tmp_path / "run")]
    assert main([*run, *options]) == 0
    assert "Unbalanced questions in 1 of the episodes" in " ".join(capsys.readouterr().out.split())
    remark = "Scores cannot be compared with those of balanced questions"
    assert remark in load_run(tmp_path / "run").report().read_text()
    shutil.copytree(tmp_path / "run", tmp_path / "again")
    both = wiw.compare(tmp_path / "run", tmp_path / "again")
    assert "Unbalanced questions in 1 of the episodes" in both.remarks()[0]


def test_apartments_stay_balanced():
    task = AEQA("apartments:val:4")
    assert task.is_balanced and task.file_header["balanced"] is True and task.explain_episodes([]) == []


def test_too_many_questions_of_a_house_are_refused(house):
    with pytest.raises(ArgumentError, match="of 900 questions satisfy"):
        generate(world(house, "cpu"), 900, 0, RULES)


def test_a_real_house_has_rooms_and_questions(data_dir: Path):
    path = data_dir / "small_house" / "worlds" / "small_house.world"
    if not path.is_file():
        pytest.skip(f"no small_house in {data_dir}")
    found = look_around(world(str(path), "cpu"), 0, EpisodeRules())
    table = found.table
    assert sorted(table.room_kinds) == ["bedroom", "gym", "kitchen", "living room"]
    rooms = {thing.name: table.kind_of(thing.room) for thing in table.things}
    expected = {
        "Wardrobe_01_001": "bedroom", "TV_02_001": "bedroom", "SofaC_01_001": "living room", "TV_01_001": "living room",
        "Refrigerator_01_001": "kitchen", "KitchenTable_01_001": "kitchen", "Dumbbell_01_001": "gym",
        "BalconyTable_01_001": "",
    }  # fmt: skip
    assert {name: rooms[name] for name in expected} == expected
    asked = {each.text: each.fact.answer for each in find_questions(found)}
    assert len(asked) >= 60 and len({each.category for each in find_questions(found)}) == 6
    assert asked["How many people can be seated at the dining table?"] == "4"
    assert asked["What color is the tablet?"] == "black" and "What color is the sofa?" not in asked
    assert not any("is the door" in text or "made of" in text for text in asked)
    episodes = generate(world(str(path), "cpu"), 48, 0)
    assert len({Question.from_info(episode.info["question"]).text for episode in episodes}) == 48
