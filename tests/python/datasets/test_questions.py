# SPDX-License-Identifier: Apache-2.0
"""Questions about homes: their language, the facts behind them, what is valid, and that texts give nothing away."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wiw import scenes
from wiw.datasets import episodes as episode_file
from wiw.datasets.cameras import camera_pose
from wiw.datasets.questions import Question, balance, blind, generate, grammar, parse, phrase, twins
from wiw.datasets.questions.answers import LOOKED_FOR, Fact, Sight, are_different, find_answer, propose
from wiw.datasets.questions.colors import name_colors
from wiw.datasets.questions.facts import BROADER, SMALL, Room, SceneTable, Thing
from wiw.datasets.questions.generate import EpisodeRules
from wiw.datasets.questions.survey import HFOV, YAWS, Survey
from wiw.datasets.worlds import World, world
from wiw.errors import ArgumentError
from wiw.types import Episode

RULES = EpisodeRules()

# -- language ----------------------------------------------------------------------------------------------------------

NAMES = st.sampled_from([*LOOKED_FOR, *sorted(SMALL), *BROADER, "fitness equipment", "bed-side table", "tv stand"])
COUNTABLE = st.sampled_from([name for name in (*LOOKED_FOR, *sorted(SMALL), *BROADER) if not name.endswith("s")])
WORDS = {
    "objects": COUNTABLE,
    "rooms": COUNTABLE,
    "color": st.sampled_from(grammar.COLORS),
    "state": st.sampled_from(grammar.STATES),
    "side": st.sampled_from(["left", "right"]),
    "activity": st.sampled_from(list(grammar.ACTIVITIES)),
    "use": st.sampled_from(list(grammar.USES)),
    "habit": st.sampled_from(list(grammar.HABITS)),
    "capacity": st.sampled_from(list(grammar.CAPACITIES)),
    "room": st.sampled_from(["kitchen", "living room", "kids room", "hallway"]),
}


@st.composite
def filled_templates(draw: st.DrawFn) -> tuple[str, dict[str, str]]:
    template = grammar.TEMPLATES[draw(st.sampled_from(list(grammar.TEMPLATES)))]
    slots = [name for name in template.slots if name in template.required_slots or draw(st.booleans())]
    return template.name, {name: draw(WORDS.get(name, NAMES)) for name in slots}


@given(filled_templates())
def test_parsing_finds_what_was_phrased(filled: tuple[str, dict[str, str]]) -> None:
    template, slots = filled
    found = parse(phrase(template, slots))
    assert found is not None
    assert (found.template, dict(found.slots)) == (template, slots)
    assert found.answer_type == grammar.TEMPLATES[template].answer_type
    assert parse("  " + phrase(template, slots).upper().replace("?", " ?")) == found


@given(filled_templates(), filled_templates())
def test_two_questions_never_have_one_text(
    first: tuple[str, dict[str, str]], second: tuple[str, dict[str, str]]
) -> None:
    assert (phrase(*first) == phrase(*second)) == (first == second)


@pytest.mark.parametrize("text", ["", "?", "What is the white object on the wall above the TV?", "Is the front door?"])
def test_foreign_texts_are_not_parsed(text: str) -> None:
    assert parse(text) is None


@pytest.mark.parametrize(
    ("template", "slots", "message"),
    [
        ("wheer", {}, "expected one of"),
        ("where", {}, "has the slots object"),
        ("where", {"object": "vase", "room": "kitchen"}, "has the slots object"),
        ("where", {"object": "white board"}, "ambiguous"),
        ("where", {"object": "key on the wall"}, "distinguished from"),
        ("activity", {"activity": "fly"}, "distinguished from"),
        ("count_in", {"objects": "books", "room": "kitchen"}, "distinguished from"),
    ],
)
def test_words_that_cannot_be_found_again_are_refused(template: str, slots: dict[str, str], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        phrase(template, slots)


def test_every_template_has_an_answer_function_and_all_categories_are_asked() -> None:
    table = SceneTable("empty", (), ())
    slots = {name: "x" for template in grammar.TEMPLATES.values() for name in template.slots}
    slots |= {
        "use": "sit on",
        "activity": "take a bath",
        "habit": "make music",
        "capacity": "work at a desk",
        "state": "on",
    }
    for template in grammar.TEMPLATES.values():
        given_slots = {name: slots[name] for name in template.slots if name in template.required_slots}
        assert find_answer(table, template.name, given_slots) is None
    assert len({template.category for template in grammar.TEMPLATES.values()}) == 7


def test_a_question_travels_as_json() -> None:
    question = Question(
        "Where is the vase?",
        "on the desk in the study",
        "object localization",
        "place",
        ("in the study",),
        "where",
        {"object": "vase"},
        (7, 9),
        ((1.0, 0.0, 2.5, 0.5),),
        "0003",
    )
    assert Question.from_info(json.loads(json.dumps(question.to_info()))) == question


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"answer": " "}, "answer with words"),
        ({"answer": "?"}, "answer with words"),
        ({"extra_answers": ["since", "..."]}, "answer with words"),
        ({"extra_answers": "since"}, "extra_answers: expected a list of texts, got 'since'"),
        ({"category": "colour"}, "category"),
        ({"answer_type": "number"}, "answer_type"),
        ({"viewpoints": [[0, 0, 0]]}, "viewpoints"),
        ({"viewpoints": [[0, 0, 0, float("nan")]]}, "viewpoints"),
        ({"target": [1.5]}, "target"),
        ({"slots": {"object": 3}}, "slots"),
        ({"secret": 1}, "secret"),
        ({"text": 3}, "text"),
    ],
)
def test_a_damaged_question_is_a_typed_error_naming_the_field(change: dict[str, Any], message: str) -> None:
    info = Question("Why?", "because", "world knowledge").to_info() | change
    with pytest.raises(ArgumentError, match=message):
        Question.from_info(info)


# -- facts -------------------------------------------------------------------------------------------------------------


def thing(number: int, category: str, low: tuple[float, ...], high: tuple[float, ...], **known: Any) -> Thing:
    front = np.asarray(known.pop("front", (0.0, 0.0, 1.0)))
    values = {"color": "", "material": "", "state": "", "room": "bedroom"} | known
    return Thing(
        number, f"{category} {number}", category, low=np.array(low), high=np.array(high), front=front, **values
    )


BED = thing(1, "bed", (-1, 0, 0), (1, 0.6, 2), color="blue", state="made")
LEFT_TABLE = thing(2, "nightstand", (-1.5, 0, 0), (-1.1, 0.5, 0.4))
LAMP = thing(3, "table lamp", (-1.4, 0.5, 0.1), (-1.2, 0.9, 0.3), state="on", color="red")
PICTURE = thing(4, "picture", (-0.4, 1.4, 0), (0.4, 1.9, 0.03))
WARDROBE = thing(5, "wardrobe", (1.2, 0, 0), (2.4, 2.1, 0.6), state="closed", material="wood")
RUG = thing(6, "rug", (-2, 0, -1), (2, 0.01, 3))
FLOOR = thing(7, "floor", (-3, 0, 0), (3, 0, 4), color="brown", material="wood planks")
BEDROOM = Room("bedroom", "bedroom", np.array([-3.0, 0, 0]), np.array([3.0, 2.5, 4]))
TABLE = SceneTable("made", (BED, LEFT_TABLE, LAMP, PICTURE, WARDROBE, RUG, FLOOR), (BEDROOM,))


def answer(template: str, table: SceneTable = TABLE, **slots: str) -> str | None:
    fact = find_answer(table, template, slots)
    return None if fact is None else fact.answer


def test_relations_are_as_one_sees_them() -> None:
    # The bed's front looks along +z; who faces it looks along -z, with -x to the left.
    assert answer("beside", anchor="bed", side="left") == "nightstand"
    assert answer("beside", anchor="bed", side="right") == "wardrobe"
    assert answer("on_top", anchor="nightstand", room="bedroom") == "table lamp"
    assert answer("above", anchor="bed") == "picture"
    assert answer("count_on", anchor="nightstand") == "1"
    assert answer("where", object="table lamp") == "on the nightstand in the bedroom"
    assert answer("where", object="wardrobe") == "next to the bed in the bedroom"
    assert answer("exists", object="desk", room="bedroom") == "no"
    assert answer("exists", object="wardrobe", room="bedroom") == "yes"
    assert answer("is_state", object="table lamp", state="off") == "no"
    assert answer("switch", object="table lamp") == "on"
    assert answer("opening", object="bed") is None  # "made" is neither
    assert answer("floor_material", room="bedroom") == "wood"
    assert answer("sleepers") == "2"
    assert answer("use", use="use to store clothes", room="bedroom") == "wardrobe"


def test_turning_an_anchor_round_exchanges_its_sides() -> None:
    turned = replace(BED, front=np.array([0.0, 0.0, -1.0]))
    table = replace(TABLE, things=(turned, *TABLE.things[1:]))
    assert answer("beside", table, anchor="bed", side="right") == "nightstand"
    assert answer("beside", table, anchor="bed", side="left") == "wardrobe"


def test_a_word_for_two_things_means_none() -> None:
    second = replace(LAMP, id=8, low=np.add(LAMP.low, [0, 0, 1.5]), high=np.add(LAMP.high, [0, 0, 1.5]))
    two_lamps = replace(TABLE, things=(*TABLE.things, second))
    assert answer("switch", two_lamps, object="table lamp") is None
    assert answer("where_colored", two_lamps, color="red", object="table lamp") is None
    blue = replace(TABLE, things=(*TABLE.things, replace(second, color="blue")))
    assert answer("where_colored", blue, color="red", object="table lamp") == "on the nightstand in the bedroom"
    pink = replace(TABLE, things=(*TABLE.things, replace(second, color="pink")))  # red to some
    assert answer("where_colored", pink, color="red", object="table lamp") is None
    bunk = replace(TABLE, things=(*TABLE.things, replace(BED, id=9, category="bunk bed")))
    assert answer("color", bunk, object="bed") is None  # a bunk bed is a bed


def test_the_bedroom_of_two_is_rejected() -> None:
    assert answer("color", room="bedroom", object="bed") == "blue"
    two = replace(TABLE, rooms=(BEDROOM, replace(BEDROOM, name="bedroom 2")))
    for _, slots in propose(two):
        assert slots.get("room") != "bedroom"
    assert answer("color", two, room="bedroom", object="bed") is None
    assert answer("floor_color", two, room="bedroom") is None
    assert answer("color", two, object="bed") == "blue"


def test_what_is_about_as_near_is_not_asked() -> None:
    middle = thing(8, "plant", (1.15, 0, 1.0), (1.3, 1, 1.2))
    table = replace(TABLE, things=(*TABLE.things, middle))
    assert answer("nearer", table, object="plant", room="bedroom", first="wardrobe", second="bed") is None
    assert answer("nearer", table, object="plant", room="bedroom", first="nightstand", second="bed") == "bed"


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((250, 250, 250), "white"),
        ((128, 128, 128), "grey"),
        ((10, 10, 10), "black"),
        ((200, 40, 40), "red"),
        ((40, 80, 200), "blue"),
        ((60, 160, 60), "green"),
        ((110, 70, 40), "brown"),
        ((230, 210, 40), "yellow"),
    ],
)
def test_colors_have_their_usual_names(rgb: tuple[int, int, int], name: str) -> None:
    assert name_colors(np.array([rgb], np.uint8)).tolist() == [name]


def test_views_of_the_survey_are_what_a_camera_shows(two_rooms: str) -> None:
    place = world(two_rooms, "cpu")
    points = place.ground.put_down(place.navmesh.sample(5, 3)).astype(float)
    surveyed = generate.survey(place, points)
    for i, yaw in ((0, 0), (1, 3), (2, 9), (4, YAWS - 1)):
        pose = camera_pose(points[i], surveyed.headings[yaw])
        ids = place.renderer.perspective(pose[None], (240, 280), HFOV, outputs=("instance",))["instance"]
        shares = np.bincount(ids.ravel(), minlength=surveyed.shares.shape[2]) / ids.size
        np.testing.assert_allclose(surveyed.shares[i, yaw], shares, atol=0.015)  # of pixels 1.4 degrees wide


def test_viewpoints_are_near_their_thing_where_a_table_lacks_instances() -> None:
    scan = replace(TABLE, things=tuple(each for each in TABLE.things if each is not BED))  # without a surface
    points = np.array([[x, 0.0, 0.5] for x in (-4.0, -2.0, 2.0, 4.0)])
    views = Survey(points, np.ones((4, 16, 8), np.float32), np.zeros((4, 4)))
    for instance, near in ((LAMP.id, [True, True, False, False]), (WARDROBE.id, [False, False, True, True])):
        found = views.find_viewpoints(scan, Sight((instance,)), 0.003, 0.001, 3.0)
        assert found.all(axis=1).tolist() == near


def test_the_shortest_route_passes_every_sight() -> None:
    places = np.arange(6.0)[:, None]
    distances = np.abs(places - places.T)
    stops = [np.array([5]), np.array([0, 1])]
    lengths, orders = generate._shortest_routes(distances, stops)
    assert lengths.tolist() == [5, 4, 5, 6, 5, 4]  # from 2: 1 to the left, then 4 to the right; or 3 and 4
    assert orders[2] == (1, 0)
    assert generate._walk(distances, 2, [stops[i] for i in orders[2]]) == [1, 5]


# -- apartments --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def around() -> generate.Surroundings:
    return generate.look_around(world("apartments:val/0", "cpu"), 0, RULES)


@pytest.fixture(scope="module")
def asked(around: generate.Surroundings) -> list[generate.Answerable]:
    return generate.find_questions(around)


def shares_from(place: World, at: tuple[float, ...]) -> np.ndarray:
    """The part of a camera's view that each instance fills."""
    pose = camera_pose(np.array(at[:3]), at[3])
    ids = place.renderer.perspective(pose[None], (240, 280), HFOV, outputs=("instance",))["instance"]
    return np.bincount(ids.ravel(), minlength=len(place.scene.instances) + 1) / ids.size


def test_an_apartment_has_many_questions_of_all_categories(asked: list[generate.Answerable]) -> None:
    counts = Counter(each.category for each in asked)
    assert len(counts) == 7
    assert len(asked) >= 100
    assert len({each.text for each in asked}) == len(asked)


def test_questions_can_be_answered_from_their_viewpoints_only(
    around: generate.Surroundings, asked: list[generate.Answerable]
) -> None:
    place = around.place
    for each in asked[::7]:
        assert RULES.shortest <= each.geodesic <= RULES.longest
        goals = np.array([at[:3] for at in each.viewpoints])
        walks = [float(place.navmesh.geodesic_distance(np.array(each.start_position), goal)) for goal in goals]
        if len(each.fact.sights) > 1:
            assert walks[0] <= each.geodesic + 1e-6
            continue
        assert each.geodesic == pytest.approx(walks[0], abs=1e-3)
        assert walks == sorted(walks)
        (sight,) = each.fact.sights
        if sight.around:
            continue
        for at in each.viewpoints[:3]:
            seen = shares_from(place, at)
            assert all(seen[i] >= 0.6 * RULES.share for i in sight.things), (each.text, at)  # of a coarse panorama
        for yaw in np.arange(8) * np.pi / 4:
            seen = shares_from(place, (*each.start_position, yaw))
            low, high = (around.table.things[sight.things[0] - 1].low, around.table.things[sight.things[0] - 1].high)
            gap = np.maximum(0, np.maximum(low - each.start_position, each.start_position - high))
            far = np.hypot(gap[0], gap[2]) > RULES.reach
            assert far or any(seen[i] < 1.5 * RULES.share for i in sight.things), each.text


def test_colors_that_are_asked_for_are_rendered(
    around: generate.Surroundings, asked: list[generate.Answerable]
) -> None:
    colored = [each for each in asked if each.template in ("color", "wall_color", "floor_color")]
    assert len(colored) >= 5
    for each in colored[::3]:
        (target,) = each.fact.target
        at = max(each.viewpoints, key=lambda at: shares_from(around.place, at)[target])
        pose = camera_pose(np.array(at[:3]), at[3])
        views = around.place.renderer.perspective(pose[None], (240, 280), HFOV, outputs=("color", "instance"))
        names = name_colors(views["color"][0][views["instance"][0] == target][:, :3])
        assert (names == each.fact.answer).mean() > 0.35, each.text
    painted = [thing for thing in around.table.things if thing.color and thing.category == "wall"]
    assert len(painted) > sum(each.template == "wall_color" for each in colored)  # a passage's, or one in other light


def test_questions_are_a_function_of_scene_and_seed(asked: list[generate.Answerable]) -> None:
    again = generate.find_questions(generate.look_around(world("apartments:val/0", "cpu"), 0, RULES))
    assert [each.to_episode(0) for each in again] == [each.to_episode(0) for each in asked]
    other = generate.find_questions(generate.look_around(world("apartments:val/0", "cpu"), 1, RULES))
    assert {each.text for each in other} != set()
    assert [each.start_position for each in other] != [each.start_position for each in asked]


def test_episodes_of_one_scene_take_turns_in_categories() -> None:
    place = world("apartments:val/0", "cpu")
    made = generate.generate(place, 14, 0, RULES, first=3)
    questions = [Question.from_info(episode.info["question"]) for episode in made]
    assert [episode.episode_id for episode in made] == [f"{i:04d}" for i in range(3, 17)]
    assert set(Counter(question.category for question in questions).values()) == {2}
    assert sum(question.answer_type == "yes_no" for question in questions) <= 2
    more = generate.generate(place, 5, 0, RULES, before=[question.text for question in questions])
    assert not {q.text for q in questions} & {e.info["question"]["text"] for e in more}
    with pytest.raises(ArgumentError, match="of 5000 questions"):
        generate.generate(place, 5000, 0, RULES)


def test_a_scene_without_rooms_is_a_typed_error(two_rooms: str) -> None:
    with pytest.raises(ArgumentError, match="expected a scene with rooms"):
        generate.generate(world(two_rooms, "cpu"), 1, 0)


def questions_in(episodes: list[Episode]) -> list[tuple[str, Question]]:
    return [(episode.scene, Question.from_info(episode.info["question"])) for episode in episodes]


def check_balance(episodes: list[Episode]) -> None:
    """Fail unless every text has two answers in two scenes at least, and none of its answers is right too often."""
    by_text: dict[str, list[tuple[str, Question]]] = defaultdict(list)
    for scene, question in questions_in(episodes):
        by_text[question.text].append((scene, question))
    for text, asked in by_text.items():
        answers = Counter(question.answer for _, question in asked)
        assert len({scene for scene, _ in asked}) >= 2, text
        assert len(answers) >= 2, text
        assert max(answers.values()) <= len(asked) / 2, text
    yes_no = [question.answer for _, question in questions_in(episodes) if question.answer_type == "yes_no"]
    assert len(yes_no) <= 0.2 * len(episodes)
    assert yes_no.count("yes") * 2 == len(yes_no)


@pytest.mark.nightly
def test_no_text_gives_its_answer_away_in_six_apartments() -> None:
    """In a block of four apartments and in a smaller one; all are homes that other tests bake as well."""
    specs = [*scenes.resolve("apartments:val:4"), *scenes.resolve("apartments:train:2")]
    episodes = balance.make_episodes(specs, 48, 0, RULES, per_scene=8, backend="cpu")
    check_balance(episodes)
    categories = Counter(question.category for _, question in questions_in(episodes))
    assert len(categories) == 7
    assert max(categories.values()) <= 12
    assert len({scene for scene, _ in questions_in(episodes)}) >= 6
    assert sum(bool(question.twin) for _, question in questions_in(episodes)) >= 6
    for count in (10,):
        first = balance.make_episodes(specs, count, 0, RULES, per_scene=8, backend="cpu")
        assert first == episodes[:count]
        check_balance(first)
    assert len(balance.make_episodes(specs, 7, 0, RULES, backend="cpu")) == 7


def test_too_few_scenes_are_a_typed_error() -> None:
    with pytest.raises(ArgumentError, match="0 of 4 questions in 1 blocks"):
        balance.make_episodes(["apartments:val/0"], 4, 0, replace(RULES, twins=0), backend="cpu")
    with pytest.raises(ArgumentError, match="with 12 rooms"):
        balance.make_episodes(["apartments:val/0"], 4, 0, replace(RULES, rooms=12), backend="cpu")


def test_adjacent_colors_and_other_corners_of_a_room_are_no_different_answers() -> None:
    assert not are_different(Fact("white", (), ()), Fact("grey", (), ()), "color")
    assert are_different(Fact("white", (), ()), Fact("blue", (), ()), "color")
    here, there = Fact("on the desk in the study", (), (), gist="study"), Fact("in the study", (), (), gist="study")
    assert not are_different(here, there, "place")


# -- twins -------------------------------------------------------------------------------------------------------------


def test_a_twin_asks_the_same_from_the_same_start_where_something_else_is_true(
    around: generate.Surroundings, asked: list[generate.Answerable]
) -> None:
    edits = twins.edits_of("apartments:val/0")
    found = []
    for template in ("switch", "count_in", "exists", "where"):
        for each in [each for each in asked if each.template == template and each.fact.answer != "no"][:4]:
            twin = twins.find_twin(each, around.table, edits, 0, RULES, "cpu")
            if twin is None:
                continue
            found.append(template)
            assert (twin.text, twin.start_position, twin.start_yaw) == (each.text, each.start_position, each.start_yaw)
            assert are_different(twin.fact, each.fact, each.answer_type)
            assert twin.scene.startswith(f"{each.scene}?")
            assert RULES.shortest <= twin.geodesic <= RULES.longest
    assert {"switch", "exists"} <= set(found)


def test_edits_of_other_things_make_no_twin(around: generate.Surroundings, asked: list[generate.Answerable]) -> None:
    lamp = next(each for each in asked if each.template == "switch" and each.slots["object"] == "ceiling lamp")
    (name,) = {thing.name for thing in around.table.things if thing.id in lamp.fact.target}
    edits = [edit for edit in twins.edits_of("apartments:val/0") if edit.kind == "state"]
    assert twins.may_have_twin(lamp, around.table, edits)
    assert not twins.may_have_twin(lamp, around.table, [edit for edit in edits if name not in edit.names])


def test_an_apartment_without_light_is_the_same_to_walk_and_see(around: generate.Surroundings) -> None:
    unlit = generate.look_around(twins.open_unlit("apartments:val/0", "cpu"), 0, RULES, around.survey.points[:20])
    np.testing.assert_array_equal(unlit.survey.shares, around.survey.shares[:20])
    np.testing.assert_allclose(unlit.survey.distances, around.survey.distances[:20, :20], rtol=1e-12)


def test_twin_episodes_name_each_other(tmp_path: Path) -> None:
    pairs = list(balance.pair_questions(["apartments:val/0"], 0, replace(RULES, twins=1.0), 4, "cpu"))
    assert len(pairs) == 2
    episodes = [episode for i, pair in enumerate(pairs) for episode in balance.to_episodes(pair, 2 * i)]
    check_balance(episodes)
    episode_file.save(tmp_path / "twins.json", episodes, "aeqa")
    assert episode_file.load(tmp_path / "twins.json") == episodes
    by_id = {episode.episode_id: episode for episode in episodes}
    for episode in episodes:
        question = Question.from_info(episode.info["question"])
        other = by_id[question.twin]
        assert other.info["question"]["twin"] == episode.episode_id
        assert other.info["question"]["text"] == question.text
        assert other.start_position == episode.start_position
        assert other.scene != episode.scene
        assert other.info["question"]["answer"] != question.answer


@pytest.mark.parametrize("text", ["paint:sofa+1=red", "color:sofa+1", "remove:sofa=1", "state"])
def test_an_unknown_edit_is_a_typed_error(text: str) -> None:
    with pytest.raises(ArgumentError, match="expected color:<instance>"):
        twins.Edit.parse(text)


def test_an_edit_names_what_it_changes() -> None:
    assert twins.Edit.parse("swap:plant_1,floor_lamp_2").names == ("plant 1", "floor lamp 2")
    assert twins.Edit.parse("state:curtain_2=half_drawn").names == ("curtain 2",)
    assert twins.edits_of("house.glb") == []
    with pytest.raises(ArgumentError, match="single apartment"):
        twins.outline("apartments:val")


# -- answers without looking -------------------------------------------------------------------------------------------


def made(text: str, right: str) -> generate.Answerable:
    found = parse(text)
    assert found is not None
    return generate.Answerable("", text, found.template, found.slots, Fact(right, (), ()), 0, (0, 0, 0), 0, 5, ())


def test_the_most_frequent_answer_is_that_of_the_narrowest_kind_of_question() -> None:
    answered = [made("What color is the sofa in the study?", color) for color in ("red", "red", "blue")]
    answered += [made("What color is the sofa?", color) for color in ("blue", "blue", "blue", "green")]
    answered += [made("What color is the desk?", "white")] * 9
    answers = blind.choose_answers(blind.count_answers(answered))
    guess = {
        text: next(answers[key] for key in blind._keys(text) if key in answers)
        for text in (
            "What color is the sofa in the study?",
            "What color is the sofa in the kitchen?",
            "What color is the stool?",
            "What color is my hat?",
            "Who?",
        )
    }
    assert list(guess.values()) == ["red", "blue", "white", "white", "white"]


def test_the_packages_table_answers_every_kind_of_question() -> None:
    assert blind.blind_answer("How many bedrooms does this home have?").isdecimal()
    assert blind.blind_answer("Is the floor lamp on or off?") in ("on", "off")
    assert blind.blind_answer("Is there a piano in the kitchen?") == "no"
    assert blind.blind_answer("What color is the front door?") in grammar.COLORS
    assert blind.blind_answer("Why?")


def test_surveyed_places_are_within_reach_of_each_other(around: generate.Surroundings) -> None:
    assert isinstance(around.survey, Survey)
    assert len(around.survey.points) >= 0.8 * RULES.places
    assert np.isfinite(around.survey.distances).all()
