# SPDX-License-Identifier: Apache-2.0
"""Active Embodied Question Answering: the protocol, its presets and metrics, and what never reaches a policy."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from run_facts import list_facts

import wiw
from wiw.action import FORWARD, STOP, TURN_LEFT
from wiw.datasets.episodes import save
from wiw.datasets.questions import Question, balance
from wiw.datasets.questions.answers import Fact
from wiw.datasets.questions.generate import Answerable
from wiw.datasets.worlds import world
from wiw.envs.episode_state import wrap_episode
from wiw.errors import ArgumentError, ContractError, FileError, JudgeError
from wiw.judging import Judge, Judgement
from wiw.loop.scheduler import run_episodes
from wiw.policies.base import Policy
from wiw.policies.explorer.policy import Explorer
from wiw.runs.recipes import AgentRecipe, TaskRecipe
from wiw.studies.run_log import load_run
from wiw.tasks.aeqa import AEQA
from wiw.tasks.answer_record import read_judgements
from wiw.types import Answer, Episode, EpisodeResult, Goal, Proposal, TextAnswer

SCENE = "apartments:val/1"
QUESTION = Question(
    "What color is the sofa?", "blue", "attribute recognition", "color", template="color", slots={"object": "sofa"}
)


@pytest.fixture(scope="module")
def episode() -> Episode:
    """A question in an apartment, asked from a place with 4 m of floor ahead."""
    place = world(SCENE)
    start = place.ground.put_down(place.navmesh.sample(1, 3)[0])
    sofa = next(each["id"] for each in place.scene.instances if each["category"] == "sofa")
    info = {"question": {**QUESTION.to_info(), "target": [sofa]}, "instruction": QUESTION.text}
    x, y, z = (float(value) for value in start)
    return Episode("0000", SCENE, (x, y, z), 0.0, (x, y, z), 0.0, 2.0, info)


def make_task(episode: Episode, **options: Any) -> AEQA:
    task = AEQA(SCENE, **options)
    task._episodes = [episode]
    return task


def begin(episode: Episode, **options: Any) -> Any:
    env = make_task(episode, **options).environment()
    env.begin(episode)
    return env


def final(text: str = "blue") -> TextAnswer:
    return TextAnswer(text, 0.9, final=True)


TURNS = [int(TURN_LEFT)] * 15


def test_an_answer_counts_once_another_view_confirms_it(episode):
    env = begin(episode)
    assert not env.run(TURNS, final("red")).terminated
    assert not env.run(TURNS, TextAnswer("red", 0.4)).terminated  # taken back
    assert not env.run(TURNS, final()).terminated
    segment = env.run(TURNS, final())
    assert segment.terminated and len(segment.executed) == 0
    assert env.result()["success"] == 1 and env.result()["primitives"] == 45


def test_on_the_same_view_nothing_is_carried_out_in_between(episode):
    env = begin(episode, preset="official")
    first = env.run(TURNS, final("red"))
    assert len(first.executed) == 0 and not first.terminated
    assert env.run(TURNS, final()).terminated and env.details()["answer"] == "blue"


def test_one_answer_is_enough_where_none_confirms_it(episode):
    env = begin(episode, confirm="none")
    assert env.run(TURNS, final()).terminated and env.result()["mark"] == 5


def test_primitives_are_limited_in_the_middle_of_a_plan(episode):
    env = begin(episode, actions=20)
    assert not env.run(TURNS, TextAnswer()).truncated
    segment = env.run(TURNS, TextAnswer("blue", 0.3))
    assert segment.truncated and len(segment.executed) == 5
    assert env.result()["answered"] == 0 and env.details()["answer"] == ""


def test_a_final_answer_that_there_is_no_time_to_confirm_counts(episode):
    env = begin(episode, actions=15)
    segment = env.run(TURNS, final("red"))
    assert segment.truncated and env.result()["answered"] == 1 and env.result()["success"] == 0


def test_turns_at_the_start_of_a_segment_are_free_in_the_published_code(episode):
    env = begin(episode, preset="official", actions=4)
    segment = env.run([int(TURN_LEFT)] * 6 + [int(FORWARD)] * 3, TextAnswer())
    assert len(segment.executed) == 9 and not segment.truncated and env.result()["primitives"] == 3
    segment = env.run([int(TURN_LEFT)] * 2 + [int(FORWARD)] * 3, TextAnswer())
    assert segment.executed.tolist() == [TURN_LEFT, TURN_LEFT, FORWARD] and segment.truncated


def test_an_agent_that_only_turns_for_nothing_comes_to_an_end(episode):
    env = begin(episode, preset="official", actions=3)
    ends = [env.run([int(TURN_LEFT)], TextAnswer()).truncated for _ in range(6)]
    assert ends == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("rule", "mark_is_blind", "spl_counts"),
    [("blind", True, False), ("blind_with_path", True, True), ("lowest", False, False)],
)
def test_episodes_without_an_answer_are_marked_as_the_rules_say(episode, monkeypatch, rule, mark_is_blind, spl_counts):
    monkeypatch.setattr("wiw.tasks.aeqa.blind_answer", lambda text: "blue")
    env = begin(episode, actions=1, unanswered=rule)
    env.run([int(TURN_LEFT)], TextAnswer())
    found = env.result()
    assert found["mark"] == (5 if mark_is_blind else 1) and found["answered"] == 0
    assert found["spl"] == (1.0 if spl_counts else 0.0) and found["success"] == 0


@pytest.mark.parametrize(("rule", "cut"), [("blind", 1.0), ("blind_with_path", 1.0), ("lowest", 0.0)])
def test_without_an_answer_the_anytime_curve_ends_at_the_score(episode, monkeypatch, rule, cut):
    monkeypatch.setattr("wiw.tasks.aeqa.blind_answer", lambda text: "blue")
    env = begin(episode, actions=1, unanswered=rule)
    env.run([int(TURN_LEFT)], TextAnswer())
    found = env.result()
    assert [found[f"score_at_{at}"] for at in (30, 60, 120, 250)] == [cut] * 4
    assert found["answer_score"] == cut


def test_there_is_no_spl_where_the_shortest_walk_is_not_known(episode):
    env = begin(replace(episode, geodesic=math.nan), confirm="none")
    env.run([], final())
    found = env.result()
    assert found["success"] == 1 and found["path_length"] == 0
    assert found.keys().isdisjoint({"spl", "shortest"})
    outcome = {"arm": "a", "episode": 0, "status": "done", "metrics": found, "details": env.details()}
    record = AEQA.read_answers({"unanswered": "blind"}, episode, outcome)
    assert record is not None and "spl" not in record.compute_metrics(read_judgements(env.details()))


def test_spl_is_the_papers(episode):
    env = begin(episode, confirm="none")
    env.run([int(FORWARD)] * 12, TextAnswer())
    env.run([], final("light blue"))
    found = env.result()
    assert found["path_length"] > 1.0 and found["shortest"] == 2.0
    credit = (found["mark"] - 1) / 4
    assert found["answer_score"] == credit > 0
    assert found["spl"] == pytest.approx(credit * 2.0 / max(2.0, found["path_length"]))


def test_the_anytime_curve_has_the_blind_mark_until_the_answer(episode, monkeypatch):
    monkeypatch.setattr("wiw.tasks.aeqa.blind_answer", lambda text: "red")
    env = begin(episode, confirm="none")
    for _ in range(3):
        env.run(TURNS, TextAnswer())
    env.run(TURNS, final())
    found = env.result()
    assert [found[f"score_at_{cut}"] for cut in (30, 60, 120, 250)] == [0.0, 1.0, 1.0, 1.0]


def test_grounding_says_whether_the_thing_was_in_sight(episode):
    place = world(SCENE)
    sofa = next(each for each in place.scene.instances if each["category"] == "sofa")
    low, high = np.asarray(sofa["bounds"], float)
    near = place.ground.put_down(place.navmesh.snap([(low[0] + high[0]) / 2, 0.0, (low[2] + high[2]) / 2]))
    moved = Episode("1", SCENE, tuple(map(float, near)), 0.0, tuple(map(float, near)), 0.0, 1.0, episode.info)
    hidden = min(
        (place.ground.put_down(point) for point in place.navmesh.sample(40, 0)),
        key=lambda point: -np.linalg.norm(point - near),
    )
    away = Episode("2", SCENE, tuple(map(float, hidden)), 0.0, tuple(map(float, near)), 0.0, 1.0, episode.info)
    grounded = []
    for each in (moved, away):
        env = begin(each, confirm="none")
        env.run([], final())
        grounded.append(env.result()["grounded"])
    assert grounded == [1.0, 0.0]


def test_stopping_ends_without_an_answer_and_an_answer_ends_what_is_stepped(episode):
    env = begin(episode)
    assert env.run([int(STOP)], TextAnswer("blue", 0.9)).terminated and env.result()["answered"] == 0
    stepped = wiw.make("AEQA-v0", scenes=SCENE)
    stepped.task._episodes = [episode]
    stepped.reset(options={"episode": 0})
    stepped.step(int(FORWARD))
    assert stepped.answer("blue")["success"] == 1
    with pytest.raises(ArgumentError, match="reply to a question"):
        stepped.answer(" ")
    with pytest.raises(ArgumentError, match="the episode has ended"):
        stepped.answer("red")  # the first answer counts
    assert stepped.result()["success"] == 1


def test_many_are_answered_one_by_one(episode):
    many = wiw.make_vec("AEQA-v0", 2, scenes=SCENE, depth=False)
    many.task._episodes, many.task.wrap_index = [episode], lambda number: 0
    many.reset(options={"episode": [0, 0]})
    assert many.answer(1, "blue")["success"] == 1
    with pytest.raises(ArgumentError, match=r"the episode has ended.*the next step"):
        many.answer(1, "red")
    _, rewards, terminated, _, infos = many.step([int(FORWARD), int(FORWARD)])
    assert rewards.tolist() == [0, 0] and not terminated.any() and "result" not in infos
    assert [state.actions for state in many._states] == [1, 0]  # the second has begun anew
    with pytest.raises(ArgumentError, match="reply to a question"):
        many.answer(0, " ")


# -- what policies are given and must return ---------------------------------------------------------------------------


CANARY, NUMBER = "XYZZY", 7654321
"""In every field that an agent is not to see, as text and as numbers."""


@pytest.fixture
def marked(episode) -> Episode:
    """An episode whose question, and whatever else is known of it, carries the canary."""
    question = Question(
        text=QUESTION.text,
        answer=CANARY,
        category=QUESTION.category,
        answer_type="text",
        extra_answers=(CANARY,),
        template=CANARY,
        slots={"object": CANARY},
        target=(NUMBER,),
        viewpoints=((float(NUMBER), 0.0, 0.0, 0.0),),
        twin=CANARY,
    )
    info = {"question": question.to_info(), "task": question.category, "note": CANARY}
    start, goal = episode.start_position, episode.goal_position
    return Episode(CANARY, SCENE, start, 0.0, goal, 0.0, float(NUMBER), info)


def knows(thing: Any) -> bool:
    """Whether the canary is anywhere in a thing, however deep: arrays, texts, private parts."""
    held = pickle.dumps(thing)
    numbers = [np.array(NUMBER, kind).tobytes() for kind in (np.int32, np.float32, np.float64, ">f8")]
    return CANARY.encode() in held or any(number in held for number in numbers)


def test_the_goal_is_the_text_and_the_budget_alone(marked):
    """No hidden field of a question reaches a policy."""
    seen: list[Any] = []

    class Spy(Talker):
        def propose(self, situations, candidates, horizon):
            seen.extend(situations)
            return super().propose(situations, candidates, horizon)

    assert all(map(knows, (CANARY, NUMBER, float(NUMBER), (float(NUMBER),))))
    assert (
        knows(marked)
        and knows(np.array([NUMBER, 1.0]))
        and knows({"deep": [Question.from_info(marked.info["question"])]})
    )
    run(make_task(marked, actions=30), Spy(final()), [marked])
    assert seen and all(each.goal == Goal("aeqa", text=QUESTION.text, question=True, budget=30) for each in seen)
    assert not any(knows((each.goal, each.key, each.memory, each.executed)) for each in seen)
    assert not any(CANARY in repr(vars(each.observation)) for each in seen)


def test_the_explorer_remembers_nothing_hidden(marked):
    """The default agent's memory after it has looked around: its map, its beliefs, and what it looks for."""
    pytest.importorskip("torch", reason="needs wiw[torch]")
    memories: list[Any] = []

    class Spy(Explorer):
        def answer(self, situations, proposals, rollouts):
            memories.extend(situation.memory for situation in situations)
            return super().answer(situations, proposals, rollouts)

    run(make_task(marked, actions=12), Spy(), [marked])
    assert memories and not any(knows(memory) for memory in memories)
    assert b"sofa" in pickle.dumps(memories[-1]), "what the text asks for is found in it by the same means"


class Talker(Policy):
    """Turns, and says the same at every decision."""

    def __init__(self, says: Any) -> None:
        self.says = says

    def propose(self, situations, candidates, horizon):
        return [[Proposal(np.full(15, TURN_LEFT, np.int8))] for _ in situations]

    def score(self, situations, proposals, rollouts):
        return [np.zeros(len(plans)) for plans in proposals]

    def answer(self, situations, proposals, rollouts):
        return [self.says] * len(situations)


class Records:
    def __init__(self) -> None:
        self.results: list[EpisodeResult] = []
        self.answers: list[Any] = []
        self.decisions: list[Any] = []

    def decision(self, record):
        self.answers.append(record.decision.answer)
        self.decisions.append(record)

    def episode(self, result):
        self.results.append(result)

    def record_restart(self, episodes):
        pass

    def record_lost(self, spent):
        pass


def run(task: AEQA, policy: Policy, episodes: list[Episode]) -> Records:
    sink = Records()
    agent = wiw.Agent(policy, **task.defaults)
    run_episodes(task, agent, list(enumerate(episodes)), seed=0, live=2, sink=sink)
    return sink


def test_agents_know_what_was_really_carried_out(episode):
    """Nothing is after a final answer that is to be confirmed on the same view."""
    known: dict[tuple[int, int], Any] = {}

    class Doubting(Talker):
        def propose(self, situations, candidates, horizon):
            known.update({(each.key.episode, each.key.decision): each for each in situations})
            return super().propose(situations, candidates, horizon)

        def answer(self, situations, proposals, rollouts):
            return [final() if each.key.decision == 0 else TextAnswer() for each in situations]

    task = make_task(episode, preset="official", actions=2)
    sink = run(task, Doubting(None), [episode, replace(episode, episode_id="0001")])
    assert [result.status for result in sink.results] == ["done"] * 2
    for index in range(2):
        assert [len(known[index, decision].executed) for decision in range(4)] == [0, 0, 15, 30]
        assert known[index, 0].goal.free_turns and known[index, 0].horizon == known[index, 0].execute == 21


@pytest.mark.parametrize(
    ("says", "expected"),
    [
        (None, "expected a TextAnswer"),
        (Answer(("a", "b"), np.array([0.5, 0.5])), "expected a TextAnswer"),
        (TextAnswer("blue", 1.5), "confidence from 0 to 1"),
        (TextAnswer("blue", math.nan), "confidence from 0 to 1"),
        (TextAnswer(" ", 0.5, final=True), "a text in a final answer"),
    ],
)
def test_answers_that_are_none_break_the_contract(episode, says, expected):
    with pytest.raises(ContractError, match=expected):
        run(make_task(episode), Talker(says), [episode])


def test_a_policy_that_does_not_answer_is_refused(episode):
    with pytest.raises(ContractError, match="asks for one in words"):
        run(make_task(episode), wiw.policy("heuristic"), [episode])


class Broken(Judge):
    name = "broken"

    def describe(self):
        return {"judge": "broken"}

    def _judge_answers(self, references, answers):
        return [JudgeError("a novel", "huge") if answer == "novel" else Judgement(3, "broken") for answer in answers]


def test_an_answer_that_cannot_be_judged_is_an_error_and_no_failure(episode):
    task = make_task(episode, judge=Broken())
    sink = run(task, Talker(final("novel")), [episode])
    assert [(each.status, each.kind) for each in sink.results] == [("error", "judge/huge")]
    (error,) = sink.results
    assert error.details["answer"] == "novel" and error.details["judgement"] is None
    assert error.details["measured"]["primitives"] == 15 and error.details["measured"]["decisions"] == 2
    assert [answer.text for answer in sink.answers] == ["novel"] * 2, "the decision that ended the episode is kept"
    sink = run(task, Talker(final("anything")), [episode])
    assert [(each.status, each.metrics["answer_score"]) for each in sink.results] == [("done", 0.5)]
    assert sink.results[0].details["judgement"]["judge"] == "broken"


def test_an_episode_that_could_not_be_judged_is_judged_later(episode, tmp_path):
    task, out = make_task(episode, judge=Broken()), tmp_path / "run"
    log = wiw.evaluate(task, wiw.Agent(Talker(final("novel"))), 1, out=out, progress=False)
    assert log.numbers().arms[0].errors == 1
    found = wiw.judge(out, progress=False)
    assert found.complete and found.log.numbers().arms[0].done == 1
    (row,) = found.log.episodes
    again = make_task(episode)
    (expected,) = run(again, Talker(final("novel")), [episode]).results
    assert row["metrics"] == expected.metrics, "the same numbers as if that judge had been the task's"
    assert row["details"] == expected.details


# -- the store ---------------------------------------------------------------------------------------------------------


def test_runs_keep_answers_and_judgements_apart_from_numbers(episode, tmp_path):
    log = wiw.evaluate(make_task(episode), wiw.Agent(Talker(final())), 1, out=tmp_path / "run", progress=False)
    (outcome,) = log.store.outcomes()
    assert outcome["details"]["answer"] == "blue" and outcome["details"]["judgement"]["mark"] == 5
    assert [row["answer"] for row in log.store.decisions()] == [{"label": "blue", "confidence": 0.9, "final": True}] * 2
    assert log.store.config["task"]["judge"] == make_task(episode).judge.describe()
    (line,) = log.numbers().arms
    assert line.estimates["answer_score"].value == 100 and line.estimates["answered"].value == 100
    assert "blue" in log.report().read_text()
    assert f"<q>{QUESTION.text}</q>" in log.report().read_text()
    json.dumps(make_task(episode).describe())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"info": {"radius": 1.0}}, r"episode 1 \('b'\) has no question: expected a file of `wiw episodes aeqa`"),
        ({"answer": " "}, r"episode 1 \('b'\): .*expected a question and an answer with words in them"),
        ({"category": "gossip"}, r"episode 1 \('b'\): .*category: expected one of object recognition"),
        ({"answer": None}, r"episode 1 \('b'\): question: answer: expected text, got None"),
        ({"episode_id": "a"}, r"episode 1 \('a'\) has the id of episode 0; expected a unique one"),
    ],
)
def test_files_without_proper_questions_are_refused(episode, tmp_path, change, said):
    path, question = tmp_path / "questions.json", dict(episode.info["question"])
    save(path, [replace(episode, episode_id=name) for name in ("a", "b")], "aeqa")
    assert [each.episode_id for each in AEQA(episode_file=path).episodes(2)] == ["a", "b"]
    body = json.loads(path.read_text())
    item = body["episodes"][1]
    if change.keys() <= item.keys():
        item.update(change)
    else:
        item["info"]["question"] = {**question, **change}
    path.write_text(json.dumps(body))
    with pytest.raises(FileError, match=said):
        AEQA(episode_file=path).episodes(2)


def test_one_and_two_workers_find_out_the_same(episode, tmp_path):
    """The default agent: what it perceives, decides and answers, and the pictures of what it believes."""
    pytest.importorskip("torch", reason="needs wiw[torch]")
    path = tmp_path / "questions.json"
    save(path, [replace(episode, episode_id=name) for name in ("a", "b")], "aeqa")
    task, agent = TaskRecipe("aeqa", {"episode_file": str(path), "actions": 24}), AgentRecipe("explorer", "warp")
    for workers in (1, 2):
        out = tmp_path / str(workers)
        wiw.evaluate(task, agent, 2, out=out, workers=workers, keep_images="all", progress=False).close()
    assert list_facts(tmp_path / "1") == list_facts(tmp_path / "2")
    assert len(load_run(tmp_path / "1").episodes) == 2


@pytest.fixture
def blocks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Give every block of several apartments two pairs of questions, one alone none; return the blocks begun."""
    begun: list[str] = []

    def pair_questions(block, *_):
        begun.append(block[0])
        yield from [(make_answerable(block[0]), make_answerable(block[1]))] * 2 if len(block) > 1 else []

    monkeypatch.setattr(balance, "_count_rooms", lambda scene: 6)
    monkeypatch.setattr(balance, "pair_questions", pair_questions)
    return begun


def make_answerable(scene: str) -> Answerable:
    fact = Fact("blue", (), ())
    at = (0.0, 0.0, 0.0)
    return Answerable(scene, QUESTION.text, "color", QUESTION.slots, fact, 0, at, 0.0, 2.0, ((*at, 0.0),))


def test_there_are_as_many_episodes_as_questions_in_pairs(blocks):
    """Nine apartments have a share of 45, and the last of them nobody to be paired with."""
    task = AEQA("apartments:val:9")
    assert [wrap_episode(task, index) for index in (0, 7, 8, 9, 44)] == [0, 7, 0, 1, 4]
    assert task.episode_count == len(task.episodes(8)) == 8 and task.drawn_count == 8
    with pytest.raises(ArgumentError, match="only 8 of 9 questions in 3 blocks"):
        task.episodes(9)


def test_a_single_apartment_is_refused_where_it_gives_no_questions(blocks):
    task = AEQA("apartments:val:1")
    assert task.episode_count == 0
    for use in (lambda: task.drawn_count, lambda: wrap_episode(task, 0), lambda: task.episode(0)):
        with pytest.raises(ArgumentError, match=r"name more scenes .*, or set twins=1"):
            use()


def test_each_block_of_apartments_is_asked_once(blocks):
    task = AEQA("apartments:val")
    made = [task.episode(wrap_episode(task, index)) for index in (*range(12), 3, 11)]
    assert blocks == ["apartments:val/0", "apartments:val/4", "apartments:val/8"]
    assert task.episode_count is None and [each.episode_id for each in made[:12]] == [f"{i:04d}" for i in range(12)]
    sent = pickle.loads(pickle.dumps(task))
    assert sent.episodes(12) == made[:12] and len(blocks) == 3
    assert sent.episodes(14) == task.episodes(14)


def test_an_interrupted_series_goes_on(blocks, monkeypatch):
    series = balance.EpisodeSeries(wiw.scenes.resolve("apartments:val:8"), 0)
    whole, pair_questions = balance.EpisodeSeries(series.scenes, 0).take(), balance.pair_questions

    def interrupt(block, *rest):
        if block[0] == "apartments:val/4":
            raise KeyboardInterrupt
        return pair_questions(block, *rest)

    monkeypatch.setattr(balance, "pair_questions", interrupt)
    with pytest.raises(KeyboardInterrupt):
        series.take(6)
    monkeypatch.setattr(balance, "pair_questions", pair_questions)
    assert series.take() == whole and len(whole) == 8


def test_a_scene_alone_has_as_many_episodes_as_questions(monkeypatch, tmp_path):
    """The questions of a house from a file come to an end, too."""
    monkeypatch.setattr("wiw.tasks.aeqa.resolve", lambda spec: [SCENE])
    monkeypatch.setattr(AEQA, "is_balanced", False)
    found = tuple(replace(make_answerable(SCENE), text=text) for text in ("one?", "two?", "three?"))
    monkeypatch.setattr("wiw.datasets.questions.generate.questions_of", lambda *_: found)
    task = AEQA(SCENE)
    assert task.episode_count == 3 and task.drawn_count == 3
    assert [wrap_episode(task, index) for index in (2, 3, 7)] == [2, 0, 1]


def test_presets_differ_in_what_the_published_code_does():
    paper, official = AEQA(SCENE), AEQA(SCENE, preset="official")
    assert paper.defaults == {"candidates": 3, "horizon": 21, "execute": 15} and paper.limit == 250
    assert official.defaults["execute"] == 50, "the whole plan, routes included"
    changed = {name for name, value in official.describe().items() if value != paper.describe()[name]}
    assert changed == {"execute", "confirm", "unanswered", "turns", "policies"}
    assert wiw.Agent("heuristic", **official.defaults).config.count_executed(21) == 21
