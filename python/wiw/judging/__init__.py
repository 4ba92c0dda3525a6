# SPDX-License-Identifier: Apache-2.0
"""Judges of answers in words: how right is an answer, from 1 to 5?

judge = make_judge("rules+llm:http://localhost:8000/v1#gpt-4o-mini")
(judgement,) = judge.judge([Reference("What color is the sofa?", "red", answer_type="color")], ["a dark red"])
"""

from wiw.judging.approximate import TokenF1Judge
from wiw.judging.judge import Judge, Judgement, Reference, TieredJudge
from wiw.judging.llm import LanguageModelJudge
from wiw.judging.make import make_judge
from wiw.judging.rules import RuleJudge

__all__ = [
    "Judge",
    "Judgement",
    "LanguageModelJudge",
    "Reference",
    "RuleJudge",
    "TieredJudge",
    "TokenF1Judge",
    "make_judge",
]
