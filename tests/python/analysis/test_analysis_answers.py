# SPDX-License-Identifier: Apache-2.0
"""Tables and plots of question answering: categories, the anytime curve, twins, blind answers, and the judge."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aeqa_runs import Ended, color_question, free_question, make_episodes, write_run

import wiw
from wiw.analysis.statistics import estimate_difference, estimate_mean
from wiw.cli import main
from wiw.errors import ArgumentError, StoreError
from wiw.judging import Judge, Judgement
from wiw.metrics.metric import ANSWER_SCORE
from wiw.report.export import tables
from wiw.report.tables import as_text
from wiw.runs.store_file import store_path
from wiw.studies.run_log import load_run

STATE, ATTRIBUTE, WORLD = "object state recognition", "attribute recognition", "world knowledge"
EDITED = "apartments:val/0?color:sofa_1=red"
QUESTIONS = [
    color_question("blue", twin="q1"),
    color_question("red", twin="q0"),
    color_question("white", STATE),
    color_question("blue", STATE),
    color_question("red", STATE),
    free_question("the curtains are closed"),
]
SCENES = ["apartments:val/0", EDITED, "apartments:val/1", "apartments:val/2", "apartments:val/2", "apartments:val/3"]
ARMS = {
    "none": [Ended("blue", 40), Ended("blue", 70), Ended(), Ended("blue", 200), Ended("green", 20), Ended("dusk", 90)],
    "warp": [
        Ended("blue", 20),
        Ended("red", 50),
        Ended("white", 100, 16.0),
        Ended("blue", 30),
        Ended(),
        Ended("closed curtains", 31),
    ],
}


class Fixed(Judge):
    """Gives every answer the same mark."""

    def __init__(self, mark: int) -> None:
        self.name, self.mark = f"fixed{mark}", mark

    def describe(self) -> dict[str, Any]:
        return {"judge": self.name}

    def _judge_answers(self, references: Any, answers: Any) -> list[Any]:
        return [Judgement(self.mark, self.name) for _ in answers]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", make_episodes(QUESTIONS, SCENES), ARMS)


def cells(run: Path, table: str) -> dict[tuple[str, str, str], float]:
    keys = {"kinds": "category", "anytime": "cut", "anytime_differences": "cut", "twins": "outcome"}
    return {(row["arm"], row[keys[table]], row["metric"]): row["value"] for row in load_run(run).breakdown(table)}


def test_categories_show_the_metrics_that_the_task_names(run: Path) -> None:
    found = cells(run, "kinds")
    assert found["none", ATTRIBUTE, "answer_score"] == 50 and found["warp", ATTRIBUTE, "answer_score"] == 100
    assert found["warp", STATE, "answer_score"] == pytest.approx(100 * 2 / 3)
    shares = [6.0 / 16.0, 7.0 / 8.0, 0.0]  # L* over metres walked, of the white, the blue and the unanswered one
    assert found["warp", STATE, "spl"] == pytest.approx(100 * np.mean(shares))
    assert ("blind", STATE, "answer_score") in found and ("blind", STATE, "spl") not in found
    assert {metric for _, _, metric in found} == {"answer_score", "spl"}, "and no success rate"
    shown = as_text(load_run(run).numbers())
    assert "Score % ↑ by category" in shown and "SPL % ↑ by category" in shown and "by kind of task" not in shown


def test_the_anytime_curve_is_the_score_if_cut_there(run: Path) -> None:
    log = load_run(run)
    rows = {arm: [row for row in log.episodes if row["arm"] == arm] for arm in ARMS}
    scenes = [row["scene"].partition("?")[0] for row in rows["warp"]]
    values = {arm: {cut: [row["metrics"][f"score_at_{cut}"] for row in rows[arm]] for cut in (30, 250)} for arm in ARMS}
    curve, gain = (
        next(each for each in log.numbers().breakdowns if each.name == name)
        for name in ("anytime", "anytime_differences")
    )
    assert curve.keys == ("30", "60", "120", "250") and gain.base == "none"
    for cut in (30, 250):
        expected = estimate_mean(values["warp"][cut], scenes, ANSWER_SCORE)
        assert curve.estimates["warp"][str(cut)] == expected
        assert gain.estimates["warp"][str(cut)] == estimate_difference(
            values["warp"][cut], values["none"][cut], scenes, ANSWER_SCORE
        )
    found = cells(run, "anytime")
    assert found["warp", "30", "answer_score"] < found["warp", "120", "answer_score"]
    assert found["none", "250", "answer_score"] == pytest.approx(
        load_run(run).numbers()["none"].estimates["answer_score"].value
    )
    blind = {found["blind", cut, "answer_score"] for cut in curve.keys}
    assert list(blind) == [pytest.approx(100 / 6)], "white is right once, and there is nothing to cut"


def test_twins_count_as_right_together(run: Path) -> None:
    found = cells(run, "twins")
    assert [found["warp", key, "twins"] for key in ("both right", "one right", "neither right")] == [100, 0, 0]
    assert [found["none", key, "twins"] for key in ("both right", "one right", "neither right")] == [0, 100, 0]
    assert found["blind", "both right", "twins"] == 0
    (row,) = (
        row for row in load_run(run).breakdown("twins") if row["arm"] == "warp" and row["outcome"] == "both right"
    )
    assert row["n"] == 1


def test_twins_that_do_not_name_each_other_or_have_not_both_ended_are_no_pair(tmp_path: Path) -> None:
    one_sided = [replace(QUESTIONS[1], twin=""), *QUESTIONS[2:]]
    run = write_run(tmp_path / "a", make_episodes([QUESTIONS[0], *one_sided], SCENES), ARMS)
    assert not load_run(run).breakdown("twins")
    broken = write_run(tmp_path / "b", make_episodes(QUESTIONS, SCENES), ARMS)
    with sqlite3.connect(store_path(broken)) as store:
        store.execute("UPDATE outcome SET status = 'error', kind = 'worker' WHERE arm = 'none' AND episode = 1")
    assert {arm for arm, _, _ in cells(broken, "twins")} == {"warp", "blind"}


def test_an_edited_copy_is_the_same_apartment_to_intervals(run: Path) -> None:
    log = load_run(run)
    assert len({row["scene"] for row in log.episodes}) == 5
    assert log.numbers()["warp"].estimates["success"].scenes == 4


def test_blind_answers_are_a_line_beside_the_arms(run: Path) -> None:
    numbers = load_run(run).numbers()
    assert [line.name for line in numbers.arms] == ["none", "warp"]
    (blind,) = numbers.baselines
    assert blind.estimates["answer_score"].value == pytest.approx(100 / 6) and set(blind.estimates) == {
        "success",
        "answer_score",
    }
    table = load_run(run).table()
    assert [line["arm"] for line in table] == ["none", "warp", "blind"] and "rules" in table[0]["judge"]
    assert "blind" in as_text(numbers) and "blind" in numbers._repr_html_()
    wiw.judge(run, Fixed(3), progress=False)
    (blind,) = load_run(run, judge="fixed3").numbers().baselines
    assert blind.estimates["answer_score"].value == 50


def test_share_answered_grounding_and_metres_are_shown(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", make_episodes(QUESTIONS, SCENES), ARMS)
    with sqlite3.connect(store_path(run)) as store:
        store.execute("UPDATE outcome SET metrics = json_remove(metrics, '$.grounded') WHERE episode = 5")
    numbers = load_run(run).numbers()
    estimates = numbers["warp"].estimates
    assert estimates["answered"].value == pytest.approx(100 * 5 / 6)
    assert estimates["path_length"].value == pytest.approx(np.mean([8, 8, 16, 8, 8, 8]))
    assert estimates["grounded"].n == 5 and numbers.difference("warp", "none", "grounded").estimate.n == 5
    assert "Grounded: over the episodes for which it is known, at least 5 of 6" in " ".join(as_text(numbers).split())


def test_the_judge_is_named_and_approximate_marks_are_marked(run: Path) -> None:
    log = load_run(run)
    own = log.store.judge
    assert own is not None
    for shown in (as_text(log.numbers()), log.numbers()._repr_html_(), log.report().read_text()):
        assert "rules+approximate" in shown and own.digest in shown
        assert "≈ Score" in shown and "≈ SPL" in shown and "≈ Answered" not in shown
        assert "1 of none, 1 of warp" in " ".join(shown.split()), "one question has free text"
    typed = [question for question in QUESTIONS if question.answer_type != "text"]
    arms = {arm: ends[: len(typed)] for arm, ends in ARMS.items()}
    exact = load_run(write_run(run.parent / "typed", make_episodes(typed, SCENES[: len(typed)]), arms))
    assert "≈" not in as_text(exact.numbers()) and "Marks by judge" in as_text(exact.numbers())


def test_unlike_judges_are_not_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    episodes = make_episodes(QUESTIONS, SCENES)
    ours, theirs = write_run(tmp_path / "a", episodes, ARMS), write_run(tmp_path / "b", episodes, ARMS, Fixed(4))
    with pytest.raises(StoreError, match=r"judge is .rules\+approximate.*fixed4.*different judges.*wiw judge"):
        wiw.compare(ours, theirs)
    wiw.judge(ours, Fixed(4), progress=False)
    with pytest.raises(StoreError, match="both have marks by fixed4"):
        wiw.compare(ours, theirs)
    with pytest.raises(StoreError, match="different judges"):
        wiw.compare(load_run(ours), load_run(ours, judge="fixed4"), arm="none", other="warp")
    found = wiw.compare(ours, theirs, judge="fixed4")
    assert found.difference("warp · b", "warp · a", "answer_score").estimate.value == 0
    assert found.marks is not None and found.marks.judge.name == "fixed4" and "fixed4" in str(found)
    assert [each.base for each in found.breakdowns if each.base] == ["none · a", "warp · a"]
    with pytest.raises(ArgumentError, match="no marks by it"):
        wiw.compare(ours, theirs, judge="rules")
    assert main(["compare", str(ours), str(theirs)]) == 2 and "different judges" in capsys.readouterr().err
    assert main(["compare", str(ours), str(theirs), "--judge", "fixed4"]) == 0
    assert "Marks by judge fixed4" in capsys.readouterr().out


def test_report_view_and_export_take_a_judge(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    judged = wiw.judge(run, Fixed(5), progress=False).judge
    assert main(["report", str(run), "--judge", "fixed5"]) == 0
    shown = capsys.readouterr().out
    assert "marks by fixed5" in shown and "≈" not in shown
    assert judged.digest in (run / "report.html").read_text()
    assert main(["report", str(run), "--judge", "nobody"]) == 2
    assert main(["view", str(run), "--judge", judged.digest]) == 0
    assert f"Marks by judge fixed5, {judged.digest}." in (run / "view" / "index.html").read_text()
    assert main(["export", str(run), "--csv", str(tmp_path / "csv"), "--judge", "fixed5"]) == 0
    assert "100.0" in (tmp_path / "csv" / "anytime.csv").read_text()


def test_exports_have_all_tables_and_the_judgements_of_all_judges(run: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    judged = wiw.judge(run, Fixed(2), progress=False).judge
    load_run(run).export(parquet=tmp_path / "tables")
    read = {path.stem: parquet.read_table(path).to_pylist() for path in (tmp_path / "tables").iterdir()}
    assert {"kinds", "anytime", "anytime_differences", "twins", "judgements"} <= set(read)
    rows = [row for row in read["judgements"] if row["arm"] == "warp" and row["episode"] == 1]
    marks = {(row["judge"] == judged.digest, row["answered_by"]): (row["answer"], row["mark"]) for row in rows}
    assert marks[False, "agent"] == ("red", 5) and marks[True, "agent"] == ("red", 2)
    assert marks[False, "blind"] == ("white", 1) and marks[True, "blind"] == ("white", 2)
    assert read["judgements"] == tables(load_run(run))["judgements"]


def test_runs_that_do_not_say_what_their_tables_show_have_what_their_task_says_now(run: Path) -> None:
    with sqlite3.connect(store_path(run)) as store:
        store.execute("UPDATE run SET info = json_remove(info, '$.tables')")
    assert ("warp", "250", "answer_score") in cells(run, "anytime")


def test_the_page_speaks_of_answers(run: Path) -> None:
    page = load_run(run).report().read_text()
    about = page[page.index('id="about"') :]
    assert "Actions" not in about and "Mean mark of the answers" in about and "shortest walk" in about
    assert page.count("<svg") >= 4 and "Score by budget" in page and "Gain over none by budget" in page
    assert "Counterfactual twins" in page and "Score by category" in page
