# SPDX-License-Identifier: Apache-2.0
"""Policy vlm in the closed loop: what it shows and asks, what it makes of answers, and of those that are none."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import agent_for
from locations import ROOT

pytest.importorskip("pydantic")
pytest.importorskip("openai")
pytest.importorskip("json_repair")

import wiw
from misbehaviour import MisbehavingVlmServer, Misbehaviour
from recognition_file import CHOICES, a_file
from wiw.cli import main
from wiw.errors import ArgumentError, PromptError, VlmError
from wiw.loop.memory import Query
from wiw.policies.vlm import presets, prompt_images
from wiw.policies.vlm.policy import VLM
from wiw.policies.vlm.prompts.templates import FOLDER, SLOTS, Prompts
from wiw.runs.recipes import AgentRecipe
from wiw.serving.vlm_server import VlmServer
from wiw.studies.evaluate import evaluate
from wiw.types import Proposal, Rollout
from wiw.vlm.messages import Call
from wiw.vlm.mock import MockClient

FORWARD, LEFT, RIGHT = 1, 2, 3
WALK = json.dumps({"reason": "free floor ahead", "actions": ["forward", "forward", "turn_left"]})


def images(call: Call) -> list[Any]:
    return [part for message in call.messages for part in message.content if not isinstance(part, str)]


def words(call: Call) -> str:
    return "\n".join(part for message in call.messages for part in message.content if isinstance(part, str))


def letter_of(call: Call, option: str) -> str:
    return next(line[0] for line in words(call).splitlines() if line[1:] == f". {option}")


def script(call: Call) -> Any:
    """Takes the table for what it is, and always wants to go on."""
    if call.schema is not None:
        return WALK
    wanted = "table" if ". table" in words(call) else "go straight for 0.20 m"
    return {letter_of(call, wanted): 0.9, "?": 0.1}


def imagenav(scene: str) -> Any:
    return wiw.make("ImageNav-v0", scenes=scene, seed=0)


def decide_in(env: Any, policy: Any, model: Any = None, **options: Any) -> Any:
    _, info = env.reset(options={"episode": 0})
    agent = agent_for(env.unwrapped.task, wiw.Agent(policy, model, **options))
    return agent.decide(env.observation, env.goal, info["key"])


def test_navigation_asks_for_plans_then_for_one_that_knows_the_futures(two_rooms: str) -> None:
    client = MockClient(script)
    decision = decide_in(imagenav(two_rooms), VLM(client), "copy")
    *proposing, revising = client.calls
    assert len(proposing) == 3 and len({call.seed for call in proposing}) == 3
    assert {call.temperature for call in proposing} == {1.0} and revising.temperature == 0
    assert [image.shape for image in images(proposing[0])] == [(480, 480, 3), (576, 1024, 3), (480, 480, 3)]
    assert "next 5 action(s)" in words(proposing[0]) and "{{" not in words(proposing[0])
    goal, strip = images(revising)
    np.testing.assert_array_equal(goal, decision.goal.image)
    assert strip.shape[0] > prompt_images.VIEW and strip.shape[1] >= 3 * prompt_images.VIEW
    assert "Plan 1: ['forward', 'forward', 'turn_left']" in words(revising)
    assert [plan.actions.tolist() for plan in decision.proposals] == [[FORWARD, FORWARD, LEFT]], "equal plans are one"
    assert decision.chosen == 0 and decision.scores.tolist() == [1.0] and decision.note == ""
    assert [each.purpose for each in decision.exchanges] == ["propose/0", "propose/1", "propose/2", "revise"]
    assert decision.spent["vlm_calls"] == 4 and decision.spent["vlm_tokens"] > 1000


def test_imagined_frames_may_be_images_of_their_own_and_without_captions(two_rooms: str) -> None:
    shapes = {}
    for shown, captions in (("strip", True), ("strip", False), ("frames", True), ("frames", False)):
        client = MockClient(script)
        policy = VLM(client, tracker=None, shown=shown, captions=captions)
        decide_in(imagenav(two_rooms), policy, "copy", candidates=1)
        shapes[shown, captions] = [image.shape[:2] for image in images(client.calls[-1])[1:]]
        assert ("a row of frames" in words(client.calls[-1])) == (shown == "strip"), "the prompt says what is shown"
        assert ("in a bar at its top" in words(client.calls[-1])) == captions
    side, bar = prompt_images.VIEW, shapes["frames", True][0][0] - prompt_images.VIEW
    assert shapes["strip", False] == [(side, 3 * side)] and shapes["frames", False] == [(side, side)] * 3
    assert bar > 10 and shapes["frames", True] == [(side + bar, side)] * 3 and shapes["strip", True][0][0] > side
    assert VLM(MockClient()).describe().keys() & {"shown", "captions", "roles"} == set()
    assert policy.describe()["shown"] == "frames" and policy.describe()["captions"] is False
    with pytest.raises(ArgumentError, match="expected shown strip or frames"):
        VLM(MockClient(), shown="film")
    with pytest.raises(ArgumentError, match=r"only for tasks ar, imagenav, got .* captions=False"):
        wiw.policy("vlm", vlm="mock", space="pose7", captions=False)


def test_roles_may_have_models_of_their_own(two_rooms: str) -> None:
    base, reviser = MockClient(script, model="a"), MockClient(script, model="b")
    policy = VLM(base, model="a", tracker=None, roles={"revise": {"vlm": reviser, "model": "b"}})
    decision = decide_in(imagenav(two_rooms), policy, "copy")
    assert len(base.calls) == 3 and len(reviser.calls) == 1
    assert [exchange.model for exchange in decision.exchanges] == ["a", "a", "a", "b"]
    assert decision.spent["vlm_calls"] == 4 and policy.describe()["roles"]["revise"]["model"] == "b"
    for roles, model in (({"revise": {"model": "b"}}, None), ({"judge": {"model": "b"}}, "a"), ({"revise": {}}, "a")):
        with pytest.raises(ArgumentError, match="expected roles among propose, revise, answer"):
            VLM(MockClient(), model=model, roles=roles)


def test_the_main_servers_key_is_not_sent_to_a_roles_own(two_rooms: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    kept = {"model": "mock", "key": "main", "cache": "off", "attempts": 1, "tracker": None}

    def decide_with(url: str, role: dict[str, Any]) -> Any:
        policy = VLM(url, roles={"revise": {"model": "mock", **role}}, **kept)
        return decide_in(imagenav(two_rooms), policy, "copy", candidates=1)

    def serve(token: str) -> VlmServer:
        return VlmServer(MockClient(script), token=token)

    with serve("main") as main, serve("own") as other:
        assert decide_with(main.url, {}).chosen == 0, "the same server, the same key"
        assert decide_with(main.url, {"vlm": main.url}).chosen == 0
        assert decide_with(main.url, {"vlm": other.url, "key": "own"}).chosen == 0
    with serve("main") as main, serve("main") as other, pytest.raises(VlmError, match="401"):
        decide_with(main.url, {"vlm": other.url})
    with pytest.raises(ArgumentError, match="optionally its own vlm and key") as error:
        VLM("mock", roles={"revise": {"key": "canary"}})
    assert "canary" not in str(error.value)


def test_options_of_the_main_server_do_not_override_the_preset_of_another() -> None:
    preset, main, other = presets.list_names()[0], "http://localhost:1/v1", "http://localhost:2/v1"

    def connect_role(**role: Any) -> Any:
        given = {"dialect": "legacy", "top_logprobs": 5, "timeout": 7.0}
        return VLM(main, model="a", cache="off", roles={"revise": role}, **given).roles["revise"]

    apart, same = connect_role(vlm=other, model=preset), connect_role(model=preset)
    assert (apart.base_url, apart.dialect, apart.top_logprobs, apart.concurrency) == (other, "vllm", 20, 16)
    assert (same.base_url, same.dialect, same.top_logprobs, same.concurrency) == (main, "legacy", 5, 16)
    assert apart.timeout == same.timeout == 7.0, "no preset says how long to wait"
    assert connect_role(vlm=other, model="b").dialect == "legacy"


def test_recipes_leave_out_the_keys_of_roles() -> None:
    roles = {"revise": {"vlm": "http://b/v1", "model": "b", "key": "canary"}, "answer": {"model": "c"}}
    options = {"vlm": "http://a/v1", "model": "a", "key": "canary", "roles": roles}
    recipe = AgentRecipe("vlm", policy_options={"vlm": options})
    assert "canary" not in str(recipe.to_json()) and "canary" not in str(recipe.describe())
    told = recipe.without_secrets().policy_options["vlm"]["roles"]
    assert told == {"revise": {"vlm": "http://b/v1", "model": "b"}, "answer": {"model": "c"}}
    assert recipe.policy_options["vlm"]["roles"]["revise"]["key"] == "canary", "the agent itself keeps it"
    wrong = AgentRecipe("vlm", policy_options={"vlm": {"model": "a", "roles": {"revise": "b"}}})
    assert wrong.without_secrets() == wrong, "refused by the policy, which says why"


def test_without_a_world_model_one_plan_is_asked_for(two_rooms: str) -> None:
    client = MockClient(script)
    decision = decide_in(imagenav(two_rooms), VLM(client))
    assert len(client.calls) == 1 and decision.actions.tolist() == [FORWARD, FORWARD, LEFT] and decision.chosen == 0


def test_answers_do_not_depend_on_who_else_is_asked_for(two_rooms: str) -> None:
    env = imagenav(two_rooms)
    queries = []
    for episode in range(2):
        _, info = env.reset(options={"episode": episode})
        queries.append(Query(env.unwrapped.observation, env.unwrapped.goal, info["key"]))
    together = wiw.Agent(VLM(MockClient()), "copy").decide_batch(queries)
    alone = [wiw.Agent(VLM(MockClient()), "copy").decide_batch([query])[0] for query in queries]
    for one, other in zip(together, alone, strict=True):
        assert one.exchanges == other.exchanges
        np.testing.assert_array_equal(one.actions, other.actions)


def test_a_plan_may_be_written_anew_or_chosen(two_rooms: str) -> None:
    plans = iter([["forward"], ["turn_left", "forward"], ["turn_right"], ["turn_left", "turn_left"]])
    client = MockClient(lambda call: json.dumps({"reason": "r", "actions": next(plans)}))
    decision = decide_in(imagenav(two_rooms), VLM(client), "copy")
    assert decision.actions.tolist() == [LEFT, LEFT] and decision.chosen is None
    assert decision.scores.tolist() == [0.0, 0.5, 0.0]
    plans = iter([["forward"], ["turn_left", "forward"], ["turn_right"]])
    chooser = MockClient(
        lambda call: (
            {"B": 0.6, "A": 0.3, "C": 0.1} if call.labels else json.dumps({"reason": "r", "actions": next(plans)})
        )
    )
    decision = decide_in(imagenav(two_rooms), VLM(chooser, revision="select"), "copy")
    assert decision.actions.tolist() == [LEFT, FORWARD] and decision.chosen == 1
    np.testing.assert_allclose(decision.scores, [0.3, 0.6, 0.1])
    assert "B. plan 2: turn_left, forward" in words(chooser.calls[-1])


class OneStep(wiw.Policy):
    """Proposes one step forward."""

    def propose(self, situations: Any, candidates: int, horizon: int) -> Any:
        return [[Proposal(np.array([FORWARD], np.int8))] for _ in situations]


def test_a_reviser_may_write_longer_plans_than_are_proposed(two_rooms: str) -> None:
    client = MockClient(script)
    decision = decide_in(imagenav(two_rooms), OneStep(), "copy", reviser=VLM(client), horizon=4)
    assert "next 4 action(s)" in words(client.calls[-1])
    assert decision.actions.tolist() == [FORWARD, FORWARD, LEFT] and decision.chosen is None


def test_plans_may_be_listed_in_one_answer(two_rooms: str) -> None:
    answer = json.dumps({"plans": [{"reason": "r", "actions": [name]} for name in ("forward", "turn_left", "forward")]})
    client = MockClient(lambda call: answer if "plans" in call.schema["properties"] else WALK)
    decision = decide_in(imagenav(two_rooms), VLM(client, proposals="listed"), "copy")
    assert len(client.calls) == 2 and "Give 3 plans" in words(client.calls[0])
    assert [plan.actions.tolist() for plan in decision.proposals] == [[FORWARD], [LEFT]]


@pytest.fixture
def recognition(tmp_path: Path, two_rooms: str) -> Iterator[Any]:
    yield wiw.make("AR-v0", episode_file=a_file(tmp_path, two_rooms, yaw=np.pi / 2))


def redness(image: Any) -> int:
    """Pixels in the colour of boxes."""
    return int((np.abs(image.astype(int) - (220, 40, 40)).max(-1) < 8).sum())


def test_recognition_asks_for_category_and_primitive(recognition: Any) -> None:
    client = MockClient(script)
    decision = decide_in(recognition, VLM(client), "warp")
    proposing, (moving, answering) = client.calls[:-2], client.calls[-2:]
    assert [each.purpose for each in decision.exchanges] == ["propose/0", "propose/1", "move", "answer"]
    assert len(proposing) == 2 and "next 4 action(s)" in words(proposing[0])
    assert "next 1 action(s)" in words(moving) and "Plan 1:" in words(moving)
    assert [image.shape[:2] for image in images(moving)[:2]] == [(480, 480), (576, 1024)] and len(images(moving)) == 3
    shapes = [image.shape[:2] for image in images(answering)]
    assert shapes[:2] == [(480, 480), (576, 1024)] and len(shapes) == 3 and shapes[2][1] > prompt_images.VIEW
    for image in (*images(moving), *images(answering), *images(proposing[0])):
        assert redness(image) > 20, "the target is not boxed"
    assert "turn left" not in words(answering) and moving.labels == ("A", "B", "C")
    assert decision.answer.label == "table" and decision.answer.probabilities.max() == pytest.approx(1.0)
    assert decision.answer.confidence == pytest.approx(0.9), "as the model gave it"
    assert decision.chosen == 0 and decision.actions[0] == FORWARD and decision.execute == 1


def test_views_of_perspective_models_are_not_said_to_be_centred_on_the_target(recognition: Any) -> None:
    def rollout(observations: Any, controls: Any, seeds: Any) -> Any:
        return np.repeat(observations.image[:, None], len(controls[0].actions) + 1, axis=1)

    for view, centred in (("panorama", True), ("perspective", False)):
        client = MockClient(script)
        model = wiw.world_model(rollout, accepts=wiw.accepts("trajectory", view))
        decide_in(recognition, VLM(client), model)
        answering = words(client.calls[-1])
        assert ("centred on the same thing" in answering) == centred and "Imagined views 1" in answering
        assert ("row of front views" in answering) == (not centred)


@pytest.mark.parametrize("side", [384, 512])
def test_both_questions_of_recognition_show_the_front_view_in_the_asked_size(recognition: Any, side: int) -> None:
    client = MockClient(script)
    decide_in(recognition, VLM(client, view_size=side))
    assert [[image.shape[:2] for image in images(call)] for call in client.calls] == [[(side, side), (576, 1024)]] * 2


def test_recognition_without_a_world_model_is_two_questions(recognition: Any) -> None:
    client = MockClient(
        lambda call: {letter_of(call, "turn right by 22.5 degrees"): 1.0} if len(call.labels) == 3 else script(call)
    )
    decision = decide_in(recognition, VLM(client))
    assert [each.purpose for each in decision.exchanges] == ["move", "answer"]
    assert decision.actions.tolist() == [RIGHT] and decision.chosen == 0
    assert [len(images(call)) for call in client.calls] == [2, 2]


def test_the_box_stays_on_the_thing_in_frames_that_ignore_the_plan(recognition: Any) -> None:
    """With `copy` nothing moves though the plan walks: boxes of the strip agree by default, not by reprojection."""
    spans = {}
    for tracker in ("flow", "reprojection"):
        client = MockClient(script)
        decide_in(recognition, VLM(client, tracker=tracker), "copy")
        strip = images(client.calls[-2])[2][-prompt_images.VIEW :]
        frames = [strip[:, k * (prompt_images.VIEW + 4) :][:, : prompt_images.VIEW] for k in range(3)]
        spans[tracker] = [np.flatnonzero((np.abs(f.astype(int) - (220, 40, 40)).max(-1) < 8).any(0)) for f in frames]
    looked, told = ([(own[0], own[-1]) for own in spans[tracker]] for tracker in ("flow", "reprojection"))
    assert np.ptp(looked, axis=0).max() <= 2
    assert np.ptp(told, axis=0).max() > 50


def test_the_category_may_be_asked_from_one_view_centred_on_the_target(recognition: Any) -> None:
    client = MockClient(script)
    decide_in(recognition, VLM(client, answer_view="target"))
    (view,) = images(client.calls[-1])
    assert view.shape[:2] == (prompt_images.VIEW, prompt_images.VIEW) and redness(view) > 20
    assert "centred on one thing" in words(client.calls[-1]) and "panorama" not in words(client.calls[-1])


def test_confidence_that_ends_an_episode_is_the_models_own(tmp_path: Path, two_rooms: str) -> None:
    """0.9 of all probability, though 0.99 of that on letters: below 0.95, so that the episode goes on."""
    ended = {}
    for mass in (0.9, 1.0):

        def answer(call: Call, mass: float = mass) -> Any:
            return (
                {letter_of(call, "table"): 0.99 * mass, letter_of(call, "chest"): 0.01 * mass, "I": 1 - mass}
                if (". table" in words(call))
                else script(call)
            )

        policy = VLM(MockClient(answer))
        log = evaluate("ar", wiw.Agent(policy), 1, seed=0, out=tmp_path / f"{mass}", progress=False,
                       episode_file=str(a_file(tmp_path, two_rooms)))  # fmt: skip
        rows = list(log.store.decisions("none"))
        ended[mass] = len(rows)
        (episode,) = log.episodes
        assert episode["metrics"]["confidence"] == pytest.approx(0.99 * mass)
        assert rows[0]["answer"]["raw"]["table"] == pytest.approx(0.99 * mass)
        assert rows[0]["answer"]["probabilities"]["table"] == pytest.approx(0.99)
    assert ended[1.0] == 1 and ended[0.9] == 10


def test_all_categories_are_one_question_or_rounds(tmp_path: Path, two_rooms: str) -> None:
    goal = wiw.types.Goal("ar", choices=tuple(f"thing {k}" for k in range(27)))
    env = wiw.make("AR-v0", episode_file=a_file(tmp_path, two_rooms))
    _, info = env.reset(options={"episode": 0})
    for rounds, asked in ((False, [27]), (True, [14, 13, 20])):
        client = MockClient()
        wiw.Agent(VLM(client, rounds=rounds), execute=1).decide(env.unwrapped.observation, goal, info["key"])
        assert [len(call.labels) for call in client.calls if len(call.labels) > 3] == asked


def test_a_summary_says_how_many_answers_could_not_be_used(two_rooms: str, tmp_path: Path) -> None:
    def run(name: str, *answers: str) -> Any:
        said = iter(answers)
        policy = VLM(MockClient(lambda call: next(said)), tries=1)
        task = wiw.make("ImageNav-v0", scenes=two_rooms, decisions=2)
        return evaluate(task, wiw.Agent(policy), 1, out=tmp_path / name, progress=False).numbers()

    half = run("half", WALK, "I'm sorry, no.")
    assert half.answers == {"none": {"": 1, "refusal": 1}}
    assert "none: 1 of 2 answers of its language model (50 %) could not be used (refusal 1)." in str(half.remarks())
    assert not run("whole", WALK, WALK).remarks()


def test_a_summary_says_how_many_choices_are_doubtful(two_rooms: str, tmp_path: Path) -> None:
    shares = iter([0.2, 0.9])

    def answer(call: Call) -> Any:
        return {call.labels[0]: next(shares, 0.9)} if len(call.labels) == len(CHOICES) else script(call)

    policy = VLM(MockClient(answer))
    task = wiw.make("AR-v0", episode_file=a_file(tmp_path, two_rooms), decisions=2)
    found = evaluate(task, wiw.Agent(policy, execute=1), 1, out=tmp_path / "run", progress=False).numbers()
    doubtful, count = found.choices["none"]
    assert doubtful == 1 and count >= 2
    assert f"none: in 1 of {count} choices of its language model" in str(found.remarks())


def test_a_primitive_that_no_plan_begins_with_is_a_plan_of_its_own(recognition: Any) -> None:
    client = MockClient(
        lambda call: {letter_of(call, "turn right by 22.5 degrees"): 1.0} if len(call.labels) == 3 else script(call)
    )
    decision = decide_in(recognition, VLM(client), "copy")
    assert decision.actions.tolist() == [RIGHT] and decision.chosen is None and decision.scores[0] < 0.5


def test_a_target_out_of_sight_is_not_asked_about(tmp_path: Path, two_rooms: str) -> None:
    file = a_file(tmp_path, two_rooms, start=(2.0, 0.0, 0.0), target="picture")
    env = wiw.make("AR-v0", episode_file=file)
    env.reset(options={"episode": 0})
    assert not env.unwrapped.observation.target.mask.any(), "the test needs a hidden target"
    client = MockClient(lambda call: {letter_of(call, "go straight for 0.20 m"): 1.0})
    decision = decide_in(env, VLM(client))
    assert len(client.calls) == 1 and "nothing was asked, no choice was preferred" in decision.note
    assert decision.answer.confidence == pytest.approx(0.25, abs=1e-6)


def test_unusable_answers_are_recorded_and_no_choice_is_preferred(recognition: Any, two_rooms: str) -> None:
    decision = decide_in(recognition, VLM(MockClient(lambda call: "I'm sorry, no."), tries=2), "copy")
    problems = {each.purpose: each for each in decision.exchanges}
    assert problems["propose/0"].problem.startswith("refusal") and problems["answer"].problem.startswith("no_option")
    assert problems["answer"].instead == "no choice was preferred" and len(problems["propose/0"].said) == 2
    for said in ("propose/0: refusal", "a primitive was drawn", "move: no_option", "the first plan was taken"):
        assert said in decision.note
    np.testing.assert_allclose(decision.answer.probabilities, 0.25, atol=1e-6)
    assert len(decision.proposals) == 1 and "drawn" in decision.proposals[0].note
    labels = set()
    for seed in range(6):
        _, info = recognition.reset(options={"episode": 0})
        key = wiw.types.Key(seed, info["key"].episode)
        agent = wiw.Agent(VLM(MockClient(lambda call: "?")), None, execute=1, horizon=4)
        labels.add(agent.decide(recognition.unwrapped.observation, recognition.unwrapped.goal, key).answer.label)
    assert len(labels) > 1, "one choice is always first"
    some = iter(["junk", WALK, WALK, "junk"])
    decision = decide_in(imagenav(two_rooms), VLM(MockClient(lambda call: next(some)), tries=1), "copy")
    assert len(decision.proposals) == 1 and decision.chosen == 0
    assert "propose/0: malformed" in decision.note and "the plan was left out" in decision.note
    assert "revise: malformed" in decision.note and "the first plan was taken" in decision.note


def test_strips_name_actions_and_show_where_the_target_is() -> None:
    from wiw.perception.tracking import Track
    from wiw.types import Proposal

    frames = np.full((2, 576, 1024, 3), 90, np.uint8)
    masks = np.zeros((2, 576, 1024), bool)
    masks[0, 250:300, 500:540] = True
    rollout = Rollout(frames, np.zeros(2, bool), "panorama")

    def draw_plan(*track: Track) -> Any:
        frames, titles = prompt_images.render_plan_frames(Proposal([FORWARD, LEFT]), rollout, *track)
        return prompt_images.arrange_frames(frames, titles, strip=True)[0]

    strip = draw_plan(Track(masks, ((500, 250, 540, 300), None)))
    half = strip.shape[1] // 2
    assert redness(strip[:, :half]) > 50 and redness(strip[:, half:]) == 0
    lost = draw_plan()
    bar = strip.shape[0] - prompt_images.VIEW
    assert not np.array_equal(strip[:bar, half:], lost[:bar, half:]), "a bar says that the target is lost"
    np.testing.assert_array_equal(strip[:bar, : half - 4], lost[:bar, : half - 4])
    assert bar > 10 and not np.array_equal(strip[:bar, : prompt_images.VIEW], strip[:bar, -prompt_images.VIEW :])
    views, titles = prompt_images.render_target_frames(rollout, Track(masks, ((500, 250, 540, 300), None)))
    assert views.shape[:3] == (1, prompt_images.VIEW, prompt_images.VIEW) and redness(views[0]) > 50
    assert titles == ["Imagined view 1"]
    real = Rollout(frames, np.ones(2, bool), "panorama")
    assert not len(prompt_images.render_target_frames(real, Track(masks, (None, None)))[0])
    front = Rollout(frames[:, :384, :384], np.zeros(2, bool), "front")
    boxed, _ = prompt_images.render_target_frames(front, Track(masks[:, :384, :384], ((9, 9, 50, 50), None)))
    assert redness(boxed[0]) > 50
    bare = prompt_images.arrange_frames(views, None, strip=False)
    assert len(bare) == 1 and np.array_equal(bare[0], views[0])  # no caption, no bar


def test_shipped_prompts_have_the_papers_slots() -> None:
    for task, name, slots in (
        ("ar", "planner", ("obs_key", "look_ahead_action_num")),
        ("imagenav", "planner", ("obs_key", "look_ahead_action_num")),
        ("imagenav", "planner_imagined", ("look_ahead_action_num",)),
    ):
        source = (FOLDER / task / f"{name}.j2").read_text()
        assert all(f"{{{{ {slot} }}}}" in source for slot in slots)
    text = Prompts().render("ar", "planner", **{**SLOTS, "look_ahead_action_num": 7, "obs_key": "a painting"})
    assert "next 7 action(s)" in text and "a painting" in text


def test_a_users_own_prompts_are_checked(tmp_path: Path, two_rooms: str) -> None:
    (tmp_path / "imagenav").mkdir()
    file = tmp_path / "imagenav/planner.j2"
    file.write_text("Walk {{ look_ahead_action_num }} steps!")
    own, shipped = Prompts(tmp_path), Prompts()
    assert own.render("imagenav", "planner", **SLOTS) == "Walk 5 steps!" and own.digest != shipped.digest
    assert own.render("ar", "answerer", **SLOTS) == shipped.render("ar", "answerer", **SLOTS)
    client = MockClient(script)
    decide_in(imagenav(two_rooms), VLM(client, prompts=tmp_path))
    assert words(client.calls[0]).startswith("Walk 5 steps!")
    file.write_text("{% if look_ahead_action_num > 1 %}{% set many = 's' %}{% endif %}Walk step{{ many }}!")
    assert Prompts(tmp_path).render("imagenav", "planner", **SLOTS) == "Walk steps!"
    for source, said in (
        ("{{ goal_colour }}", "unknown slot 'goal_colour'; the slots are obs_key"),
        ("{{ actions.fly.high }}", "UndefinedError"),
        ("{% if look_ahead_action_num > 9 %}{% set many = 's' %}{% endif %}{{ many }}", "UndefinedError"),
        ("{% if %}", "TemplateSyntaxError"),
        ("{{ look_ahead_action_num / 0 }}", "ZeroDivisionError"),
        ("{{ obs_key.__class__.__mro__ }}", "SecurityError"),
    ):
        file.write_text(source)
        with pytest.raises(PromptError, match=r"imagenav/planner\.j2") as error:
            VLM("mock", prompts=tmp_path)
        assert said in str(error.value)
    file.rename(tmp_path / "imagenav/plan.j2")
    with pytest.raises(PromptError, match="no prompt has this name"):
        Prompts(tmp_path)
    with pytest.raises(PromptError, match="found none"):
        Prompts(tmp_path / "nowhere")


def test_options_out_of_range_and_tasks_without_prompts() -> None:
    for wrong in (
        {"proposals": "many"},
        {"revision": "guess"},
        {"temperature": -1.0},
        {"tries": 0},
        {"colour": 1},
        {"answer_view": "x"},
    ):
        with pytest.raises(ArgumentError):
            VLM("mock", **wrong)
    with pytest.raises(ArgumentError, match="ar, imagenav"):
        VLM("mock").begin(wiw.types.Goal("dance"), wiw.types.Key(0, 0))


def test_presets_name_a_model_and_how_it_is_served() -> None:
    docs = (ROOT / "docs/vlm.md").read_text()
    for name in presets.list_names():
        options = presets.get_client_options(name)
        assert options["model"] in presets.get_serve_command(name) and options["dialect"] == "vllm"
        assert " ".join(presets.get_serve_command(name).split()) in " ".join(docs.replace("\\\n", " ").split()), name
        assert VLM("http://localhost:1/v1", model=name).client.model == options["model"]
    assert presets.list_names() == ["internvl3-78b-awq", "qwen2.5-vl-72b-awq"]


def test_runs_against_a_server_are_recorded_and_verified(tmp_path: Path, two_rooms: str) -> None:
    """Both tasks, with the scripted model, over HTTP with faults; what was said is enough to run them again."""
    faults = Misbehaviour({"429": 0.1, "500": 0.05, "malformed": 0.05, "refusal": 0.05}, seed=1, retry_after=0.01)
    with MisbehavingVlmServer(MockClient(script, model="scripted"), misbehaviour=faults) as server:
        file = a_file(tmp_path, two_rooms)
        preset = tmp_path / "short.yaml"
        preset.write_text("decisions: 4\n")
        for task, options in (("ar", {"episode_file": str(file)}), ("imagenav", {"scenes": two_rooms})):
            recipe = AgentRecipe(
                "vlm", "copy", policy_options={"vlm": {"vlm": server.url, "dialect": "vllm", "tries": 2}}
            )
            log = evaluate(task, recipe, 1, seed=0, out=tmp_path / task, progress=False, preset=str(preset), **options)
            (episode,) = log.episodes
            assert episode["status"] == "done"
            rows = list(log.store.decisions("copy"))
            assert all(each["model"] == "scripted" for row in rows for each in row["exchanges"])
            assert log.costs()[0]["spent_vlm_input_tokens"] > 0
            if task == "ar":
                assert episode["metrics"]["success"] == 1.0
    for task in ("ar", "imagenav"):  # the server is gone
        checked = wiw.verify(tmp_path / task, episodes=1)
        assert checked.same, str(checked)


def test_recipes_that_name_no_server_are_replayed_too() -> None:
    assert AgentRecipe("vlm").replaying(Path("r")).policy_options == {"vlm": {"vlm": "replay:r", "cache": "off"}}
    recipe = AgentRecipe("heuristic", reviser="vlm", policy_options={"vlm": {"vlm": "http://x", "tries": 2}})
    assert recipe.replaying(Path("r")).policy_options["vlm"] == {"vlm": "replay:r", "cache": "off", "tries": 2}
    assert recipe.describe()["policy_options"] == {"vlm": {"tries": 2}}, "the address is no part of the identity"
    assert AgentRecipe("matcher").replaying(Path("r")) == AgentRecipe("matcher")


def test_a_server_that_is_down_is_infrastructure(tmp_path: Path, two_rooms: str) -> None:
    with MisbehavingVlmServer(MockClient(), misbehaviour=Misbehaviour({"500": 1.0})) as server:
        policy = VLM(server.url, model="mock", cache="off", attempts=1)
        log = evaluate("imagenav", wiw.Agent(policy), 1, seed=0, out=tmp_path / "run", progress=False, scenes=two_rooms)
        (episode,) = log.episodes
        assert episode["status"] == "error" and episode["kind"] == "vlm/status"


def test_the_command_line_against_the_tiny_random_model(
    tmp_path: Path, two_rooms: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("transformers")
    from wiw.vlm.tiny import make_tiny
    from wiw.vlm.transformers import TransformersClient

    with VlmServer(TransformersClient(make_tiny(tmp_path / "tiny"), device="cpu")) as server:
        common = ["--policy", "vlm", "--vlm", server.url, "--episodes", "1", "--no-report"]
        preset = tmp_path / "short.yaml"
        preset.write_text("decisions: 2\ncandidates: 2\nhorizon: 2\n")
        file = a_file(tmp_path, two_rooms)
        assert (
            main(
                [
                    "run",
                    "ar",
                    *common,
                    "--episode-file",
                    str(file),
                    "--preset",
                    str(preset),
                    "--out",
                    str(tmp_path / "ar"),
                ]
            )
            == 0
        )
        preset.write_text("decisions: 2\ncandidates: 2\nhorizon: 2\nexecute: 1\n")
        assert main(
            ["run", "imagenav", *common, "--scenes", two_rooms, "--preset", str(preset), "--world-model", "copy",
             "--out", str(tmp_path / "nav")]
        ) == 0  # fmt: skip
    for name in ("ar", "nav"):
        rows = [
            row
            for arm in wiw.load_run(tmp_path / name).arms
            for row in wiw.load_run(tmp_path / name).store.decisions(arm)
        ]
        assert rows and all(each["model"] == "tiny" for row in rows for each in row["exchanges"])
    assert main(["run", "imagenav", "--vlm", "mock"]) == 2 and "give --policy vlm" in capsys.readouterr().err
