# SPDX-License-Identifier: Apache-2.0
"""The explorer: what it believes of a home, what it looks for, how imagined views count, and when it answers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_aeqa import SCENE, Records, episode, make_task  # noqa: F401 - a fixture

import wiw
from wiw.action import FORWARD, TURN_LEFT
from wiw.analysis.answer_confidence import fit_curve, write_calibration
from wiw.datasets import episodes
from wiw.datasets.questions import parse
from wiw.datasets.questions.blind import blind_answer
from wiw.datasets.questions.facts import Room, SceneTable, Thing, make_table
from wiw.errors import ArgumentError
from wiw.experiments.privileged_explorers import (
    SPACING,
    OracleExplorer,
    OracleTourExplorer,
    _rename,
    choose_places,
    look_from,
    take_tour,
)
from wiw.loop.memory import Query
from wiw.loop.privileged import LiveEnvironments
from wiw.loop.scheduler import run_episodes
from wiw.mapping.fragments import pack_voxels, split_along_wall, unpack_voxels
from wiw.mapping.object_map import MapObject, ObjectMap
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.views import Views, place_cameras, unproject
from wiw.perception.scene_labels import CATEGORIES, STATES, Labeller, SceneLabels
from wiw.policies.base import Situation
from wiw.policies.explorer import confidence
from wiw.policies.explorer.answering import Belief, answer, list_wanted
from wiw.policies.explorer.destinations import Destination, _measure_way
from wiw.policies.explorer.home import KNOWLEDGE, Home, Surface, believe_home, load_knowledge, to_table_frame
from wiw.policies.explorer.memory import Memory
from wiw.policies.explorer.policy import SURFACE_STRIDE, SURFACES, Explorer
from wiw.policies.explorer.presuming import find_likeliest
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.scenes import apartment_table
from wiw.tasks.aeqa import AEQA
from wiw.training.home_knowledge import count_homes, write_knowledge
from wiw.types import Goal, Key, Observation, Proposal, Rollout, TextAnswer

PALETTE = {
    "white": (230, 228, 222), "grey": (128, 128, 128), "black": (30, 30, 30), "brown": (110, 75, 45),
    "red": (170, 50, 45), "yellow": (220, 190, 70), "green": (80, 130, 75), "blue": (65, 95, 150),
}  # fmt: skip


class RedIsASofa(Labeller):
    """Takes pure red for a sofa and anything else for nothing."""

    categories = CATEGORIES

    def compute_labels(self, images: np.ndarray, hfov_deg: float, ids: Any, depth: Any) -> SceneLabels:
        sofa = (images == (255, 0, 0)).all(axis=-1)
        category = np.where(sofa, CATEGORIES.index("sofa"), 0).astype(np.uint8)
        return SceneLabels(category, sofa.astype(np.float32), np.zeros_like(category))


@pytest.fixture(autouse=True)
def plain_colors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Name colours by the nearest of a few, so that no weights are needed."""
    names, values = list(PALETTE), np.array(list(PALETTE.values()), float)

    def name_color(pixels: np.ndarray, category: str) -> tuple[str, float]:
        return names[int(((values - pixels.mean(axis=0)) ** 2).sum(axis=1).argmin())], 0.8

    monkeypatch.setattr("wiw.policies.explorer.policy.name_color", name_color)


def make_explorer(**options: Any) -> OracleExplorer:
    return OracleExplorer(perception=RedIsASofa(), **options)


# -- what homes are like -----------------------------------------------------------------------------------------------


def test_rooms_are_told_by_what_is_in_them():
    known = load_knowledge()
    for things, kind in (
        ({"toilet": 1}, "bathroom"),
        ({"bed": 1, "wardrobe": 1}, "bedroom"),
        ({"stove": 1}, "kitchen"),
    ):
        shares = known.judge_room(things)
        assert known.kinds[int(shares.argmax())] == kind and shares.sum() == pytest.approx(1)
    assert known.measure_affinity("bathroom", ["toilet"]) > 0.5 > known.measure_affinity("kitchen", ["toilet"])


def test_knowledge_is_counted_in_train_apartments(tmp_path):
    write_knowledge(tmp_path / "own.json", apartments=2)
    own = json.loads((tmp_path / "own.json").read_text())
    assert own == json.loads(json.dumps(count_homes([make_table(apartment_table(i, "train")) for i in range(2)])))
    assert set(own) == set(json.loads(KNOWLEDGE.read_text())) and sum(own["rooms"].values()) == pytest.approx(
        1, abs=1e-3
    )


def test_the_table_has_the_axes_of_scenes():
    forward, left, up = to_table_frame(np.eye(3))
    assert forward.tolist() == [0, 0, -1] and left.tolist() == [-1, 0, 0] and up.tolist() == [0, 1, 0]


# -- floors and walls --------------------------------------------------------------------------------------------------


def look_plainly(explorer: Explorer, views: Views, labels: SceneLabels) -> list[Surface]:
    """Look at floors and walls patch by patch."""
    looks, half = [], SURFACE_STRIDE // 2
    for name in SURFACES:
        mask = (labels.category == CATEGORIES.index(name)) & (views.depth > 0)
        for view in range(len(mask)):
            for row in range(half, views.size[0] - half, SURFACE_STRIDE):
                for column in range(half, views.size[1] - half, SURFACE_STRIDE):
                    patch = np.s_[view, row - half // 2 : row + half // 2, column - half // 2 : column + half // 2]
                    if mask[patch].all():
                        color, confidence = explorer.name_color(views.images[patch].reshape(-1, 3), name)
                        point = unproject(views, *(np.array([i]) for i in (view, row, column)))[0]
                        looks.append(Surface(name, point[:2], color, confidence))
    return looks


@pytest.mark.parametrize("size", [(192, 224), (97, 61), (20, 20)])
def test_looks_at_surfaces_are_patches_of_one_surface(monkeypatch, size):
    def weigh(pixels: np.ndarray, category: str) -> tuple[str, float]:
        assert pixels.dtype == np.uint8 and pixels.shape == ((SURFACE_STRIDE // 2) ** 2, 3)
        return category, float(np.arange(pixels.size) @ pixels.ravel())  # tells any order of the pixels

    monkeypatch.setattr("wiw.policies.explorer.policy.name_color", weigh)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (4, *size, 3), np.uint8)
    depth = rng.uniform(0.5, 5, (4, *size)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.001] = 0
    category = np.zeros((4, *size), np.uint8)
    category[:, : size[0] // 2], category[:, size[0] // 2 :] = (CATEGORIES.index(name) for name in ("wall", "floor"))
    category[rng.random(category.shape) < 0.001] = CATEGORIES.index("sofa")
    views = Views(images, depth, place_cameras(np.array([1.0, -2.0, 0.7])), np.array([1.0, -2.0, 0.7]))
    labels = SceneLabels(category, np.ones(depth.shape, np.float32), np.zeros_like(category))
    explorer = Explorer(perception=RedIsASofa())
    found, expected = explorer._look_at_surfaces(views, labels), look_plainly(explorer, views, labels)
    assert (len(found) > 20 and {look.category for look in found} == set(SURFACES)) or size != (192, 224)
    assert [(each.category, each.position.tolist(), each.color, each.weight) for each in found] == [
        (each.category, each.position.tolist(), each.color, each.weight) for each in expected
    ]


# -- from the map to a home -------------------------------------------------------------------------------------------


def make_boxes(
    category: str, *boxes: tuple[tuple[float, float], tuple[float, float]]
) -> tuple[ObjectMap, OccupancyGrid]:
    """Return a map in which a category fills boxes 0.5 m high, given by their range along x and y."""
    objects = ObjectMap(CATEGORIES, STATES)
    votes = np.eye(len(CATEGORIES))[CATEGORIES.index(category)]
    for number, ((x0, x1), (y0, y1)) in enumerate(boxes, start=1):
        axes = [np.arange(low, high, 0.05) + 0.025 for low, high in ((x0, x1), (y0, y1), (0.0, 0.5))]
        voxels = pack_voxels(np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3))
        objects._objects[number] = MapObject(
            number, np.unique(voxels), votes, np.zeros(len(STATES)), (), category, "", "", 0.1, 1.0, 1, 0, 0
        )
    return objects, OccupancyGrid()


@pytest.mark.parametrize(
    ("category", "boxes", "count"),
    [
        ("sofa", [((0, 0.9), (0, 0.9)), ((0.95, 1.9), (0, 0.9))], 1),  # two ends of one
        ("sofa", [((0, 1.9), (0, 0.9)), ((1.95, 3.9), (0, 0.9))], 2),  # side by side
        ("sofa", [((0, 0.6), (0, 0.9)), ((1.2, 1.9), (0, 0.9))], 2),  # apart
        ("cup", [((0, 0.05), (0, 0.05)), ((0.1, 0.15), (0, 0.05))], 2),  # small things stand close together
    ],
)
def test_parts_that_fill_the_space_of_one_thing_are_one(category, boxes, count):
    objects, grid = make_boxes(category, *boxes)
    home = believe_home(objects, grid, [], load_knowledge())
    assert len(home.objects) == count
    assert sum(len(thing.voxels) for thing in home.objects.values()) == sum(
        len(thing.voxels) for thing in objects.objects
    )


# -- questions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("What color is the sofa?", ("sofa",)),
        ("Is the bin in the kitchen nearer to the stove or to the refrigerator?", ("bin", "stove", "refrigerator")),
        ("Where can I wash clothes?", ("washing machine",)),
        ("How many people can sleep in the beds of this home?", ("bed", "bunk bed")),
        ("What is love?", ()),
    ],
)
def test_what_is_looked_for_follows_from_the_words(text, wanted):
    assert list_wanted(parse(text)) == wanted


def test_an_empty_map_leaves_the_guess_from_the_text():
    grid = OccupancyGrid()
    home = believe_home(ObjectMap(CATEGORIES, STATES), grid, [], load_knowledge())
    for text in ("What color is the sofa?", "What is love?"):
        belief = answer(parse(text), text, home, grid)
        assert (belief.text, belief.confidence) == (blind_answer(text), 0.0)


class Supported(ObjectMap):
    """Objects of which views saw something else in most looks, and in every voxel in half of them."""

    def measure_support(self, thing: MapObject) -> float:
        return 0.2

    def find_supported(self, thing: MapObject, least: float) -> np.ndarray:
        return thing.voxels if least <= 0.5 else thing.voxels[:0]


def test_thin_things_are_believed_in_with_less_support():
    """The voxels of a picture are also those of its wall."""
    objects, votes = Supported(CATEGORIES, STATES), np.zeros(len(CATEGORIES))
    for number, category in enumerate(("sofa", "picture", "cup"), start=1):
        own = votes.copy()
        own[CATEGORIES.index(category)] = 1.0
        voxels = np.unique(
            pack_voxels(np.array([number, 0.0, 0.5]) + 0.05 * (np.indices((8, 8, 8)).reshape(3, -1).T + 0.5))
        )
        objects._objects[number] = MapObject(number, voxels, own, votes, (), category, "", "", 0.1, 1.0, 1, 0, 0)
    home = believe_home(objects, OccupancyGrid(), [], load_knowledge())
    assert [thing.category for thing in home.table.things] == ["picture", "cup"]


# -- how much of a thing was seen --------------------------------------------------------------------------------------


def test_scraps_are_no_things_until_a_question_speaks_of_one():
    """The edge of a wardrobe is taken for a second sofa; a question about the sofa means the whole one."""
    objects, grid = make_boxes("sofa", ((0, 1.9), (0, 0.9)), ((4, 4.15), (0, 0.1)))
    home = believe_home(objects, grid, [], load_knowledge())
    assert [thing.id for thing in home.table.things] == [1] and [thing.id for thing in home.scraps] == [2]
    assert set(home.objects) == {1, 2}  # it is worth another look

    objects, grid = make_boxes("sofa", ((4, 4.15), (0, 0.1)))
    objects._objects[1] = replace(objects[1], color="red")
    home = believe_home(objects, grid, [], load_knowledge())
    assert home.table.things == ()
    text = "What color is the sofa?"
    assert answer(parse(text), text, home, grid).text == "red"


def test_pictures_side_by_side_have_wall_between_them():
    axes = [np.arange(low, high, 0.05) + 0.025 for low, high in ((0.0, 1.3), (0.0, 0.05), (1.0, 1.5))]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    keys = np.sort(pack_voxels(points))
    along = unpack_voxels(keys)[:, 0]
    shares = np.where((along > 0.6) & (along < 0.7), 0.4, 0.95)
    parts = split_along_wall(keys, shares)
    assert [round(float(np.ptp(unpack_voxels(part)[:, 0]) + 0.05), 2) for part in parts] == [0.6, 0.6]
    assert split_along_wall(keys, np.full(len(keys), 0.5))[0].tolist() == keys.tolist()  # unsure, but of one piece


def test_a_material_is_that_of_things_in_the_colour():
    known = replace(load_knowledge(), materials={"desk": "wood", "desk/red": "lacquer"})
    assert known.name_material("desk", "red") == "lacquer"
    assert known.name_material("desk", "blue") == "wood" and known.name_material("sofa", "red") == ""


def test_a_labeller_says_which_of_its_labels_are_mapped():
    class Unsure(RedIsASofa):
        least_confidence = 0.9

    goal = Goal("aeqa", text="What color is the sofa?", question=True)
    assert Explorer(perception=Unsure()).begin(goal, Key(0, 0)).objects.least_confidence == 0.9
    assert Explorer(perception=RedIsASofa()).begin(goal, Key(0, 0)).objects.least_confidence == 0.3


# -- what questions take for granted -----------------------------------------------------------------------------------


def make_thing(number: int, category: str, room: str, color: str = "", x: float = 0.0) -> Thing:
    low = np.array([x, 0.0, 0.0])
    return Thing(number, f"{category} {number}", category, color, "", "", room, low, low + 0.5, np.array([0.0, 0, 1]))


def make_home(things: list[Thing], kinds: dict[str, dict[str, float]], weights: dict[int, float]) -> Home:
    rooms = tuple(
        Room(name, max(shares, key=lambda kind: shares[kind]), np.zeros(3), np.ones(3))
        for name, shares in kinds.items()
    )
    votes, voxels = np.ones(1), np.zeros(1, np.int64)
    objects = {
        number: MapObject(number, voxels, votes, votes, (), "", "", "", weight, 1.0, 1, 0, 0)
        for number, weight in weights.items()
    }
    return Home(SceneTable("", tuple(things), rooms), objects, {}, kinds)


def ask(home: Home, text: str) -> str | None:
    question = parse(text)
    assert question is not None
    fact = find_likeliest(home, question)
    return fact.answer if fact is not None else None


def test_of_two_things_that_a_question_takes_for_one_the_better_supported_counts():
    things = [make_thing(1, "sofa", "a", "red"), make_thing(2, "sofa", "a", "blue")]
    kinds = {"a": {"living room": 0.9, "study": 0.1}}
    assert ask(make_home(things, kinds, {1: 0.01, 2: 0.2}), "What color is the sofa?") == "blue"
    assert ask(make_home(things, kinds, {1: 0.2, 2: 0.01}), "What color is the sofa?") == "red"


def test_the_room_that_a_question_names_is_the_likeliest_one():
    things = [make_thing(1, "sofa", "a", "red"), make_thing(2, "sofa", "b", "blue")]
    weights = {1: 0.1, 2: 0.1}
    kinds = {"a": {"study": 0.6, "living room": 0.3, "kitchen": 0.1}, "b": {"study": 0.9, "living room": 0.1}}
    assert ask(make_home(things, kinds, weights), "What color is the sofa in the study?") == "blue"
    assert ask(make_home(things, kinds, weights), "What color is the sofa in the living room?") == "red"
    assert ask(make_home(things, kinds, weights), "What color is the sofa in the bathroom?") is None


def test_what_hinders_an_answer_is_doubted_the_weakest_first():
    things = [make_thing(1, "armchair", "a"), make_thing(2, "pouf", "a"), make_thing(3, "stool", "b")]
    kinds = {"a": {"bedroom": 1.0}, "b": {"kitchen": 1.0}}
    text = "What can I sit on in the bedroom?"
    assert ask(make_home(things, kinds, {1: 0.3, 2: 0.02, 3: 0.01}), text) == "armchair"
    assert ask(make_home(things, kinds, {1: 0.02, 2: 0.3, 3: 0.01}), text) == "pouf"


# -- tours -------------------------------------------------------------------------------------------------------------


def test_a_tour_passes_everything_and_shows_what_stands_there(episode):  # noqa: F811
    env = make_task(episode).environment(depth=True)
    env.begin(episode)
    state = env.state
    places = choose_places(state.world, state.positions[-1])
    survey = state.world.navmesh.sample(200, 5, int(state.world.navmesh.island_of(state.positions[-1])))
    everywhere = np.concatenate([places, state.positions[-1][None]])
    away = np.linalg.norm(survey[:, None, [0, 2]] - everywhere[:, [0, 2]], axis=2).min(axis=1)
    assert away.max() < SPACING + 0.6 and len(places) > 5
    looks = list(take_tour(env, ids=True))
    assert len(looks) == len(places) and np.allclose(env.state.positions[-1], state.positions[-1])
    # A walk of the environment itself ends where the odometry of a look at its end says.
    walked = make_task(episode).environment(depth=True)
    walked.begin(episode)
    seen = walked.run([int(TURN_LEFT), int(FORWARD), int(FORWARD)], TextAnswer("", 0.0)).observation
    (look,) = (each for each in look_from(env, [walked.state.positions[-1]], ids=False))
    assert np.allclose(look.odometry[:2], seen.odometry[:2], atol=0.02) and look.odometry[2] == 0


def test_after_a_tour_the_first_answer_is_final(episode):  # noqa: F811
    task, sink = make_task(episode), Records()
    agent = wiw.Agent(OracleTourExplorer(perception=RedIsASofa()), **task.defaults)
    run_episodes(task, agent, [(0, episode)], seed=0, live=1, sink=sink)
    assert sink.results[0].status == "done", sink.results[0].error
    assert sink.answers[0].final and len(sink.answers) == 2 and sink.results[0].metrics["primitives"] <= 3


# -- episodes ----------------------------------------------------------------------------------------------------------


def test_it_finds_the_sofa_and_answers_from_its_map(episode):  # noqa: F811
    task = make_task(episode)
    sofa = next(each for each in make_table(apartment_table(1, "val")).things if each.category == "sofa")
    asked = "In which room is the sofa?"
    question = {**episode.info["question"], "text": asked, "template": "which_room", "answer_type": "place"}
    moved = replace(episode, info={"question": {**question, "answer": sofa.room.split(" 1")[0]}})
    sink = run(task, moved)
    (result,) = sink.results
    assert result.status == "done", result.error
    assert result.metrics["answered"] == 1 and result.metrics["success"] == 1
    assert sink.answers[-1].final and sink.answers[-2].final and sink.answers[-1].confidence >= 0.45


def run(task: AEQA, *episodes: Any, live: int = 1) -> Records:
    sink = Records()
    agent = wiw.Agent(make_explorer(), **task.defaults)
    run_episodes(task, agent, list(enumerate(episodes)), seed=0, live=live, sink=sink)
    return sink


def test_episodes_do_not_depend_on_what_else_is_live(episode):  # noqa: F811
    task = make_task(episode, actions=45)
    turned = replace(episode, episode_id="0001", start_yaw=2.0)
    alone, together = run(task, episode, turned), run(task, episode, turned, live=2)
    assert {each.episode: each.metrics for each in alone.results} == {
        each.episode: each.metrics for each in together.results
    }


@pytest.mark.parametrize(("budget", "actions"), [(None, 20), (20, 45)], ids=["the task's", "its own"])
def test_time_that_is_nearly_up_makes_any_belief_final(episode, budget, actions):  # noqa: F811
    policy = make_explorer(budget=budget, sure=1.1)
    task = make_task(episode, actions=actions)
    sink = Records()
    run_episodes(task, wiw.Agent(policy, **task.defaults), [(0, episode)], seed=0, live=1, sink=sink)
    assert [each.final for each in sink.answers[:1]] == [False] and sink.answers[-1].final
    assert sink.results[0].metrics["answered"] == 1


@pytest.mark.parametrize(
    ("free_turns", "execute", "most"), [(False, None, 18), (False, 15, 18), (True, 15, 18), (True, 21, 24)]
)
def test_the_budget_is_counted_as_the_task_counts_it(free_turns, execute, most):
    policy, walked = make_explorer(sure=1.1), [int(TURN_LEFT)] * 4 + [int(FORWARD), int(TURN_LEFT)]
    goal = Goal("aeqa", text="q", question=True, budget=30, free_turns=free_turns)
    memory, finals = policy.begin(goal, Key(0, 0)), []
    memory.azimuth, memory.destinations = 0.0, [Destination(np.zeros(2), 1.0)]
    for decision in range(5):
        place = Observation(np.zeros((576, 1024, 3), np.uint8), np.zeros((480, 480, 3), np.uint8), np.zeros(3))
        situation = Situation(place, goal, Key(0, 0, decision), memory, tuple(walked * decision), execute=execute)
        policy._follow(situation)
        finals.append(policy.is_final(situation))
    assert finals == [30 - (2 if free_turns else 6) * decision <= most for decision in range(5)]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sure": "high"}, "expected a number for sure, got 'high'"),
        ({"sure": float("nan")}, "expected a number for sure, got nan"),
        ({"path": float("inf")}, "expected a number for path, got inf"),
        ({"budget": 0}, "expected a whole budget of at least 1, got 0"),
        ({"budget": 12.5}, "expected a whole budget of at least 1, got 12.5"),
        ({"calibrated": "never"}, "expected true or false for calibrated, got 'never'"),
    ],
)
def test_options_that_are_no_numbers_are_refused_before_a_run(options, message):
    with pytest.raises(ArgumentError, match=f"policy explorer: {message}"):
        make_explorer(**options)


# -- imagined views ----------------------------------------------------------------------------------------------------


def test_a_plan_whose_imagined_end_shows_the_thing_scores_higher(episode):  # noqa: F811
    task, policy = make_task(episode), make_explorer(imagination=5.0)
    env = task.environment(depth=True)
    observation = env.begin(episode)
    environments = LiveEnvironments()
    environments.add(Key(0, 0), env)
    policy.grant(environments)
    memory = policy.begin(env.goal, Key(0, 0))
    situation = wiw.policies.base.Situation(observation, env.goal, Key(0, 0), memory)
    policy.observe([situation])
    empty = np.zeros((2, 288, 512, 3), np.uint8)
    shown = empty.copy()
    shown[-1, 130:200, 200:300] = (255, 0, 0)
    passed = empty.copy()
    passed[0, 130:200, 200:300] = (255, 0, 0)  # in sight on the way only
    front = np.zeros((2, 192, 192, 3), np.uint8)
    front[-1, 90:150, 60:130] = (255, 0, 0)
    real = np.zeros(2, bool)
    rollouts = [Rollout(frames, real, "panorama") for frames in (empty, shown, passed)] + [
        Rollout(front, real, "front")
    ]
    plans = [Proposal(np.array([1, 1], np.int8), prior=1.0) for _ in rollouts]
    (scores,) = policy.score([situation], [plans], [rollouts])
    assert scores[0] == scores[2] == 1.0 and scores[1] > 5.5 and scores[3] > 5.5


def test_true_perception_is_told_apart():
    assert make_explorer().describe()["privileged"] == ["perception"]
    assert OracleTourExplorer(perception=RedIsASofa()).describe()["privileged"] == ["perception", "tour"]
    with pytest.raises(ArgumentError, match="explorer-oracle"):
        wiw.policy("explorer", perception=wiw.registry.LABELLERS.make("oracle", instances=[]))
    with pytest.raises(ArgumentError, match="use it with task aeqa"):
        Explorer.require({"task": "imagenav"})


def test_queries_carry_the_text_alone(episode):  # noqa: F811
    env = make_task(episode).environment(depth=True)
    query = Query(env.begin(episode), env.goal, Key(0, 0))
    assert query.goal.text == episode.info["question"]["text"] and SCENE not in repr(query.goal)


# -- how sure it is ----------------------------------------------------------------------------------------------------


def test_curves_of_confidence_never_fall_and_doubt_few_samples():
    rng = np.random.default_rng(0)
    support = rng.uniform(0, 1, 3000)
    many = fit_curve([(s, float(rng.uniform() < s**2), 1.0) for s in support])
    assert many["support"] == sorted(many["support"]) and many["right"] == sorted(many["right"])
    assert np.allclose(many["right"], np.square(many["support"]), atol=0.07)
    assert max(fit_curve([(0.9, 1.0, 1.0)] * 3)["right"]) < 0.85
    halves = fit_curve([(0.5, 1.0, 0.01)] * 100 + [(0.5, 0.0, 1.0)] * 9)  # one long episode against nine short ones
    assert max(halves["right"]) < 0.5


def test_confidence_is_read_off_the_curve_of_the_answers_type(monkeypatch):
    curves = {"": {"support": [0.0, 1.0], "right": [0.2, 0.6]}, "color": {"support": [0.5], "right": [0.9]}}
    monkeypatch.setattr(confidence, "load_curves", lambda: curves)
    assert confidence.estimate_confidence("color", 0.1) == 0.9
    assert confidence.estimate_confidence("count", 0.5) == pytest.approx(0.4)
    assert confidence.estimate_confidence("color", 0.0) == 0.0


def test_confidence_is_calibrated_by_a_run(episode, tmp_path):  # noqa: F811
    options = {"perception": f"{__file__}:RedIsASofa", "calibrated": False}
    agent = AgentRecipe("explorer-oracle-tour", policy_options={"explorer-oracle-tour": options})
    file = tmp_path / "asked.json"
    episodes.save(file, [episode], "aeqa")
    task = TaskRecipe("aeqa", {"episode_file": str(file)})
    wiw.evaluate(task, agent, 1, out=tmp_path / "run", progress=False, keep_images=0)
    curves = write_calibration(tmp_path / "run", tmp_path / "own.json")
    assert set(curves) == {""} and json.loads((tmp_path / "own.json").read_text()) == curves
    assert 0 < curves[""]["right"][0] < 1 and 0 < curves[""]["support"][0] <= 1


def test_the_shipped_curves_never_fall():
    for curve in confidence.load_curves().values():
        assert curve["support"] == sorted(curve["support"]) and curve["right"] == sorted(curve["right"])
        assert 0 < curve["right"][0] <= curve["right"][-1] < 1


def test_true_perception_knows_the_words_and_colors_of_scenes_from_files():
    """Where a scene does not say a colour, it is seen; other words for a category mean the same."""
    said = [
        {"id": 1, "category": "couch", "attributes": {"color": "blue"}},
        {"id": 2, "category": "cooking bench", "attributes": {}},
    ]
    instances = _rename(said)
    assert [each["category"] for each in instances] == ["sofa", "stove"] and said[0]["category"] == "couch"
    images = np.full((1, 2, 3, 3), 128, np.uint8)
    images[0, 0] = PALETTE["red"]
    ids = np.array([[[2, 2, 1], [1, 1, 0]]], np.uint32)
    explorer = make_explorer()
    painted = explorer._paint(images, ids, instances)
    assert [explorer.name_color(painted[ids == number], "")[0] for number in (1, 2)] == ["blue", "red"]


def test_what_lies_beyond_the_map_has_no_way():
    grid = OccupancyGrid()
    distances = np.ones((40, 40))
    edge = grid.to_points(np.array([[0, 0]]))[0]
    for offset in ([-5.0, 0.0], [0.0, -5.0], [-5.0, -5.0], [500.0, 0.0]):
        place = Destination(edge + offset, 0.0, radius=1.0)
        assert _measure_way(grid, distances, place) == np.inf


@pytest.mark.parametrize("horizon", [1, 2, 3, 4, 8])
@pytest.mark.parametrize("confidence", [0.1, 0.9])
@pytest.mark.parametrize("places", [[], [(-2.0, 0.5)], [(50.0, 0.5)]])  # the last one cannot be reached
def test_plans_are_no_longer_than_the_horizon(monkeypatch, horizon, confidence, places):
    monkeypatch.setattr(Explorer, "__init__", lambda self: None)
    explorer = Explorer()
    explorer.sure, explorer.budget = 0.7, None
    memory = Memory(None, ObjectMap(CATEGORIES, STATES))
    memory.grid.add(np.full((144, 256), 3, np.float32), np.zeros(3))
    memory.belief = Belief("red", confidence)
    memory.destinations = [Destination(np.array(place), 1.0) for place in places]
    situation = Situation(None, Goal("aeqa", text="q", question=True, budget=250), Key(0, 0), memory)
    plans = explorer.propose([situation], 3, horizon)[0]
    assert plans and all(1 <= len(plan.actions) <= horizon for plan in plans)
