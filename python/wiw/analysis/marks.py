# SPDX-License-Identifier: Apache-2.0
"""Who gave the marks that scores rest on, and the score of answers from the question's text alone."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from wiw.metrics.metric import Metric
from wiw.runs.judges import JUDGE_ERROR, JudgeRecord
from wiw.tasks.answer_record import map_mark, read_blind_judgement, read_end_judgement
from wiw.types import TableSpec

BLIND = "blind"
"""Name of the line of answers from the text alone."""
APPROXIMATE = "≈"
"""Stands before the titles of metrics that rest on approximate marks."""


@dataclass(frozen=True)
class Marks:
    """Whose marks a summary rests on."""

    judge: JudgeRecord
    metrics: tuple[str, ...]
    """Names of the metrics that depend on marks."""
    approximate: Mapping[str, int]
    """Scored episodes per arm with an approximate mark."""
    missing: int
    """Episodes that are an error because the judge gave no mark."""

    @property
    def is_approximate(self) -> bool:
        """Whether any mark is approximate."""
        return any(self.approximate.values())

    def label(self, metric: Metric) -> Metric:
        """Return the metric with a title that says so where it rests on approximate marks."""
        if not self.is_approximate or metric.name not in self.metrics:
            return metric
        return replace(metric, label=f"{APPROXIMATE} {metric.label}")

    def describe(self) -> list[str]:
        """Return sentences that a reader of the scores needs."""
        own = ", the run's own" if self.judge.own else ""
        found = [f"Marks by judge {self.judge.full_label}{own}."]
        if self.is_approximate:
            counts = ", ".join(f"{count} of {arm}" for arm, count in self.approximate.items() if count)
            found.append(
                f"{APPROXIMATE}: with approximate marks: free text is compared only by word overlap ({counts})."
            )
            found.append(
                "Approximate marks have not been shown to agree with people or language models; `wiw judge RUN --llm "
                "URL` uses a language model."
            )
        if self.missing:
            count = "1 episode has" if self.missing == 1 else f"{self.missing} episodes have"
            found.append(f"{count} no mark by this judge: `wiw judge RUN` with it requests the missing marks.")
        return found


def read_marks(
    judge: JudgeRecord | None, outcomes: Iterable[Mapping[str, Any]], arms: Sequence[str], tables: TableSpec
) -> Marks | None:
    """Return whose marks outcomes have; None if no marks are given."""
    if judge is None:
        return None
    approximate, missing = dict.fromkeys(arms, 0), 0
    for outcome in outcomes:
        if outcome["arm"] in approximate:
            done = outcome["status"] == "done"
            approximate[outcome["arm"]] += done and _is_approximate(outcome.get("details", {}))
            missing += not done and outcome["kind"].startswith(JUDGE_ERROR)
    return Marks(judge, tables.judged, approximate, missing)


def answer_blind(
    done: Mapping[str, Mapping[int, Mapping[str, Any]]], cuts: Sequence[int]
) -> dict[int, Mapping[str, Any]]:
    """Return the outcomes of answering from the question's text alone, by episode, where a judge has marked that.

    Such an answer walks nowhere, so it has scores, and no SPL or length.
    """
    found: dict[int, Mapping[str, Any]] = {}
    for ended in done.values():
        for index, outcome in ended.items():
            judgement = read_blind_judgement(outcome.get("details", {}))
            if index in found or judgement is None:
                continue
            score = map_mark(judgement.mark)
            metrics = {"success": float(score == 1), "answer_score": score}
            found[index] = {**outcome, "arm": BLIND, "metrics": metrics | {f"score_at_{cut}": score for cut in cuts}}
    return dict(sorted(found.items()))


def _is_approximate(details: Mapping[str, Any]) -> bool:
    found = (read_end_judgement(details), read_blind_judgement(details))
    return any(each is not None and each.approximate for each in found)
