# SPDX-License-Identifier: Apache-2.0
"""The numbers of a run: one line an arm, and each arm against the arms without a (real) world model."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, reduce
from typing import Any

from wiw.analysis.statistics import Difference, Estimate, adjusted, compare, estimate_mean
from wiw.analysis.utility import CEILING, FLOOR, Utility, utility
from wiw.errors import RegistryError
from wiw.metrics.headlines import SUCCESS, Headline
from wiw.registry import METRICS
from wiw.runs.run import Records, Run

ROLES = {
    "none": "the policy alone",
    "copy": "the floor, a world where nothing moves",
    "oracle": "the ceiling, the true future",
}
"""What the reference arms stand for; any other arm is a world model under test, or a policy without one."""
PLACEBOS = {
    "placebo-shuffled": "placebo, futures of shuffled actions",
    "placebo-swapped": "placebo, futures of another episode",
}
"""Arms that cost what a world model costs and know nothing of the plan; perhaps followed by ":" and its name."""
TELLS = {
    "none": "What imagination adds to the policy alone",
    "copy": "What it adds over a world where nothing moves",
}
"""What a difference to these arms tells."""
WORLD_MODEL, ANOTHER_POLICY = "world model", "another policy, alone"

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
class Group:
    """One table of differences."""

    title: str
    heading: str
    """What it tells, for the report."""
    corner: str
    """Which minus which."""
    rows: Mapping[str, Mapping[str, Difference]]
    """By label of the row, then by metric."""


@dataclass(frozen=True)
class Summary:
    """The numbers of a run, as `RunLog.summary()` shows them."""

    arms: tuple[ArmSummary, ...]
    differences: tuple[Difference, ...]
    """Each arm minus "none" and minus "copy", on the episodes that both have finished."""
    same_episodes: bool
    """Whether all arms have finished the same episodes, so that their lines can be compared as they stand."""
    utilities: tuple[Utility, ...] = ()
    """Where each arm stands between "copy" and "oracle", if the run has both."""
    kinds: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    """Success rates by kind of episode, then by arm, where a task has several kinds."""

    def groups(self) -> tuple[Group, ...]:
        """The differences as tables, one for each base."""
        bases = dict.fromkeys(difference.base for difference in self.differences)
        return tuple(
            Group(f"Difference to {base}, paired by episode", TELLS[base], f"Arm minus {base}", self._rows(base))
            for base in bases
        )

    def _rows(self, base: str) -> dict[str, dict[str, Difference]]:
        rows: dict[str, dict[str, Difference]] = {}
        for difference in self.differences:
            if difference.base == base:
                rows.setdefault(difference.arm, {})[difference.metric] = difference
        return rows

    def remarks(self) -> tuple[str, ...]:
        """What else a reader must know, a sentence each."""
        return ()

    def utility(self, arm: str) -> Utility:
        """Where an arm stands between floor and ceiling."""
        for found in self.utilities:
            if found.arm == arm:
                return found
        raise KeyError(f"no utility of '{arm}' in this run: it needs episodes that arm, copy and oracle have finished")

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
        outcomes: ended episodes with "arm", "episode", "scene", "status", "metrics", and "task" where there are kinds.
        episodes: how many the run has.
        seed: of the bootstrap.
        policies: arms that have no world model and differ from "none" by their policy.
    """
    done, failed = finished(arms, outcomes)
    lines = tuple(_line(arm, role_of(arm, policies), done[arm], failed[arm], episodes, seed) for arm in arms)
    differences = tuple(
        difference for base in ("none", FLOOR) if base in arms for difference in _against(base, arms, done, seed)
    )
    same = len({frozenset(ended) for ended in done.values()}) == 1
    return Summary(lines, differences, same, _utilities(lines, done), _kinds(done, seed))


def summarise_run(run: Run) -> Summary:
    """Return means, intervals and paired differences of a run."""
    config = run.store.config
    policies = [arm["name"] for arm in config["arms"] if arm["agent"].get("model") is None]
    return summarise(run.arms, run.store.outcomes(), len(run.store.episodes()), config["seed"], policies)


def arm_table(run: Run) -> Records:
    """Return the table of arms as plain values: one dict per arm, with `<metric>`, `<metric>_low`, `<metric>_high`.

    "utility" and its ends are there for arms between floor and ceiling, nan where not identifiable.
    """
    summary = summarise_run(run)
    utilities = {found.arm: found for found in summary.utilities}
    lines = []
    for arm in summary.arms:
        line: dict[str, Any] = {"arm": arm.name, "role": arm.role}
        line |= {"n": arm.done, "asked": arm.asked, "failed": arm.failed}
        for metric, estimate in arm.estimates.items():
            line |= {metric: estimate.value, f"{metric}_low": estimate.low, f"{metric}_high": estimate.high}
        if found := utilities.get(arm.name):
            line |= {"utility": found.value, "utility_low": found.low, "utility_high": found.high}
        lines.append(line)
    return Records(lines)


def finished(
    arms: Sequence[str], outcomes: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, dict[int, Mapping[str, Any]]], dict[str, int]]:
    """By arm: episodes that count, by index, with all metrics that can be told; and how many infrastructure failed."""
    known = headlines()
    done: dict[str, dict[int, Mapping[str, Any]]] = {arm: {} for arm in arms}
    failed = dict.fromkeys(arms, 0)
    for outcome in outcomes:
        if outcome["status"] == "done":
            metrics = reduce(lambda told, headline: headline.added(told), known, outcome["metrics"])
            done[outcome["arm"]][outcome["episode"]] = {**outcome, "metrics": metrics}
        else:
            failed[outcome["arm"]] += 1
    return done, failed


def role_of(arm: str, policies: Collection[str] = ()) -> str:
    """What an arm stands for, by its name; `policies` name those without a world model."""
    if arm in ROLES:
        return ROLES[arm]
    placebo = PLACEBOS.get(arm.rpartition("+")[2].partition(":")[0])
    return placebo or (ANOTHER_POLICY if arm in policies else WORLD_MODEL)


def _against(
    base: str, arms: Sequence[str], done: Mapping[str, Mapping[int, Mapping[str, Any]]], seed: int
) -> tuple[Difference, ...]:
    others = [arm for arm in arms if arm not in (base, "none")]
    found = [compare(arm, base, done, headline, seed) for arm in others for headline in headlines_of(done)]
    return adjusted([difference for difference in found if difference is not None])


def _utilities(lines: Sequence[ArmSummary], done: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> tuple[Utility, ...]:
    if FLOOR not in done or CEILING not in done:
        return ()
    others = [line for line in lines if line.name not in (FLOOR, CEILING)]
    found = [utility(line.name, done, reference=not under_test(line.name, line.role)) for line in others]
    return tuple(one for one in found if one is not None)


def _kinds(done: Mapping[str, Mapping[int, Mapping[str, Any]]], seed: int) -> dict[str, dict[str, Estimate]]:
    found: dict[str, dict[str, Estimate]] = {}
    for arm, ended in done.items():
        judged = [o for o in ended.values() if "task" in o and "success" in o["metrics"]]
        for kind in dict.fromkeys(o["task"] for o in judged):
            own = [o for o in judged if o["task"] == kind]
            values, scenes = [o["metrics"]["success"] for o in own], [o["scene"] for o in own]
            found.setdefault(kind, {})[arm] = estimate_mean(values, scenes, SUCCESS, seed=seed)
    return found


def under_test(arm: str, role: str) -> bool:
    """Whether it is a world model with this run's policy; `warp` is what geometry alone gives."""
    return role == WORLD_MODEL and arm != "warp" and "+" not in arm


def headlines() -> tuple[Headline, ...]:
    """All metrics that are known: built-in ones, then those of installed packages that can be loaded."""
    return _headlines_on(tuple(sys.path))


@cache
def _headlines_on(path: tuple[str, ...]) -> tuple[Headline, ...]:
    """Packages are looked for once for each state of `sys.path`: that takes longer than all the numbers of a run."""
    found = []
    for name in METRICS.names():
        try:
            found.append(METRICS.make(name))
        except RegistryError as error:  # a broken package must not hide what a run has shown
            warnings.warn(str(error), RuntimeWarning, stacklevel=2)
    return tuple(found)


def headlines_of(done: Mapping[str, Mapping[int, Mapping[str, Any]]]) -> list[Headline]:
    """The columns that every finished episode has a value for."""
    ended = [outcome["metrics"] for arm in done.values() for outcome in arm.values()]
    return [headline for headline in headlines() if ended and all(headline.metric in metrics for metrics in ended)]


def _line(
    arm: str, role: str, done: Mapping[int, Mapping[str, Any]], failed: int, episodes: int, seed: int
) -> ArmSummary:
    scenes = [outcome["scene"] for outcome in done.values()]
    estimates = {
        headline.metric: estimate_mean(
            [outcome["metrics"][headline.metric] for outcome in done.values()], scenes, headline, seed=seed
        )
        for headline in headlines_of({arm: done})
    }
    return ArmSummary(arm, role, len(done), failed, episodes - len(done) - failed, estimates)


def notes(summary: Summary) -> list[str]:
    """What a reader must know about the numbers, one sentence each."""
    found = [f"{line.name}: {line.role}." for line in summary.arms if line.name in ROLES and len(summary.arms) > 1]
    found = [" ".join(found)] if found else []
    if summary.invalid:
        found.insert(0, f"INVALID RUN, not to be quoted: {' '.join(summary.invalid)} `wiw resume --retry-failed`.")
    found += [_missing(line) for line in summary.arms if line.done < line.asked]
    found += [*_about_intervals(summary), *_about_differences(summary), *_about_utility(summary)]
    found += summary.remarks()
    widest = max(
        (line.estimates["success"] for line in summary.arms if "success" in line.estimates),
        key=lambda estimate: estimate.high - estimate.low,
        default=None,
    )
    if widest is not None and widest.high - widest.low > 30:
        found.append(
            f"So few episodes ({widest.n}) say little: intervals of SR are up to "
            f"{widest.high - widest.low:.0f} points wide."
        )
    return found


def _missing(line: ArmSummary) -> str:
    """What the rate could be if nobody had been left out: with every missing episode lost, and with every one won."""
    said = f"{line.name}: {line.done} of {line.asked} episodes asked were judged"
    said += f", {line.failed} failed for infrastructure" if line.failed else ""
    said += f", {line.pending} still to run" if line.pending else ""
    if "success" not in line.estimates:
        return f"{said}."
    won = line.estimates["success"].value * line.done
    least, most = won / line.asked, (won + 100 * (line.asked - line.done)) / line.asked
    return f"{said}; over all {line.asked}, SR would lie between {least:.1f} and {most:.1f} %."


def _about_intervals(summary: Summary) -> list[str]:
    first = next((estimate for line in summary.arms for estimate in line.estimates.values()), None)
    if first is None:
        return []
    if first.scenes == 1:
        return [f"95 % intervals over episodes of one scene ({first.method}); they say nothing about other scenes."]
    if first.scenes == first.n:
        return [f"95 % intervals: Student's t over {first.n} episodes, each in a scene of its own."]
    few = " So few leave them wide: add scenes, not episodes of the same." if first.scenes < 5 else ""
    return [f"95 % intervals: Student's t over {first.scenes} scenes.{few}"]


def _about_differences(summary: Summary) -> list[str]:
    tested = [difference for difference in summary.differences if difference.p_adjusted is not None]
    return ["p: exact McNemar test of SR, adjusted by Holm for the arms of its table."] if tested else []


def _about_utility(summary: Summary) -> list[str]:
    if not summary.utilities:
        return []
    found = ["U = (SR - copy) / (oracle - copy), on the episodes that all three have finished; Fieller's interval."]
    if any(not one.identifiable for one in summary.utilities):
        found.append("Not identifiable: the interval of oracle - copy holds 0; there is no share to measure.")
    return found


def show_estimate(estimate: Estimate, signed: bool = False) -> str:
    """E.g. "46.3 [38.9, 54.0]", or "+21.3 [12.8, 29.9]" for a difference."""
    interval = "[?]" if math.isnan(estimate.low) else f"[{estimate.low:.1f}, {estimate.high:.1f}]"
    return f"{estimate.value:{'+.1f' if signed else '.1f'}} {interval}"


def show_utility(found: Utility) -> str:
    """E.g. "0.75 [0.58, 0.93]"."""
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]" if found.identifiable else "not identifiable"


def show_p(p_value: float | None) -> str:
    """E.g. "0.012", "<.001", or nothing."""
    if p_value is None:
        return ""
    return "<.001" if p_value < 0.001 else f"{p_value:.3f}"


def shown_headlines(summary: Summary) -> list[Headline]:
    """The columns that the summary has numbers for."""
    present = {metric for line in summary.arms for metric in line.estimates}
    return [headline for headline in headlines() if headline.metric in present]


def column_title(headline: Headline) -> str:
    """E.g. "SR % ↑"; the arrow points to the better side."""
    arrow = "↑" if headline.higher_is_better else "↓"
    return " ".join(part for part in (headline.label, headline.unit, arrow) if part)
