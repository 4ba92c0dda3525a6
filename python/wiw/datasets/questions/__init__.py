# SPDX-License-Identifier: Apache-2.0
"""Questions about homes: their language, the facts that answer them, episodes that ask them, and published files."""

from wiw.datasets.questions.grammar import ParsedQuestion, parse, phrase
from wiw.datasets.questions.question import ANSWER_TYPES, CATEGORIES, Question

__all__ = ["ANSWER_TYPES", "CATEGORIES", "ParsedQuestion", "Question", "parse", "phrase"]
