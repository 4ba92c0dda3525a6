# SPDX-License-Identifier: Apache-2.0
"""The judges of a run: its own, and those that have marked its answers since; which one's marks are read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wiw.errors import ArgumentError

DIGITS = 12
"""Hexadecimal digits of a digest."""
SHORTEST_PREFIX = 4
"""Digits of a digest that name a judge, where no other begins with them."""
JUDGE_ERROR = "judge/"
"""Prefix of the kinds of a judge's errors."""
NOT_JUDGED = "judge/missing"
"""Kind of an outcome that a judge has not been asked about."""
_SHORT_NAMES = {"rules": "rules+approximate"}
"""Names of judges as they are requested, where they differ from what these call themselves."""
OWN = "own"
"""Names the judge that the run was made with."""


@dataclass(frozen=True)
class JudgeRecord:
    """A judge that has marked answers of a run."""

    description: Mapping[str, Any]
    """All that its marks depend on; marks of judges that differ in it are not comparable."""
    own: bool = False
    """Whether the run was made with it."""

    @property
    def digest(self) -> str:
        """Digest of the description, by which the store names the judge."""
        return digest_judge(self.description)

    @property
    def name(self) -> str:
        """Such as "rules+llm"."""
        return str(self.description.get("judge", ""))

    @property
    def models(self) -> tuple[str, ...]:
        """Names of the language models that it asks."""
        return tuple(dict.fromkeys(_find_models(self.description)))

    @property
    def label(self) -> str:
        """Name with language models, such as "rules+llm (gpt-4o-mini)"."""
        return f"{self.name} ({', '.join(self.models)})" if self.models else self.name

    @property
    def full_label(self) -> str:
        """Label with the digest, which tells apart judges of one name."""
        return f"{self.label}, {self.digest}"


@dataclass(frozen=True)
class JudgedRow:
    """One row of table `judged`: an outcome as a judge marks it."""

    judge: str
    """Digest."""
    arm: str
    episode: int
    metrics: Mapping[str, float]
    details: Mapping[str, Any]
    error: str = ""
    """Why there are no marks; empty if there are."""
    kind: str = ""

    @property
    def status(self) -> str:
        """Either "done", or "error" where the judge gave no mark."""
        return "error" if self.kind else "done"


def digest_judge(description: Mapping[str, Any]) -> str:
    """Return the digest of all that a judge's marks depend on."""
    text = json.dumps(description, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:DIGITS]


def find_judge(judges: Sequence[JudgeRecord], name: str | None, place: str) -> JudgeRecord | None:
    """Return the judge of a name or a digest (its first digits suffice); the run's own for None and "own".

    Args:
        judges: of the run, its own first.
        name: such as "rules+llm", "rules+llm (gpt-4o-mini)" or "3f2a9c01".
        place: the run, for messages.

    Raises:
        ArgumentError: no judge or several of that name; lists those that there are.
    """
    own = next((judge for judge in judges if judge.own), None)
    if name is None or (name == OWN and own is not None):
        return own
    if not judges:
        raise ArgumentError(f"judge '{name}': the outcomes of {place} do not depend on a judge; leave --judge out")
    names = {name, _SHORT_NAMES.get(name, name)}
    found = [judge for judge in judges if names & {judge.name, judge.label, judge.digest}]
    if not found and len(name) >= SHORTEST_PREFIX:
        found = [judge for judge in judges if judge.digest.startswith(name.lower())]
    if len(found) == 1:
        return found[0]
    listed = "; ".join(judge.full_label + (" (the run's own)" if judge.own else "") for judge in judges)
    if found:
        raise ArgumentError(f"judge '{name}': {len(found)} judges of {place} match this name; give a digest: {listed}")
    raise ArgumentError(
        f"judge '{name}': {place} has no marks by it, only by: {listed}. `wiw judge {place}` adds marks"
    )


def apply_judge(
    outcomes: Sequence[dict[str, Any]], judged: Mapping[tuple[str, int], Mapping[str, Any]], judge: JudgeRecord
) -> list[dict[str, Any]]:
    """Return the outcomes with a judge's marks; with errors where it has none.

    The run's own marks stay where it is the judge, and its later ones replace errors of its own.

    Args:
        outcomes: as the run recorded them.
        judged: rows of table `judged` by arm and episode.
        judge: whose marks.
    """
    return [_apply_judge(row, judged.get((row["arm"], row["episode"])), judge) for row in outcomes]


def _apply_judge(row: dict[str, Any], judged: Mapping[str, Any] | None, judge: JudgeRecord) -> dict[str, Any]:
    if not can_be_judged(row) or (judge.own and row["status"] == "done"):
        return row
    if judged is not None:
        return {**row, **judged}
    if judge.own:
        return row
    said = f"not judged yet by {judge.full_label}; `wiw judge RUN` with that judge requests the missing marks"
    return {**row, "status": "error", "metrics": {}, "details": {}, "error": said, "kind": NOT_JUDGED}


def can_be_judged(outcome: Mapping[str, Any]) -> bool:
    """Return whether the episode itself came to its end, and nothing but marks is missing."""
    return bool(
        outcome["status"] == "done" or (outcome["kind"].startswith(JUDGE_ERROR) and "measured" in outcome["details"])
    )


def _find_models(description: Mapping[str, Any]) -> Iterator[str]:
    if description.get("model"):
        yield str(description["model"])
    for tier in description.get("tiers") or ():
        if isinstance(tier, Mapping):
            yield from _find_models(tier)
