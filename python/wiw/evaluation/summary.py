# SPDX-License-Identifier: Apache-2.0
"""The numbers of a run: one line an arm, and each arm against the arms without a (real) world model."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wiw.evaluation.statistics import HEADLINES, Difference, Estimate, Headline, compare, estimate_mean

ROLES = {
    "none": "the policy alone",
    "copy": "the floor, a world where nothing moves",
    "oracle": "the ceiling, the true future",
}
"""What the reference arms stand for; any other arm is a world model under test, or a policy without one."""

MOST_FAILED = 0.01
"""Share of an arm's episodes whose infrastructure may fail before the run counts as invalid."""


@dataclass(frozen=True)
class ArmSummary:
    """One line of the table."""

    name: str
    role: str
    done: int
    """Episodes that count."""
    failed: int
    """Episodes left out because infrastructure failed."""
    pending: int
    """Episodes not run yet."""
    estimates: Mapping[str, Estimate]
    """Over the episodes that count, by metric: "success" and "spl" in percent, "actions" in primitives."""

    @property
    def asked(self) -> int:
        """Episodes of the run, whether they count or not."""
        return self.done + self.failed + self.pending

    @property
    def judged(self) -> str:
        """E.g. "20", or "18/20" where some of those asked do not count."""
        return str(self.done) if self.done == self.asked else f"{self.done}/{self.asked}"


@dataclass(frozen=True)
class Summary:
    """What `RunLog.summary()` returns; shows itself as a table in a terminal and in Jupyter."""

    arms: tuple[ArmSummary, ...]
    differences: tuple[Difference, ...]
    """Each arm minus "none" and minus "copy", on the episodes that both have finished."""
    same_episodes: bool
    """Whether all arms have finished the same episodes, so that their lines can be compared as they stand."""

    @property
    def invalid(self) -> tuple[str, ...]:
        """Why the run must not be quoted, a sentence an arm; empty for a valid run."""
        return tuple(
            f"{line.failed} of {line.asked} episodes of {line.name} failed for infrastructure "
            f"({100 * line.failed / line.asked:.1f} %; at most {100 * MOST_FAILED:g} % may)."
            for line in self.arms
            if line.failed > MOST_FAILED * line.asked
        )

    def __getitem__(self, arm: str) -> ArmSummary:
        """The line of an arm."""
        for line in self.arms:
            if line.name == arm:
                return line
        raise KeyError(f"no arm '{arm}' in this run; it has {', '.join(line.name for line in self.arms)}")

    def difference(self, arm: str, base: str, metric: str = "success") -> Difference:
        """One paired difference."""
        for difference in self.differences:
            if (difference.arm, difference.base, difference.metric) == (arm, base, metric):
                return difference
        raise KeyError(f"no difference of {metric} between '{arm}' and '{base}' in this run")

    def __rich_console__(self, console: Any, options: Any) -> Any:
        from wiw.evaluation.tables import summary_tables

        yield summary_tables(self, options.max_width)

    def _repr_html_(self) -> str:
        from wiw.evaluation.report import summary_html

        return summary_html(self)


def summarise(
    arms: Sequence[str],
    outcomes: Sequence[Mapping[str, Any]],
    episodes: int,
    seed: int = 0,
    policies: Collection[str] = (),
) -> Summary:
    """Numbers of a run.

    Args:
        arms: names in the order of the table.
        outcomes: ended episodes with "arm", "episode", "scene", "status", "metrics".
        episodes: how many the run has.
        seed: of the bootstrap.
        policies: arms that have no world model and differ from "none" by their policy.
    """
    roles = dict.fromkeys(policies, "another policy, alone") | ROLES
    done: dict[str, dict[int, Mapping[str, Any]]] = {arm: {} for arm in arms}
    failed = dict.fromkeys(arms, 0)
    for outcome in outcomes:
        if outcome["status"] == "done":
            done[outcome["arm"]][outcome["episode"]] = outcome
        else:
            failed[outcome["arm"]] += 1
    lines = tuple(_line(arm, roles.get(arm, "world model"), done[arm], failed[arm], episodes, seed) for arm in arms)
    differences = tuple(
        difference
        for base in ("none", "copy")
        for arm in arms
        for headline in _headlines(done)
        if base in arms and arm not in (base, "none") and (difference := compare(arm, base, done, headline, seed))
    )
    return Summary(lines, differences, len({frozenset(ended) for ended in done.values()}) == 1)


def _headlines(done: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> list[Headline]:
    """The columns that every finished episode has a value for."""
    ended = [outcome["metrics"] for arm in done.values() for outcome in arm.values()]
    return [headline for headline in HEADLINES if ended and all(headline.metric in metrics for metrics in ended)]


def _line(
    arm: str, role: str, done: Mapping[int, Mapping[str, Any]], failed: int, episodes: int, seed: int
) -> ArmSummary:
    scenes = [outcome["scene"] for outcome in done.values()]
    estimates = {
        headline.metric: estimate_mean(
            [outcome["metrics"][headline.metric] for outcome in done.values()], scenes, headline, seed=seed
        )
        for headline in _headlines({arm: done})
    }
    return ArmSummary(arm, role, len(done), failed, episodes - len(done) - failed, estimates)


def notes(summary: Summary) -> list[str]:
    """What a reader must know about the numbers, one sentence each."""
    found = [f"{line.name}: {line.role}." for line in summary.arms if line.name in ROLES and len(summary.arms) > 1]
    found = [" ".join(found)] if found else []
    if summary.invalid:
        found.insert(0, f"INVALID RUN, not to be quoted: {' '.join(summary.invalid)} `wiw resume --retry-failed`.")
    found += [_missing(line) for line in summary.arms if line.done < line.asked]
    first = next((estimate for line in summary.arms for estimate in line.estimates.values()), None)
    if first is not None:
        found.append(
            f"95 % intervals: the wider of a bootstrap over {first.scenes} scenes and an interval over episodes."
            if first.scenes > 1
            else f"95 % intervals over episodes of one scene ({first.method})."
        )
    widest = max(
        (line.estimates["success"] for line in summary.arms if "success" in line.estimates),
        key=lambda estimate: estimate.high - estimate.low,
        default=None,
    )
    if widest is not None and widest.high - widest.low > 30:
        found.append(
            f"{widest.n} episodes say little: intervals of SR are up to {widest.high - widest.low:.0f} points wide."
        )
    return found


def _missing(line: ArmSummary) -> str:
    """What the rate could be if nobody had been left out: with every missing episode lost, and with every one won."""
    said = f"{line.name}: {line.done} of {line.asked} episodes asked were judged"
    said += f", {line.failed} failed for infrastructure" if line.failed else ""
    said += f", {line.pending} are still to run" if line.pending else ""
    if "success" not in line.estimates:
        return f"{said}."
    won = line.estimates["success"].value * line.done
    least, most = won / line.asked, (won + 100 * (line.asked - line.done)) / line.asked
    return f"{said}; over all {line.asked}, SR would lie between {least:.1f} and {most:.1f} %."


def show_estimate(estimate: Estimate, signed: bool = False) -> str:
    """E.g. "46.3 [38.9, 54.0]", or "+21.3 [12.8, 29.9]" for a difference."""
    interval = "[?]" if math.isnan(estimate.low) else f"[{estimate.low:.1f}, {estimate.high:.1f}]"
    return f"{estimate.value:{'+.1f' if signed else '.1f'}} {interval}"


def show_p(p_value: float | None) -> str:
    """E.g. "0.012", "<.001", or nothing."""
    if p_value is None:
        return ""
    return "<.001" if p_value < 0.001 else f"{p_value:.3f}"


def shown_headlines(summary: Summary) -> list[Headline]:
    """The columns that the summary has numbers for."""
    present = {metric for line in summary.arms for metric in line.estimates}
    return [headline for headline in HEADLINES if headline.metric in present]


def column_title(headline: Headline) -> str:
    """E.g. "SR % ↑"; the arrow points to the better side."""
    arrow = "↑" if headline.higher_is_better else "↓"
    return " ".join(part for part in (headline.label, headline.unit, arrow) if part)
