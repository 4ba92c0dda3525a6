# SPDX-License-Identifier: Apache-2.0
"""Beliefs over an episode: the answer at each decision, and the judgement of the last one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wiw.judging.normalise import normalise
from wiw.tasks.answer_record import read_end_judgement
from wiw.types import Episode


@dataclass(frozen=True)
class Belief:
    """The answer at one decision."""

    label: str
    """Empty while the agent believes nothing."""
    confidence: float
    """From 0 to 1."""
    final: bool
    """Whether it was given as the answer, where answers are in words."""
    right: bool
    """Whether it is what was expected, but for its wording; the judge may see it otherwise."""
    lasts: int
    """Decisions in a row with this answer, if this is the first of them; else 0."""

    @property
    def text(self) -> str:
        """E.g. "blue, 85 %, given as the answer"."""
        label = self.label or "nothing"
        return f"{label}, {100 * self.confidence:.0f} %" + (", given as the answer" if self.final else "")


@dataclass(frozen=True)
class Verdict:
    """The judgement of the answer in words that an episode has ended with."""

    answer: str
    """Empty where none was given in time."""
    expected: str
    mark: int
    """1 to 5."""
    judge: str
    """With its model, e.g. "llm (qwen)"."""
    approximate: bool
    reply: str
    """Reply of a language model."""

    @property
    def text(self) -> str:
        """E.g. "answered “blue”, mark 4 of 5"."""
        said = f"answered “{self.answer}”" if self.answer else "no answer"
        return f"{said}, {'approximate ' if self.approximate else ''}mark {self.mark} of 5"


def list_expected(episode: Episode) -> tuple[str, ...]:
    """Return the answers that count as right, the main one first; empty if the task expects none."""
    question = episode.info.get("question")
    if isinstance(question, Mapping):
        return str(question.get("answer", "")), *(str(extra) for extra in question.get("extra_answers", ()))
    category = str(episode.info.get("category", ""))
    return (category,) if category else ()


def list_beliefs(decisions: Sequence[Mapping[str, Any]], expected: Sequence[str]) -> list[Belief | None]:
    """Return what was believed at each decision; None if the task asks for no answer."""
    accepted = {normalise(text) for text in expected}
    labels = [row["answer"]["label"] if row["answer"] else None for row in decisions]
    found: list[Belief | None] = []
    for index, row in enumerate(decisions):
        answer, label = row["answer"], labels[index]
        if label is None:
            found.append(None)
            continue
        first = index == 0 or labels[index - 1] != label
        right = bool(label) and normalise(label) in accepted
        confidence = answer["confidence"] or 0.0
        lasts = _count_same(labels[index:]) if first else 0
        found.append(Belief(label, confidence, bool(answer.get("final")), right, lasts))
    return found


def read_verdict(details: Mapping[str, Any]) -> Verdict | None:
    """Return the judgement that an outcome's details hold; None if the task has no judge."""
    found = read_end_judgement(details)
    if found is None:
        return None
    judge = f"{found.judge} ({found.model})" if found.model else found.judge
    answer, expected = (str(details.get(name, "")) for name in ("answer", "expected"))
    return Verdict(answer, expected, found.mark, judge, found.approximate, found.reply)


def _count_same(labels: Sequence[str | None]) -> int:
    """Return how many labels in a row are the first one."""
    return next((index for index, label in enumerate(labels) if label != labels[0]), len(labels))
