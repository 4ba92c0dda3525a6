# SPDX-License-Identifier: Apache-2.0
"""Policy vlm on questions: commands and walks, routes to landmarks, pictures, and answers from real views alone."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import agent_for
from hypothesis import given, settings
from hypothesis import strategies as st
from locations import TESTS
from test_aeqa import Records
from test_labellers import Whole

pytest.importorskip("pydantic")
pytest.importorskip("openai")
pytest.importorskip("json_repair")

import wiw
from misbehaviour import MisbehavingVlmServer, Misbehaviour
from question_file import QUESTION, ByColor, a_file, make_episode
from wiw.action import FORWARD, TURN_LEFT, TURN_RIGHT
from wiw.errors import ArgumentError
from wiw.loop.memory import Query
from wiw.loop.scheduler import run_episodes
from wiw.mapping.landmarks import Landmark
from wiw.mapping.marks import MarkedViews
from wiw.mapping.occupancy import OccupancyGrid
from wiw.mapping.routes import STEP, TURN
from wiw.mapping.views import SIZE
from wiw.perception.detection import Detections, Detector
from wiw.perception.detector_labeller import DetectorLabeller
from wiw.policies.vlm.make import make_vlm
from wiw.policies.vlm.questions import commands, steering
from wiw.policies.vlm.questions.home_map import HomeMap, find_named
from wiw.policies.vlm.questions.policy import QuestionVLM
from wiw.runs.recipes import AgentRecipe
from wiw.serving.vlm_server import VlmServer
from wiw.tasks import presets
from wiw.tasks.aeqa import AEQA
from wiw.types import Key, Proposal
from wiw.vlm.messages import Call, Completion
from wiw.vlm.mock import MockClient
from wiw.vlm.structured import parse_object

LEFT, RIGHT = int(TURN_LEFT), int(TURN_RIGHT)
HORIZON = 21
"""As the task gives it: L = 14 with the turn at the beginning counted as one."""


def command(view: str = "front", landmark: Any = None, answer: Any = None, plan: str = "Go on.") -> dict[str, Any]:
    chosen = {"chosen_view": view, "chosen_landmark": landmark}
    return {"reason": "free floor", "action_plan": plan, **chosen, "answer": answer}


def walk(*steps: tuple[str, int]) -> dict[str, Any]:
    return {"reason": "free floor", "actions": [{"action": action, "times": times} for action, times in steps]}


def without_answer(said: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in said.items() if name != "answer"}


def parse(schema: Any, value: Any) -> Any:
    """The validated object, or the problem's text."""
    outcome = parse_object(Completion(json.dumps(value)), schema)
    return outcome[0] if isinstance(outcome, tuple) else str(outcome)


def words(call: Call) -> str:
    return "\n".join(part for message in call.messages for part in message.content if isinstance(part, str))


def images(call: Call) -> list[Any]:
    return [part for message in call.messages for part in message.content if not isinstance(part, str)]


def level(call: Call) -> str:
    """Which of the prompts a call is."""
    if call.schema is None:
        return "choose"
    names = set(call.schema["properties"])
    kinds = {"actions": "walk", "plans": "listed", "chosen_view": "plan" if "answer" in names else "revise"}
    return next((kind for name, kind in kinds.items() if name in names), "answer")


# -- commands and walks ------------------------------------------------------------------------------------------------


def test_commands_have_the_papers_fields_and_name_what_is_marked() -> None:
    schema = commands.command_schema((1, 4))
    assert list(schema.model_fields) == ["reason", "action_plan", "chosen_view", "chosen_landmark", "answer"]
    assert parse(schema, command("left", 4)).chosen_landmark == 4
    for nothing in ("None", "none", " null ", "", None):
        found = parse(schema, command(landmark=nothing, answer=nothing))
        assert found.chosen_landmark is None and found.answer is None
    assert parse(schema, command(landmark="4", answer="3")).chosen_landmark == 4
    assert parse(schema, command(answer="3")).answer == "3", "an answer of digits stays a text"
    assert "chosen_landmark" in parse(schema, command(landmark=2)), "no such mark"
    assert "chosen_view" in parse(schema, command("above"))
    assert "answer" in parse(schema, command(answer="a novel" * 100))
    assert "chosen_landmark" in parse(commands.command_schema(()), command(landmark=1)), "nothing is marked"
    assert "action_plan" in parse(schema, command(plan=""))
    listed = commands.command_schema((1, 4), 2)
    assert len(parse(listed, {"plans": [command(), command("left", 1)]}).plans) == 2
    assert "plans" in parse(listed, {"plans": [command()] * 3})


def test_commands_walks_and_answers_are_read_in_harmless_variations() -> None:
    schema = commands.command_schema((1, 4))
    assert parse(schema, command(answer=4)).answer == "4" and parse(schema, command(answer=2.5)).answer == "2.5"
    assert parse(commands.answer_schema(), {"answer": 3}).answer == "3"
    for ambiguous in (True, ["red"], {"colour": "red"}, float("nan")):
        assert "answer" in parse(schema, command(answer=ambiguous))
    assert parse(schema, command("Left", plan="Go.") | {"confidence": 0.9}).chosen_view == "left"
    unreasoned = {key: value for key, value in command().items() if key != "reason"}
    assert parse(schema, unreasoned).reason == "" and "chosen_view" in parse(schema, command("front left"))
    silent = commands.command_schema((1,), answers=False)
    assert parse(silent, command(answer="none")).action_plan == "Go on.", "null says nothing"
    spelled = {key.replace("_", " ").title(): value for key, value in command("Left", 4, "red").items()}
    assert "Chosen Landmark" in spelled and parse(schema, spelled) == parse(schema, command("left", 4, "red"))
    assert "Answer" in parse(schema, command(answer="red") | {"Answer": "blue"})
    del spelled["Answer"]
    assert "answer" in parse(schema, spelled | {"ANSWER": "red", "Answer": "red"}), "two spellings of one field"
    steps = {"actions": [{"action": "Turn Left", "times": 2, "why": "a wall"}, {"action": "STOP", "times": 1}]}
    assert commands.parse_walk(parse(commands.walk_schema(), steps)).tolist() == [LEFT] * 2
    assert "action_plan" in parse(schema, {"chosen_view": "front", "chosen_landmark": None, "answer": None})


VALUES = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.lists(st.integers(), max_size=2)


@settings(max_examples=150, deadline=None)
@given(st.fixed_dictionaries(dict.fromkeys(command(), VALUES)))
def test_whatever_a_model_writes_is_a_command_or_a_problem(said: dict[str, Any]) -> None:
    for value in (said, {**command(), "chosen_landmark": said["chosen_landmark"], "answer": said["answer"]}):
        found = parse(commands.command_schema((1, 4)), value)
        if not isinstance(found, str):
            assert found.chosen_landmark in (None, 1, 4) and found.chosen_view in ("front", "left", "right", "back")
            assert commands.parse_answer(found) == "" or found.answer.strip()


def test_where_imagined_views_are_shown_no_answer_can_be_given() -> None:
    schema = commands.command_schema((1,), answers=False)
    assert parse(schema, without_answer(command(landmark=1))).chosen_landmark == 1
    assert "answer" in parse(schema, command(answer="red")), "forbidden"


def test_a_landmark_counts_where_another_view_is_named() -> None:
    small, large = np.zeros(SIZE, bool), np.ones(SIZE, bool)
    small[0, 0] = True
    mark = Landmark(7, "sofa", np.zeros(3), {1: small, 2: large}, 3.0)
    marked = MarkedViews(
        np.zeros((4, *SIZE, 3), np.uint8), {0: {}, 1: {1: "sofa"}, 2: {1: "sofa"}, 3: {}}, {1: mark}, {}
    )
    schema = commands.command_schema(commands.list_marks(marked))
    found = [commands.parse_commands(parse(schema, command(view, 1)), marked)[0] for view in ("front", "left", "right")]
    assert [each.view for each in found] == [2, 1, 2] and all(each.landmark is mark for each in found)
    assert commands.name_marks(marked) == {"front": {}, "left": {1: "sofa"}, "right": {1: "sofa"}, "back": {}}


def test_walks_are_four_actions_of_four_at_most_and_end_where_they_stop() -> None:
    schema = commands.walk_schema()
    found = parse(schema, walk(("forward", 4), ("turn_left", 2), ("stop", 1), ("forward", 1)))
    assert commands.parse_walk(found).tolist() == [int(FORWARD)] * 4 + [LEFT] * 2
    assert commands.parse_walk(parse(schema, walk(("stop", 1)))).tolist() == []
    assert "actions" in parse(schema, walk(*[("forward", 1)] * 5))
    assert "times" in parse(schema, walk(("forward", 5))) and "times" in parse(schema, walk(("forward", 0)))
    assert "action" in parse(schema, walk(("jump", 1))) and "actions" in parse(schema, walk())


# -- from commands to primitives ---------------------------------------------------------------------------------------


def open_floor(wall: bool = False) -> OccupancyGrid:
    """6 x 6 m of floor around the start; a wall 1 m ahead that is passed on the left."""
    grid = OccupancyGrid()
    grid.free[34:94, 34:94] = True
    if wall:
        grid.occupied[74:76, 34:84] = True
        grid.free[74:76, 34:84] = False
    return grid


def thing(x: float, y: float, radius: float = 0.8) -> Landmark:
    return Landmark(1, "sofa", np.array([x, y, 0.4]), {}, 2.0, radius)


def end_of(actions: Any) -> Any:
    """Where primitives lead from the origin: x, y, azimuth."""
    x = y = azimuth = 0.0
    for action in actions:
        azimuth += TURN * (int(action == LEFT) - int(action == RIGHT))
        x, y = x + STEP * (action == FORWARD) * np.cos(azimuth), y + STEP * (action == FORWARD) * np.sin(azimuth)
    return np.array([x, y, azimuth])


START = np.zeros(3)


def test_a_landmark_is_walked_to_and_around_what_stands_in_the_way() -> None:
    straight = steering.cut_plan(steering.find_route(open_floor(), START, thing(2.1, 0.0)), HORIZON)
    assert straight.tolist() == [int(FORWARD)] * 7 and straight.dtype == np.int8
    around = steering.cut_plan(steering.find_route(open_floor(wall=True), START, thing(2.2, 0.0)), 60)
    assert np.linalg.norm(end_of(around)[:2] - (2.2, 0)) <= 0.8 and len(around) > 12
    places = np.array([end_of(around[:k])[:2] for k in range(len(around) + 1)])
    inside = (places[:, 0] > 1.0) & (places[:, 0] < 1.2)
    assert (places[inside, 1] > 2.0).all(), "through the wall"


def test_beside_a_landmark_the_agent_turns_to_it() -> None:
    beside, ahead = (steering.find_route(open_floor(), START, thing(*at)) for at in ((0.0, 0.5), (0.5, 0.0)))
    assert steering.cut_plan(beside, HORIZON).tolist() == [LEFT] * 4
    assert steering.cut_plan(ahead, HORIZON).tolist() == [LEFT] * 4, "look around"


def test_the_turn_at_the_beginning_counts_as_one_action() -> None:
    behind = steering.walk_in_view(3, np.full(16, FORWARD, np.int8), HORIZON)
    assert behind.tolist() == [LEFT] * 8 + [int(FORWARD)] * 13
    assert steering.walk_in_view(0, np.full(16, FORWARD, np.int8), HORIZON).tolist() == [int(FORWARD)] * 14
    assert steering.walk_in_view(2, np.full(2, FORWARD, np.int8), HORIZON).tolist() == [RIGHT] * 4 + [int(FORWARD)] * 2
    assert steering.walk_in_view(1, np.zeros(0, np.int8), HORIZON).tolist() == [LEFT] * 4
    assert steering.walk_in_view(0, np.zeros(0, np.int8), HORIZON).tolist() == [LEFT] * 4, "nowhere to go: look around"
    assert len(steering.walk_in_view(3, np.full(16, FORWARD, np.int8), 2)) == 2


def test_straight_ahead_is_a_turn_and_then_steps_alone() -> None:
    assert steering.go_straight(steering.turn_to_view(3), HORIZON).tolist() == [LEFT] * 8 + [int(FORWARD)] * 13
    assert steering.go_straight(steering.turn_to_view(0), HORIZON).tolist() == [int(FORWARD)] * 13
    for degrees in (-170, -91, -12, 0, 11, 100, 179):
        angle = np.radians(degrees)
        pose, target = np.array([1.0, 2.0, 0.7]), thing(1 + 3 * np.cos(0.7 + angle), 2 + 3 * np.sin(0.7 + angle))
        turned = end_of(steering.turn_to_landmark(pose, target))[2]
        assert abs(turned - angle) <= TURN / 2 + 1e-9, degrees


def test_a_step_that_is_refused_though_floor_is_seen_is_remembered(two_rooms: str) -> None:
    episode = make_episode(two_rooms)
    observation = AEQA(two_rooms).environment(depth=True).begin(episode)
    labeller = ByColor()
    from wiw.mapping.views import HFOV_DEG, cut_views

    views = cut_views(observation.panorama, observation.depth, observation.odometry)
    labels = labeller.label(views.images, HFOV_DEG)
    ahead = np.array([[0.0, -0.2]])  # of the second primitive of the walk, a right angle turned
    for actions, blocked in (([RIGHT] * 4 + [int(FORWARD)], True), ([RIGHT] * 4, False), ([], False)):
        home = HomeMap(labeller.categories)
        home.add(observation, views, labels, "", np.zeros(0, np.int8))
        assert not home.grid.lookup(home.grid.occupied, ahead).any()
        home.add(observation, views, labels, "", np.array(actions, np.int8))
        assert home.grid.lookup(home.grid.occupied, ahead).any() == blocked


def test_numbers_keep_off_what_the_question_names() -> None:
    marks = [replace(thing(0, 0), id=3, category="coffee table"), replace(thing(0, 0), id=5, category="sofa")]
    assert find_named(marks, "What is on the Coffee Table?") == [3] and find_named(marks, "How many rooms?") == []


# -- in the loop -------------------------------------------------------------------------------------------------------


class Script:
    """Answers each prompt by what is planned for it; `plans` in turn, the last one again and again."""

    def __init__(self, *plans: Any, revision: Any = None, steps: Any = (("forward", 3),)) -> None:
        self.plans, self.revision, self.steps = list(plans), revision, steps

    def __call__(self, call: Call) -> Any:
        kind = level(call)
        if kind == "plan":
            return json.dumps(self.plans.pop(0) if len(self.plans) > 1 else self.plans[0])
        if kind == "listed":
            return json.dumps({"plans": self.plans})
        if kind == "walk":
            return json.dumps(walk(*self.steps))
        if kind == "answer":
            return json.dumps({"reason": "r", "answer": self.plans[0]["answer"]})
        return {"B": 0.7, "A": 0.2, "C": 0.1} if kind == "choose" else json.dumps(self.revision)


def make_policy(script: Any, **options: Any) -> QuestionVLM:
    policy = make_vlm(task="aeqa", vlm=MockClient(script), perception=ByColor(), **options)
    assert isinstance(policy, QuestionVLM)
    return policy


def decide(scene: str, policy: Any, model: Any = None, **options: Any) -> Any:
    task = AEQA(scene)
    env = task.environment(depth=True)
    observation = env.begin(make_episode(scene))
    agent = wiw.Agent(policy, model, **{**task.defaults, **options})
    return agent.decide(observation, env.goal, Key(0, 0))


def run(task: AEQA, policy: Any, *episodes: Any, model: Any = None, live: int = 1) -> Records:
    sink = Records()
    agent = wiw.Agent(policy, model, **task.defaults)
    run_episodes(task, agent, list(enumerate(episodes)), seed=0, live=live, sink=sink)
    return sink


THREE = (command(landmark=1), command("right", plan="Go through the gap."), command("back"))


def test_the_planner_sees_real_views_with_marks_and_without(two_rooms: str) -> None:
    policy = make_policy(Script(command(landmark=1)))
    decision = decide(two_rooms, policy)
    (call,) = policy.client.calls
    marked, plain = images(call)
    assert marked.shape == plain.shape and marked.shape[1] >= 4 * SIZE[1]
    changed = (marked != plain).any(-1)
    assert 0 < changed.mean() < 0.05, "outlines and numbers"
    text = words(call)
    assert QUESTION.text in text and "front view: 1 table" in text and "left view: nothing marked" in text
    assert "picture" in text and "{{" not in text and "Real views, marked:" in text
    assert (
        decision.chosen == 0 and decision.actions.tolist()[:1] != [LEFT] and decision.execute == len(decision.actions)
    )
    assert not decision.answer.final and decision.answer.text == ""
    assert [each.purpose for each in decision.exchanges] == ["propose/0"]


def test_words_are_turned_into_a_walk_by_a_second_question(two_rooms: str) -> None:
    policy = make_policy(Script(command("right", plan="Go through the gap."), steps=(("forward", 4), ("turn_left", 1))))
    decision = decide(two_rooms, policy)
    planning, walking = policy.client.calls
    assert level(planning) == "plan" and level(walking) == "walk"
    assert decision.actions.tolist() == [RIGHT] * 4 + [int(FORWARD)] * 4 + [LEFT]
    assert '"action_plan": "Go through the gap."' in words(walking) and "the right view" in words(walking)
    (view,) = images(walking)
    strip = images(planning)[0]
    np.testing.assert_array_equal(view[-SIZE[0] :], strip[-SIZE[0] :, 2 * (SIZE[1] + 4) :][:, : SIZE[1]])
    assert [each.purpose for each in decision.exchanges] == ["propose/0", "walk"]
    assert decision.proposals[0].note == "Go through the gap."


def test_candidates_are_imagined_and_real_views_are_told_from_imagined_ones(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE, revision=without_answer(THREE[1])))
    decision = decide(two_rooms, policy, "copy")
    kinds = [level(call) for call in policy.client.calls]
    assert kinds == ["plan"] * 3 + ["walk"] * 2 + ["revise", "walk"]
    revising = policy.client.calls[5]
    marked, plain, *ends = images(revising)
    assert len(ends) == len(decision.proposals) == 3 and all(end.shape == marked.shape for end in ends)
    text = words(revising)
    assert text.index("Real views, marked:") < text.index("are real. You are now also shown views that are not")
    for number, plan in enumerate(THREE, 1):
        assert f'Plan {number}: {{"action_plan": "{plan["action_plan"]}"' in text
    assert text.count("\nImagined views at its end:") == 3 and "answer" not in revising.schema["properties"]
    assert decision.chosen == 1 and decision.scores.tolist() == [0.0, 1.0, decision.scores[2]]
    for end, plan in zip(ends, decision.proposals, strict=True):  # the floor imagines nothing new: the turned real view
        turns = steering.count_leading_turns(plan.actions) if plan.actions[0] != FORWARD else 0
        shown = end[-SIZE[0] :, : SIZE[1]].astype(int)
        view = {0: 0, 4: 2, 8: 3}[turns] if plan is not decision.proposals[0] else None
        if view is not None:
            real = plain[-SIZE[0] :, view * (SIZE[1] + 4) :][:, : SIZE[1]].astype(int)
            assert np.abs(shown - real).mean() < 6


def test_a_plan_that_only_turns_ends_with_real_views(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE, revision=without_answer(THREE[0]), steps=[("stop", 1)]))
    decide(two_rooms, policy, "copy")
    revising = next(call for call in policy.client.calls if level(call) == "revise")
    text = words(revising)
    assert text.count("\nImagined views at its end:") == 1
    assert text.count("\nThe real views, turned, at its end:") == 2


def test_a_route_is_walked_to_its_end_though_only_straight_steps_are_imagined(two_rooms: str) -> None:
    def decide_officially(model: Any, **options: Any) -> Any:
        script = Script(*THREE, revision=without_answer(THREE[0]))
        return decide(two_rooms, make_policy(script, **options), model, horizon=10, execute=50)

    whole = {"imagined": "straight", "longest_route": 50}
    decision, plain = decide_officially("copy", **whole), decide_officially("copy")
    straight = decision.proposals[0].actions
    assert straight[-2:].tolist() == [int(FORWARD)] * 2 and len(set(straight[:-2].tolist())) <= 1
    assert len(plain.actions) <= 10 and len(decision.actions) > len(plain.actions)
    assert decision.actions[: len(plain.actions)].tolist() == plain.actions.tolist(), "the same route, further"
    assert decision.execute == len(decision.actions) <= 50
    assert len(decide_officially("copy", imagined="straight", longest_route=5).actions) == 5
    alone = decide_officially(None, **whole)
    assert alone.actions.tolist() == decision.actions.tolist() and alone.chosen == 0
    assert alone.proposals[0].actions.tolist() == plain.actions.tolist(), "nothing is imagined"


def test_what_stands_behind_straight_steps_is_said(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE, revision=without_answer(THREE[1])), imagined="straight", longest_route=50)
    decision = decide(two_rooms, policy, "copy")
    text = words(next(call for call in policy.client.calls if level(call) == "revise"))
    assert text.count("Imagined views after the turn it begins with and some steps straight on:") == 3
    assert "views at its end:" not in text
    walked = [RIGHT] * 4 + [int(FORWARD)] * 3  # what the second question wrote, not what was imagined
    assert decision.actions.tolist() == walked and decision.scores.argmax() == 1 and decision.chosen is None


def test_the_command_that_was_written_is_followed_though_another_is_imagined_alike(two_rooms: str) -> None:
    ahead, written = command("front", plan="Walk on."), without_answer(command("front", plan="Only turn round."))
    steps = iter([[("forward", 4)], [("turn_left", 4)]])
    script = Script(ahead, revision=written)

    def answer(call: Call) -> Any:
        script.steps = next(steps) if level(call) == "walk" else script.steps
        return script(call)

    policy = make_policy(answer, imagined="straight")
    decision = decide(two_rooms, policy, "copy", candidates=1)
    assert decision.proposals[0].actions.tolist() == [int(FORWARD)] * 13 and decision.proposals[0].note == "Walk on."
    assert decision.actions.tolist() == [LEFT] * 4 and decision.chosen is None


def test_an_answer_that_does_not_count_cuts_no_plan_short(two_rooms: str) -> None:
    """Only the first of several samples may answer."""
    far = [("forward", 4), ("turn_left", 1), ("forward", 4)]
    script = Script(
        command("right"), command("back", answer="red"), revision=without_answer(command("right")), steps=far
    )
    decision = decide(two_rooms, make_policy(script), "copy", candidates=2)
    assert [len(plan.actions) for plan in decision.proposals] == [4 + 9, 8 + 9] and decision.answer.text == ""


def test_an_answer_is_looked_at_again_where_straight_steps_are_imagined(two_rooms: str) -> None:
    policy = make_policy(Script(command(landmark=1, answer="red")), imagined="straight", longest_route=50)
    decision = decide(two_rooms, policy, "copy")
    assert len(decision.actions) <= steering.LOOK and decision.answer.final and decision.chosen == 0
    policy = make_policy(Script(command(landmark=1, answer="red")), longest_route=50)
    assert len(decide(two_rooms, policy, horizon=2).actions) == 2, "no more than a plan may have"


def test_a_reviser_may_only_choose(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE), revision="select")
    decision = decide(two_rooms, policy, "copy")
    assert decision.chosen == 1 and np.allclose(decision.scores, [0.2, 0.7, 0.1])
    assert "B. plan 2" in words(policy.client.calls[-1])


class OneStep(wiw.Policy):
    """Proposes one step forward."""

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        return [[Proposal(np.array([int(FORWARD)], np.int8))] for _ in situations]


def test_a_reviser_may_command_more_than_is_proposed(two_rooms: str) -> None:
    far = [("forward", 4), ("turn_left", 1), ("forward", 4)]
    reviser = make_policy(Script(command(), revision=without_answer(command("right")), steps=far))
    decision = decide(two_rooms, OneStep(), "copy", reviser=reviser)
    assert len(decision.actions) == 4 + 9


def test_plans_may_be_listed_in_one_answer(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE, revision=without_answer(THREE[2])), proposals="listed")
    decision = decide(two_rooms, policy, "copy")
    assert "Give 3 plans" in words(policy.client.calls[0]) and len(decision.proposals) == 3 and decision.chosen == 2


def test_imagined_views_never_answer(two_rooms: str) -> None:
    said = {**without_answer(THREE[1]), "answer": "red"}
    decision = decide(two_rooms, make_policy(Script(*THREE, revision=said), tries=1), "copy")
    assert decision.answer.text == "" and not decision.answer.final
    assert "revise: schema" in decision.note and "the first plan was taken" in decision.note and decision.chosen == 0


def test_an_answer_is_looked_at_again_and_confirmed(two_rooms: str) -> None:
    policy = make_policy(Script(command(landmark=1, answer="red.")))
    sink = run(AEQA(two_rooms), policy, make_episode(two_rooms), model="copy")
    (result,) = sink.results
    assert result.status == "done", result.error
    assert [(each.text, each.confidence, each.final) for each in sink.answers] == [("red.", 1.0, True)] * 2
    assert result.details["answer"] == "red." and result.metrics["success"] == 1
    assert result.metrics["primitives"] == steering.LOOK and result.metrics["path_length"] > 0
    assert {level(call) for call in policy.client.calls} == {"plan"}, "nothing to choose among"


def test_on_the_same_view_the_answer_is_asked_for_again_at_once(two_rooms: str) -> None:
    policy = make_policy(Script(command("back", answer="green"), command(landmark=1, answer="red")))
    (result,) = run(AEQA(two_rooms, preset="official"), policy, make_episode(two_rooms)).results
    assert result.details["answer"] == "red" and result.metrics["primitives"] == 0
    first, second = (call for call in policy.client.calls if level(call) == "plan")
    assert words(first) == words(second) and first.seed != second.seed
    np.testing.assert_array_equal(images(first)[0], images(second)[0])


class OneLamp(Detector):
    """Finds a lamp in the middle of every view."""

    def find(self, images: Any, names: Any, ids: Any) -> list[Detections]:
        boxes = np.array([[160, 150, 290, 250]], np.float32)
        return [Detections(boxes, np.array([0.9], np.float32), ("lamp",)) for _ in images]


def test_landmarks_may_come_from_a_detector_and_a_segmenter(two_rooms: str) -> None:
    found = DetectorLabeller(OneLamp(), Whole(), ("chair", "lamp"))
    policy = make_vlm(task="aeqa", vlm=MockClient(Script(command(landmark=1))), perception=found)
    decision = decide(two_rooms, policy)
    assert policy.describe()["perception"]["detector"] == "OneLamp" and decision.note == ""
    assert "front view: 1 lamp\n" in words(policy.client.calls[0])


def test_the_planner_is_told_what_it_has_decided_unless_it_has_no_memory(two_rooms: str) -> None:
    plans = [command(landmark=1, plan=f"Look at it, {k}.") for k in range(9)]
    for history, count in ((2, 2), (0, 0), (5, 3)):
        policy = make_policy(Script(*plans), history=history)
        run(AEQA(two_rooms, actions=8, execute=2), policy, make_episode(two_rooms))
        first, *_, latest = map(words, policy.client.calls)
        assert len(policy.client.calls) == 4 and "decided before" not in first
        assert re.findall(r"after (\d) actions: Look at it, (\d)", latest) == [
            (str(2 * k), str(k)) for k in range(3 - count, 3)
        ]


def test_unusable_answers_are_recorded_and_the_walk_goes_on(two_rooms: str) -> None:
    decision = decide(two_rooms, make_policy(lambda call: "I'm sorry, no.", tries=2), "copy")
    assert "propose/0: refusal" in decision.note and "a primitive was drawn" in decision.note
    assert len(decision.proposals) == 1 and not decision.answer.final
    half = make_policy(lambda call: json.dumps(command("left")) if level(call) == "plan" else "?")
    decision = decide(two_rooms, half)
    assert decision.actions.tolist() == [LEFT] * 4 and "walk: malformed" in decision.note
    assert "the robot only turns to the view" in decision.note


def test_another_policys_plans_are_ranked_and_the_question_is_asked_apart(two_rooms: str) -> None:
    policy = make_policy(Script(command(answer="red")), revision="select")
    task = AEQA(two_rooms)
    env = task.environment(depth=True)
    observation = env.begin(make_episode(two_rooms))
    agent = wiw.Agent("heuristic", "copy", reviser=policy, **task.defaults)
    decision = agent.decide(observation, env.goal, Key(0, 0))
    assert decision.answer.final and decision.answer.text == "red" and decision.chosen == 1
    assert [each.purpose for each in decision.exchanges] == ["revise", "answer"]
    assert "in primitives: " in words(policy.client.calls[0]) and len(images(policy.client.calls[1])) == 2


def test_who_has_the_role_answers_a_question_that_is_asked_apart(two_rooms: str) -> None:
    apart = MockClient(Script(command(answer="green")))
    roles = {"answer": {"vlm": apart, "model": "b"}}
    policy = make_policy(Script(command(answer="red")), revision="select", model="a", roles=roles)
    task = AEQA(two_rooms)
    env = task.environment(depth=True)
    observation = env.begin(make_episode(two_rooms))
    agent = wiw.Agent("heuristic", "copy", reviser=policy, **task.defaults)
    assert agent.decide(observation, env.goal, Key(0, 0)).answer.text == "green"
    assert [level(call) for call in apart.calls] == ["answer"]
    assert [level(call) for call in policy.client.calls] == ["choose"]


def test_decisions_do_not_depend_on_who_else_is_asked_for(two_rooms: str) -> None:
    task = AEQA(two_rooms)
    queries = []
    for number, yaw in enumerate((0.0, 2.0)):
        env = task.environment(depth=True)
        queries.append(Query(env.begin(make_episode(two_rooms, yaw=yaw)), env.goal, Key(0, number)))
    together = wiw.Agent(make_policy(None), "copy", **task.defaults).decide_batch(queries)
    for query, decision in zip(queries, together, strict=True):
        (alone,) = wiw.Agent(make_policy(None), "copy", **task.defaults).decide_batch([query])
        assert alone.exchanges == decision.exchanges and len(alone.exchanges) >= 3
        np.testing.assert_array_equal(alone.actions, decision.actions)


def test_views_of_perspective_models_are_shown_alone(two_rooms: str) -> None:
    policy = make_policy(Script(*THREE, revision=without_answer(THREE[1])))
    handed: list[Any] = []

    def rollout(observations: Any, controls: Any, seeds: Any) -> Any:
        handed.extend(zip(controls, observations.image, strict=True))
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, axis=1)

    model = wiw.world_model(rollout, accepts=wiw.accepts("trajectory", "perspective"))
    decide(two_rooms, policy, model)
    revising = next(call for call in policy.client.calls if level(call) == "revise")
    _, plain, *ends = images(revising)
    assert len(ends) == 3 and all(end.shape[0] < 480 and end.shape[1] == 384 for end in ends)
    for turned, end in ((2, ends[1]), (3, ends[2])):  # the candidate's direction, where the model begins
        real = plain[-SIZE[0] :, turned * (SIZE[1] + 4) :][:, : SIZE[1]]
        middle = np.s_[170:214, 170:214]
        assert np.abs(end[-384:][middle].mean((0, 1)) - real[170:214, 202:246].mean((0, 1))).max() < 8


def test_what_is_hidden_in_a_question_reaches_no_prompt(two_rooms: str) -> None:
    canary = "XYZZY"
    hidden = replace(
        QUESTION, answer=canary, extra_answers=(canary,), template=canary, slots={"object": canary}, twin=canary,
        target=(271828,), viewpoints=((31.4159, 0.0, 2.71828, 1.0),),
    )  # fmt: skip
    episode = replace(make_episode(two_rooms, hidden), episode_id=canary)
    policy = make_policy(Script(*THREE, command(answer="red"), revision=without_answer(THREE[1])))
    task = AEQA(two_rooms, actions=40)
    task._measure_grounding = lambda state: {}  # type: ignore[method-assign]  # there is no such target
    (result,) = run(task, policy, episode, model="copy").results
    assert result.status == "done", result.error
    kinds = {level(call) for call in policy.client.calls}
    assert kinds == {"plan", "walk", "revise"}
    for call in policy.client.calls:
        said = words(call) + json.dumps(call.schema)
        assert not any(secret in said for secret in (canary, "271828", "31.4159", "2.71828")), said


# -- options, presets, runs --------------------------------------------------------------------------------------------


def test_options_out_of_range() -> None:
    for wrong in ({"history": -1}, {"order": "sideways"}):
        with pytest.raises(ArgumentError, match="history >= 0 and order"):
            make_policy(None, **wrong)
    for wrong in ({"imagined": "nothing"}, {"longest_route": 0}):
        with pytest.raises(ArgumentError, match="imagined plan or straight and longest_route of at least 1"):
            make_policy(None, **wrong)
    for of_targets in ({"tracker": "flow"}, {"rounds": True}, {"answer_view": "target"}, {"tracker_options": {"a": 1}}):
        with pytest.raises(ArgumentError, match="only for tasks that point a target out"):
            make_policy(None, **of_targets)
        with pytest.raises(ArgumentError, match="only for tasks that point a target out"):
            make_vlm(task="imagenav", vlm="mock", **of_targets)
    with pytest.raises(ArgumentError, match="instance ids"):
        make_vlm(task="aeqa", vlm="mock", perception=wiw.registry.LABELLERS.make("oracle", instances=[]))
    with pytest.raises(ArgumentError, match="create it with task='aeqa'"):
        make_vlm(vlm="mock").begin(wiw.types.Goal("aeqa", text="Why?", question=True), Key(0, 0))
    with pytest.raises(ArgumentError, match="imagined places, which have no depth"):
        wiw.Agent(make_policy(None), "copy", depth=2)
    policy = make_policy(None)
    assert policy.describe()["order"] == "marked_first" and "tracker" not in policy.describe()


def test_presets_give_the_policy_its_memory_and_order(two_rooms: str, tmp_path: Path) -> None:
    vlm = {"vlm": {"vlm": "mock", "perception": ByColor()}}
    for preset, options, expected in (
        ("paper", {}, (5, "marked_first")),
        ("official", {}, (0, "plain_first")),
        ("official", {"history": 3}, (3, "plain_first")),
    ):
        recipe = AgentRecipe("vlm", policy_options={"vlm": {**vlm["vlm"], **options}})
        policy = agent_for(AEQA(two_rooms, preset=preset), recipe).policy
        assert isinstance(policy, QuestionVLM) and (policy.history, policy.order) == expected
        follows_code = preset == "official"
        assert policy.imagined == ("straight" if follows_code else "plan")
        assert policy.longest_decision == (50 if follows_code else None)
    own = tmp_path / "own.yaml"
    own.write_text("policies:\n  vlm: {history: 1}\n")
    task = AEQA(two_rooms, preset=own)
    assert task.policy_options["vlm"] == {"task": "aeqa", "history": 1, "order": "marked_first"}
    assert task.describe() != AEQA(two_rooms).describe()
    own.write_text("policies: [vlm]\n")
    with pytest.raises(ArgumentError, match="policies: expected options by name"):
        presets.load_preset("aeqa", own)


def test_the_order_of_pictures_is_the_presets(two_rooms: str) -> None:
    first, second = (make_policy(Script(command(landmark=1)), order=order) for order in ("marked_first", "plain_first"))
    for policy in (first, second):
        decide(two_rooms, policy)
    (one,), (other,) = first.client.calls, second.client.calls
    for shown, again in zip(images(one), reversed(images(other)), strict=True):
        np.testing.assert_array_equal(shown, again)
    text = words(other)
    assert text.index("without marks:") < text.index("Real views, marked:")


def test_runs_are_recorded_verified_and_replayed(two_rooms: str, tmp_path: Path) -> None:
    script = Script(*THREE, command(landmark=1, answer="red"), revision=without_answer(THREE[0]))
    options: dict[str, Any] = {"dialect": "vllm", "perception": f"{TESTS}/question_file.py:ByColor"}
    how: Any = {"progress": False, "episode_file": str(a_file(tmp_path, two_rooms))}
    with VlmServer(MockClient(script, model="scripted")) as server:
        recipe = AgentRecipe("vlm", "copy", policy_options={"vlm": {"vlm": server.url, "cache": "off", **options}})
        log = wiw.evaluate("aeqa", recipe, 1, seed=0, out=tmp_path / "run", **how)
    (episode,) = log.episodes
    assert episode["status"] == "done" and episode["metrics"]["success"] == 1, episode["error"]
    rows = list(log.store.decisions("copy"))
    assert all(each["model"] == "scripted" for row in rows for each in row["exchanges"]) and len(rows) == 3
    checked = wiw.verify(tmp_path / "run", episodes=1)
    assert checked.same, str(checked)
    again = AgentRecipe("vlm", "copy", policy_options={"vlm": {"vlm": f"replay:{tmp_path / 'run'}", **options}})
    (replayed,) = wiw.evaluate("aeqa", again, 1, seed=0, out=tmp_path / "again", **how).episodes
    assert replayed["metrics"] == episode["metrics"]


def test_a_server_that_is_down_is_infrastructure(two_rooms: str, tmp_path: Path) -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=Misbehaviour({"500": 1.0})) as server:
        policy = make_vlm(task="aeqa", vlm=server.url, model="m", cache="off", attempts=1, perception=ByColor())
        log = wiw.evaluate(
            "aeqa", wiw.Agent(policy), 1, seed=0, out=tmp_path / "run", progress=False,
            episode_file=a_file(tmp_path, two_rooms),
        )  # fmt: skip
        (episode,) = log.episodes
        assert episode["status"] == "error" and episode["kind"] == "vlm/status"


def test_the_command_line_against_the_tiny_random_model(two_rooms: str, tmp_path: Path) -> None:
    pytest.importorskip("transformers")
    from wiw.cli import main
    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    with VlmServer(TransformersClient(make_tiny(tmp_path / "tiny"), device="cpu")) as server:
        assert main(
            ["run", "aeqa", "--policy", "vlm", "--vlm", server.url, "--episodes", "1", "--no-report",
             "--episode-file", str(a_file(tmp_path, two_rooms)), "--task-option", "actions=3", "--candidates", "2",
             "--world-model", "copy", "--out", str(tmp_path / "run")]
        ) == 0  # fmt: skip
    rows = list(wiw.load_run(tmp_path / "run").store.decisions("copy"))
    assert rows and all(each["model"] == "tiny" for row in rows for each in row["exchanges"])
