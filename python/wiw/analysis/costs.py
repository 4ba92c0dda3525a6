# SPDX-License-Identifier: Apache-2.0
"""Costs: each arm's requests to its world model, its wall time, and the cost per success."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wiw.runs.run import Run

COLUMNS = (
    ("decisions", "Decisions per episode."),
    ("consulted", "Decisions per episode that consulted the world model."),
    ("rollouts", "Imagined futures per episode, from the model or the cache."),
    ("frames", "Frames of these rollouts."),
    ("calls", "Batches per episode sent to the model; a batch is divided among the episodes that share it."),
    ("cached", "Share of the rollouts from the cache."),
    (
        "tokens",
        "Tokens per episode read and written by a language model; ≥ where a server did not count some.",
    ),
    ("model s", "Seconds per episode inside the world model."),
    ("all s", "Seconds per episode, all stages."),
    ("rollouts / success", "Rollouts of the arm divided by its successes."),
    ("s / success", "Seconds of the arm divided by its successes."),
)
"""Columns of the table and their meaning."""
PRICE_COLUMN = (
    "$",
    "Dollars per episode for language models with known prices (--vlm-prices); ≥ where a model has none, or a server "
    "did not count some tokens.",
)
"""Further column, where any price is known."""
LOST_COLUMNS = (
    ("lost calls", "Calls per episode for decisions that were interrupted by an error; not counted in other columns."),
    ("lost s", "Seconds per episode on them."),
)
"""Further columns, where anything was lost."""


@dataclass(frozen=True)
class Costs:
    """One arm's totals over the decisions of its ended episodes."""

    arm: str
    episodes: int
    """Ended episodes, scored or not: one with an error counts with its costs until then."""
    successes: float
    decisions: int
    calls: Mapping[str, float]
    """Requested: consultations, rows (rollouts), frames. A function of the decisions alone."""
    spent: Mapping[str, float]
    """Spent: calls of the model with their rows and frames, retries, cached_rows, vlm_tokens and vlm_usd, credits of a
    service."""
    seconds: Mapping[str, float]
    """Wall time by stage; it depends on the machine and on what else ran."""
    lost: Mapping[str, float] = field(default_factory=dict)
    """Spent on decisions that were interrupted by an error, as `spent`, and their seconds; in no other figure."""

    @property
    def all_seconds(self) -> float:
        """Wall time of all stages except replays, which only serve measurement."""
        return sum(seconds for stage, seconds in self.seconds.items() if stage != "replay")

    def per_success(self, total: float) -> float:
        """Return a total divided by the number of successes; inf if there is none."""
        return total / self.successes if self.successes else math.inf

    def as_dict(self) -> dict[str, Any]:
        """Return totals: `asked_<name>`, `spent_<name>`, `seconds_<stage>`, `lost_<name>`, and two per success."""
        return {
            "arm": self.arm,
            "episodes": self.episodes,
            "successes": self.successes,
            "decisions": self.decisions,
            **{f"asked_{name}": value for name, value in self.calls.items()},
            **{f"spent_{name}": value for name, value in self.spent.items()},
            **{f"seconds_{stage}": value for stage, value in self.seconds.items()},
            **{f"lost_{name}": value for name, value in self.lost.items()},
            "seconds": self.all_seconds,
            "rollouts_per_success": self.per_success(self.calls.get("rows", 0.0)),
            "seconds_per_success": self.per_success(self.all_seconds),
        }

    def cells(self, columns: Sequence[tuple[str, str]]) -> list[str]:
        """Return the cells of these columns, such as `cost_columns` chooses."""
        each = max(1, self.episodes)
        asked, spent = self.calls, self.spent
        rows = asked.get("rows", 0.0)
        at_least = "≥" if spent.get("vlm_uncounted") else ""
        at_least_paid = "≥" if spent.get("vlm_unpriced") else at_least
        found = {
            "decisions": f"{self.decisions / each:.1f}",
            "consulted": f"{asked.get('consultations', 0.0) / each:.1f}",
            "rollouts": f"{rows / each:.1f}",
            "frames": f"{asked.get('frames', 0.0) / each:.1f}",
            "calls": f"{spent.get('calls', 0.0) / each:.1f}",
            "cached": f"{100 * spent.get('cached_rows', 0.0) / rows:.0f} %" if rows else "–",
            "tokens": f"{at_least}{tokens / each:.0f}" if (tokens := spent.get("vlm_tokens", 0.0)) else "–",
            "$": f"{at_least_paid}{spent['vlm_usd'] / each:.4f}" if "vlm_usd" in spent else "–",
            "model s": f"{self.seconds.get('world_model', 0.0) / each:.2f}",
            "all s": f"{self.all_seconds / each:.2f}",
            "rollouts / success": _number(self.per_success(rows)) if rows else "–",
            "s / success": _number(self.per_success(self.all_seconds)),
            "lost calls": f"{self.lost.get('calls', 0.0) / each:.1f}",
            "lost s": f"{self.lost.get('seconds', 0.0) / each:.2f}",
        }
        return [found[title] for title, _ in columns]


def costs(run: Run) -> list[Costs]:
    """Return the costs of each arm of a run; arms without an ended episode are left out."""
    calls, spent, seconds = (run.store.totals(column) for column in ("calls", "spent", "seconds"))
    lost = run.store.sum_lost_costs()
    ended: dict[str, list[float]] = {}
    for outcome in run.store.outcomes():
        ended.setdefault(outcome["arm"], []).append(float(outcome["metrics"].get("success", 0.0)))
    return [
        Costs(
            arm,
            len(ended[arm]),
            sum(ended[arm]),
            int(calls.get(arm, {}).get("decisions", 0)),
            *({name: value for name, value in of.get(arm, {}).items() if name != "decisions"} for of in found),
        )
        for found in [(calls, spent, seconds, lost)]
        for arm in run.arms
        if arm in ended
    ]


def cost_columns(lines: Sequence[Costs]) -> tuple[tuple[str, str], ...]:
    """Return the columns that these arms need."""
    priced = (PRICE_COLUMN,) if any("vlm_usd" in line.spent for line in lines) else ()
    return COLUMNS + priced + (LOST_COLUMNS if any(line.lost for line in lines) else ())


def _number(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.1f}"
