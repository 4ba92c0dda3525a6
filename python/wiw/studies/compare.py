# SPDX-License-Identifier: Apache-2.0
"""Compare two runs episode by episode; runs of different episodes are refused."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from wiw.analysis.breakdowns import find_twins
from wiw.analysis.statistics import adjust_p_values
from wiw.analysis.statistics import compare as compare_arms
from wiw.analysis.stopping import describe_bets, find_units
from wiw.analysis.summary import (
    ArmSummary,
    Group,
    Summary,
    count_unbalanced,
    describe_stop,
    role_of,
    select_metrics,
    split_outcomes,
    summarise,
)
from wiw.analysis.utility import Utility
from wiw.errors import ArgumentError, StoreError
from wiw.loop.config import AgentConfig
from wiw.report.tables import SummaryTable
from wiw.runs.rows import drop_folders, to_json
from wiw.runs.run import find_folder
from wiw.studies.run_log import RunLog, load_run
from wiw.types import Episode

LENGTH_TOLERANCE = 1e-3
"""Metres by which an episode's shortest path may differ between two machines."""

BUDGET_RULES = ("decisions", "actions", "limit", "budget", "execute", "horizon")
"""Rules of tasks that define an episode's budget."""
MOST_NAMED = 5
"""Maximum number of differences between two agents that are listed by name."""


@dataclass(frozen=True)
class Comparison(SummaryTable):
    """The result of `wiw.compare`: the arms of both runs, and the second run minus the first, arm by arm."""

    runs: tuple[str, str] = ("", "")
    """Names of the runs in the table."""
    changed: tuple[str, ...] = ()
    """Differences between the two agents of a row, one sentence each."""

    def groups(self) -> tuple[Group, ...]:
        """Return all differences as one table."""
        first, second = self.runs
        rows: dict[str, dict[str, Any]] = {}
        for one in self.differences:
            label = _label(one.arm.removesuffix(f" · {second}"), one.base.removesuffix(f" · {first}"))
            rows.setdefault(label, {})[one.metric] = one
        title = f"{second} minus {first}, paired by episode"
        return (Group(title, f"Gain of {second} over {first}", f"{second} minus {first}", rows),)

    def remarks(self) -> tuple[str, ...]:
        """Return notes on how to read both runs, and the differences between the agents."""
        return (*super().remarks(), *self.changed)


def compare(
    a: str | Path | RunLog,
    b: str | Path | RunLog,
    arm: str | None = None,
    other: str | None = None,
    *,
    judge: str | None = None,
    unlike_budgets: bool = False,
) -> Comparison:
    """Compare two runs on the same episodes: run b minus run a, for each arm that both have.

        wiw.compare("runs/old", "runs/new")                      # every arm of both runs, under its name
        wiw.compare("runs/a", "runs/b", arm="warp")              # one arm
        wiw.compare("runs/a", "runs/b", arm="warp", other="mine")  # b's "mine" minus a's "warp"

    Args:
        a: a run, or its folder.
        b: the same for the second run.
        arm: arm of run a (and of run b, unless `other` is given); None: all arms that both have, or the only one of
            each.
        other: arm of run b to compare with `arm`.
        judge: name or digest of the judge whose marks are compared (see `wiw.judge`); None for each run's own, or the
            one that a run given as an object was opened with.
        unlike_budgets: whether to compare runs whose episodes have different budgets of decisions or actions; the table
            then says what differs.

    Raises:
        ArgumentError: an arm that does not exist, no common arm, or a judge that has not marked a run.
        StoreError: a run cannot be read, or the two differ in task, seed, episodes or judge: the first field that
            differs.
    """
    with ExitStack() as stack:
        first, second = (_open(run, judge, stack) for run in (a, b))
        return _compare_logs(first, second, arm, other, unlike_budgets)


def _compare_logs(
    first: RunLog, second: RunLog, arm: str | None, other: str | None, unlike_budgets: bool
) -> Comparison:
    pairs = _list_pairs(first, second, arm, other)
    require_comparable(first, second, pairs, unlike_budgets)
    differing = list_unlike_budgets(first, second, pairs)
    unlike = [f"DIFFERENT BUDGETS: {'; '.join(differing)}."] if differing else []
    names = _name_runs(first, second)
    sides = [
        (log, {pair[side]: f"{pair[side]} · {names[side]}" for pair in pairs})
        for side, log in enumerate((first, second))
    ]
    outcomes = [
        {**row, "arm": labels[row["arm"]]} for log, labels in sides for row in log.episodes if row["arm"] in labels
    ]
    labelled = [tuple(labels[arm] for arm, (_, labels) in zip(pair, sides, strict=True)) for pair in pairs]
    seed = int(first.store.config["seed"])
    episodes = first.store.episodes()
    looked_at = any("until" in log.store.info for log in (first, second))
    units = find_units(episodes, outcomes, [label for pair in labelled for label in pair]) if looked_at else None
    both = summarise(
        [label for pair in labelled for label in pair],
        outcomes,
        len(episodes),
        seed,
        tables=first.tables,
        twins=find_twins(episodes),
        judge=first.store.judge,
        pairs=[(theirs, ours) for ours, theirs in labelled],
        units=units,
    )
    done, _ = split_outcomes([line.name for line in both.arms], outcomes)
    found = [
        compare_arms(theirs, ours, done, metric, seed, units)
        for ours, theirs in labelled
        for metric in select_metrics(done)
    ]
    lines = {line.name: line for log, labels in sides for line in _summarise_arms(log, both, labels)}
    return Comparison(
        tuple(lines[line.name] for line in both.arms),
        adjust_p_values([one for one in found if one is not None]),
        both.same_episodes,
        tuple(one for log, labels in sides for one in _list_utilities(log, labels)),
        both.breakdowns,
        both.baselines,
        both.marks,
        names,
        (
            *unlike,
            *(line for pair in pairs for line in _describe_changes(first, second, pair)),
            *_describe_salts(first, second),
        ),
        unbalanced=count_unbalanced(second),
        looks=_describe_looks(first, second, names),
        bets="" if units is None else describe_bets(episodes, units),
    )


def _open(run: str | Path | RunLog, judge: str | None, stack: ExitStack) -> RunLog:
    """Return a run with the marks of a judge; what is opened for it is closed with the stack."""
    if isinstance(run, RunLog) and judge is None:
        return run
    return stack.enter_context(closing(load_run(find_folder(run), judge)))


def _summarise_arms(log: RunLog, both: Summary, labels: Mapping[str, str]) -> list[ArmSummary]:
    """Return the lines of one run's arms, with their roles in it and what it still has to run; `labels` by arm."""
    agents = {one["name"]: one["agent"] for one in log.store.config["arms"]}
    lines = [replace(both[label], role=role_of(arm, agents[arm])) for arm, label in labels.items()]
    episodes = len(log.store.own_episodes())
    return [replace(line, pending=episodes - line.done - line.errors) for line in lines]


def _describe_looks(a: RunLog, b: RunLog, names: tuple[str, str]) -> str:
    """Return which runs a rule was to stop early, and whether it did; empty if none."""
    found = []
    for log, name in zip((a, b), names, strict=True):
        if "until" in (info := log.store.info):
            rule, ended = info["until"]["rule"], describe_stop(log)
            found.append(f"{name} was checked as it ran, to stop once {rule}; it {ended}.")
    return " ".join(found)


def _list_utilities(log: RunLog, labels: Mapping[str, str]) -> list[Utility]:
    """Return the utilities of one run's arms, with its own floor and ceiling."""
    found = log.numbers().utilities
    return [replace(one, arm=labels[one.arm]) for one in found if one.arm in labels]


def require_comparable(
    a: RunLog, b: RunLog, pairs: Sequence[tuple[str, str]] = (), unlike_budgets: bool = False
) -> None:
    """Check that two runs have the same benchmark, task, seed, episodes and budget, so that episodes can be paired.

    Args:
        a: run.
        b: another.
        pairs: arms of both to compare, whose budgets must be equal.
        unlike_budgets: whether budgets may differ.

    Raises:
        StoreError: the first field that differs, with both values and what to do; for budgets all that differ.
    """
    versions = [a.store.benchmark, b.store.benchmark]
    if versions[0] != versions[1]:
        advice = (
            "scores of different versions differ because of the benchmark itself (docs/results.md): rerun the older one"
        )
        _refuse(a, b, "version of the benchmark", versions, advice)
    ours, theirs = a.store.config, b.store.config
    for name in dict.fromkeys([*ours["task"], *theirs["task"]]):
        values = [drop_folders(config["task"].get(name)) for config in (ours, theirs)]
        if values[0] != values[1] and name not in ("judge", *BUDGET_RULES):
            _refuse(a, b, f"task.{name}", values, "rerun one of them with the other's task, scenes and preset")
    if not unlike_budgets and (differing := list_unlike_budgets(a, b, pairs)):
        raise StoreError(
            f"cannot compare {a.path} and {b.path}: their episodes have different budgets: {'; '.join(differing)}. A "
            "larger budget raises success by itself: rerun one of them with the other's budget, or compare them "
            "anyway with --unlike-budgets (unlike_budgets=True) and report both budgets"
        )
    _require_same_judge(a, b)
    if ours["seed"] != theirs["seed"]:
        _refuse(a, b, "seed", [ours["seed"], theirs["seed"]], f"rerun one of them with --seed {ours['seed']}")
    episodes = a.store.episodes(), b.store.episodes()
    if len(episodes[0]) != len(episodes[1]):
        counts = [len(one) for one in episodes]
        _refuse(a, b, "episodes", counts, f"rerun the shorter one with --episodes {max(counts)}")
    for index, pair in enumerate(zip(*episodes, strict=True)):
        _require_same_episode(a, b, index, pair)


def list_unlike_budgets(a: RunLog, b: RunLog, pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Return how the budgets of two runs differ: rules of the task, and actions that arms execute per decision."""
    rules = [log.store.config["task"] for log in (a, b)]
    found = [
        f"task.{name} is {to_json(rules[0].get(name))} in the first and {to_json(rules[1].get(name))} in the second"
        for name in BUDGET_RULES
        if rules[0].get(name) != rules[1].get(name)
    ]
    for pair in pairs:
        executed = [count_executed(log, arm) for log, arm in zip((a, b), pair, strict=True)]
        if None not in executed and executed[0] != executed[1]:
            found.append(f"{_label(pair[1], pair[0])} executes {executed[0]} and {executed[1]} actions per decision")
    return found


def count_executed(log: RunLog, arm: str) -> int | None:
    """Return the maximum number of actions that an arm executes per decision; None for an agent that does not say."""
    built = log.store.info.get("built", {}).get(arm, {})
    if not {"horizon", "execute"} <= built.keys():
        return None
    numbers = AgentConfig(horizon=built["horizon"], execute=built["execute"])
    return numbers.count_executed(built["horizon"])


def _require_same_judge(a: RunLog, b: RunLog) -> None:
    """Check that the marks of both runs are by the same judge, with the same model, prompt and sampling."""
    judges = [log.store.judge for log in (a, b)]
    digests = [None if judge is None else judge.digest for judge in judges]
    if digests[0] != digests[1]:
        known = [{judge.digest: judge for judge in log.store.judges} for log in (a, b)]
        common = [judge.full_label for digest, judge in known[0].items() if digest in known[1]]
        judged = f"both have marks by {common[0]}: choose it with judge= or --judge" if common else ""
        remedy = judged or "judge both with the same judge (`wiw judge`), then choose it with judge= or --judge"
        labels = ["no judge" if judge is None else judge.full_label for judge in judges]
        _refuse(a, b, "judge", labels, f"marks from different judges are not comparable; {remedy}")


def _require_same_episode(a: RunLog, b: RunLog, index: int, pair: tuple[Episode, Episode]) -> None:
    described = [asdict(episode) for episode in pair]
    lengths = [float(one.pop("geodesic")) for one in described]
    for name in described[0]:
        values = [drop_folders(one[name]) for one in described]
        if values[0] != values[1]:
            _refuse(a, b, f"episode {index}: {name}", values, "they ran on different episodes; rerun one of them")
    if all(map(math.isfinite, lengths)) and abs(lengths[0] - lengths[1]) > LENGTH_TOLERANCE:
        advice = "the scene itself has changed (its file or its navigation mesh); rerun one of them"
        _refuse(a, b, f"episode {index}: shortest path", lengths, advice)


def _refuse(a: RunLog, b: RunLog, field: str, values: Sequence[Any], advice: str) -> None:
    raise StoreError(
        f"cannot compare {a.path} and {b.path}: {field} is {to_json(values[0])} in the first and {to_json(values[1])} "
        f"in the second; only runs of the same task, seed, episodes and judge can be paired: {advice}"
    )


def _list_pairs(a: RunLog, b: RunLog, arm: str | None, other: str | None) -> list[tuple[str, str]]:
    if other is not None and arm is None:
        raise ArgumentError(
            f"compare: other='{other}' names an arm of the second run; also name one of the first with arm="
        )
    if arm is not None:
        pair = arm, other or arm
        for log, name in ((a, pair[0]), (b, pair[1])):
            if name not in log.arms:
                raise ArgumentError(f"compare: no arm '{name}' in {log.path}; it has {', '.join(log.arms)}")
        return [pair]
    common = [name for name in a.arms if name in b.arms]
    if common:
        return [(name, name) for name in common]
    if len(a.arms) == len(b.arms) == 1:
        return [(a.arms[0], b.arms[0])]
    raise ArgumentError(
        f"compare: {a.path} has arms {', '.join(a.arms)}, {b.path} has {', '.join(b.arms)}: none in common; name one "
        "of each (arm= and other=, or --arm and --other)"
    )


def _name_runs(a: RunLog, b: RunLog) -> tuple[str, str]:
    """Return the shortest differing ends of the two paths."""
    paths = [log.path.resolve().parts for log in (a, b)]
    if paths[0] == paths[1]:
        return "first", "second"
    for length in range(1, max(map(len, paths)) + 1):
        ends = ["/".join(parts[-length:]) for parts in paths]
        if ends[0] != ends[1]:
            return ends[0], ends[1]
    return str(a.path), str(b.path)


def _label(theirs: str, ours: str) -> str:
    return theirs if theirs == ours else f"{theirs} - {ours}"


def _describe_changes(a: RunLog, b: RunLog, pair: tuple[str, str]) -> list[str]:
    """Return how the two agents differ, by their descriptions and their version of wiw."""
    sides = list(zip((a, b), pair, strict=True))
    built = all(arm in log.store.info.get("built", {}) for log, arm in sides)
    described = [_describe_agent(log, arm, built) for log, arm in sides]
    names = dict.fromkeys([*described[0], *described[1]])
    differing = [name for name in names if described[0].get(name) != described[1].get(name)]
    label = _label(pair[1], pair[0])
    if not differing:
        return [f"{label}: the same agent in both runs."]
    details = [f"{name} {to_json(described[0].get(name))} -> {to_json(described[1].get(name))}" for name in differing]
    more = f", and {len(details) - MOST_NAMED} more" if len(details) > MOST_NAMED else ""
    return [f"{label}: {', '.join(details[:MOST_NAMED])}{more}."]


def _describe_salts(a: RunLog, b: RunLog) -> list[str]:
    """Return that the runs drew different random numbers, if they did."""
    if a.store.salt == b.store.salt:
        return []
    return [
        "The runs have different salts, so policies and world models that draw random numbers drew different ones; to "
        "compare with equal draws, give both runs the same --salt (salt=)."
    ]


def _describe_agent(log: RunLog, arm: str, built: bool) -> dict[str, Any]:
    """Return the agent's flattened description: as built, or else as configured."""
    configured = next(one["agent"] for one in log.store.config["arms"] if one["name"] == arm)
    return {**_flatten(log.store.info["built"][arm] if built else configured), "wiw": log.store.wiw_version}


def _flatten(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, item in value.items():
        key = f"{prefix}{name}"
        found |= _flatten(item, f"{key}.") if isinstance(item, dict) else {key: item}
    return found
