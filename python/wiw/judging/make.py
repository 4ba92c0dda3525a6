# SPDX-License-Identifier: Apache-2.0
"""Judges by name, as a task's option or the command line gives them."""

from __future__ import annotations

import re
from typing import Any

from wiw.errors import ArgumentError
from wiw.judging.approximate import TokenF1Judge
from wiw.judging.judge import Judge, TieredJudge
from wiw.judging.llm import LanguageModelJudge
from wiw.judging.rules import RuleJudge

EXPECTED = (
    "rules (typed rules, word overlap for the rest), rules+llm:URL#MODEL (typed rules, a language model for the rest), "
    "llm:URL#MODEL (a language model for all) or approximate (word overlap for all)"
)
_NEXT_TIER = re.compile(r"\+(?=rules\b|llm:|approximate\b)")


def make_judge(spec: Any = "rules", **options: Any) -> Judge:
    """Create the judge of a specification.

    Args:
        spec: "rules", "rules+llm:URL#MODEL", "llm:URL#MODEL", "approximate", or a judge, which is returned as it is.
            URL is an address of `wiw.vlm.connect`; "#MODEL" may be left out where a server offers one model only.
        options: of `LanguageModelJudge`.

    Raises:
        ArgumentError: another specification, or options without a language model.
    """
    if isinstance(spec, Judge):
        return spec
    names = _NEXT_TIER.split(str(spec))
    if options and not any(name.startswith("llm:") for name in names):
        raise ArgumentError(f"judge '{spec}': options {', '.join(options)} are of language models only (llm:URL#MODEL)")
    if len(set(names)) < len(names):
        raise ArgumentError(f"judge '{spec}': expected each judge once; there are {EXPECTED}")
    tiers = [_make_tier(name, str(spec), options) for name in names]
    if names == ["rules"]:
        tiers.append(TokenF1Judge())
    return tiers[0] if len(tiers) == 1 else TieredJudge(tiers)


def _make_tier(name: str, spec: str, options: dict[str, Any]) -> Judge:
    if name == "rules":
        return RuleJudge()
    if name == "approximate":
        return TokenF1Judge()
    kind, _, address = name.partition(":")
    url, _, model = address.partition("#")
    if kind == "llm" and url:
        return LanguageModelJudge(url, model or None, **options)
    raise ArgumentError(f"judge '{spec}': expected {EXPECTED}")
