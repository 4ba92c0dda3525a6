# SPDX-License-Identifier: Apache-2.0
"""Policy vlm before a table: the numbered view, plans in whole numbers, examples that work, and answers that do not."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import agent_for

pytest.importorskip("pydantic")
pytest.importorskip("openai")
pytest.importorskip("json_repair")

import wiw
from misbehaviour import MisbehavingVlmServer, Misbehaviour
from wiw.errors import ArgumentError, PromptError
from wiw.policies.vlm.arm import plans, prompt_images
from wiw.policies.vlm.arm.plans import GRID
from wiw.policies.vlm.arm.policy import ArmVLM
from wiw.policies.vlm.policy import VLM
from wiw.policies.vlm.prompts.templates import ARM_SLOTS, Prompts
from wiw.runs.recipes import AgentRecipe
from wiw.studies.evaluate import evaluate
from wiw.tabletop.workbench import CAMERAS, TABLE
from wiw.tasks.manipulation import TABLETOP_TASKS, Manipulation
from wiw.types import Goal, Key, Proposal
from wiw.vlm.messages import Call
from wiw.vlm.mock import MockClient

ABOVE, BELOW = [50, 50, 30, 0, 60, 60, 1], [50, 50, 25, 0, 60, 60, 0]


def answer(*actions: list[int], words: str = "Go there.") -> dict[str, Any]:
    return {
        "visual_state_description": "three buttons",
        "reasoning_and_reflection": "the first is above",
        "language_plan": words,
        "executable_plan": [{"action": action} for action in actions],
    }


def write_answer(*actions: list[int], **options: Any) -> str:
    return json.dumps(answer(*actions, **options))


def images(call: Call) -> list[Any]:
    return [part for message in call.messages for part in message.content if not isinstance(part, str)]


def words(call: Call) -> str:
    return "\n".join(part for message in call.messages for part in message.content if isinstance(part, str))


def decide_at_table(policy: Any, model: Any = None, kind: str = "push_buttons", **options: Any) -> Any:
    env = Manipulation(kind, seed=1).environment()
    env.reset(options={"episode": 1})
    agent = agent_for(env.task, wiw.Agent(policy, model, **options), cache="off")
    return agent.decide(env.observation, env.goal, Key(0, 1))


class Reader(wiw.WorldModel):
    """Remembers the words it is handed."""

    accepts = wiw.accepts("text", "perspective", (64, 64), frames=9)

    def __init__(self) -> None:
        self.read: list[str] = []

    def rollout(self, observations: Any, controls: Any, seeds: Any) -> Any:
        self.read += [control.text for control in controls]
        return np.repeat(observations.image[:, None], 1 + len(controls[0].actions), axis=1)


def test_plans_are_asked_for_then_one_that_knows_the_futures() -> None:
    answers = iter(
        [
            write_answer(ABOVE),
            write_answer(BELOW, words="Down."),
            write_answer(ABOVE, BELOW),
            write_answer(ABOVE),
            write_answer(BELOW),
            write_answer(BELOW),
        ]
    )
    client, model = MockClient(lambda call: next(answers)), Reader()
    decision = decide_at_table(ArmVLM(client), model)
    *proposing, revising = client.calls
    assert len(proposing) == 5 and len({call.seed for call in proposing}) == 5
    assert {call.temperature for call in proposing} == {1.0} and revising.temperature == 0
    told = words(proposing[0])
    numbers = plans.encode_objects(decision.observation.places)
    assert f"Instruction: {decision.goal.text}" in told and "1 to 5 actions" in told and "{{" not in told
    assert all(f"object {index}: {place}" in told for index, place in numbers.items())
    assert "from 0 to 100" in told and "from 0 to 120; one unit is 3 degrees" in told and '"executable_plan"' in told
    assert [image.shape for image in images(proposing[0])] == [(480, 480, 3)]
    assert [plan.actions.shape for plan in decision.proposals] == [(1, 7), (1, 7), (2, 7)], "equal plans are one"
    np.testing.assert_array_equal(decision.proposals[2].actions, GRID.decode([ABOVE, BELOW]))
    now, *strips = images(revising)
    np.testing.assert_array_equal(now, images(proposing[0])[0])
    assert [strip.shape[1] // 384 for strip in strips] == [1, 1, 2] and all(len(strip) > 384 for strip in strips)
    assert f"Plan 3: Go there.\nActions: [{ABOVE}, {BELOW}]" in words(revising)
    assert decision.chosen == 1 and decision.scores.tolist() == [0.0, 1.0, 0.0] and decision.note == ""
    assert model.read == [plans.SCENE_WORDS + spoken for spoken in ("Go there.", "Down.", "Go there.")]
    assert [each.purpose for each in decision.exchanges] == [*(f"propose/{k}" for k in range(5)), "revise"]


def test_without_a_world_model_one_plan_is_asked_for() -> None:
    client = MockClient(lambda call: write_answer(ABOVE, BELOW))
    decision = decide_at_table(ArmVLM(client))
    assert len(client.calls) == 1 and decision.chosen == 0 and decision.execute == 2


def test_a_plan_may_be_written_anew_or_chosen_and_plans_may_be_listed() -> None:
    both = json.dumps({"plans": [answer(ABOVE), answer(ABOVE, BELOW)]})
    client = MockClient(lambda call: both if "plans" in call.schema["properties"] else write_answer(ABOVE, ABOVE))
    decision = decide_at_table(ArmVLM(client, proposals="listed"), "copy")
    assert len(client.calls) == 2 and "Give 5 plans" in words(client.calls[0])
    assert client.calls[0].max_tokens == 5 * client.calls[1].max_tokens
    assert decision.chosen is None and decision.scores.tolist() == [0.5, 0.5]
    np.testing.assert_array_equal(decision.actions, GRID.decode([ABOVE, ABOVE]))
    client = MockClient(lambda call: {"B": 0.7, "A": 0.3} if call.labels else both)
    decision = decide_at_table(ArmVLM(client, proposals="listed", revision="select"), "copy")
    assert decision.chosen == 1 and "B. plan 2" in words(client.calls[-1])


class Glider(wiw.Policy):
    """Ten poses that are no whole numbers, to two places."""

    space = "pose7"

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        here = situations[0].observation.pose
        ends = [[0.2, y, 1.0, np.pi, 0, 0, 1] for y in (-0.123, 0.123)]
        return [[Proposal(wiw.action.resample([end], horizon, start=here)) for end in ends] for _ in situations]


def test_of_another_policys_plans_one_is_chosen_by_some_of_its_poses() -> None:
    client = MockClient(lambda call: {"B": 0.8, "A": 0.2})
    decision = decide_at_table(Glider(), "copy", reviser=ArmVLM(client), horizon=12, execute=12)
    (call,) = client.calls
    assert decision.chosen == 1 and call.labels == ("A", "B")
    assert [strip.shape[1] // 384 for strip in images(call)[1:]] == [5, 5]
    last = GRID.encode(decision.proposals[1].actions[-1]).tolist()
    assert words(call).count(str(last)) == 1
    assert words(call).count(": 5 of 12 actions: [[") == 2


def test_a_long_plan_that_may_be_written_again_is_told_whole() -> None:
    long = [[50, 50, height, 0, 60, 60, 1] for height in range(30, 23, -1)]
    both = json.dumps({"plans": [answer(*long), answer(ABOVE)]})
    client = MockClient(lambda call: both if "plans" in call.schema["properties"] else write_answer(*long))
    decision = decide_at_table(ArmVLM(client, proposals="listed"), "copy", horizon=7)
    assert f"Plan 1: Go there.\nActions: {long}" in words(client.calls[-1])
    assert [strip.shape[1] // 384 for strip in images(client.calls[-1])[1:]] == [5, 1]
    assert decision.chosen == 0


@pytest.mark.parametrize(("count", "places"), [(1, [0]), (4, [0, 1, 2, 3]), (50, [9, 19, 29, 39, 49]), (7, None)])
def test_the_end_of_a_plan_is_always_shown(count: int, places: Any) -> None:
    found = plans.select_shown(count)
    assert len(found) == min(count, 5) and found[-1] == count - 1 and (np.diff(found) > 0).all()
    assert places is None or found.tolist() == places


def test_numbers_out_of_range_are_understood_and_counted() -> None:
    odd = [100, -3, 250, 120, -60, 180, 2]
    decision = decide_at_table(ArmVLM(MockClient(lambda call: write_answer(ABOVE, odd))))
    np.testing.assert_array_equal(decision.actions[1], GRID.decode([99, 0, 99, 0, 60, 60, 1]))
    assert decision.exchanges[0].result["out_of_range"] == 5 and decision.note == ""


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (write_answer(ABOVE[:6]), "schema: executable_plan.0.action"),
        (write_answer([*ABOVE[:6], 10**30]), "schema: executable_plan.0.action.6"),
        (write_answer([0.5, *ABOVE[1:]]), "schema: executable_plan.0.action.0"),
        (write_answer(*[ABOVE] * 6), "schema: executable_plan"),
        (write_answer(), "schema: executable_plan"),
        (json.dumps({"executable_plan": [{"action": ABOVE}]}), "schema: visual_state_description"),
        ("I go to the left.", "malformed"),
        ("I'm sorry, no.", "refusal"),
    ],
)
def test_unusable_answers_are_asked_for_again_and_then_a_pose_is_drawn(text: str, problem: str) -> None:
    client = MockClient(lambda call: text)
    decision = decide_at_table(ArmVLM(client, tries=2))
    assert len(client.calls) == 2 and decision.exchanges[0].problem.startswith(problem)
    assert "a pose was drawn" in decision.note and decision.actions.shape == (1, 7)
    assert plans.is_on_grid(decision.actions) and "drawn" in decision.proposals[0].note
    some = iter(["junk", write_answer(ABOVE), text.replace("'", ""), *["junk"] * 3])
    decision = decide_at_table(ArmVLM(MockClient(lambda call: next(some)), tries=1), "copy", candidates=3)
    assert len(decision.proposals) == 1 and decision.chosen == 0
    assert "the plan was left out" in decision.note and "the first plan was taken" in decision.note


def test_harmless_variations_are_read() -> None:
    written = json.loads(write_answer(ABOVE)) | {"confidence": 0.8}
    del written["reasoning_and_reflection"]
    client = MockClient(lambda call: json.dumps(written))
    decision = decide_at_table(ArmVLM(client, tries=2))
    assert len(client.calls) == 1 and decision.exchanges[0].problem == "" and decision.exchanges[0].result["adapted"]


def test_slips_of_syntax_are_mended() -> None:
    slip = write_answer(ABOVE).replace('"language_plan"', "language_plan")
    decision = decide_at_table(ArmVLM(MockClient(lambda call: f"Here you are:\n{slip}")))
    np.testing.assert_array_equal(decision.actions, GRID.decode([ABOVE]))
    assert decision.exchanges[0].result["repaired"] is True


@pytest.mark.parametrize("size", [480, 448])
@pytest.mark.parametrize("kind", TABLETOP_TASKS)
def test_marks_are_on_their_objects_and_hide_little_of_them(kind: str, size: int) -> None:
    task = Manipulation(kind, seed=2)
    for index in range(4):
        table = task.set_table(task.episode(index))
        seen = table.bench.render_view("front", (size, size), ("color", "instance"))
        observation = wiw.types.ArmObservation(
            seen["color"], table.bench.pose, places=table.bench.get_poses(table.objects)
        )
        drawn = prompt_images.render_observation(observation)
        changed = (drawn != seen["color"]).any(-1)
        assert changed.mean() < 0.03
        spots = plans.index_objects(observation.places)
        points = CAMERAS["front"].project_points(np.array([*spots.values()]), (size, size))
        for name, (column, row) in zip(sorted(observation.places), np.floor(points).astype(int), strict=True):
            near = drawn[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).astype(int)
            assert (np.abs(near - (220, 40, 40)).max(-1) < 70).any(), f"{name} has no point"
            if name != "ring":
                there = _pixels_of(seen["instance"], row, column)
                assert there.sum() > 60 and changed[there].mean() < 0.35, f"{name} is hidden"


def _pixels_of(ids: Any, row: int, column: int) -> Any:
    """Of what is seen at a pixel, near it."""
    near = np.zeros(ids.shape, bool)
    near[row - 25 : row + 25, column - 25 : column + 25] = True
    return (ids == ids[row, column]) & near


def test_indices_follow_no_order_of_the_task_and_stay() -> None:
    places = {name: np.eye(4) + np.eye(4, k=3) * x for name, x in (("teal", 0.1), ("azure", 0.2), ("rose", 0.3))}
    assert [spot[0] for spot in plans.index_objects(places).values()] == [0.2, 0.3, 0.1]
    assert plans.encode_objects({"cup": np.eye(4)}) == {1: GRID.encode([0] * 7)[:3].tolist()}
    assert plans.SURFACE == 15 and GRID.decode([0, 0, plans.SURFACE, 0, 0, 0, 0])[2] == pytest.approx(TABLE + 0.005)


EXAMPLES = {"push_buttons": (12, 1), "slide_block": (11, 1), "insert_peg": (12, 0), "stack_cups": (12, 1)}
"""Seed and variation of the tables that the examples were taken from."""


@pytest.mark.parametrize("kind", TABLETOP_TASKS)
def test_examples_are_true_and_work(kind: str) -> None:
    seed, variation = EXAMPLES[kind]
    setup = TABLETOP_TASKS[kind].create_setup(seed, variation)
    text = Prompts().render("manipulation", "examples", **{**ARM_SLOTS, "instruction": setup.instruction})
    assert text.count("Example") == 1 and f"Instruction: {setup.instruction}\n" in text
    bench = setup.build_workbench()
    places = plans.encode_objects(bench.get_poses(setup.objects))
    assert re.findall(r"object (\d+): (\[.*\])", text) == [(str(index), str(place)) for index, place in places.items()]
    shown = plans.plan_schema(5).model_validate_json(text.split("Answer:\n")[1])
    (plan,) = plans.parse_plans(shown)
    sight = shown.visual_state_description
    for index, name in enumerate(sorted(setup.objects), 1):
        assert re.search(rf"object {index}\b[^,]* {name}|{name}, object {index}\b", sight), f"{name} is not named"
    for pose in plan.actions:
        bench.move_to(pose)
    if kind == "stack_cups":  # five actions stack one of two
        assert np.linalg.norm((bench.get_pose("navy") - bench.get_pose("gray"))[:2, 3]) < 0.015
    else:
        assert TABLETOP_TASKS[kind].is_success(bench, setup)


def test_each_instruction_has_the_example_of_its_sort() -> None:
    prompts, texts = Prompts(), set()

    def shown(**slots: Any) -> str:
        return prompts.render("manipulation", "examples", **{**ARM_SLOTS, **slots})

    for kind in TABLETOP_TASKS.values():
        setups = (kind.create_setup(seed, variation) for seed in range(3) for variation in range(kind.variations))
        found = {shown(instruction=setup.instruction) for setup in setups}
        assert len(found) == 1
        texts |= found
    assert len(texts) == len(TABLETOP_TASKS)
    assert shown(instruction="open the drawer").count("Example") == len(TABLETOP_TASKS)
    assert shown(look_ahead_action_num=2).count('"action"') == 2


def test_a_users_own_prompts_have_the_tasks_slots(tmp_path: Path) -> None:
    (tmp_path / "manipulation").mkdir()
    file = tmp_path / "manipulation/planner.j2"
    file.write_text("Up to {{ position_bins }}, {{ rotation_bins }}, {{ rotation_degrees }}!")
    client = MockClient(lambda call: write_answer(ABOVE))
    decide_at_table(ArmVLM(client, prompts=tmp_path))
    assert words(client.calls[0]).startswith("Up to 100, 120, 3!")
    file.write_text("{{ obs_key }}")
    with pytest.raises(PromptError, match="unknown slot 'obs_key'; the slots are look_ahead_action_num"):
        ArmVLM("mock", prompts=tmp_path)


def test_one_name_for_primitives_and_poses() -> None:
    mock = {"vlm": {"vlm": "mock"}}
    agent = wiw.Agent(wiw.policy("vlm", vlm="mock"), "oracle", reviser=VLM("mock"))
    assert type(agent.policy) is VLM and agent.policy.space == agent.model.accepts.space == "discrete"
    posing = agent_for(Manipulation(), AgentRecipe("vlm", "oracle", reviser="vlm", policy_options=mock))
    assert isinstance(posing.policy, ArmVLM) and isinstance(posing.reviser, ArmVLM)
    assert posing.model.accepts.space == "pose7" and posing.policy.needs == ()
    assert posing.replace(candidates=2).policy.space == "pose7"
    assert isinstance(wiw.policy("vlm", vlm="mock", space="pose7"), ArmVLM)
    assert posing.policy.describe()["policy"] == "ArmVLM" and "tracker" not in posing.policy.describe()
    for policy, name in (("heuristic", "Heuristic"), (agent.policy, "VLM")):
        with pytest.raises(
            ArgumentError, match=f"plans in poses of a gripper, but policy {name} makes plans of discrete primitives"
        ):
            agent_for(Manipulation(), wiw.Agent(policy))
    with pytest.raises(ArgumentError, match="among ar, imagenav, got 'manipulation'"):
        agent.policy.begin(Goal("manipulation"), Key(0, 0))
    with pytest.raises(ArgumentError, match="among manipulation, got 'ar'"):
        posing.policy.begin(Goal("ar"), Key(0, 0))


def test_runs_against_a_server_are_recorded_and_verified(tmp_path: Path) -> None:
    """With drawn answers, over HTTP with faults; what was said is enough to run it again."""
    faults = Misbehaviour({"429": 0.1, "malformed": 0.2, "refusal": 0.1, "truncated": 0.1}, seed=0, retry_after=0.01)
    with MisbehavingVlmServer(MockClient(), misbehaviour=faults) as server:
        options = {"vlm": server.url, "dialect": "vllm", "tries": 1, "cache": "off"}
        recipe = AgentRecipe("vlm", "copy", candidates=2, policy_options={"vlm": options})
        log = evaluate(
            "manipulation", recipe, 1, seed=0, out=tmp_path / "run", progress=False, tasks="slide_block", actions=6
        )
    assert not any(episode["error"] for episode in log.episodes), "".join(e["error"] for e in log.episodes)
    rows = list(log.store.decisions("copy"))
    exchanges = [each for row in rows for each in row["exchanges"]]
    problems = {each["problem"].partition(":")[0] for each in exchanges}
    assert "" in problems and len(problems) > 1, "some answers were usable and some were not"
    assert log.costs()[0]["spent_vlm_retries"] > 0
    assert all(episode["metrics"]["poses"] <= 6 for episode in log.episodes)
    checked = wiw.verify(tmp_path / "run", episodes=1)  # the server is gone
    assert checked.same, str(checked)


def test_a_server_that_is_too_slow_is_infrastructure(tmp_path: Path) -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=Misbehaviour({"slow": 1.0}, slow_seconds=0.5)) as server:
        policy = ArmVLM(server.url, model="mock", cache="off", attempts=1, timeout=0.1)
        log = evaluate(Manipulation(), wiw.Agent(policy), 1, seed=0, out=tmp_path / "run", progress=False)
        (episode,) = log.episodes
        assert episode["status"] == "error" and episode["kind"] == "vlm/timeout"


def test_the_tiny_random_model_writes_plans() -> None:
    pytest.importorskip("transformers")
    import tempfile

    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    with tempfile.TemporaryDirectory() as folder:
        client = TransformersClient(make_tiny(Path(folder) / "tiny"), device="cpu")
        decision = decide_at_table(ArmVLM(client, tries=1), horizon=1, execute=1)
    assert decision.note == "" and decision.actions.shape == (1, 7)
