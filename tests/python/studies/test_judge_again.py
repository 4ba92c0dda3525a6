# SPDX-License-Identifier: Apache-2.0
"""Stored answers are judged again: nothing is overwritten, and only what is missing is asked about."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pydantic")
pytest.importorskip("openai")

from aeqa_runs import BLIND, Ended, color_question, free_question, make_episodes, write_run

import wiw
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError, VlmError
from wiw.judging import Judge, Judgement
from wiw.runs.store import RunStore
from wiw.serving.vlm_server import VlmServer
from wiw.studies.judge import read_answers
from wiw.studies.run_log import load_run
from wiw.vlm.messages import Call, Completion
from wiw.vlm.mock import MockClient

QUESTIONS = [color_question("blue"), free_question("the curtains are closed"), free_question("the lamp is off")]
SCENES = ["apartments:val/0", "apartments:val/1", "apartments:val/2"]
ARMS = {
    "none": [Ended("blue", 40), Ended("the lamp is off", 20), Ended()],
    "warp": [Ended("blue", 20), Ended("curtains", 50), Ended("it is night", 100)],
}
REFUSED = (
    ("6", "range"),
    ("", "empty"),
    ("It was a dark and stormy night, and 3 candles burned. " * 40, "malformed"),
)


def said(call: Call) -> str:
    """Return the answer that a judge is asked about, and with it the question."""
    return "".join(part for message in call.messages for part in message.content if isinstance(part, str))


def reply(call: Call) -> str:
    """Mark answers by a table: whoever mentions curtains is right, the night is half right."""
    marks = {"it is night": 3, '"curtains"': 5}
    return json.dumps({"mark": next((mark for text, mark in marks.items() if text in said(call)), 1)})


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", make_episodes(QUESTIONS, SCENES), ARMS)


def metrics(run: Path, judge: str | None = None) -> dict[tuple[str, int], dict[str, Any]]:
    with RunStore.read(run) as store:
        store.use_judge(judge)
        return {(row["arm"], row["episode"]): row["metrics"] for row in store.outcomes()}


def test_marks_are_stored_beside_the_runs_own(run: Path) -> None:
    before = metrics(run)
    client = MockClient(reply, model="m")
    with VlmServer(client) as server:
        found = wiw.judge(run, f"rules+llm:{server.url}#m", progress=False, cache="off")
    assert found.complete and found.judge.label == "rules+llm (m)"
    assert metrics(run) == before, "the run's own marks stay"
    now = metrics(run, "rules+llm")
    assert now["none", 0] == before["none", 0], "typed questions are judged by rules"
    assert (before["warp", 1]["mark"], now["warp", 1]["mark"], now["warp", 2]["mark"]) == (3, 5, 3)
    assert now["warp", 1]["success"] == 1 and now["warp", 1]["answer_score"] == 1.0
    assert now["warp", 1]["spl"] == pytest.approx(5.0 / 8.0)
    cuts = [now["warp", 1][f"score_at_{cut}"] for cut in (30, 60, 120, 250)]
    assert cuts == [0.0, 1.0, 1.0, 1.0], "what is computed from marks follows them"
    assert now["warp", 2]["answer_score"] == 0.5 and now["none", 2]["answered"] == 0 and now["none", 2]["spl"] == 0
    with RunStore.read(run) as store:
        details = store.judged_outcomes(found.judge.digest)["warp", 2]["details"]
        assert [judge.name for judge in store.judges] == ["rules+approximate", "rules+llm"]
    judged = details["judgement"]
    assert (judged["mark"], judged["judge"], judged["model"], judged["reply"]) == (3, "llm", "m", '{"mark": 3}')
    assert judged["seed"] == 1234 and judged["temperature"] == 0.2 and len(judged["prompt_digest"]) > 8
    assert details["blind"]["answer"] == BLIND and details["blind"]["judgement"]["mark"] == 1


def test_equal_answers_to_a_question_are_asked_about_once_and_nothing_twice(tmp_path: Path) -> None:
    ends = [Ended("blue"), Ended("the lamp"), Ended("dusk")]
    run = write_run(tmp_path / "run", make_episodes(QUESTIONS, SCENES), {"none": ends, "warp": ends, "copy": ends})
    with VlmServer(MockClient(reply, model="m")) as server:
        spec = f"rules+llm:{server.url}#m"
        found = wiw.judge(run, spec, progress=False, cache="off")
        assert server.count == 4, "two free questions, each with an answer and the one from the text alone"
        assert found.asked == 6 and found.known == 0  # two of them by rules
        again = wiw.judge(run, spec, progress=False, cache="off")
        assert server.count == 4 and (again.asked, again.known) == (0, 6) and again.complete


@pytest.mark.parametrize(("text", "kind"), REFUSED, ids=["six", "nothing", "novel"])
def test_a_reply_that_is_no_mark_is_an_error_of_its_episode_alone(run: Path, text: str, kind: str) -> None:
    bad = [True]
    client = MockClient(lambda call: text if bad[0] and "it is night" in said(call) else reply(call), model="m")
    with VlmServer(client) as server:
        spec = f"rules+llm:{server.url}#m"
        found = wiw.judge(run, spec, progress=False, cache="off")
        (missing,) = found.missing
        assert (missing.arm, missing.episode, missing.kind) == ("warp", 2, f"judge/{kind}")
        rows = {(row["arm"], row["episode"]): row for row in found.log.episodes}
        assert rows["warp", 2]["status"] == "error" and "expected a mark from 1 to 5" in rows["warp", 2]["error"]
        assert rows["warp", 1]["metrics"]["mark"] == 5 and found.log.numbers()["warp"].errors == 1
        count, bad[0] = server.count, False
        again = wiw.judge(run, spec, progress=False, cache="off")
        assert server.count == count + 1 and again.asked == 1 and again.complete, "only the missing one is asked about"
    assert metrics(run, "rules+llm")["warp", 2]["mark"] == 3


def test_a_dead_server_is_an_error_of_each_episode_and_loses_nothing(run: Path) -> None:
    with VlmServer(MockClient(reply, model="m")) as server:
        port = int(server.url.split(":")[2].split("/")[0])
        spec = f"rules+llm:{server.url}#m"
    options: dict[str, Any] = {"cache": "off", "attempts": 1, "progress": False}
    found = wiw.judge(run, spec, **options)
    assert {(each.arm, each.episode) for each in found.missing} == {
        ("none", 1),
        ("none", 2),
        ("warp", 1),
        ("warp", 2),
    }
    assert {each.kind for each in found.missing} == {"judge/unreachable"}
    assert metrics(run, "rules+llm")["warp", 0]["mark"] == 5, "what rules judge needs no server"
    with VlmServer(MockClient(reply, model="m"), port) as server:
        again = wiw.judge(run, spec, **options)
        assert again.complete and again.asked == server.count == 5 and again.known == 2


def test_a_reply_that_takes_too_long_is_an_error_of_its_episode(run: Path) -> None:
    ended = threading.Event()

    def slow(call: Call) -> str:
        if "it is night" in said(call):
            ended.wait(60)
        return reply(call)

    with VlmServer(MockClient(slow, model="m")) as server:
        try:
            found = wiw.judge(
                run, f"rules+llm:{server.url}#m", progress=False, cache="off", attempts=1, timeout=6.0, concurrency=1
            )
        finally:
            ended.set()
    assert [(each.arm, each.episode, each.kind) for each in found.missing] == [("warp", 2, "judge/timeout")]


def test_a_server_that_stays_dead_is_not_asked_about_every_answer(tmp_path: Path) -> None:
    count = 12
    questions = [free_question(f"reason {index}") for index in range(count)]
    arms = {"none": [Ended(f"guess {index}") for index in range(count)]}
    run = write_run(tmp_path / "run", make_episodes(questions, [f"s{index}" for index in range(count)]), arms)
    with VlmServer(MockClient(model="m")) as server:
        spec = f"rules+llm:{server.url}#m"
    found = wiw.judge(run, spec, progress=False, cache="off", attempts=1, concurrency=2)
    assert len(found.missing) == count and found.asked < 10 and "answers were not judged" in found.stopped


def test_a_model_without_a_name_at_a_dead_server_leaves_the_run_as_it_is(run: Path) -> None:
    with VlmServer(MockClient(model="m")) as server:
        url = server.url
    with pytest.raises(VlmError):
        wiw.judge(run, f"rules+llm:{url}", progress=False, attempts=1)
    with RunStore.read(run) as store:
        assert len(store.judges) == 1


class Grumpy(Judge):
    """Gives the lowest mark, and breaks at what it is told to."""

    name = "grumpy"

    def __init__(self, breaks_at: str = "", mark: int = 1) -> None:
        self.breaks_at, self.mark = breaks_at, mark

    def describe(self) -> dict[str, Any]:
        return {"judge": self.name, "mark": self.mark}

    def _judge_answers(self, references: Any, answers: Any) -> list[Any]:
        if self.breaks_at and self.breaks_at in answers:
            raise RuntimeError("no more")
        return [Judgement(self.mark, self.name) for _ in answers]


def test_a_judge_of_ones_own_that_breaks_is_an_error_too(run: Path) -> None:
    found = wiw.judge(run, Grumpy("curtains"), progress=False)
    assert [(each.kind, each.error) for each in found.missing] == [("judge/raised", "RuntimeError: no more")]
    assert wiw.judge(run, Grumpy(), progress=False).complete


def test_errors_of_the_runs_own_judge_are_mended_without_running_anything(tmp_path: Path) -> None:
    class Once(Grumpy):
        def _judge_answers(self, references: Any, answers: Any) -> list[Any]:
            found = super()._judge_answers(references, answers)
            return [
                wiw.errors.JudgeError("a novel") if each == "curtains" else own
                for each, own in zip(answers, found, strict=True)
            ]

    run = write_run(tmp_path / "run", make_episodes(QUESTIONS, SCENES), ARMS, Once())
    log = load_run(run)
    assert log.numbers()["warp"].errors == 1 and log.store.pending("warp", retry_errors=True) == [1]
    found = wiw.judge(run, Grumpy(), progress=False)
    assert found.judge.own and found.asked == 1 and found.complete
    log = load_run(run)
    assert log.numbers()["warp"].errors == 0 and log.store.pending("warp", retry_errors=True) == []
    assert metrics(run)["warp", 1]["mark"] == 1 and metrics(run)["warp", 1]["path_length"] == 8.0
    with RunStore.annotate(run) as store:
        store.discard("warp", [1])
        assert not store.judged_outcomes(found.judge.digest), "what is run again is judged again"


def test_episodes_that_a_judge_has_not_marked_are_errors_under_it(run: Path) -> None:
    wiw.judge(run, Grumpy(), progress=False)
    with RunStore.annotate(run) as store, store._writing() as connection:
        connection.execute("DELETE FROM judged WHERE arm = 'none' AND episode = 0")
    log = load_run(run, judge="grumpy")
    (row,) = (row for row in log.episodes if row["status"] == "error")
    assert row["kind"] == "judge/missing" and "wiw judge" in row["error"] and not log.valid
    again = wiw.judge(run, Grumpy(), progress=False)
    assert again.complete and again.asked == 0, "the other arm's answer to that question was the same"


def test_judges_go_by_name_and_digest(run: Path) -> None:
    low, high = wiw.judge(run, Grumpy(), progress=False), wiw.judge(run, Grumpy(mark=5), progress=False)
    assert low.judge.digest != high.judge.digest
    assert load_run(run, judge=high.judge.digest[:6]).numbers()["warp"].estimates["answer_score"].value == 100
    assert load_run(run, judge="own").numbers()["warp"].estimates["answer_score"].value < 100
    with pytest.raises(ArgumentError, match=f"2 judges .* give a digest: .*{low.judge.digest}.*{high.judge.digest}"):
        load_run(run, judge="grumpy")
    with pytest.raises(ArgumentError, match=r"no marks by it, only by: rules\+approximate, \w{12} \(the run's own"):
        load_run(run, judge="nobody")


def test_a_run_without_answers_in_words_has_no_judge(tmp_path: Path) -> None:
    from fakes import LineAgent, LineTask

    from wiw.studies.evaluate import run_arms

    run = run_arms(LineTask(), {"none": LineAgent()}, 1, out=tmp_path / "run", progress=False).path
    with pytest.raises(StoreError, match="task 'line', whose outcomes do not depend on a judge"):
        wiw.judge(run, progress=False)
    with pytest.raises(ArgumentError, match="do not depend on a judge"):
        load_run(run, judge="rules")


def test_a_task_that_is_not_known_here_cannot_be_judged(run: Path) -> None:
    with RunStore.annotate(run) as store, store._writing() as connection:
        connection.execute("UPDATE run SET config = json_set(config, '$.task.task', 'mine')")
    with pytest.raises(StoreError, match="task in memory, 'mine', that is not registered"):
        wiw.judge(run, progress=False)


@pytest.mark.parametrize(
    "change",
    [
        "DELETE FROM outcome",
        "UPDATE outcome SET status = 'error', error = 'lost', kind = 'agent', metrics = '{}', details = '{}'",
    ],
    ids=["just begun", "errors alone"],
)
def test_a_run_without_a_finished_episode_is_shown_without_marks(
    run: Path, change: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunStore.annotate(run) as store, store._writing() as connection:
        connection.execute(change)
    found = wiw.judge(run, Grumpy(), progress=False)
    assert (found.asked, found.known, found.complete) == (0, 0, True)
    assert len(found.log.episodes) == len(load_run(run, judge="grumpy").episodes) == (0 if "DELETE" in change else 6)
    assert main(["judge", str(run), "--judge", "approximate"]) == 0
    assert "0 judged now, 0 judged before" in capsys.readouterr().out


class Counted(dict[Any, Any]):
    """Answers that count how often they are read."""

    reads = 0

    def __getitem__(self, key: Any) -> Any:
        self.reads += 1
        return super().__getitem__(key)


def test_each_answer_is_looked_at_a_few_times_however_many_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = 60
    questions = [free_question(f"reason {index}") for index in range(count)]
    arms = {arm: [Ended(f"guess {index}") for index in range(count)] for arm in ("none", "warp")}
    run = write_run(tmp_path / "run", make_episodes(questions, [f"s{index}" for index in range(count)]), arms)
    with RunStore.read(run) as store:
        answers = Counted(read_answers(store))
    monkeypatch.setattr("wiw.studies.judge.read_answers", lambda store: answers)
    assert wiw.judge(run, Grumpy(), progress=False).complete
    assert answers.reads <= 8 * len(answers)


def test_a_run_that_is_being_written_is_left_alone(run: Path) -> None:
    with RunStore.annotate(run), pytest.raises(StoreError, match="another process"):
        wiw.judge(run, progress=False)


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        ("details", "{}", "no 'answer'"),
        ("details", '{"answer": 3, "blind": {"answer": "x"}}', "no answer in words"),
        ("metrics", "{}", "no 'path_length'"),
        ("metrics", '{"path_length": null, "shortest": 1, "primitives": 3}', "no number path_length"),
    ],
)
def test_a_store_that_was_edited_is_an_error_that_names_the_place(
    run: Path, column: str, value: str, expected: str
) -> None:
    with RunStore.annotate(run) as store, store._writing() as connection:
        connection.execute(f"UPDATE outcome SET {column} = ? WHERE arm = 'warp' AND episode = 1", (value,))
    with pytest.raises(StoreError, match=f"outcome of warp in episode 1: {expected}; the run store was edited"):
        wiw.judge(run, Grumpy(), progress=False)


def test_a_stored_judgement_that_was_edited_is_an_error(run: Path) -> None:
    wiw.judge(run, Grumpy(), progress=False)
    for value in ('{"mark": 6, "judge": "grumpy"}', '{"marks": 5}'):
        with RunStore.annotate(run) as store, store._writing() as connection:
            connection.execute("UPDATE judged SET details = json_set(details, '$.judgement', json(?))", (value,))
        with pytest.raises(StoreError, match="expected a judgement with a mark"):
            load_run(run, judge="grumpy").numbers()


def test_the_command(run: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["judge", str(run)]) == 0
    assert "0 judged now" in capsys.readouterr().out, "these are the run's own marks"
    client = MockClient(lambda call: Completion("", "stop") if "it is night" in said(call) else reply(call), model="m")
    with VlmServer(client) as server:
        arguments = ["judge", str(run), "--llm", server.url, "--model", "m", "--judge-option", "cache=off"]
        assert main(arguments) == 1
        shown = capsys.readouterr()
        assert (
            "judge   rules+llm (m), " in shown.out
            and "no marks: warp 2: JudgeError" in shown.err
            and "repeat the command" in shown.err
        )
        assert "/7 answers" in shown.err, "progress is shown, also where there is no terminal"
        client.script = reply
        assert main(arguments) == 0
        assert server.requests[-1]["temperature"] == 0.2
        assert main(["judge", str(run), "--judge", f"llm:{server.url}#m", "--judge-option", "temperature=0"]) == 0
        assert server.requests[-1]["temperature"] == 0


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (["--judge", "rules", "--llm", "http://localhost:1/v1"], "--llm is short for --judge rules"),
        (["--model", "m"], "expected a language model given without a name"),
        (["--judge", "llm:http://localhost:1/v1#m", "--model", "m"], "expected a language model given without a name"),
        (["--judge", "coin"], "judge 'coin': expected rules"),
        (["--judge-option", "temperature=1"], "options temperature are of language models only"),
    ],
)
def test_flags_that_make_no_sense_are_refused(
    run: Path, capsys: pytest.CaptureFixture[str], flags: list[str], expected: str
) -> None:
    assert main(["judge", str(run), *flags]) == 2
    assert expected in capsys.readouterr().err
