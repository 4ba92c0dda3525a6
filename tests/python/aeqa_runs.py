# SPDX-License-Identifier: Apache-2.0
"""Stored runs of question answering, written without running anything: what judges and tables are tested with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from wiw.datasets.questions import Question
from wiw.errors import JudgeError
from wiw.judging import Judge, make_judge
from wiw.runs.rows import OutcomeRow
from wiw.runs.store import RunStore
from wiw.tasks.aeqa import AEQA
from wiw.tasks.answer_record import AnswerRecord
from wiw.types import Episode, EpisodeResult

BLIND = "white"
"""The answer from the text alone, of all questions here."""


@dataclass(frozen=True)
class Ended:
    """How an arm ended an episode; an empty answer is none."""

    answer: str = ""
    primitives: int = 250
    path_length: float = 8.0
    grounded: float = 1.0


def color_question(answer: str, category: str = "attribute recognition", twin: str = "") -> Question:
    return Question("What color is the sofa?", answer, category, "color", twin=twin)


def free_question(answer: str) -> Question:
    return Question("Why is the room dark?", answer, "world knowledge", "text")


def make_episodes(questions: Sequence[Question], scenes: Sequence[str]) -> list[Episode]:
    return [
        Episode(
            f"q{index}",
            scene,
            (0.0, 0.0, 0.0),
            0.0,
            (1.0, 0.0, 0.0),
            0.0,
            4.0 + index % 5,
            {"question": question.to_info(), "task": question.category, "instruction": question.text},
        )
        for index, (question, scene) in enumerate(zip(questions, scenes, strict=True))
    ]


def write_run(
    folder: Path,
    episodes: Sequence[Episode],
    arms: Mapping[str, Sequence[Ended]],
    judge: str | Judge = "rules",
    **rules: Any,
) -> Path:
    """Write a run whose arms ended the episodes so, marked by a judge."""
    made, task = make_judge(judge), AEQA("apartments:val", judge=judge, **rules)
    described = [
        {"name": arm, "agent": {"policy": "explorer", "model": None if arm == "none" else arm}} for arm in arms
    ]
    config = {"task": task.describe(), "seed": 0, "episodes": len(episodes), "arms": described}
    info = {
        "platform": {},
        "task": None,
        "agents": dict.fromkeys(arms),
        "pictures": [],
        "live": 1,
        "workers": 1,
        "limits": {},
        "wording": asdict(task.wording),
        "tables": asdict(task.tables),
        "command": ["wiw", "run"],
        "scenes": {},
    }
    with RunStore.create(folder, config, info, episodes) as store:
        for arm, ends in arms.items():
            for index, (episode, end) in enumerate(zip(episodes, ends, strict=True)):
                store.write(OutcomeRow(arm, _result(made, task, index, episode, end)))
    return folder


def _result(made: Judge, task: AEQA, index: int, episode: Episode, end: Ended) -> EpisodeResult:
    question = Question.from_info(episode.info["question"])
    measured = {
        "path_length": end.path_length,
        "shortest": episode.geodesic,
        "primitives": float(end.primitives),
        "answered": float(bool(end.answer)),
        "grounded": end.grounded,
        "decisions": 4.0,
    }
    record = AnswerRecord(question, end.answer, BLIND, task.rules.unanswered, measured)
    found = made.judge_each([record.reference] * len(record.answers), record.answers)
    pairs = dict(zip(record.answers, found, strict=True))
    judgements = {answer: each for answer, each in pairs.items() if not isinstance(each, JudgeError)}
    facts = (index, episode.episode_id, episode.scene)
    if len(judgements) < len(pairs):
        error = next(each for each in found if isinstance(each, JudgeError))
        return EpisodeResult(
            *facts, "error", {}, 1.0, f"JudgeError: {error}", f"judge/{error.kind}", record.describe(judgements)
        )
    return EpisodeResult(*facts, "done", record.compute_metrics(judgements), 1.0, details=record.describe(judgements))
