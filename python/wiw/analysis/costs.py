# SPDX-License-Identifier: Apache-2.0
"""The cost ledger: what each arm asked of its world model, how long it took, and what a success came to."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wiw.runs.run import Run

COLUMNS = (
    ("decisions", "Decisions an episode."),
    ("consulted", "Decisions an episode for which the world model was consulted."),
    ("rollouts", "Imagined futures an episode, whether the model or the cache gave them."),
    ("frames", "Frames of them."),
    ("calls", "Batches an episode that the model was asked for; episodes that share one divide it."),
    ("cached", "Share of the rollouts that came from the cache."),
    ("tokens", "Tokens an episode that a language model has read and written."),
    ("model s", "Seconds an episode inside the world model."),
    ("all s", "Seconds an episode, all stages."),
    ("rollouts / success", "All rollouts of the arm over its successes."),
    ("s / success", "All seconds of the arm over its successes."),
)
"""Columns of the table and what they mean."""
LOST_COLUMNS = (
    ("lost calls", "Calls an episode for decisions that failed or were begun again; in no other column."),
    ("lost s", "Seconds an episode on them."),
)
"""The same, where anything was lost."""


@dataclass(frozen=True)
class Costs:
    """One arm's totals over the decisions of its ended episodes."""

    arm: str
    episodes: int
    """That have ended, judged or not: what a failed one had asked for until then counts."""
    successes: float
    decisions: int
    calls: Mapping[str, float]
    """Asked for: consultations, rows (rollouts), frames. A function of the decisions alone."""
    spent: Mapping[str, float]
    """Taken: calls of the model with their rows and frames, retries, cached_rows, vlm_tokens, credits of a service."""
    seconds: Mapping[str, float]
    """Wall time by stage; it depends on the machine and on what else ran."""
    lost: Mapping[str, float] = field(default_factory=dict)
    """Spent on decisions that failed or were begun again, as `spent`, and their seconds; in no other figure."""

    @property
    def all_seconds(self) -> float:
        """Wall time of all stages, but for replays, which only measure."""
        return sum(seconds for stage, seconds in self.seconds.items() if stage != "replay")

    def per_success(self, total: float) -> float:
        """A total over the number of successes; inf where there is none."""
        return total / self.successes if self.successes else math.inf

    def as_dict(self) -> dict[str, Any]:
        """Totals as plain values: `asked_<what>`, `spent_<what>`, `seconds_<stage>`, `lost_<what>`, two a success."""
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

    def cells(self) -> list[str]:
        """The columns of the table, in words, with those of what was lost."""
        each = max(1, self.episodes)
        asked, spent = self.calls, self.spent
        rows = asked.get("rows", 0.0)
        return [
            f"{self.decisions / each:.1f}",
            f"{asked.get('consultations', 0.0) / each:.1f}",
            f"{rows / each:.1f}",
            f"{asked.get('frames', 0.0) / each:.1f}",
            f"{spent.get('calls', 0.0) / each:.1f}",
            f"{100 * spent.get('cached_rows', 0.0) / rows:.0f} %" if rows else "–",
            f"{tokens / each:.0f}" if (tokens := spent.get("vlm_tokens", 0.0)) else "–",
            f"{self.seconds.get('world_model', 0.0) / each:.2f}",
            f"{self.all_seconds / each:.2f}",
            _number(self.per_success(rows)) if rows else "–",
            _number(self.per_success(self.all_seconds)),
            f"{self.lost.get('calls', 0.0) / each:.1f}",
            f"{self.lost.get('seconds', 0.0) / each:.2f}",
        ]


def costs(run: Run) -> list[Costs]:
    """What each arm of a run cost, in the order of its table; arms without an ended episode are left out."""
    calls, spent, seconds = (run.store.totals(column) for column in ("calls", "spent", "seconds"))
    lost = run.store.lost()
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


def print_costs(run: Run) -> None:
    """Prints the ledger; nothing where no episode has ended."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    lines = costs(run)
    if not lines:
        return
    table = Table(title="Costs, an episode", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
    table.add_column("arm", style="bold")
    columns = cost_columns(lines)
    for title, _ in columns:
        table.add_column(title, justify="right")
    for line in lines:
        table.add_row(line.arm, *line.cells()[: len(columns)])
    console = Console()
    Console(width=None if console.is_terminal else max(console.width, 160)).print(table)


def cost_columns(lines: Sequence[Costs]) -> tuple[tuple[str, str], ...]:
    """The columns that these arms need."""
    return COLUMNS + LOST_COLUMNS if any(line.lost for line in lines) else COLUMNS


def _number(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.1f}"
