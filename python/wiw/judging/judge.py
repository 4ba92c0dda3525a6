# SPDX-License-Identifier: Apache-2.0
"""The interface of judges: they compare answers with references and mark them from 1 (wrong) to 5 (right)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from wiw.datasets.questions.question import ANSWER_TYPES
from wiw.errors import ArgumentError, JudgeError
from wiw.judging.words import cut_after_last_period

LOWEST_MARK, HIGHEST_MARK = 1, 5


@dataclass(frozen=True)
class Reference:
    """A question and the answers that count as right.

    Raises:
        ArgumentError: an answer that is empty, or another answer type than those of `ANSWER_TYPES`.
    """

    question: str
    answer: str
    extra_answers: tuple[str, ...] = ()
    answer_type: str = "text"

    def __post_init__(self) -> None:
        object.__setattr__(self, "extra_answers", tuple(self.extra_answers))
        if self.answer_type not in ANSWER_TYPES:
            raise ArgumentError(
                f"question '{self.question}': expected an answer type among {', '.join(ANSWER_TYPES)}, "
                f"got '{self.answer_type}'"
            )
        if not all(is_answer(text) for text in self.answers):
            raise ArgumentError(f"question '{self.question}': expected answers with words, got {list(self.answers)}")

    @property
    def answers(self) -> tuple[str, ...]:
        """All right answers, the main one first."""
        return (self.answer, *self.extra_answers)


@dataclass(frozen=True)
class Judgement:
    """A mark, and what it depends on.

    Raises:
        ArgumentError: the mark is not a whole number from 1 to 5.
    """

    mark: int
    judge: str
    """Name of the judge that gave it."""
    approximate: bool = False
    """Whether it compares words only; such marks do not replace rules or a language model."""
    model: str = ""
    prompt_digest: str = ""
    reply: str = ""
    """The language model's raw reply."""
    unanswered: bool = False
    """Whether there was no answer; the mark is the lowest then."""
    seed: int | None = None
    """Sampling setting of the language model; None without one."""
    temperature: float | None = None

    def __post_init__(self) -> None:
        if isinstance(self.mark, bool) or not isinstance(self.mark, int) or not 1 <= self.mark <= HIGHEST_MARK:
            raise ArgumentError(f"judgement: expected a mark from 1 to 5, got {self.mark!r}")

    def to_info(self) -> dict[str, Any]:
        """Return a JSON-able form; `from_info` is the inverse."""
        return asdict(self)

    @classmethod
    def from_info(cls, info: Mapping[str, Any]) -> Judgement:
        """Restore a judgement from its JSON-able form."""
        return cls(**info)


class Judge(ABC):
    """Marks answers."""

    name: str
    """Name in judgements and tables."""

    @property
    def concurrency(self) -> int:
        """How many answers are best judged at a time, each in its own thread."""
        return 1

    def judge(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement]:
        """Return one judgement per answer, in order.

        Raises:
            ArgumentError: another number of answers than of references.
            JudgeError: an answer could not be judged; see `judge_each`, which keeps the judgements of the others.
            VlmError: a language model could not be asked.
        """
        outcomes = self.judge_each(references, answers)
        for outcome in outcomes:
            if isinstance(outcome, JudgeError):
                raise outcome
        return [outcome for outcome in outcomes if isinstance(outcome, Judgement)]

    def judge_each(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        """Return one judgement per answer, or the error of an answer that could not be judged.

        Empty answers are unanswered and get the lowest mark without being judged.

        Raises:
            ArgumentError: another number of answers than of references.
            VlmError: a language model could not be asked.
        """
        if len(references) != len(answers):
            raise ArgumentError(f"judge: expected one answer per reference ({len(references)}), got {len(answers)}")
        rows = [(ref, cut_after_last_period(answer).strip()) for ref, answer in zip(references, answers, strict=True)]
        given = [place for place, (_, answer) in enumerate(rows) if is_answer(answer)]
        outcomes: list[Judgement | JudgeError] = [Judgement(LOWEST_MARK, self.name, unanswered=True) for _ in rows]
        marked = self._judge_answers([rows[place][0] for place in given], [rows[place][1] for place in given])
        for place, outcome in zip(given, marked, strict=True):
            outcomes[place] = outcome
        return outcomes

    def can_judge(self, reference: Reference) -> bool:
        """Return whether this judge marks answers to a question."""
        return True

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return a JSON-able identity: everything that marks depend on. Marks of unlike judges are not comparable."""

    @abstractmethod
    def _judge_answers(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        """Return the outcome of answers that are not empty."""


class TieredJudge(Judge):
    """Leaves each question to the first of several judges that can judge it.

    Raises:
        ArgumentError: no judges.
    """

    def __init__(self, tiers: Sequence[Judge]) -> None:
        if not tiers:
            raise ArgumentError("judge: expected at least one judge, got none")
        self.tiers = tuple(tiers)
        self.name = "+".join(tier.name for tier in self.tiers)

    @property
    def concurrency(self) -> int:
        """Maximum number of answers judged at the same time, over the judges."""
        return max(tier.concurrency for tier in self.tiers)

    def can_judge(self, reference: Reference) -> bool:
        """Return whether one of the judges can."""
        return any(tier.can_judge(reference) for tier in self.tiers)

    def describe(self) -> dict[str, Any]:
        """Return the identities of all judges, first to last."""
        return {"judge": self.name, "tiers": [tier.describe() for tier in self.tiers]}

    def _judge_answers(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        chosen = [self._choose_tier(reference) for reference in references]
        outcomes: dict[int, Judgement | JudgeError] = {}
        for tier in self.tiers:
            places = [place for place, judge in enumerate(chosen) if judge is tier]
            marked = tier.judge_each([references[k] for k in places], [answers[k] for k in places])
            outcomes |= dict(zip(places, marked, strict=True))
        return [outcomes[place] for place in range(len(references))]

    def _choose_tier(self, reference: Reference) -> Judge:
        """Return the first judge that can judge a question; the last one says why it cannot."""
        return next((tier for tier in self.tiers if tier.can_judge(reference)), self.tiers[-1])


def is_answer(text: str) -> bool:
    """Return whether a text says anything: it has a letter or a digit."""
    return any(character.isalnum() for character in text)
