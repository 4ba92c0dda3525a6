# SPDX-License-Identifier: Apache-2.0
"""How marks become the metrics of a question, for an episode that has just ended and for a stored one alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from wiw.datasets.questions import Question
from wiw.errors import ArgumentError, StoreError
from wiw.judging import Judgement, Reference
from wiw.judging.judge import HIGHEST_MARK, LOWEST_MARK
from wiw.metrics import path_efficiency

CUTS = (30, 60, 120, 250)
"""Primitives after which the anytime curve looks at what has been answered."""
MARK_METRICS = ("success", "mark", "answer_score", "spl", *(f"score_at_{cut}" for cut in CUTS))
"""Metrics of an episode that depend on marks."""
Unanswered = Literal["blind", "blind_with_path", "lowest"]
"""Mark of an episode without a final answer: that of the answer by the text alone, with an SPL of 0 or with the path's,
or 1."""


@dataclass(frozen=True)
class AnswerRecord:
    """An episode of question answering at its end, before its answers are judged."""

    question: Question
    answer: str
    """The final answer; empty without one."""
    blind: str
    """The best guess from the question's text alone."""
    unanswered: Unanswered
    measured: Mapping[str, float]
    """Metrics that no mark changes, "path_length", "primitives" and, where it is known, "shortest" (L*) among them."""

    @property
    def reference(self) -> Reference:
        """The reference that answers are compared with."""
        return make_reference(self.question)

    @property
    def answers(self) -> tuple[str, ...]:
        """The different answers to be judged: the agent's, if it gave one, and the one from the text alone."""
        return tuple(dict.fromkeys(text for text in (self.answer, self.blind) if text))

    def require_whole(self) -> None:
        """Check that there is all that metrics are computed from.

        Raises:
            KeyError: a metric is missing.
            TypeError: one is not a number, or an answer is not text.
        """
        known = ("shortest",) if "shortest" in self.measured else ()
        for name in ("path_length", "primitives", *known):
            if not isinstance(self.measured[name], int | float):
                raise TypeError(f"number {name}")
        if not isinstance(self.answer, str) or not isinstance(self.blind, str):
            raise TypeError("answer in words")

    def compute_metrics(self, judgements: Mapping[str, Judgement]) -> dict[str, float]:
        """Return all metrics of the episode; see `wiw.tasks.aeqa.AEQA.measure`.

        Args:
            judgements: of all `answers`, by answer.
        """
        end, blind = self.select_judgement(judgements), judgements[self.blind]
        score, walk = map_mark(end.mark), self.measured
        without = 0.0 if self.unanswered == "lowest" else map_mark(blind.mark)
        in_time = {cut: bool(self.answer) and walk["primitives"] <= cut for cut in CUTS}
        return {
            "success": float(bool(self.answer) and end.mark == HIGHEST_MARK),
            "mark": float(end.mark),
            "answer_score": score,
            **self._weigh_by_path(score),
            **walk,
            **{f"score_at_{cut}": score if in_time[cut] else without for cut in CUTS},
        }

    def _weigh_by_path(self, score: float) -> dict[str, float]:
        """Return the episode's contribution to SPL; nothing where L* is not known."""
        if "shortest" not in self.measured:
            return {}
        counts = bool(self.answer) or self.unanswered == "blind_with_path"
        walk = [self.measured["shortest"]], [self.measured["path_length"]]
        return {"spl": float(path_efficiency([score if counts else 0.0], *walk)[0])}

    def select_judgement(self, judgements: Mapping[str, Judgement]) -> Judgement:
        """Return the judgement of the final answer, or what the rules put in its place."""
        if self.answer:
            return judgements[self.answer]
        blind = judgements[self.blind]
        return replace(blind, mark=LOWEST_MARK) if self.unanswered == "lowest" else blind

    def describe(self, judgements: Mapping[str, Judgement]) -> dict[str, Any]:
        """Return the answers with what is known of their judgements, as the details of an outcome.

        Where a judgement is missing, there are no metrics, and "measured" has those that do not depend on marks.
        """
        whole = all(answer in judgements for answer in self.answers)
        judged = judgements.get(self.answer) if self.answer else None
        found = self.select_judgement(judgements) if whole else judged
        return {
            "answer": self.answer,
            "expected": self.question.answer,
            "judgement": None if found is None else found.to_info(),
            "blind": {
                "answer": self.blind,
                "judgement": judgements[self.blind].to_info() if self.blind in judgements else None,
            },
            **({} if whole else {"measured": dict(self.measured)}),
        }


def make_reference(question: Question) -> Reference:
    """Return what answers to a question are compared with."""
    return Reference(question.text, question.answer, question.extra_answers, question.answer_type)


def read_judgements(details: Mapping[str, Any]) -> dict[str, Judgement]:
    """Return the judgements that an outcome's details hold, by answer.

    Raises:
        StoreError: one of them is none.
    """
    blind = _read_mapping(details, "blind")
    pairs = ((details.get("answer"), read_end_judgement(details)), (blind.get("answer"), read_blind_judgement(details)))
    return {str(answer): judgement for answer, judgement in pairs if answer and judgement is not None}


def read_end_judgement(details: Mapping[str, Any]) -> Judgement | None:
    """Return the judgement that an outcome's marks follow from, if its details hold one.

    Raises:
        StoreError: it is none.
    """
    return _read_judgement(_read_mapping(details, "judgement"))


def read_blind_judgement(details: Mapping[str, Any]) -> Judgement | None:
    """Return the judgement of the answer from the text alone, if an outcome's details hold one.

    Raises:
        StoreError: it is none.
    """
    return _read_judgement(_read_mapping(_read_mapping(details, "blind"), "judgement"))


def _read_mapping(values: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Return a mapping within details; an empty one where a task of the user's own has something else there."""
    found = values.get(name)
    return found if isinstance(found, Mapping) else {}


def _read_judgement(info: Mapping[str, Any]) -> Judgement | None:
    try:
        return Judgement.from_info(info) if info else None
    except (TypeError, ArgumentError) as error:
        raise StoreError(
            f"expected a judgement with a mark, got {dict(info)!r:.120} ({error}); the run store was edited: restore "
            "it from a backup"
        ) from error


def map_mark(mark: float) -> float:
    """Return a mark from 1 to 5 as a share (paper, "Answering Score")."""
    return (mark - LOWEST_MARK) / (HIGHEST_MARK - LOWEST_MARK)
