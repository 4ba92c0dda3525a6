# SPDX-License-Identifier: Apache-2.0
"""Marks by typed rules: what kind of answer a question has decides how an answer is compared with it.

| type | 5 | 4 | 3 | 2 |
|---|---|---|---|---|
| yes_no | same polarity | | | |
| count | same number | | | off by one |
| color | same colour | shade of it | adjacent hue, another shade | |
| category, material | same or synonym | broader or narrower | | same group |
| state | same | | | in between |
| place | anchor and room | anchor | room | wrong anchor of the right category |

Everything else is 1. The best mark over all right answers counts. An answer that lists several things gets the mean of
their marks, rounded down, so that listing everything does not help.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from wiw.errors import JudgeError
from wiw.judging.judge import HIGHEST_MARK, LOWEST_MARK, Judge, Judgement, Reference
from wiw.judging.normalise import affirms_words, find_concepts, find_states, normalise, read_counts, read_polarity
from wiw.judging.places import mark_place, names_place
from wiw.judging.vocabulary import Concept, Kind, Relation, load_vocabulary

RULES_VERSION = 4
"""Raised when an answer may get another mark than before, beside changes of the vocabulary."""
OFF_BY_ONE_MARK = 2
COLOR_MARKS = {Relation.SAME: 5, Relation.BROADER: 4, Relation.NEAR: 3}
OBJECT_MARKS = {Relation.SAME: 5, Relation.BROADER: 4, Relation.GROUP: 2}
STATE_MARKS = {Relation.SAME: 5, Relation.NEAR: 2}
Rule = Callable[[str, str, str], "int | None"]
"""(question, right answer, answer) to the mark; None if the right answer is beyond the rule."""


class RuleJudge(Judge):
    """Marks answers of known type; questions with free text are beyond it."""

    name = "rules"

    def can_judge(self, reference: Reference) -> bool:
        """Return whether there is a rule for the question's type, and its main answer is of that type."""
        return self._mark(reference, reference.answer, reference.answer) is not None

    def describe(self) -> dict[str, Any]:
        """Return the versions of rules and vocabulary."""
        return {"judge": self.name, "version": RULES_VERSION, "vocabulary": load_vocabulary().digest}

    def _judge_answers(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        return [self._judge_answer(*row) for row in zip(references, answers, strict=True)]

    def _judge_answer(self, reference: Reference, answer: str) -> Judgement | JudgeError:
        if not self.can_judge(reference):
            return JudgeError(
                f"question '{reference.question}': expected an answer type ({reference.answer_type}) that has a "
                f"rule and fits the answer '{reference.answer}'; add a judge for free text, as in 'rules+approximate'",
                "no_rule",
            )
        marks = [self._mark(reference, right, answer) for right in reference.answers]
        return Judgement(max(mark for mark in marks if mark is not None), self.name)

    @staticmethod
    def _mark(reference: Reference, right: str, answer: str) -> int | None:
        rule = RULES.get(reference.answer_type)
        if rule is None:
            return None
        mark = rule(reference.question, right, answer)
        same = mark is not None and normalise(right) == normalise(answer)
        return HIGHEST_MARK if same else mark


def mark_yes_no(question: str, right: str, answer: str) -> int | None:
    """Return 5 for the right polarity, 1 for the other and for answers that say neither."""
    polarity = read_polarity(right, question)
    if polarity is None:
        return None
    return HIGHEST_MARK if read_polarity(answer, question) is polarity else LOWEST_MARK


def mark_count(question: str, right: str, answer: str) -> int | None:
    """Return 5 for the right number, 2 for one that is off by one."""
    number = read_counts(right)
    if len(number) != 1:
        return None
    marks = [
        HIGHEST_MARK if each == number[0] else OFF_BY_ONE_MARK if abs(each - number[0]) == 1 else LOWEST_MARK
        for each in read_counts(answer)
    ]
    return sum(marks) // len(marks) if marks else LOWEST_MARK


def mark_color(question: str, right: str, answer: str) -> int | None:
    """Return the mark of a colour, or of several."""
    return _mark_concepts(find_concepts(right, ["color"]), find_concepts(answer, ["color"]), COLOR_MARKS)


def mark_material(question: str, right: str, answer: str) -> int | None:
    """Return the mark of a material, or of several."""
    return _mark_named("material", right, answer)


def mark_category(question: str, right: str, answer: str) -> int | None:
    """Return the mark of an object's category."""
    return _mark_named("object", right, answer)


def mark_state(question: str, right: str, answer: str) -> int | None:
    """Return the mark of a state; "not open" is closed."""
    return _mark_concepts(find_states(right), find_states(answer), STATE_MARKS)


RULES: dict[str, Rule] = {
    "yes_no": mark_yes_no,
    "count": mark_count,
    "color": mark_color,
    "material": mark_material,
    "category": mark_category,
    "state": mark_state,
    "place": lambda question, right, answer: (
        mark_place(question, right, answer) if names_place(question, right) else None
    ),
}


def _mark_named(kind: Kind, right: str, answer: str) -> int:
    """Return the mark of concepts of a kind; of words that no concept has, whether the answer says them."""
    known = find_concepts(right, [kind])
    if not known:
        return HIGHEST_MARK if affirms_words(answer, right) else LOWEST_MARK
    return _mark_concepts(known, find_concepts(answer, [kind]), OBJECT_MARKS) or LOWEST_MARK


def _mark_concepts(right: list[Concept], said: list[Concept], marks: Mapping[Relation, int]) -> int | None:
    """Return the mark of concepts: the lower mean of how well the right ones are covered and the answer's are right."""
    if not right:
        return None
    if not said:
        return LOWEST_MARK
    find_relation = load_vocabulary().find_relation
    table = [[marks.get(find_relation(one, other), LOWEST_MARK) for other in said] for one in right]
    covered = sum(max(row) for row in table) / len(right)
    correct = sum(max(column) for column in zip(*table, strict=True)) / len(said)
    return int(min(covered, correct))
